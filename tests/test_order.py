"""The order of the leaves: along the screen, or by hashes."""

import numpy as np
import pytest
from soup import random_rays

from raystream import device, hash, rays
from raystream.order import hashed_slots, leaf_slots, screen_slots

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
