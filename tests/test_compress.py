"""The ray-order stages, each exact against numpy, and all of them against a stable sort."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from raystream import compress, device
from raystream.statistics import COMPRESSION, DECOMPRESSION, SORTING

INVALID = 0xFFFFFFFF
JUNK = 0xDEADBEEF  # in places that mean nothing
# Around the vectors of 16, the 32 work-items per unit and their shares of several vectors.
LENGTHS = [0, 1, 2, 15, 16, 17, 31, 32, 33, 63, 64, 65, 127, 128, 129, 1023, 1024, 1025, 10_007]
LARGE = 100_003
KEYS = ["one", "few", "runs", "alternating", "distinct", "any"]
ACTIVE = ["all", "none", "half", "rare", "first", "last"]


def make_keys(kind, count, rng):
    return {
        "one": lambda: np.full(count, 77),
        "few": lambda: rng.integers(0, 3, count),
        "runs": lambda: np.repeat(rng.integers(0, 50, count), rng.integers(1, 40, count))[:count],
        "alternating": lambda: np.arange(count) % 2,
        "distinct": lambda: rng.permutation(count),
        "any": lambda: rng.integers(0, 2**32, count),
    }[kind]().astype(np.uint32)


def make_active(kind, count, rng):
    places = np.arange(count)
    return {
        "all": lambda: places >= 0,
        "none": lambda: places < 0,
        "half": lambda: rng.random(count) < 0.5,
        "rare": lambda: rng.random(count) < 0.01,
        "first": lambda: places == 0,
        "last": lambda: places == count - 1,
    }[kind]().astype(np.uint8)


def make_rays(count, rng):
    """Rays in no order; some are INVALID and must travel like the others."""
    rays = rng.permutation(count).astype(np.uint32)
    rays[rng.random(count) < 0.1] = INVALID
    return rays


def upload(array, capacity=None):
    """On the device, followed by junk up to `capacity`."""
    padded = np.full(len(array) if capacity is None else capacity, JUNK, np.uint32)
    padded[: len(array)] = array
    return device.session().upload("x", padded)


def upload_flags(flags):
    return device.session().upload("x", flags)


def number(array):
    assert array.shape == (1,) and array.dtype == np.uint32
    return int(array.get()[0])


def chunks_by_numpy(keys):
    """Keys, bases and sizes of the runs of equal keys."""
    heads = np.ones(len(keys), bool)
    heads[1:] = keys[1:] != keys[:-1]
    bases = np.flatnonzero(heads)
    return keys[bases], bases, np.diff(bases, append=len(keys))


def slots_by_numpy(keys, rays, active, bits):
    kept = np.flatnonzero(active)
    order = np.argsort(keys[kept] & np.uint32(2**bits - 1), kind="stable")
    slots = np.full(len(keys), INVALID, np.uint32)
    slots[: len(kept)] = rays[kept[order]]
    return slots


def uploaded_chunks(keys, capacity):
    """Chunks as `compress` makes them, by numpy, with junk behind them."""
    chunk_keys, bases, sizes = chunks_by_numpy(keys)
    arrays = (upload(array, capacity) for array in (chunk_keys, bases, sizes))
    return compress.Chunks(*arrays, upload([len(bases)]))


# --- stage by stage ---


@pytest.mark.parametrize("kind", ACTIVE)
def test_trim_keeps_the_active_pairs_in_order(kind, session, rng):
    for count in [*LENGTHS, LARGE]:
        keys, rays = make_keys("any", count, rng), make_rays(count, rng)
        active = make_active(kind, count, rng)
        arrays = upload(keys), upload(rays), upload_flags(active)
        trimmed_keys, trimmed_rays, kept = compress.trim(session, *arrays)
        assert number(kept) == active.sum()
        assert trimmed_keys.shape == trimmed_rays.shape == (count,)
        np.testing.assert_array_equal(trimmed_keys.get()[: number(kept)], keys[active != 0])
        np.testing.assert_array_equal(trimmed_rays.get()[: number(kept)], rays[active != 0])


@pytest.mark.parametrize("kind", KEYS)
def test_compress_finds_the_runs_of_equal_keys(kind, session, rng):
    for capacity in [*LENGTHS, LARGE]:
        for count in {0, capacity // 3, capacity}:
            keys = make_keys(kind, count, rng)
            chunks = compress.compress(session, upload(keys, capacity), upload([count]))
            chunk_keys, bases, sizes = chunks_by_numpy(keys)
            length = number(chunks.length)
            assert length == len(bases)
            np.testing.assert_array_equal(chunks.keys.get()[:length], chunk_keys)
            np.testing.assert_array_equal(chunks.bases.get()[:length], bases)
            np.testing.assert_array_equal(chunks.sizes.get()[:length], sizes)


@pytest.mark.parametrize("bits", [0, 1, 5, 24, 32])
@pytest.mark.parametrize("kind", KEYS)
def test_sort_orders_the_chunks(kind, bits, session, rng):
    for capacity in [*LENGTHS, LARGE]:
        keys = make_keys(kind, capacity // 2, rng)
        chunk_keys = chunks_by_numpy(keys)[0] & np.uint32(2**bits - 1)
        order = compress.sort(session, uploaded_chunks(keys, capacity), bits)
        expected = np.argsort(chunk_keys, kind="stable")
        np.testing.assert_array_equal(order.get()[: len(expected)], expected)


@pytest.mark.parametrize("kind", KEYS)
def test_decompress_fills_chunk_by_chunk(kind, session, rng):
    for capacity in [*LENGTHS, LARGE]:
        for count in {0, capacity // 3, capacity}:
            keys, rays = make_keys(kind, count, rng), make_rays(count, rng)
            _, bases, sizes = chunks_by_numpy(keys)
            order = rng.permutation(len(bases))
            chunks, trimmed = uploaded_chunks(keys, capacity), upload(rays, capacity)
            arguments = chunks, upload(order, capacity), trimmed, upload([count])
            slots = compress.decompress(session, *arguments).get()
            expected = [rays[bases[c] : bases[c] + sizes[c]] for c in order]
            expected.append(np.full(capacity - count, INVALID, np.uint32))
            np.testing.assert_array_equal(slots, np.concatenate(expected))


# --- all together ---


def assert_coherent(keys, rays, active, bits):
    session = device.session()
    arrays = upload(keys), upload(rays), upload_flags(active)
    slots, num_chunks = compress.coherent_slots(session, *arrays, bits)
    np.testing.assert_array_equal(slots.get(), slots_by_numpy(keys, rays, active, bits))
    assert number(num_chunks) == len(chunks_by_numpy(keys[active != 0])[0])
    for array, host in zip(arrays, (keys, rays, active), strict=True):
        np.testing.assert_array_equal(array.get(), host)


@pytest.mark.parametrize("keys", KEYS)
@pytest.mark.parametrize("active", ACTIVE)
def test_slots_are_in_the_order_of_the_keys(keys, active, rng):
    for count in [*LENGTHS, LARGE]:
        flags = make_active(active, count, rng)
        assert_coherent(make_keys(keys, count, rng), make_rays(count, rng), flags, 32)


# Runs of (key, whether active, length).
RUNS = st.lists(
    st.tuples(st.integers(0, 2**32 - 1), st.booleans(), st.integers(1, 70)), max_size=40
)


@settings(max_examples=100, deadline=None)
@given(RUNS, st.integers(0, 32), st.integers(1, 2**32 - 1))
def test_slots_of_any_runs(runs, bits, modulus):
    lengths = [length for _, _, length in runs]
    keys = np.repeat(np.array([key % modulus for key, _, _ in runs], np.uint32), lengths)
    active = np.repeat(np.array([flag for _, flag, _ in runs], np.uint8), lengths)
    assert_coherent(keys, np.arange(len(keys), dtype=np.uint32), active, bits)


def test_flags_other_than_one_are_active(rng):
    active = rng.choice(np.array([0, 1, 2, 128, 255], np.uint8), 1009)
    assert_coherent(make_keys("few", 1009, rng), make_rays(1009, rng), active, 32)


def test_every_launch_is_filed_under_its_stage(session, rng):
    keys, rays = upload(make_keys("runs", 1009, rng)), upload(make_rays(1009, rng))
    active = upload_flags(make_active("half", 1009, rng))
    session.finish()
    keys, rays, count = compress.trim(session, keys, rays, active)
    chunks = compress.compress(session, keys, count)
    assert list(session.finish()) == [COMPRESSION]
    order = compress.sort(session, chunks, 32)
    assert list(session.finish()) == [SORTING]
    compress.decompress(session, chunks, order, rays, count)
    assert list(session.finish()) == [DECOMPRESSION]
