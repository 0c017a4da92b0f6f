"""Packing rays: exact, and the first one that no tracer can take is named wherever it stands."""

import numpy as np
import pyopencl.array as cla
import pytest
from soup import random_rays

from raystream import device, rays

MANY = 16 * 16 * 3 + 7  # several runs of sixteen for each of sixteen chunks, and a rest
SIZES = [0, 1, 15, 16, 17, 31, 1009, MANY]


def packed(session, origins, directions, tnear=0.0, tfar=np.inf):
    """From arrays on the host and on the device, which are the same."""
    stream = rays.from_numpy(session, origins, directions, tnear, tfar)
    arguments = [
        cla.to_device(session.queue, a) if np.ndim(a) else a
        for a in (np.float32(origins), np.float32(directions), tnear, tfar)
    ]
    other = rays.from_device(session, *arguments)
    for name in ("org_tnear", "dir_tfar"):
        np.testing.assert_array_equal(getattr(other, name).get(), getattr(stream, name).get())
    return stream.org_tnear.get(), stream.dir_tfar.get()


def first_refused(session, *arguments):
    arrays = [cla.to_device(session.queue, a) for a in arguments]
    with pytest.raises(ValueError, match="rays: need finite origins and directions") as raised:
        rays.from_device(session, *arrays)
    return int(str(raised.value).split()[-1])


@pytest.mark.parametrize("count", SIZES)
def test_every_value_arrives_in_its_place(count, path, rng):
    origins, directions = random_rays(rng, count)
    tnear, tfar = rng.random((2, count)).astype(np.float32)
    for near, far in ((tnear, tfar), (0.5, tfar), (tnear, np.inf), (0.25, -1.0)):
        org_tnear, dir_tfar = packed(device.session(), origins, directions, near, far)
        np.testing.assert_array_equal(org_tnear[:, :3], origins)
        np.testing.assert_array_equal(dir_tfar[:, :3], directions)
        np.testing.assert_array_equal(org_tnear[:, 3], np.broadcast_to(np.float32(near), count))
        np.testing.assert_array_equal(dir_tfar[:, 3], np.broadcast_to(np.float32(far), count))


@pytest.fixture
def good(rng):
    """Rays along the axes, two components zero, most of them with an end."""
    directions = np.eye(3, dtype=np.float32)[rng.integers(0, 3, MANY)]
    return {
        "origins": rng.normal(size=(MANY, 3)).astype(np.float32),
        "directions": -directions,
        "tnear": np.zeros(MANY, np.float32),
        "tfar": rng.choice(np.float32([1, np.inf, -np.inf]), MANY),
    }


BAD = {
    "origins": (np.nan, np.inf, -np.inf),
    "directions": (np.nan, np.inf, -np.inf),
    "tnear": (np.nan, -1e-30, -np.inf),
    "tfar": (np.nan,),
}


@pytest.mark.parametrize("name", BAD)
def test_the_first_refused_ray_is_named_in_every_place(name, good, path, rng):
    session = device.session()
    for place in {*range(40), *range(MANY - 20, MANY), *rng.integers(0, MANY, 20)}:
        array = good[name].copy()
        at = (place, rng.integers(3)) if array.ndim == 2 else place
        array[at] = rng.choice(BAD[name])
        later = rng.integers(place, MANY)
        array[later] = array[place]
        assert first_refused(session, *{**good, name: array}.values()) == place


def test_a_zero_direction_is_refused_in_every_place(good, path):
    session = device.session()
    for place in (*range(40), *range(MANY - 20, MANY)):
        directions = good["directions"].copy()
        directions[place] = (0.0, -0.0, 0.0)
        assert first_refused(session, *{**good, "directions": directions}.values()) == place


def test_the_smallest_values_are_no_zero(path):
    tiny = np.full((33, 3), 1e-45, np.float32)
    org_tnear, dir_tfar = packed(device.session(), tiny, tiny)
    np.testing.assert_array_equal(org_tnear[:, :3], tiny)
    np.testing.assert_array_equal(dir_tfar[:, :3], tiny)


def test_the_callers_arrays_may_change_afterwards(session, rng):
    """Where the device reads them in place."""
    origins, directions = (a.astype(np.float32) for a in random_rays(rng, 100_003))
    kept = origins.copy()
    stream = rays.from_numpy(session, origins, directions, 0.0, np.inf)
    origins[:] = 7
    np.testing.assert_array_equal(stream.org_tnear.get()[:, :3], kept)


def test_arrays_of_any_alignment_and_none_that_may_be_written(session, rng):
    memory = np.zeros(3 * 1000 + 7, np.float32)
    for first in range(7):
        origins = memory[first : first + 3000].reshape(-1, 3)
        origins[:], directions = random_rays(rng, 1000)
        origins.flags.writeable = directions.flags.writeable = False
        org_tnear, dir_tfar = packed(session, origins, directions)
        np.testing.assert_array_equal(org_tnear[:, :3], origins)
        np.testing.assert_array_equal(dir_tfar[:, :3], directions)


def pixels(width, height, unit, parallel=False):
    """Rays through the pixels of a screen, row by row: from one point, or parallel."""
    x, y = np.meshgrid(np.arange(width) - width / 2, height / 2 - np.arange(height))
    grid = np.stack((x, y, np.full_like(x, -unit)), axis=-1).reshape(-1, 3).astype(np.float32)
    same = np.tile(np.float32([0.5, 0, -3]), (len(grid), 1))
    return (grid, same) if parallel else (same, grid)


@pytest.mark.parametrize("size", [(8, 8), (512, 512), (640, 480), (13, 101), (101, 13)])
def test_rays_of_a_screen_are_recognised(size, session):
    origins, directions = pixels(*size, unit=max(size))
    normalised = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    for rays_of in ((origins, directions), (origins, normalised), pixels(*size, 1, parallel=True)):
        assert rays.from_numpy(session, *rays_of, 0.0, np.inf).size == size


def test_other_rays_are_no_screen(session, rng):
    origins, directions = pixels(64, 64, unit=64)
    order = np.arange(4096)
    tiles = order.reshape(8, 8, 8, 8).transpose(0, 2, 1, 3).ravel()
    gap = np.delete(order, slice(1000, 1010))
    for chosen in (tiles, rng.permutation(order), gap, order[1:], order[: 7 * 64], order[:63]):
        stream = rays.from_numpy(session, origins[chosen], directions[chosen], 0.0, np.inf)
        assert stream.size is None
    same = np.ones((4096, 3), np.float32)
    assert rays.from_numpy(session, same, same, 0.0, np.inf).size is None
    assert rays.from_numpy(session, *random_rays(rng, 4096), 0.0, np.inf).size is None


def test_rays_from_one_point_are_recognised_unless_they_are_a_screens(session, rng):
    origins, directions = random_rays(rng, 5003)
    one = np.broadcast_to(origins[0], origins.shape)
    assert rays.from_numpy(session, one, directions, 0.0, 1.0).one_origin
    assert not rays.from_numpy(session, origins, directions, 0.0, 1.0).one_origin
    two = np.where(np.arange(5003)[:, None] < 4900, one, origins[1])
    assert not rays.from_numpy(session, two, directions, 0.0, 1.0).one_origin
    screen = rays.from_numpy(session, *pixels(64, 64, unit=True), 0.0, np.inf)
    assert screen.size == (64, 64) and not screen.one_origin
