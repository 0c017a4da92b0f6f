"""The work-group stream primitives: exact against numpy, at every length where tiles begin."""

from unittest.mock import patch

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from raystream import device, groups
from raystream.statistics import STREAM_REDUCTION

TILE = groups.GROUP * groups.ITEMS
PRIME = 10_007
# Around an item, a group, a tile, two tiles, and a tile of tiles, where the recursion deepens.
SHORT = [0, *(n + d for n in (1, 4, groups.GROUP, TILE, 2 * TILE) for d in (-1, 0, 1)), PRIME]
LONG = [TILE**2 - 1, TILE**2, TILE**2 + 1, TILE**2 + TILE + 1]
DTYPES = ["uint32", "int32", "uint64", "int64", "float32"]
PATTERNS = ["all", "none", "alternating", "random", "rare", "last"]
ELEMENTS = [("uint32", ()), ("float32", ()), ("int64", ()), ("uint32", (2,)), ("float32", (4,))]
SENTINEL = 77
# Groups so small that a few elements make many tiles; 1 is all that some CPU devices allow.
SMALL_GROUPS = [1, 4]


@pytest.fixture(autouse=True)
def only_stream_reduction(session):
    """Every launch of a test is timed under the one stage."""
    session.finish()
    yield
    assert set(session.finish()) <= {STREAM_REDUCTION}


def upload(array):
    return device.session().upload(STREAM_REDUCTION, array)


def flags(pattern, n, rng):
    """uint8 flags; any nonzero value counts as set."""
    is_set = {
        "all": np.ones(n, bool),
        "none": np.zeros(n, bool),
        "alternating": np.arange(n) % 2 == 0,
        "random": rng.random(n) < 0.5,
        "rare": rng.random(n) < 1e-3,
        "last": np.arange(n) == n - 1,
    }[pattern]
    return np.where(is_set, rng.choice([1, 2, 128, 255], n), 0).astype(np.uint8)


def numbers(dtype, n, rng):
    """Values of the whole range, and floats of which all sums are exact."""
    if dtype == "float32":
        return rng.integers(-3, 4, n).astype(np.float32)
    return rng.integers(0, 256, n * np.dtype(dtype).itemsize, dtype=np.uint8).view(dtype)


def run_scan(values, inclusive, heads=None):
    """The scan, which must not touch what follows its last element."""
    session = device.session()
    out = upload(np.full(len(values) + 9, SENTINEL, values.dtype))
    heads = None if heads is None else upload(heads)
    groups.scan(session, upload(values), out, inclusive, heads)
    result = out.get()
    assert (result[len(values) :] == SENTINEL).all()
    return result[: len(values)]


def run_reduce(values, keep):
    """The survivors; the rest of the output must stay as it was."""
    session = device.session()
    out, count = upload(np.full_like(values, SENTINEL)), upload(np.array([SENTINEL], np.uint32))
    groups.reduce(session, upload(values), upload(keep), out, count)
    number, result = int(count.get()[0]), out.get()
    assert number == np.count_nonzero(keep)
    assert (result[number:] == SENTINEL).all()
    return result[:number]


def run_sort(keys, values, bits):
    session = device.session()
    device_keys, device_values = upload(keys), None if values is None else upload(values)
    sorted_keys, sorted_values = groups.sort_by_key(session, device_keys, device_values, bits)
    np.testing.assert_array_equal(device_keys.get(), keys)
    if values is None:
        assert sorted_values is None
        return sorted_keys.get(), None
    np.testing.assert_array_equal(device_values.get(), values)
    return sorted_keys.get(), sorted_values.get()


def segmented_sums(values, heads, inclusive):
    """One segment after the other."""
    parts = np.split(values, np.flatnonzero(heads))
    if not inclusive:
        parts = [np.insert(part, 0, 0)[:-1] for part in parts]
    return np.concatenate([np.cumsum(part, dtype=part.dtype) for part in parts])


def assert_scans(values, heads=None):
    for inclusive in (True, False):
        np.testing.assert_array_equal(
            run_scan(values, inclusive, heads),
            segmented_sums(values, np.zeros(len(values)) if heads is None else heads, inclusive),
        )


def assert_sorts(keys, values, bits):
    low = keys & keys.dtype.type((1 << bits) - 1)
    order = np.argsort(low, kind="stable")
    sorted_keys, sorted_values = run_sort(keys, values, bits)
    np.testing.assert_array_equal(sorted_keys, keys[order])
    assert sorted_keys.dtype == keys.dtype
    if values is not None:
        np.testing.assert_array_equal(sorted_values, values[order])
        assert sorted_values.dtype == values.dtype


# --- scan ---


@pytest.mark.parametrize("dtype", DTYPES)
def test_scan_equals_cumsum(dtype, rng):
    for n in SHORT:
        values = numbers(dtype, n, rng)
        sums = np.cumsum(values, dtype=dtype)
        np.testing.assert_array_equal(run_scan(values, True), sums)
        np.testing.assert_array_equal(run_scan(values, False), sums - values)


@pytest.mark.parametrize("n", LONG)
def test_scan_of_long_streams(n, rng):
    for dtype in ("uint32", "int64"):
        values = numbers(dtype, n, rng)
        np.testing.assert_array_equal(run_scan(values, True), np.cumsum(values, dtype=dtype))


def test_scan_of_more_than_16_million_elements(rng):
    values = numbers("uint32", 2**24 + 1, rng)
    sums = np.cumsum(values, dtype=np.uint32)
    np.testing.assert_array_equal(run_scan(values, False), sums - values)


@pytest.mark.parametrize("pattern", PATTERNS)
@pytest.mark.parametrize("dtype", DTYPES)
def test_segmented_scan(dtype, pattern, rng):
    for n in SHORT:
        assert_scans(numbers(dtype, n, rng), flags(pattern, n, rng))


@pytest.mark.parametrize("pattern", ["none", "rare", "last"])
def test_segmented_scan_of_long_streams(pattern, rng):
    n = TILE**2 + 1
    assert_scans(numbers("uint32", n, rng), flags(pattern, n, rng))


@pytest.mark.parametrize("head", [0, 1, TILE - 1, TILE, TILE + 1, 3 * TILE])
def test_a_segment_over_many_tiles(head):
    values, heads = np.ones(5 * TILE, np.uint32), np.zeros(5 * TILE, np.uint8)
    heads[head] = 1
    assert_scans(values, heads)


@pytest.mark.parametrize("n", [1, TILE, PRIME])
def test_scan_in_place(n, session, rng):
    values, heads = numbers("uint32", n, rng), flags("rare", n, rng)
    for flag, inclusive in [(None, True), (None, False), (heads, True), (heads, False)]:
        array = upload(values)
        groups.scan(session, array, array, inclusive, None if flag is None else upload(flag))
        np.testing.assert_array_equal(array.get(), run_scan(values, inclusive, flag))


def test_float_sums_are_accurate_and_do_not_change(rng):
    values = rng.random(100_003, dtype=np.float32)
    sums = run_scan(values, True)
    np.testing.assert_allclose(sums, np.cumsum(values, dtype=np.float64), rtol=1e-5)
    np.testing.assert_array_equal(run_scan(values, True), sums)


def test_infinity_and_nan_stay_in_their_segment(rng):
    n = 3 * TILE
    values, heads = numbers("float32", n, rng), np.zeros(n, np.uint8)
    values[5], values[TILE + 7] = np.nan, np.inf
    heads[[10, TILE + 10]] = 1
    assert_scans(values, heads)


# --- reduce ---


@pytest.mark.parametrize("pattern", PATTERNS)
@pytest.mark.parametrize("dtype, row", ELEMENTS)
def test_reduce_equals_boolean_indexing(dtype, row, pattern, rng):
    for n in SHORT:
        values = numbers(dtype, n * int(np.prod(row)), rng).reshape(n, *row)
        keep = flags(pattern, n, rng)
        np.testing.assert_array_equal(run_reduce(values, keep), values[keep != 0])


@pytest.mark.parametrize("n", LONG)
def test_reduce_long_streams(n, rng):
    values, keep = np.arange(n, dtype=np.uint32), flags("random", n, rng)
    np.testing.assert_array_equal(run_reduce(values, keep), values[keep != 0])


# --- sort ---


@pytest.mark.parametrize("value_dtype", [None, "uint32", "float32", "uint64"])
@pytest.mark.parametrize("key_dtype", ["uint32", "uint64"])
def test_sort_equals_stable_argsort(key_dtype, value_dtype, rng):
    bits = 8 * np.dtype(key_dtype).itemsize
    for n in SHORT:
        values = None if value_dtype is None else np.arange(n).astype(value_dtype)
        assert_sorts(numbers(key_dtype, n, rng), values, bits)


@pytest.mark.parametrize("bits", [0, 1, 3, 4, 5, 8, 31, 32, 33, 63, 64])
def test_sort_by_the_lowest_bits(bits, rng):
    dtypes = ["uint64"] if bits > 32 else ["uint32", "uint64"]
    for dtype in dtypes:
        assert_sorts(numbers(dtype, 3001, rng), np.arange(3001, dtype=np.uint32), bits)


@pytest.mark.parametrize("n", [TILE**2 // 16, TILE**2 // 16 + 1, TILE**2 + 1])
def test_sort_long_streams(n, rng):
    assert_sorts(numbers("uint32", n, rng), np.arange(n, dtype=np.uint32), 8)


@pytest.mark.parametrize("order", ["equal", "ascending", "descending", "two"])
def test_sort_keys_in_order(order):
    n = PRIME
    keys = {
        "equal": np.full(n, 0xFFFFFFFF),
        "ascending": np.arange(n),
        "descending": np.arange(n)[::-1],
        "two": np.arange(n) % 2 * 0x80000000,
    }[order].astype(np.uint32)
    assert_sorts(keys, np.arange(n, dtype=np.uint32), 32)


def test_sort_rows_of_two_words(rng):
    values = np.arange(2 * PRIME, dtype=np.uint32).reshape(-1, 2)
    assert_sorts(numbers("uint32", PRIME, rng), values, 12)


# --- any stream, in tiles of a few elements ---


@settings(max_examples=60, deadline=None)
@given(
    st.sampled_from(SMALL_GROUPS),
    st.lists(st.tuples(st.integers(0, 2**32 - 1), st.integers(0, 2)), max_size=300),
    st.booleans(),
)
def test_any_scan(group, elements, segmented):
    values = np.array([v for v, _ in elements], np.uint32)
    heads = np.array([h for _, h in elements], np.uint8)
    with patch.object(groups, "GROUP", group):
        assert_scans(values, heads if segmented else None)


@settings(max_examples=40, deadline=None)
@given(st.sampled_from(SMALL_GROUPS), st.lists(st.integers(0, 2), max_size=300))
def test_any_reduction(group, keep):
    keep = np.array(keep, np.uint8)
    values = np.arange(len(keep), dtype=np.uint32)
    with patch.object(groups, "GROUP", group):
        np.testing.assert_array_equal(run_reduce(values, keep), values[keep != 0])


@settings(max_examples=40, deadline=None)
@given(
    st.sampled_from(SMALL_GROUPS),
    st.lists(st.integers(0, 2**32 - 1) | st.integers(0, 3), max_size=150),
    st.integers(0, 32),
)
def test_any_sort(group, keys, bits):
    with patch.object(groups, "GROUP", group):
        assert_sorts(np.array(keys, np.uint32), np.arange(len(keys), dtype=np.uint32), bits)


# --- refusals ---


def test_what_cannot_be_processed_is_refused(session):
    bytes_, words = session.empty(3, np.uint8), session.empty(3, np.uint32)
    rows, count = session.empty((3, 3), np.uint32), session.empty(1, np.uint32)
    with pytest.raises(ValueError, match="values: dtype.*'uint32'.*got 'uint8'"):
        groups.scan(session, bytes_, bytes_)
    with pytest.raises(ValueError, match="values: bytes per element: need one of 4, 8, 16, got 12"):
        groups.reduce(session, rows, bytes_, rows, count)
    with pytest.raises(ValueError, match="values: bytes per element: need one of 4, 8, got 12"):
        groups.sort_by_key(session, words, rows, 32)
    with pytest.raises(ValueError, match="keys: dtype.*got 'uint8'"):
        groups.sort_by_key(session, bytes_, None, 8)
