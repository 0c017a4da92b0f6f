"""The ray-space hierarchy: the order of its leaves, and that every node bounds its rays."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from soup import random_rays

import raystream as rs
from raystream import device, rays
from raystream.hierarchy import screen_slots

INVALID = 0xFFFFFFFF
COUNTS = [1, 2, 3, 4, 5, 15, 16, 17, 63, 64, 65, 1009]


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


def stream(origins, directions, tfar=np.inf):
    return rays.from_numpy(device.session(), origins, directions, 0.0, tfar)


def assert_bounds(hierarchy, origins, directions, tfar):
    """Every node's cone-sphere, in float64, holds its active rays."""
    length = np.linalg.norm(directions.astype(np.float64), axis=1)
    unit = directions / length[:, None]
    active = tfar >= 0
    for k in range(hierarchy.num_levels + 1):
        nodes = hierarchy.nodes(k).astype(np.float64)
        of_ray = np.arange(len(origins)) // hierarchy.arity**k
        centre, radius, axis, cosine, sine, reach = np.split(
            nodes[of_ray], [3, 4, 7, 8, 9], axis=1
        )
        away = np.linalg.norm(origins - centre, axis=1)
        assert (away <= radius[:, 0])[active].all()
        along = (unit * axis).sum(axis=1)
        across = np.linalg.norm(np.cross(unit, axis), axis=1)
        # 2 u: the axis of a single ray is its direction, rounded (cl/node.h covers that).
        inside = (cosine[:, 0] <= 0) | ((along > 0) & (across <= sine[:, 0] + 2**-22))
        assert inside[active].all()
        assert (tfar * length <= reach[:, 0])[active].all()
        holds_ray = np.zeros(len(nodes), bool)
        holds_ray[of_ray[active]] = True
        np.testing.assert_array_equal(nodes[:, 9] >= 0, holds_ray)


@pytest.mark.parametrize("arity", [4, 8])
@pytest.mark.parametrize("count", COUNTS)
def test_nodes_bound_their_rays(rng, arity, count):
    origins, directions = random_rays(rng, count)
    tfar = np.where(rng.random(count) < 0.3, -1.0, rng.random(count) * 3).astype(np.float32)
    hierarchy = rs.RayHierarchy.build(stream(origins, directions, tfar), arity=arity)
    assert hierarchy.num_nodes[-1] == 1
    assert_bounds(hierarchy, origins, directions, tfar)
    levels = [hierarchy.nodes(k) for k in range(hierarchy.num_levels + 1)]
    assert hierarchy.count_nodes() == [int((nodes[:, 9] >= 0).sum()) for nodes in levels]


@settings(max_examples=60, deadline=None)
@given(
    st.integers(0, 2**32 - 1),
    st.floats(0, 4),
    st.floats(0, 4),
    st.sampled_from([1e-4, 1.0, 1e5]),
)
def test_nodes_bound_bundles_of_any_spread(seed, angular, spatial, scale):
    rng = np.random.default_rng(seed)
    base = rng.normal(size=3)
    directions = base / np.linalg.norm(base) + angular * rng.normal(size=(64, 3))
    origins = scale * (rng.normal(size=3) + spatial * rng.normal(size=(64, 3)))
    origins, directions = origins.astype(np.float32), directions.astype(np.float32)
    tfar = np.full(64, np.inf, np.float32)
    assert_bounds(rs.RayHierarchy.build(stream(origins, directions)), origins, directions, tfar)


def test_parallel_opposite_and_tiny_directions():
    directions = np.array([[0, 0, 1], [0, 0, 1], [0, 0, 1], [0, 0, 1]] * 4, np.float32)
    directions[4:8] *= 1e-30
    directions[8] = [0, 0, -1]
    origins = np.zeros((16, 3), np.float32)
    hierarchy = rs.RayHierarchy.build(stream(origins, directions))
    assert_bounds(hierarchy, origins, directions, np.full(16, np.inf, np.float32))
    parallel, tiny, opposite, _ = hierarchy.nodes(1)
    assert parallel[8] < 1e-6 and tiny[8] < 1e-6 and opposite[7] <= 0


@pytest.mark.parametrize(
    ("option", "message"),
    [({"arity": 3}, "arity: need one of 4, 8, got 3"), ({"levels": 0}, "levels"),
     ({"order": "hilbert"}, "order")],
)  # fmt: skip
def test_options_that_there_are_not(option, message):
    with pytest.raises(ValueError, match=message):
        rs.RayHierarchy.build(stream(np.zeros((4, 3)), np.ones((4, 3))), **option)


def test_levels_can_be_inspected():
    origins = np.array([[0, 0, 0], [2, 0, 0], [0, 0, 0], [0, 0, 0], [5, 5, 5]], np.float32)
    directions = np.array([[0, 0, 2], [0, 0, 1], [1, 0, 1], [-1, 0, 1], [0, 1, 0]], np.float32)
    hierarchy = rs.RayHierarchy.build((origins, directions))
    spheres, cones = hierarchy.level(0)
    np.testing.assert_array_equal(spheres, np.column_stack([origins, np.zeros(5)]))
    np.testing.assert_allclose(cones[:2], [[0, 0, 1, 0]] * 2)
    spheres, cones = hierarchy.level(1)
    np.testing.assert_allclose(spheres[0], [1, 0, 0, 1], rtol=1e-5)
    np.testing.assert_allclose(cones[0], [0, 0, 1, np.pi / 4], atol=1e-5)
    holes = stream(origins, directions, np.array([1, 1, 1, 1, -1], np.float32))
    for part in rs.RayHierarchy.build(holes).level(1):
        assert np.isnan(part[1]).all() and np.isfinite(part[0]).all()
