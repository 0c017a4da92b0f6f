"""The ray-space hierarchy: every node bounds its rays."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from soup import random_rays

import raystream as rs
from raystream import device, rays
from raystream.hierarchy import BOUNDS

INVALID = 0xFFFFFFFF
COUNTS = [1, 2, 3, 4, 5, 15, 16, 17, 63, 64, 65, 1009]


def stream(origins, directions, tfar=np.inf):
    return rays.from_numpy(device.session(), origins, directions, 0.0, tfar)


def assert_bounds(hierarchy, origins, directions, tfar):
    """Every node's cone-sphere, and its boxes, in float64, hold its active rays."""
    length = np.linalg.norm(directions.astype(np.float64), axis=1)
    unit = directions / length[:, None]
    active = tfar >= 0
    slots = hierarchy.slots.get()
    held = np.flatnonzero(slots < len(origins))
    slot_of_ray = np.zeros(len(origins), np.int64)
    slot_of_ray[slots[held]] = held
    assert np.isin(np.flatnonzero(active), slots).all()
    for k in range(hierarchy.num_levels + 1):
        nodes = hierarchy.nodes(k).astype(np.float64)
        assert not np.isnan(nodes).any()
        of_ray = slot_of_ray // hierarchy.arity**k
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
        # A tiny reach is rounded to whole multiples of 2^-149.
        assert (tfar * length <= reach[:, 0] + 2**-140)[active].all()
        holds_ray = np.zeros(len(nodes), bool)
        holds_ray[of_ray[active]] = True
        np.testing.assert_array_equal(nodes[:, 9] >= 0, holds_ray)
        if hierarchy.bound == "tight":
            assert_boxes(nodes, of_ray[active], origins[active], directions[active], tfar[active])


def assert_boxes(nodes, of_ray, origins, directions, tfar):
    """Node `of_ray[i]` holds the origin of ray i, and its end or, where a ray has none, its way."""
    origins, directions = origins.astype(np.float64), directions.astype(np.float64)
    unit = directions / np.linalg.norm(directions, axis=1)[:, None]
    with np.errstate(invalid="ignore"):  # 0 * inf
        ways = tfar[:, None].astype(np.float64) * directions
        has_end = (np.abs(origins) + np.abs(ways) < 2.0**100).all(axis=1)
    all_end = np.ones(len(nodes), bool)
    all_end[of_ray[~has_end]] = False
    live = nodes[:, 9] >= 0
    np.testing.assert_array_equal(nodes[live, 19], all_end[live])
    centre, origin_half, middle, half = (nodes[of_ray, i : i + 3] for i in (0, 10, 13, 16))
    assert (np.abs(origins - centre) <= origin_half).all()
    at_end = all_end[of_ray]
    ends = (origins + ways)[at_end]
    assert (np.abs(ends - middle[at_end]) <= half[at_end]).all()
    turned = ~at_end
    assert (np.abs(unit - middle)[turned] <= half[turned] + 2**-22).all()


@pytest.mark.parametrize("order", ["screen", "hash"])
@pytest.mark.parametrize("bound", BOUNDS)
@pytest.mark.parametrize("arity", [4, 8])
@pytest.mark.parametrize("count", COUNTS)
def test_nodes_bound_their_rays(rng, order, bound, arity, count):
    origins, directions = random_rays(rng, count)
    tfar = rng.choice([-1.0, 1.0, np.inf], count, p=[0.3, 0.65, 0.05]) * 3 * rng.random(count)
    tfar = tfar.astype(np.float32)
    rays_given = stream(origins, directions, tfar)
    hierarchy = rs.RayHierarchy.build(rays_given, arity, order=order, bound=bound)
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
    st.sampled_from([0.0, 0.05, 1.0]),
    st.sampled_from(BOUNDS),
)
def test_nodes_bound_bundles_of_any_spread(seed, angular, spatial, scale, endless, bound):
    rng = np.random.default_rng(seed)
    base = rng.normal(size=3)
    directions = base / np.linalg.norm(base) + angular * rng.normal(size=(64, 3))
    origins = scale * (rng.normal(size=3) + spatial * rng.normal(size=(64, 3)))
    origins, directions = origins.astype(np.float32), directions.astype(np.float32)
    tfar = np.where(rng.random(64) < endless, np.inf, scale * rng.random(64)).astype(np.float32)
    hierarchy = rs.RayHierarchy.build(stream(origins, directions, tfar), bound=bound)
    assert_bounds(hierarchy, origins, directions, tfar)


@settings(max_examples=60, deadline=None)
@given(
    st.integers(0, 2**32 - 1),
    st.sampled_from([0, 18, 19, 37, 38]),
    st.sampled_from([-45, -38, 0, 37]),
    st.sampled_from([-45, 0, 30, 38]),
    st.sampled_from([4, 8]),
    st.sampled_from(BOUNDS),
)
def test_nodes_bound_rays_at_the_ends_of_the_range(seed, origin, direction, far, arity, bound):
    """Powers of ten that are reached by one ray in two; denormal ones, and those that overflow."""
    rng = np.random.default_rng(seed)

    def powers(exponent):
        return 10.0 ** np.where(rng.random((300, 1)) < 0.5, exponent, rng.integers(-2, 2, (300, 1)))

    origins = rng.uniform(-3, 3, (300, 3)) * powers(origin)
    directions = rng.choice([-1, 0, 1], (300, 3), p=[0.2, 0.3, 0.5]) * rng.uniform(2, 9, (300, 1))
    directions[~directions.any(axis=1), 2] = 1
    directions = directions * powers(direction)
    tfar = rng.choice([-1, 0, 1], 300, p=[0.2, 0.1, 0.7]) * 3 * powers(far)[:, 0]
    tfar[rng.random(300) < 0.02] = np.inf
    data = [a.astype(np.float32) for a in (origins, directions, tfar)]
    assert_bounds(rs.RayHierarchy.build(stream(*data), arity, bound=bound), *data)


@pytest.mark.parametrize("bound", BOUNDS)
@pytest.mark.parametrize("arity", [4, 8])
def test_null_children_widen_nothing(arity, bound):
    """Every pattern of null children, the others far from the null node's zeros."""
    patterns = np.arange(2**arity)[:, None] >> np.arange(arity) & 1
    tfar = np.where(patterns.ravel(), 1.0, -1.0).astype(np.float32)
    along = np.linspace(0, 1e-3, len(tfar), dtype=np.float32)[:, None]
    origins = np.float32([100, -100, 100]) + along
    directions = np.float32([0, 0.6, 0.8]) + along
    hierarchy = rs.RayHierarchy.build(stream(origins, directions, tfar), arity, bound=bound)
    assert_bounds(hierarchy, origins, directions, tfar)
    np.testing.assert_array_equal(hierarchy.valid[1].get()[: len(patterns)], patterns.sum(axis=1))
    for k in range(hierarchy.num_levels + 1):
        nodes = hierarchy.nodes(k)
        nodes = nodes[nodes[:, 9] >= 0]
        assert (nodes[:, [3, 8]] < 0.01).all()
        if bound == "tight":
            assert (nodes[:, [10, 11, 12, 16, 17, 18]] < 0.01).all() and (nodes[:, 9] < 1.01).all()


@pytest.mark.parametrize("bound", BOUNDS)
def test_parallel_opposite_and_tiny_directions(bound):
    directions = np.array([[0, 0, 1], [0, 0, 1], [0, 0, 1], [0, 0, 1]] * 4, np.float32)
    directions[4:8] *= 1e-30
    directions[8] = [0, 0, -1]
    origins = np.zeros((16, 3), np.float32)
    hierarchy = rs.RayHierarchy.build(stream(origins, directions), bound=bound)
    assert_bounds(hierarchy, origins, directions, np.full(16, np.inf, np.float32))
    parallel, tiny, opposite, _ = hierarchy.nodes(1)
    assert parallel[8] < 1e-6 and tiny[8] < 1e-6 and opposite[7] <= 0


@pytest.mark.parametrize(
    ("option", "message"),
    [({"arity": 3}, "arity: need one of 4, 8, got 3"), ({"levels": 0}, "levels"),
     ({"order": "hilbert"}, "order"), ({"bound": "loose"}, "bound")],
)  # fmt: skip
def test_options_that_there_are_not(option, message):
    with pytest.raises(ValueError, match=message):
        rs.RayHierarchy.build(stream(np.zeros((4, 3)), np.ones((4, 3))), **option)


def test_the_bounds_of_the_paper_are_its_unions():
    """Two rays share the cone between them; two spheres lie in that around the middle."""
    origins = np.array([[0, 0, 0], [2, 0, 0], [4, 0, 0], [6, 0, 0]] * 2, np.float32)
    angles = np.radians([0, 40, 40, 40, 10, 10, 10, 50])
    directions = np.stack([np.sin(angles), 0 * angles, np.cos(angles)], axis=1)
    hierarchy = rs.RayHierarchy.build(stream(origins, directions), bound="paper")
    spheres, cones = hierarchy.level(1)
    # Middles of middles: (0, 2) -> 1, radius 1; with 4 -> 2.5, 1.5 + 1; with 6 -> 4.25, 1.75 + 2.5.
    np.testing.assert_allclose(spheres[:, [0, 3]], [[4.25, 4.25]] * 2, rtol=1e-5)
    np.testing.assert_allclose(np.degrees(cones[:, 3]), [20, 20], atol=1e-3)
    root = hierarchy.level(2)[1][0]
    middle = np.radians(25)  # of the axes at 20 and 30 degrees; 5 + max(20, 20) wide
    np.testing.assert_allclose(root[:3], [np.sin(middle), 0, np.cos(middle)], atol=1e-5)
    np.testing.assert_allclose(np.degrees(root[3]), 25, atol=1e-3)
    assert (hierarchy.nodes(1)[:, 9] == np.inf).all()  # tfar is not known to them


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
