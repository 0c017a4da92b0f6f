"""Hashes of rays: exact against numpy, and close for rays that are close."""

import dataclasses

import numpy as np
import pytest
from soup import random_rays

from raystream import hash, rays

PAPER, OCTAHEDRAL = hash.HASHES["paper"], hash.HASHES["octahedral"]
F = np.float32


def keys_of(session, origins, directions, name, light=None, tfar=np.inf):
    stream = rays.from_numpy(session, origins, directions, 0.0, tfar)
    slots = session.upload("test", np.arange(len(stream), dtype=np.uint32))
    keys, active = hash.hash_rays(session, dataclasses.replace(stream, light=light), slots, name)
    return keys.get(), active.get()


def cells(origins, bits):
    """Cells of the box of the origins, as the kernel rounds."""
    low, high = origins.min(axis=0), origins.max(axis=0)
    scale = np.where(high > low, F(1 << bits) / np.where(high > low, high - low, F(1)), F(0))
    return np.minimum((origins - low) * scale, F((1 << bits) - 1)).astype(np.uint32)


def octahedral(directions, bits):
    magnitudes = np.abs(directions)
    largest = magnitudes.max(axis=1, keepdims=True)
    e, a = directions / largest, magnitudes / largest
    total = (a[:, 0] + a[:, 1]) + a[:, 2]
    u, v = e[:, 0] / total, e[:, 1] / total
    folded_u = (F(1) - np.abs(v)) * np.where(u >= 0, F(1), F(-1))
    folded_v = (F(1) - np.abs(u)) * np.where(v >= 0, F(1), F(-1))
    below = directions[:, 2] < 0
    u, v = np.where(below, folded_u, u), np.where(below, folded_v, v)
    half = F(1 << bits) * F(0.5)
    return [np.minimum((x + F(1)) * half, F((1 << bits) - 1)).astype(np.uint32) for x in (u, v)]


def interleave(x, y, bits):
    key = np.zeros_like(x)
    for b in range(bits):
        key |= (x >> b & 1) << (2 * b + 1) | (y >> b & 1) << (2 * b)
    return key


def part(keys, bits, below):
    """`bits` bits of the keys, with `below` bits under them."""
    return keys >> below & ((1 << bits) - 1)


def test_octahedral_directions_frame_the_key(session, rng):
    origins, directions = random_rays(rng, 4001)
    keys, active = keys_of(session, origins, directions, "octahedral")
    coarse, fine, bits = (OCTAHEDRAL[k] for k in ("COARSE_BITS", "FINE_BITS", "CELL_BITS"))
    x, y = (c >> OCTAHEDRAL["WIDE_BITS"] - coarse - fine
            for c in octahedral(directions, OCTAHEDRAL["WIDE_BITS"]))  # fmt: skip
    assert active.all()
    np.testing.assert_array_equal(
        part(keys, 2 * coarse, 3 * bits + 2 * fine), interleave(x >> fine, y >> fine, coarse)
    )
    np.testing.assert_array_equal(part(keys, 2 * fine, 0), interleave(x, y, fine))


def test_the_cells_of_the_origins_follow_a_hilbert_curve(session, rng):
    """Along the curve one step leads to a neighbour, and every cell has its own place."""
    bits = 3
    side = 1 << bits
    grid = np.stack(np.meshgrid(*[np.arange(side)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    origins = ((grid + 0.5) / side).astype(F)
    corners = np.array([[0, 0, 0], [1, 1, 1]], F)  # so that the box is the unit cube
    origins = np.concatenate([origins, corners])
    directions = np.broadcast_to(F([0.3, 0.2, 1.0]), origins.shape)
    keys = keys_of(session, origins, directions, "octahedral")[0][:-2]
    below = 2 * OCTAHEDRAL["FINE_BITS"] + 3 * (OCTAHEDRAL["CELL_BITS"] - bits)
    place = part(keys, 3 * bits, below)  # the first steps of a finer curve are a coarser curve
    assert sorted(place) == list(range(side**3))
    steps = np.diff(grid[np.argsort(place)], axis=0)
    assert (np.abs(steps).sum(axis=1) == 1).all()


def test_rays_from_one_point_are_sorted_by_direction_alone(session, rng):
    directions = rng.normal(size=(1000, 3)).astype(F)
    keys, _ = keys_of(session, np.full((1000, 3), F(7)), directions, "octahedral")
    wide = OCTAHEDRAL["WIDE_BITS"]
    np.testing.assert_array_equal(keys, interleave(*octahedral(directions, wide), wide))


def test_segments_from_one_point_are_sorted_by_their_ends(session, rng):
    """As shadow rays from their light: along the curve the ends are close to each other."""
    ends = rng.random((5000, 3)).astype(F)
    light = np.tile(F([0.5, 0.5, 3.0]), (5000, 1))
    keys, _ = keys_of(session, light, ends - light, "octahedral", tfar=1.0)
    steps = np.linalg.norm(np.diff(ends[np.argsort(keys)], axis=0), axis=1)
    assert np.median(steps) < 2 * 5000 ** (-1 / 3)
    assert len(np.unique(keys)) > 4990 and keys.max() < 1 << 3 * OCTAHEDRAL["END_BITS"]


@pytest.mark.parametrize("light", [None, 0, 5])
def test_the_paper_hash_holds_light_or_origin_above_the_angles(light, session, rng):
    origins, directions = random_rays(rng, 4001)
    keys, _ = keys_of(session, origins, directions, "paper", light)
    angle, bits = PAPER["ANGLE_BITS" if light is None else "SHADOW_ANGLE_BITS"], PAPER["CELL_BITS"]
    x, y, z = directions.astype(np.float64).T
    azimuth = (np.arctan2(y, x) / (2 * np.pi) + 0.5) * (1 << angle)
    polar = np.arctan2(np.hypot(x, y), z) / np.pi * (1 << angle)
    for ours, exact in ((part(keys, angle, angle), azimuth), (part(keys, angle, 0), polar)):
        # The angle functions of devices differ in the last place: at a border, either side.
        clear = np.abs(exact - np.round(exact)) > 1e-4
        np.testing.assert_array_equal(ours[clear], np.floor(exact[clear]))
        assert clear.mean() > 0.99
    if light is not None:
        assert (keys >> 2 * angle == light).all()
        return
    x, y, z = cells(origins, bits).T
    np.testing.assert_array_equal(keys >> 2 * angle, (x << bits | y) << bits | z)


@pytest.mark.parametrize("name", hash.HASHES)
def test_inactive_rays_are_flagged_and_do_not_widen_the_grid(name, session, rng):
    origins, directions = random_rays(rng, 500)
    tfar = np.where(np.arange(500) % 7 == 3, -1.0, 1.0)
    far = np.where((tfar < 0)[:, None], F(1e6), origins)
    keys, active = keys_of(session, far, directions, name, tfar=tfar)
    np.testing.assert_array_equal(active != 0, tfar >= 0)
    assert (keys[tfar < 0] == 0).all()
    alone, _ = keys_of(session, origins[tfar >= 0], directions[tfar >= 0], name)
    np.testing.assert_array_equal(keys[tfar >= 0], alone)


@pytest.mark.parametrize("name", hash.HASHES)
@pytest.mark.parametrize("count", [0, 1, 63, 64, 65, 1009])
def test_any_number_of_rays_and_any_values(name, count, session, rng):
    origins = (rng.normal(size=(count, 3)) * F(3e38)).clip(-3.4e38, 3.4e38).astype(F)
    directions = rng.choice(F([-3e38, -1, -1e-40, 0, 1e-40, 2, 3e38]), (count, 3))
    directions[~directions.any(axis=1)] = 1
    keys, active = keys_of(session, origins, directions, name)
    assert len(keys) == count and active.all()
    assert (keys.astype(np.uint64) < 1 << hash.BITS[name]).all()
    assert (hash_all_of(session, origins, directions, name) < 1 << hash.BITS[name]).all()


def hash_all_of(session, origins, directions, name):
    stream = rays.from_numpy(session, origins, directions, 0.0, np.inf)
    return hash.hash_all(session, stream, name).get()


@pytest.mark.parametrize("name", hash.HASHES)
@pytest.mark.parametrize("count", [2, 17, 1009, 100_003])
def test_all_rays_get_the_same_keys_where_those_measured_say_how_far_they_reach(
    name, count, session, rng
):
    """The first two are measured, whatever the number of chunks: they span the box."""
    origins, directions = random_rays(rng, count)
    origins[:2] = origins.min(axis=0), origins.max(axis=0)
    keys, _ = keys_of(session, origins, directions, name)
    np.testing.assert_array_equal(hash_all_of(session, origins, directions, name), keys)


def test_rays_outside_the_measured_box_are_in_the_cells_at_its_sides(session, rng):
    chunk = 1000
    origins, directions = random_rays(rng, chunk * hash._chunks(session))
    origins[100::chunk] *= F(-1e30)  # of runs 0, 16, 32, ... of each chunk no ray
    keys = hash_all_of(session, origins, directions, "coarse")
    assert keys.max() < 1 << hash.BITS["coarse"]
    assert len(np.unique(keys)) > 10_000  # in a box of them all the others would be in one cell
