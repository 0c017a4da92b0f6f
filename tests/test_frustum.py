"""Frusta of ray packets: what they are, that they cull, and that they never cull a hit."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from raystream.baselines.brute_force import BruteForceTracer
from raystream.baselines.frustum import GROW, PAD, PacketRays, bound_packets
from raystream.baselines.watertight import intersect_pairs

SCENE = np.array([[-10.0, -10, -10], [10, 10, 10]])
WAYS = [{"corner_rays": False}, {"planes": False}, {}]


def frustum(origins, directions, corners=None, scene=SCENE):
    """Return the frusta of one packet of rays (n, 3), n a multiple of 4."""
    origins, directions = (np.float32(values).reshape(-1, 4, 3) for values in (origins, directions))
    units = directions / np.abs(directions).max(axis=2, keepdims=True)
    rays = PacketRays(origins, units, np.ones(origins.shape[:2], bool), np.array([0]))
    corners = None if corners is None else np.array([corners])
    return bound_packets(rays, rays.direction(), corners, *scene)


def tile(side=4, slope=0.5, forward=(0, 0, -1)):
    """Return directions of a camera's tile in rows of SIMD rays, and its corner lanes."""
    forward = np.array(forward, float)
    right = np.cross(forward, [0.1, 1, 0.2])
    up = np.cross(right, forward)
    lanes = np.arange(side * side)
    simd, lane = np.divmod(lanes, 4)
    y, x = 2 * (simd // (side // 2)) + lane // 2, 2 * (simd % (side // 2)) + lane % 2
    x, y = (slope * (2 * (values + 0.5) / side - 1) for values in (x, y))
    directions = forward + x[:, None] * right - y[:, None] * up
    last = side // 2 - 1
    simd = np.array([0, last, side * side // 4 - 1, side * side // 4 - 1 - last])
    return directions, 4 * simd + [0, 1, 3, 2]


def culls(frusta, low, high, **ways):
    """Return whether packet 0 culls each box."""
    low, high = np.atleast_2d(low).astype(np.float32), np.atleast_2d(high).astype(np.float32)
    return frusta.cull_boxes(np.zeros(len(low), int), low, high, **ways)


def culls_triangles(frusta, corners, **ways):
    corners = np.asarray(corners, np.float32).reshape(-1, 3, 3)
    return frusta.cull_triangles(np.zeros(len(corners), int), corners, **ways)


def spread_rays(seed=0, count=16, towards=(0, 0, 1.0)):
    """Return rays with origins of their own, around one direction."""
    rng = np.random.default_rng(seed)
    origins = rng.uniform(-1, 1, (count, 3))
    return origins, np.array(towards) + rng.uniform(-0.2, 0.2, (count, 3))


def test_light_frustum_by_hand():
    # Slopes u = x / z and v = y / z from -0.5 to 0.25 and from 0.5 to 1, light at (1, 2, 3).
    directions = [[-1, 1, 2], [0.5, 2, 2], [-0.25, 0.5, 1], [0, 3, 4]]
    frusta = frustum([[1, 2, 3]] * 4, directions)
    assert frusta.valid and frusta.shared and not frusta.primary
    corner_rays = frusta.directions[0]
    np.testing.assert_allclose(
        corner_rays[:, :2] / corner_rays[:, 2:], [[-0.5, 0.5], [0.25, 0.5], [0.25, 1], [-0.5, 1]]
    )
    np.testing.assert_allclose(frusta.origins[0], [[1, 2, 3]] * 4, atol=3 * PAD * 10)
    point = np.array([1, 2, 3]) + 4 * np.array([-0.125, 0.75, 1])
    for step, outside in (
        ([0.37, 0, 0], 0),
        ([0.38, 0, 0], 1),
        ([0, 0.26, 0], 1),
        ([0, -0.24, 0], 0),
    ):
        step = 4 * np.array(step)
        assert culls(frusta, point + step, point + step, corner_rays=False) == [bool(outside)]


def test_near_and_far_plane_by_hand():
    # Dominant axis -y; the near plane goes through the highest origin, y = 2; the far is y = -10.
    origins = [[0, 2, 0], [1, 1, 0], [0, 2, 3], [1, 2, 3]]
    directions = [[0, -1, 0], [1, -2, 0], [0, -1, 1], [0, -3, 0]]
    frusta = frustum(origins, directions)
    assert frusta.valid and not frusta.shared
    pad = 1.01 * PAD * 15
    near, far = frusta.origins[0], frusta.origins[0] + frusta.directions[0]
    assert (near[:, 1] == 2).all()
    np.testing.assert_allclose(far[:, 1], -10)
    # x: 0, 0.5, 0, 1 at the near and 0, 6.5, 0, 1 at the far plane; z: 0, 0, 3, 3 and 0, 0, 15, 3.
    np.testing.assert_allclose([near.min(0), near.max(0)], [[0, 2, 0], [1, 2, 3]], atol=pad)
    np.testing.assert_allclose([far.min(0), far.max(0)], [[0, -10, 0], [6.5, -10, 15]], atol=pad)
    on_plane = np.array([[3.75, -4, 1], [0, -4, 1], [1, -4, 9], [1, -4, 0]])  # half-way
    outward = np.array([[1, 0, 0], [-1, 0, 0], [0, 0, 1], [0, 0, -1]])
    for way in (5 * pad, -pad):
        points = on_plane + way * outward
        assert (culls(frusta, points, points, corner_rays=False) == (way > 0)).all()


def test_primary_frustum_is_that_of_the_corner_rays():
    directions, corners = tile()
    frusta = frustum(np.ones_like(directions), directions, corners)
    assert frusta.valid and frusta.shared and frusta.primary
    found, given_ = frusta.directions[0], np.float32(directions[corners])
    found /= np.linalg.norm(found, axis=1, keepdims=True)
    np.testing.assert_allclose(
        found, given_ / np.linalg.norm(given_, axis=1, keepdims=True), atol=GROW
    )
    normals = np.cross(given_, np.roll(given_, -1, axis=0))
    lengths = np.linalg.norm(normals, axis=1) * np.linalg.norm(frusta.normals[0], axis=1)
    np.testing.assert_allclose(np.abs((normals * frusta.normals[0]).sum(1)), lengths, rtol=1e-6)
    assert (np.einsum("ic,nc->in", frusta.normals[0], np.float32(directions)) < 0).all()


@pytest.mark.parametrize("side", [2, 4, 16])
@pytest.mark.parametrize("forward", [(0, 0, -1), (1, 2, 3), (-5, 0.1, 0.3), (1, 1, 1)])
def test_camera_tiles_of_any_size_and_direction_have_primary_frusta(side, forward):
    directions, corners = tile(side, 0.01 * side, forward)
    assert frustum(np.ones_like(directions), directions, corners).primary


def test_corner_rays_that_do_not_bound_the_packet_are_not_used():
    directions, corners = tile()
    directions[6] = 1.1 * directions[7] - 0.1 * directions[4]  # beyond the right column
    frusta = frustum(np.ones_like(directions), directions, corners)
    assert frusta.valid and not frusta.primary
    missing = frustum(np.ones_like(directions), directions, np.full(4, -1))
    assert missing.valid and not missing.primary


def test_parallel_rays_have_a_frustum_that_culls():
    origins, _ = spread_rays()
    frusta = frustum(origins, np.tile([0.2, -1, 0.3], (16, 1)))
    assert frusta.valid
    assert culls(frusta, [5, -9, 5], [6, -8, 6], corner_rays=False).all()
    assert culls(frusta, [5, -9, 5], [6, -8, 6], planes=False).all()


@pytest.mark.parametrize("second", [[0, 0, -1], [1, 0, 0]])
def test_rays_that_part_have_no_frustum_and_cull_nothing(second):
    directions = np.tile([[0, 0, 1.0]], (16, 1))
    directions[7] = second
    frusta = frustum(np.zeros((16, 3)), directions)
    assert not frusta.valid
    assert not culls(frusta, [5, 5, -9], [6, 6, -8]).any()
    assert not culls_triangles(frusta, np.eye(3) - 9).any()


@pytest.mark.parametrize("ways", WAYS)
def test_boxes_beside_are_culled_and_boxes_inside_are_not(ways):
    forward = (1, 0.7, -2)  # corner rays cull a box only when all rise, or fall, along an axis
    directions, corners = tile(slope=0.1, forward=forward)
    beside = [[9, 0, -9], [0, 9, -9], [-9, -9, 2]]
    inside = [[4, 3, -8], [-9, -9, -9]]
    for frusta in (
        frustum(np.ones_like(directions), directions, corners),
        frustum(np.ones_like(directions), directions),
        frustum(*spread_rays(towards=forward)),
    ):
        assert culls(frusta, beside, np.array(beside) + 1, **ways).all()
        assert not culls(frusta, inside, [[6, 5, -6], [9, 9, 9]], **ways).any()


def test_only_corner_rays_cull_a_box_behind_the_origins():
    frusta = frustum(*spread_rays(towards=(0, 0, 1.0)))
    assert culls(frusta, [-1, -1, -9], [1, 1, -8], planes=False).all()
    assert not culls(frusta, [-4, -4, -4], [4, 4, -2], corner_rays=False).any()


def test_only_corner_rays_cull_a_triangle_whose_edge_passes_a_corner():
    directions, corners = tile(slope=0.5)
    frusta = frustum(np.zeros_like(directions), directions, corners)
    # Large, its long side diagonal just outside of the tile's corner: in no plane's outside.
    corner = frusta.directions[0, 1]
    right_up = corner * 8 / -corner[2]
    away = np.array([right_up[0], right_up[1], 0])
    across = np.array([-right_up[1], right_up[0], 0])
    triangle = right_up + 0.05 * away + np.array([20 * across, -20 * across, 20 * away])
    assert not culls_triangles(frusta, triangle, corner_rays=False).any()
    assert culls_triangles(frusta, triangle, planes=False).all()
    assert not culls_triangles(frusta, triangle - 0.2 * away).any()


def test_triangles_outside_of_a_plane_are_culled():
    directions, corners = tile()
    frusta = frustum(np.zeros_like(directions), directions, corners)
    assert culls_triangles(frusta, np.eye(3) + [9, 0, -9], corner_rays=False).all()
    assert not culls_triangles(frusta, np.eye(3) + [0, 0, -9]).any()


def test_four_corner_rays_bound_rays_of_many_origins():
    """Also those from any point of the near to any point of the far rectangle (see frustum.py)."""
    rng = np.random.default_rng(1)
    for _ in range(40):
        near, far = rng.uniform(-1, 1, (2, 64, 3))
        near *= [*10 ** rng.uniform(-3, 0, 2), 0]
        far *= [*10 ** rng.uniform(-3, 0.5, 2), 0]
        far += [*rng.uniform(-1, 1, 2), 6]
        near, far = np.float32(near).astype(float), np.float32(far).astype(float)
        directions = np.float32(far - near).astype(float)
        frusta = frustum(near, directions, scene=np.array([[-3.0, -3, 0], [3, 3, 6]]))
        ray = rng.integers(64, size=500)
        places = near[ray] + rng.random((500, 1)) * directions[ray]
        a, b = places + 10 ** rng.uniform(-2, 1, (2, 500, 1)) * rng.normal(size=(2, 500, 3))
        c = places + rng.random((500, 1)) * (places - a) + rng.random((500, 1)) * (places - b)
        triangles = np.stack([a, b, c], axis=1)
        hit, t, _, _ = intersect_pairs(near[ray], directions[ray], triangles)
        hit &= (t >= 0) & (t <= 0.999)
        assert hit.sum() > 100
        low, high = places - rng.random((2, 500, 3)) * 10 ** rng.uniform(-3, 1, (2, 500, 3)) * [
            [[1]],
            [[-1]],
        ]
        for ways in WAYS:
            assert not culls_triangles(frusta, triangles[hit], **ways).any()
            assert not culls(frusta, low, high, **ways).any()


@st.composite
def packets(draw):
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    kind = draw(st.sampled_from(["camera", "light", "curved", "parallel"]))
    corners = None
    if kind == "camera":
        forward = rng.normal(size=3) * draw(st.sampled_from([1, [1, 1e-3, 1e-3]]))
        directions, corners = tile(draw(st.sampled_from([2, 4, 8])), rng.uniform(0.01, 1), forward)
        origins = np.tile(rng.normal(size=3), (len(directions), 1))
    else:
        spread = draw(st.sampled_from([0.01, 0.2, 0.7]))
        axis = rng.normal(size=3)
        origins = rng.normal(size=3) + (kind != "light") * rng.uniform(-1, 1, (16, 3))
        origins = np.broadcast_to(origins, (16, 3))
        directions = axis + (kind != "parallel") * spread * rng.normal(size=(16, 3))
    if draw(st.booleans()):
        directions = directions * 10.0 ** rng.uniform(-3, 3, (len(directions), 1))
        corners = None
    scale = draw(st.sampled_from([1e-4, 1.0, 1e5]))
    return scale * origins, directions, corners, scale, rng


@settings(max_examples=150, deadline=None)
@given(packets())
def test_no_hit_is_culled(case):
    origins, directions, corners, scale, rng = case
    origins, directions = (
        np.float32(values).astype(np.float64) for values in (origins, directions)
    )
    lengths = np.linalg.norm(directions, axis=1, keepdims=True)
    chosen = rng.integers(len(origins), size=60)
    along = scale * rng.uniform(-1, 4, (60, 1)) / lengths[chosen]
    places = origins[chosen] + along * directions[chosen]
    size = scale * 10.0 ** rng.uniform(-2, 0.5, (60, 1, 1))
    triangles = np.float32(places[:, None] + size * rng.normal(size=(60, 3, 3)))
    if rng.random() < 0.5:  # on a side of the box or an edge of the triangle, not around
        triangles[:, 0] = 2 * places - triangles[:, 1]
    low, high = triangles.min(axis=1), triangles.max(axis=1)
    scene = np.array([low.min(axis=0), high.max(axis=0)])
    frusta = frustum(origins, directions, corners, scene)
    tracer = BruteForceTracer(triangles.reshape(-1, 3), np.arange(180).reshape(-1, 3))
    unlimited = np.zeros(len(origins)), np.full(len(origins), np.inf)
    hit = np.unique(tracer.all_hits(origins, directions, *unlimited)[1])
    boxes = _met_boxes(origins, directions, low, high)
    for ways in WAYS:
        assert not culls_triangles(frusta, triangles, **ways)[hit].any()
        assert not culls(frusta, low, high, **ways)[boxes].any()


def _met_boxes(origins, directions, low, high):
    """Return which boxes, (k,) bool, any ray (n, 3) meets, exactly up to rounding."""
    inverse = 1 / np.where(directions == 0, 1e-200, directions)
    first, second = ((side[:, None] - origins) * inverse for side in (low, high))
    enter = np.minimum(first, second).max(axis=2)
    leave = np.maximum(first, second).min(axis=2)
    return (np.maximum(enter, 0) <= leave).any(axis=1)
