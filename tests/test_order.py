"""The order of the leaves: along the screen, or by hashes."""

import numpy as np
import pytest
from soup import random_rays

from raystream import device, hash, rays
from raystream.order import hashed_slots, leaf_slots, screen_slots, tiled_slots

INVALID = 0xFFFFFFFF


@pytest.mark.parametrize("size", [(1, 1), (8, 8), (7, 5), (9, 8), (64, 64), (100, 37), (512, 3)])
def test_every_pixel_is_one_leaf(size):
    slots = screen_slots(*size)
    assert len(slots) % 64 == 0
    np.testing.assert_array_equal(np.sort(slots[slots != INVALID]), np.arange(size[0] * size[1]))


@pytest.mark.parametrize("k", [1, 2, 3, 4, 5])
def test_powers_of_four_leaves_are_squares(k):
    y, x = np.divmod(screen_slots(32, 32).reshape(-1, 4**k), 32)
    for axis in (x, y):
        assert (np.ptp(axis, axis=1) == 2**k - 1).all()
        assert (axis.min(axis=1) % 2**k == 0).all()


def test_eight_leaves_are_four_by_two():
    y, x = np.divmod(screen_slots(64, 64).reshape(-1, 8), 64)
    assert (np.ptp(x, axis=1) == 3).all() and (np.ptp(y, axis=1) == 1).all()


@pytest.mark.parametrize("name", hash.HASHES)
@pytest.mark.parametrize("size", [None, (37, 27)])
def test_hashed_slots_are_the_active_rays_in_stable_order_of_their_keys(name, size, session, rng):
    origins, directions = random_rays(rng, 999)
    tfar = np.where(rng.random(999) < 0.2, -1.0, np.inf)
    stream = rays.from_numpy(session, origins, directions, 0.0, tfar)
    stream.size = size
    slots = leaf_slots(session, stream)
    keys, active = (a.get() for a in hash.hash_rays(session, stream, slots, name))
    before = slots.get()
    held = np.isin(before, np.flatnonzero(tfar >= 0))
    np.testing.assert_array_equal(active != 0, held)
    expected = before[held][np.argsort(keys[held], kind="stable")]
    after = hashed_slots(session, stream, slots, name).get()
    np.testing.assert_array_equal(after[: held.sum()], expected)
    assert (after[held.sum() :] == INVALID).all() and len(after) == len(before)


def test_the_order_is_kept_by_the_session(session, rng):
    stream = rays.from_numpy(device.session(), *random_rays(rng, 10), 0.0, np.inf)
    assert leaf_slots(session, stream) is leaf_slots(session, stream)


def tiled(session, directions, tfar=np.inf):
    """The order of rays from one point."""
    origins = np.broadcast_to(np.float32([0.5, 0.25, 4.0]), directions.shape)
    return tiled_slots(session, rays.from_numpy(session, origins, directions, 0.0, tfar)).get()


def picture(rng, width, height, missing):
    """Pixels (n, 2), x and y, of which a share is missing, and what they show of a wavy ground."""
    y, x = np.divmod(np.arange(width * height), width)
    pixels = np.stack((x, y), axis=1)[rng.random(width * height) >= missing]
    x, y = pixels.T / width
    return pixels, np.stack((x, 3 * y, 0.1 * np.sin(9 * x) * y - 4), axis=1).astype(np.float32)


@pytest.mark.parametrize("missing", [0.0, 0.02, 0.1])
@pytest.mark.parametrize("size", [(300, 200), (512, 512), (1000, 300)])
@pytest.mark.parametrize("tfar", [1.0, np.inf])
def test_rows_with_gaps_become_tiles(session, rng, size, missing, tfar):
    pixels, directions = picture(rng, *size, missing)
    slots = tiled(session, directions, tfar)
    np.testing.assert_array_equal(np.sort(slots), np.arange(len(pixels)))
    runs = pixels[slots[: len(slots) // 64 * 64]].reshape(-1, 64, 2)
    width, height = np.median(np.ptp(runs, axis=1), axis=0) + 1
    assert width <= (10 if missing == 0 else 28) and height <= 9


def test_what_is_missing_may_be_in_one_place(session, rng):
    pixels, directions = picture(rng, 512, 400, 0.0)
    there = np.abs(pixels - (300, 200)).max(axis=1) > 60
    slots = tiled(session, directions[there])
    np.testing.assert_array_equal(np.sort(slots), np.arange(there.sum()))
    tiles = pixels[there][slots[: len(slots) // 64 * 64]].reshape(-1, 64, 2)
    assert (np.median(np.ptp(tiles, axis=1), axis=0) < (16, 9)).all()


@pytest.mark.parametrize("count", [1, 63, 64, 4095, 4096, 8191, 8192, 8193, 50021])
def test_other_rays_from_one_point_stay_where_they_are(session, rng, count):
    slots = tiled(session, rng.normal(size=(count, 3)).astype(np.float32))
    np.testing.assert_array_equal(np.sort(slots), np.arange(count))
    assert (slots == np.arange(count)).mean() > 0.9


def test_a_shuffled_picture_stays_shuffled(session, rng):
    slots = tiled(session, rng.permutation(picture(rng, 512, 512, 0.05)[1]))
    assert (slots == np.arange(len(slots))).mean() > 0.6
