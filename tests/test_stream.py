"""The public stream primitives: exact against numpy, in every form of input."""

import pathlib

import numpy as np
import pyopencl as cl
import pyopencl.array as cla
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from raystream import device, scan, sort, stream
from raystream import reduce as reduction

LENGTHS = [0, 1, 2, 15, 16, 17, 63, 64, 65, 127, 128, 129, 1000, 4095, 4096, 4097, 10_007, 65_537]
LARGE = 2**24 + 1
PATTERNS = ["all", "none", "alternating", "random", "rare"]
ELEMENTS = {
    "4": np.dtype(np.uint32),
    "8": np.dtype([("node", np.uint32), ("triangle", np.uint32)]),
    "16": np.dtype([("a", np.float64), ("b", np.int32), ("c", np.float32)]),
}
METHODS = list(reduction.METHODS)


def flags(pattern, count, rng):
    return {
        "all": lambda: np.ones(count, bool),
        "none": lambda: np.zeros(count, bool),
        "alternating": lambda: np.arange(count) % 2 == 0,
        "random": lambda: rng.random(count) < 0.5,
        "rare": lambda: rng.random(count) < 0.01,
    }[pattern]()


def elements(dtype, count, rng):
    return rng.integers(0, 256, count * dtype.itemsize, dtype=np.uint8).view(dtype)


def rows_of(array):
    """Elements as rows of bytes, in ascending order: for results without an order."""
    raw = np.frombuffer(array.tobytes(), np.uint8).reshape(len(array), array.dtype.itemsize)
    return raw[np.lexsort(raw.T)]


def assert_reduced(kept, values, keep, method):
    expected = values[keep]
    assert len(kept) == len(expected) and kept.dtype == values.dtype
    if method == "append":
        np.testing.assert_array_equal(rows_of(kept), rows_of(expected))
    else:
        assert kept.tobytes() == expected.tobytes()


# --- reduce ---


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("size", ELEMENTS)
@pytest.mark.parametrize("pattern", PATTERNS)
def test_reduce_equals_boolean_indexing(method, size, pattern, rng):
    for count in LENGTHS:
        values, keep = elements(ELEMENTS[size], count, rng), flags(pattern, count, rng)
        kept, number = stream.reduce(values, keep, method=method)
        assert number == keep.sum()
        assert_reduced(kept, values, keep, method)


@pytest.mark.parametrize("method", ["segmented", "scan", "append"])
def test_reduce_of_a_long_stream(method, rng):
    values, keep = np.arange(LARGE, dtype=np.uint32), rng.random(LARGE) < 0.3
    kept, _ = stream.reduce(values, keep, method=method)
    assert_reduced(np.sort(kept) if method == "append" else kept, values, keep, "scan")


@pytest.mark.parametrize("segment_size", [1, 3, 63, 64, 65, 100_000])
def test_segments_of_any_size(segment_size, rng):
    values, keep = elements(ELEMENTS["8"], 10_007, rng), rng.random(10_007) < 0.4
    kept, _ = stream.reduce(values, keep, segment_size=segment_size)
    assert_reduced(kept, values, keep, "segmented")
    segments, lengths = stream.reduce_segments(values, keep, segment_size)
    for s, length in enumerate(lengths):
        part = slice(s * segment_size, (s + 1) * segment_size)
        expected = values[part][keep[part]]
        assert length == len(expected)
        assert segments[part][:length].tobytes() == expected.tobytes()


def test_rows_and_nonzero_flags(rng):
    values = rng.normal(size=(1009, 2)).astype(np.float32)
    keep = rng.choice(np.array([0, 1, 2, 128, 255], np.uint8), 1009)
    kept, count = stream.reduce(values, keep)
    np.testing.assert_array_equal(kept, values[keep != 0])
    assert count == (keep != 0).sum()


@settings(max_examples=50, deadline=None)
@given(st.lists(st.booleans(), max_size=300), st.sampled_from(METHODS), st.integers(1, 80))
def test_any_flags(keep, method, segment_size):
    keep = np.array(keep, bool)
    values = np.arange(len(keep), dtype=np.uint64)
    kept, _ = stream.reduce(values, keep, method=method, segment_size=segment_size)
    assert_reduced(np.sort(kept) if method == "append" else kept, values, keep, "scan")


# --- scan ---


@pytest.mark.parametrize("dtype", [np.uint32, np.int32, np.uint64, np.int64])
def test_scans_equal_cumsum(dtype, rng):
    for count in LENGTHS:
        info = np.iinfo(dtype)
        values = rng.integers(info.min, info.max, count, dtype=dtype)
        with np.errstate(over="ignore"):
            expected = np.cumsum(values, dtype=dtype)
        inclusive, exclusive = stream.inclusive_scan(values), stream.exclusive_scan(values)
        assert inclusive.dtype == exclusive.dtype == dtype
        np.testing.assert_array_equal(inclusive, expected)
        np.testing.assert_array_equal(exclusive, expected - values)


def test_scan_of_a_long_stream(rng):
    values = rng.integers(0, 2**32, LARGE, dtype=np.uint32)
    expected = np.cumsum(values, dtype=np.uint32)
    np.testing.assert_array_equal(stream.inclusive_scan(values), expected)
    np.testing.assert_array_equal(stream.exclusive_scan(values), expected - values)


def test_float_sums_are_close(rng):
    values = rng.random(100_003).astype(np.float32)
    exact = np.cumsum(values, dtype=np.float64)
    np.testing.assert_allclose(stream.inclusive_scan(values), exact, rtol=1e-4)


def segmented_sums(values, heads):
    """Inclusive sums by numpy: what lies before a segment is taken off again."""
    sums = np.cumsum(values, dtype=values.dtype)
    starts = np.where(heads, np.arange(len(values)), 0)
    last_head = np.maximum.accumulate(starts) if len(values) else starts
    before = np.concatenate([[0], sums]).astype(values.dtype)[last_head]
    return sums - np.where(np.cumsum(heads) > 0, before, 0).astype(values.dtype)


@pytest.mark.parametrize("share", [0.0, 0.001, 0.3, 1.0])
def test_segmented_scans(share, rng):
    for count in LENGTHS:
        values = rng.integers(0, 2**32, count, dtype=np.uint32)
        heads = rng.random(count) < share
        expected = segmented_sums(values, heads)
        np.testing.assert_array_equal(stream.inclusive_scan(values, heads), expected)
        np.testing.assert_array_equal(stream.exclusive_scan(values, heads), expected - values)


# --- sort ---


@pytest.mark.parametrize("key", [np.uint32, np.uint64])
@pytest.mark.parametrize("value", [None, np.uint32, np.float32, np.uint64, np.float64])
def test_sort_is_stable_and_ascending(key, value, rng):
    for count in LENGTHS:
        keys = rng.integers(0, np.iinfo(key).max, count, dtype=key, endpoint=True)
        keys[rng.random(count) < 0.5] = 7  # many equal keys show whether it is stable
        values = None if value is None else np.arange(count).astype(value)
        order = np.argsort(keys, kind="stable")
        sorted_keys, sorted_values = stream.sort_by_key(keys, values)
        np.testing.assert_array_equal(sorted_keys, keys[order])
        assert sorted_keys.dtype == key
        if value is None:
            assert sorted_values is None
        else:
            np.testing.assert_array_equal(sorted_values, values[order])
            assert sorted_values.dtype == value


@pytest.mark.parametrize("bits", [0, 1, 7, 8, 11, 12, 22, 23, 31, 32])
def test_only_the_lowest_bits_count(bits, rng):
    keys = rng.integers(0, 2**32, 10_007, dtype=np.uint32)
    values = np.arange(10_007, dtype=np.uint32)
    order = np.argsort(keys & np.uint32(2**bits - 1), kind="stable")
    sorted_keys, sorted_values = stream.sort_by_key(keys, values, bits=bits)
    np.testing.assert_array_equal(sorted_keys, keys[order])
    np.testing.assert_array_equal(sorted_values, order)


@pytest.mark.parametrize("value", [np.uint32, np.uint64])
@pytest.mark.parametrize("digit_bits", [8, 10, 12])
def test_the_same_order_without_the_keys(digit_bits, value, session, rng):
    for count in LENGTHS:
        keys = rng.integers(0, 2**30, count, dtype=np.uint32)
        keys[rng.random(count) < 0.5] = 7
        order = np.argsort(keys, kind="stable")
        arrays = [session.upload("x", a) for a in (keys, np.arange(count, dtype=value))]
        options = {"digit_bits": digit_bits, "keep_keys": False}
        sorted_keys, sorted_values = sort.sort_by_key(session, *arrays, 30, **options)
        assert sorted_keys is None
        np.testing.assert_array_equal(sorted_values.get(), order)


def test_sort_of_a_long_stream(rng):
    keys = rng.integers(0, 2**32, LARGE, dtype=np.uint32)
    sorted_keys, order = stream.sort_by_key(keys, np.arange(LARGE, dtype=np.uint32))
    np.testing.assert_array_equal(sorted_keys, np.sort(keys))
    np.testing.assert_array_equal(keys[order], sorted_keys)


@settings(max_examples=50, deadline=None)
@given(st.lists(st.integers(0, 2**64 - 1), max_size=200), st.integers(0, 64))
def test_any_keys(keys, bits):
    keys = np.array(keys, np.uint64)
    order = np.argsort(keys & np.uint64(2**bits - 1), kind="stable")
    np.testing.assert_array_equal(stream.sort_by_key(keys, bits=bits)[0], keys[order])


@pytest.mark.parametrize("key", [np.uint32, np.uint64])
@pytest.mark.parametrize("value", [None, np.uint32, np.uint64])
def test_sort_of_a_length_on_the_device(key, value, session, rng):
    for capacity in LENGTHS:
        for length in {0, 1, capacity // 3, capacity} & set(range(capacity + 1)):
            keys = rng.integers(0, 50, capacity, dtype=key)
            values = None if value is None else np.arange(capacity, dtype=value)
            order = np.argsort(keys[:length], kind="stable")
            arrays = [None if a is None else session.upload("x", a) for a in (keys, values)]
            on_device = session.upload("x", np.array([length], np.uint32))
            sorted_keys, sorted_values = sort.sort_by_key(session, *arrays, 32, on_device)
            np.testing.assert_array_equal(sorted_keys.get()[:length], keys[order])
            if value is not None:
                np.testing.assert_array_equal(sorted_values.get()[:length], values[order])


# --- streams larger than the cache ---


@pytest.fixture
def no_cache(monkeypatch):
    """Short streams take the path of those that no cache holds."""
    monkeypatch.setattr(device.Session, "exceeds_cache", lambda _session, nbytes: nbytes > 0)


def test_scan_past_the_cache(no_cache, rng):
    test_scans_equal_cumsum(np.uint32, rng)
    on_device = device.session().upload("x", np.arange(10_007, dtype=np.uint32))
    scan.scan(device.session(), on_device, on_device)  # in place
    expected = np.cumsum(np.arange(10_007)) - np.arange(10_007)
    np.testing.assert_array_equal(on_device.get(), expected)


@pytest.mark.parametrize("key", [np.uint32, np.uint64])
@pytest.mark.parametrize("value", [None, np.uint32, np.float64])
def test_buffered_sort(no_cache, key, value, rng):
    test_sort_is_stable_and_ascending(key, value, rng)


@pytest.mark.parametrize("value", [None, np.uint32, np.uint64])
def test_buffered_sort_of_a_length_on_the_device(no_cache, value, session, rng):
    test_sort_of_a_length_on_the_device(np.uint32, value, session, rng)


@pytest.mark.parametrize("bits", [1, 11, 12, 23, 32])
def test_buffered_sort_of_the_lowest_bits(no_cache, bits, rng):
    test_only_the_lowest_bits_count(bits, rng)


BEYOND = 2**29 + 77  # 32-bit elements: more than 2^31 bytes


def free_memory():
    """Bytes that this process may still take: a container's limit is not in what PoCL reports."""
    meminfo = pathlib.Path("/proc/meminfo")
    if not meminfo.exists():
        return 0  # not known
    lines = meminfo.read_text().splitlines()
    free = 1024 * next(int(line.split()[1]) for line in lines if line.startswith("MemAvailable"))
    limit = pathlib.Path("/sys/fs/cgroup/memory.max")
    text = limit.read_text().strip() if limit.exists() else "max"
    return free if text == "max" else min(free, int(text))


@pytest.fixture
def huge(session):
    """A session whose device takes buffers beyond 2^31 bytes, with memory for five of them."""
    needed = 5 * 4 * BEYOND
    memory = min(session.device.global_mem_size, free_memory())
    if session.device.max_mem_alloc_size < 4 * BEYOND or memory < needed:
        pytest.skip(f"needs buffers of {4 * BEYOND} bytes and {needed} bytes of free memory")
    yield session
    session.trim()


def test_scan_and_reduction_beyond_2_to_31_bytes(huge):
    values, out = (huge.empty(BEYOND, np.uint32) for _ in range(2))
    huge.fill("x", values, 3)
    scan.scan(huge, values, out)
    tail = out[2**29 - 16 :].get()
    np.testing.assert_array_equal(tail, 3 * np.arange(2**29 - 16, BEYOND, dtype=np.uint32))
    keep, total = huge.empty(BEYOND, np.uint8), huge.empty(1, np.uint32)
    huge.fill("x", keep, 0)
    keep[BEYOND - 77 :] = np.ones(77, np.uint8)
    reduction.Reducer(huge, 4).reduce("scan", BEYOND, out, keep, values, total, 4096)
    assert total.get().tolist() == [77]
    np.testing.assert_array_equal(values[:77].get(), tail[-77:])


def test_sort_beyond_2_to_31_bytes(huge):
    keys = huge.empty(BEYOND, np.uint32)
    huge.fill("x", keys, 2)
    keys[BEYOND - 77 :] = np.tile(np.arange(7, dtype=np.uint32), 11)
    sorted_keys, _ = sort.sort_by_key(huge, keys, None, 3)
    assert sorted_keys[:22].get().tolist() == [0] * 11 + [1] * 11
    expected = np.repeat(np.arange(2, 7), 11)
    np.testing.assert_array_equal(sorted_keys[BEYOND - 55 :].get(), expected)


# --- both designs, all forms of input ---


@pytest.fixture(params=["chunks", "groups"])
def design(request, monkeypatch):
    monkeypatch.setattr(stream, "_walks_chunks", lambda _session: request.param == "chunks")
    return request.param


def test_both_designs_behind_the_same_functions(design, rng):
    values, keep = elements(ELEMENTS["8"], 10_007, rng), rng.random(10_007) < 0.4
    assert_reduced(stream.reduce(values, keep)[0], values, keep, "segmented")
    numbers = rng.integers(0, 2**32, 10_007, dtype=np.uint32)
    expected = np.cumsum(numbers, dtype=np.uint32)
    np.testing.assert_array_equal(stream.inclusive_scan(numbers), expected)
    expected = segmented_sums(numbers, keep)
    np.testing.assert_array_equal(stream.inclusive_scan(numbers, keep), expected)
    keys, order = stream.sort_by_key(numbers, np.arange(10_007, dtype=np.uint32), bits=20)
    np.testing.assert_array_equal(order, np.argsort(numbers & 0xFFFFF, kind="stable"))
    np.testing.assert_array_equal(keys, numbers[order])


@pytest.mark.parametrize("own_queue", [False, True])
def test_device_arrays_stay_on_the_device(design, own_queue, session, rng):
    queue = cl.CommandQueue(cl.Context([session.device])) if own_queue else session.queue
    values, keep = elements(ELEMENTS["8"], 5000, rng), rng.random(5000) < 0.4
    numbers = rng.integers(0, 2**32, 5000, dtype=np.uint32)
    on_device = [cla.to_device(queue, a) for a in (values, keep.view(np.uint8), numbers)]
    kept, count = stream.reduce(*on_device[:2])
    assert isinstance(count, cla.Array) and kept.shape == values.shape
    number = int(count.get()[0])
    assert kept.get()[:number].tobytes() == values[keep].tobytes()
    expected = np.cumsum(numbers, dtype=np.uint32)
    np.testing.assert_array_equal(stream.inclusive_scan(on_device[2]).get(), expected)
    keys, payload = stream.sort_by_key(on_device[2], on_device[2])
    np.testing.assert_array_equal(keys.get(), np.sort(numbers))
    np.testing.assert_array_equal(payload.get(), np.sort(numbers))
    np.testing.assert_array_equal(on_device[2].get(), numbers)


def test_nothing_is_kept_in_memory_by_calls(session, rng):
    numbers = session.upload("x", rng.integers(0, 9, 1000, dtype=np.uint32))
    stream.exclusive_scan(numbers)
    assert session.finish() == {}


N = np.arange(4, dtype=np.uint32)
YES = np.ones(4, bool)


@pytest.mark.parametrize(("call", "error", "message"), [
    (lambda: stream.reduce(N, YES, method="fast"), ValueError, "method: need one of 'segmented'"),
    (lambda: stream.reduce(N, YES[1:]), ValueError, r"keep: need shape \(4,\), got \(3,\)"),
    (lambda: stream.reduce(N, N), TypeError, "keep: need dtype bool or uint8, got uint32"),
    (lambda: stream.reduce(N.astype(np.uint16), YES), TypeError, "values: need elements of 4, 8"),
    (lambda: stream.reduce([1, 2], YES), TypeError, "values: need a numpy or pyopencl array"),
    (lambda: stream.reduce(N, YES, segment_size=0), ValueError, "segment_size"),
    (lambda: stream.exclusive_scan(N.astype(np.uint8)), TypeError, "values: need dtype uint32"),
    (lambda: stream.exclusive_scan(N.reshape(2, 2)), ValueError, r"values: need shape \(n,\)"),
    (lambda: stream.exclusive_scan(N, YES[1:]), ValueError, "heads: need shape"),
    (lambda: stream.sort_by_key(N.astype(np.float32)), TypeError, "keys: need dtype uint32"),
    (lambda: stream.sort_by_key(N, N[1:]), ValueError, r"values: need shape \(4,\)"),
    (lambda: stream.sort_by_key(N, N.astype(np.uint8)), TypeError, "values: need elements of 4 or"),
    (lambda: stream.sort_by_key(N, bits=33), ValueError, "bits: need at most 32"),
    (lambda: stream.sort_by_key(N.astype(">u4")), TypeError, "keys: need the machine's byte order"),
])  # fmt: skip
def test_bad_input_is_refused(call, error, message):
    with pytest.raises(error, match=message):
        call()


def test_numpy_and_device_arrays_do_not_mix(session):
    with pytest.raises(TypeError, match="values, keep: need all on the device or none"):
        stream.reduce(session.upload("x", N), YES)
