"""Method `packet`: the hits of brute force bit for bit, the counts of the numpy version exactly."""

import dataclasses
import functools

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from raystream.baselines import PacketTracer
from soup import FIELDS, mesh_of, random_rays, triangle_soup

import raystream as rs
from raystream import device
from raystream.errors import MemoryLimitError
from raystream.packet import COUNTERS, PACKET_SIZES, TRAVERSALS
from raystream.rays import Rays

SIZE = (45, 34)  # no multiple of any packet but the smallest
KINDS = ("primary", "shadow", "reflection", "refraction", "in order")
# Packet size and SIMD width.
SHAPES = [(2, 4), (4, 4), (16, 4), (4, 16), (8, 16), (16, 16), (32, 16)]
# And from how many active SIMD rays on the frustum is asked; 0: never.
COUNTED = [((2, 4), 1), ((16, 4), 1), ((16, 16), 0), ((16, 16), 6), ((32, 16), 1)]


@functools.cache
def scene():
    """A ball and triangles of several sizes, some without an area, in two meshes."""
    rng = np.random.default_rng(7)
    corners = rng.uniform(-3, 3, (300, 1, 3)) + rng.normal(size=(300, 3, 3)) * rng.choice(
        [0.05, 0.4, 2.0], (300, 1, 1)
    )
    corners[::10, 2] = corners[::10, 1]
    ball = trimesh.creation.icosphere(subdivisions=3)
    meshes = [rs.Mesh(ball.vertices, ball.faces), mesh_of("soup", corners.astype(np.float32))]
    return rs.Scene(meshes)


def camera():
    return rs.Camera.look_at((0.3, 0.4, 4.0), (0.1, 0, 0), fov_y=50.0)


@functools.cache
def rays_of(kind):
    """Origins, directions, tnear and tfar of one kind of ray.

    A ray for each pixel, those without a ray have tfar < tnear; "in order" has no pixels.
    """
    count = SIZE[0] * SIZE[1]
    origins, directions = camera().rays(SIZE)
    tnear, tfar = np.zeros(count), np.full(count, np.inf)
    if kind == "in order":
        count = 601
        tnear, tfar = tnear[:count], tfar[:count]
        origins, directions = random_rays(np.random.default_rng(1), count)
        tfar[::7] = np.random.default_rng(2).random(len(tfar[::7]))
    if kind in ("shadow", "reflection", "refraction"):
        hits = brute().intersect(origins, directions)
        hit = np.isfinite(hits.t)
        points = np.where(hit[:, None], origins + np.where(hit, hits.t, 0)[:, None] * directions, 1)
        normals = points / np.linalg.norm(points, axis=1, keepdims=True)
        along = (directions * normals).sum(axis=1, keepdims=True)
        tnear, tfar = np.full(count, 1e-4), np.where(hit, np.inf, -1)
        origins, directions = {
            "shadow": (np.tile([2.0, 3.0, 2.5], (count, 1)), points - [2.0, 3.0, 2.5]),
            "reflection": (points, directions - 2 * along * normals),
            "refraction": (points, directions - 0.3 * along * normals),
        }[kind]
        tfar = np.where(hit, 0.9999, -1) if kind == "shadow" else tfar
    return [np.ascontiguousarray(a, np.float32) for a in (origins, directions, tnear, tfar)]


def stream_of(kind):
    """The rays on the device, those of pixels with their screen."""
    origins, directions, tnear, tfar = rays_of(kind)
    session = device.session()
    packed = (np.column_stack(pair) for pair in ((origins, tnear), (directions, tfar)))
    arrays = [session.upload("test", a) for a in packed]
    return Rays(*arrays, size=None if kind == "in order" else SIZE)


@functools.cache
def brute():
    return rs.Tracer(scene(), "brute")


@functools.cache
def expected(kind):
    """Hits and occlusion of brute force."""
    session = device.session()
    return (
        arrays_of(brute().intersect_stream(session, stream_of(kind))),
        brute().occluded_stream(session, stream_of(kind)).get(),
    )


def arrays_of(hits):
    return {name: getattr(hits, name).get() for name in ("t", "triangle", "u", "v")}


@functools.cache
def traced(kind, traversal, packet_size, simd_width, least_active):
    """Hits, occlusion and the statistics of both; least_active 0: no culling."""
    tracer = rs.Tracer(
        scene(), "packet", traversal=traversal, packet_size=packet_size, simd_width=simd_width,
        frustum_culling=least_active > 0, least_active=max(1, least_active),
    )  # fmt: skip
    session = device.session()
    hits = arrays_of(tracer.intersect_stream(session, stream_of(kind)))
    counts = tracer.statistics
    blocked = tracer.occluded_stream(session, stream_of(kind)).get()
    return hits, blocked, counts, tracer.statistics


@functools.cache
def baseline(traversal, packet_size, simd_width, least_active):
    return PacketTracer(
        scene().vertices, scene().faces, scene().first_prims, traversal=traversal,
        packet_size=packet_size, simd_width=simd_width, frustum_culling=least_active > 0,
        least_active=least_active, precision="single",
    )  # fmt: skip


@pytest.mark.parametrize("least_active", [0, 1, 6])
@pytest.mark.parametrize("shape", SHAPES, ids=str)
@pytest.mark.parametrize("traversal", TRAVERSALS)
@pytest.mark.parametrize("kind", KINDS)
def test_the_hits_of_brute_force(kind, traversal, shape, least_active):
    hits, blocked, counts, _ = traced(kind, traversal, *shape, least_active)
    reference, shadowed = expected(kind)
    for name, values in hits.items():
        np.testing.assert_array_equal(values, reference[name], name)
    np.testing.assert_array_equal(blocked, shadowed)
    assert counts.final_hits == np.isfinite(reference["t"]).sum() > 50


def assert_same_counts(ours, theirs):
    for name in COUNTERS:
        assert ours.by_depth[name] == getattr(theirs, f"{name}_by_depth").tolist(), name
    assert ours.tests_by_depth == theirs.tests_by_depth.tolist()
    names = ("rays", "simd_rays", "packets", "total_tests")
    assert [getattr(ours, name) for name in names] == [getattr(theirs, name) for name in names]
    assert ours.final_hits == theirs.hits


@pytest.mark.parametrize(("shape", "least_active"), COUNTED, ids=str)
@pytest.mark.parametrize("traversal", TRAVERSALS)
@pytest.mark.parametrize("kind", KINDS)
def test_the_counts_of_the_numpy_version(kind, traversal, shape, least_active):
    _, _, counts, any_counts = traced(kind, traversal, *shape, least_active)
    tracer = baseline(traversal, *shape, least_active)
    screen = {} if kind == "in order" else {"size": SIZE}
    origins, directions, tnear, tfar = rays_of(kind)
    tracer.intersect(origins, directions, tnear, tfar, **screen)
    assert_same_counts(counts, tracer.statistics)
    tracer.occluded(origins, directions, tnear, tfar, **screen)
    assert_same_counts(any_counts, tracer.statistics)


def test_frusta_cull():
    for kind in ("primary", "shadow", "reflection"):
        counts = traced(kind, "partition", 16, 4, 1)[2].by_depth
        assert sum(counts["frustum_box_culls"]) > 0
        assert kind == "reflection" or sum(counts["frustum_triangle_culls"]) > 0
        plain = traced(kind, "partition", 16, 4, 0)[2].by_depth
        assert sum(counts["box_tests"]) < sum(plain["box_tests"])
        assert sum(plain["frustum_box_tests"]) == 0


@pytest.mark.parametrize("count", [1, 3, 4, 15, 16, 17, 64, 255, 256, 257, 1009, 1025])
@pytest.mark.parametrize("packet_size", PACKET_SIZES)
def test_any_number_of_rays(rng, packet_size, count):
    soup = triangle_soup(rng, 100, size=0.5)
    rays = random_rays(rng, count)
    tracer = rs.Tracer(soup, "packet", packet_size=packet_size)
    hits, reference = tracer.intersect(*rays), rs.Tracer(soup, "brute").intersect(*rays)
    for field in FIELDS:
        np.testing.assert_array_equal(getattr(hits, field), getattr(reference, field), field)
    assert tracer.statistics.packets == -(-count // packet_size**2)
    assert tracer.statistics.rays == count


def test_statistics():
    counts = traced("reflection", "ranged", 8, 16, 6)[2]
    by_depth = counts.by_depth
    for depth, level in enumerate(counts.levels):
        assert level["nodes"] == by_depth["visits"][depth]
        assert level["tests"] == by_depth["box_tests"][depth] == level["hits"] + level["misses"]
        assert level["hits"] == by_depth["box_hits"][depth]
    assert counts.final_tests == sum(by_depth["triangle_tests"])
    assert counts.total_tests == sum(counts.tests_by_depth) == counts.to_dict()["total_tests"]
    assert counts.structure_bytes > 0 and counts.triangles == scene().num_triangles


def test_counts_of_streams_are_added():
    first, second = (traced(kind, "masked", 8, 16, 6)[2] for kind in ("primary", "shadow"))
    total = dataclasses.replace(rs.Tracer(scene()).statistics)
    for counts in (first, second):
        total.add(counts)
    for name in COUNTERS:
        sums = np.add(first.by_depth[name], second.by_depth[name])
        assert total.by_depth[name] == sums.tolist()
    assert total.packets == first.packets + second.packets
    assert total.levels[0]["tests"] == first.levels[0]["tests"] + second.levels[0]["tests"]


def test_a_deep_tree(rng):
    """Deeper than the kernels' stack at first."""
    places = np.float32(2) ** np.arange(-120, 120, 0.5, dtype=np.float32)
    corners = places[:, None, None] * np.float32(np.eye(3) + 0.1)
    deep = rs.Scene([mesh_of("deep", corners)])
    rays = np.zeros((500, 3)), rng.random((500, 3)) + 0.05
    tracer = rs.Tracer(deep, "packet")
    hits, reference = tracer.intersect(*rays), rs.Tracer(deep, "brute").intersect(*rays)
    assert len(tracer.statistics.levels) > 64
    np.testing.assert_array_equal(hits.t, reference.t)
    np.testing.assert_array_equal(hits.prim_id, reference.prim_id)


@st.composite
def packets_and_triangles(draw):
    """A packet of some kind and triangles around its rays, on a coarse grid or not."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    kind = draw(st.sampled_from(["point", "near", "anywhere"]))
    spread = draw(st.sampled_from([0.0, 0.05, 0.5, 2.0]))
    scale = draw(st.sampled_from([1e-10, 1e-3, 1.0, 1e4, 1e12]))
    length = 10.0 ** draw(st.integers(-30, 20))
    origins = {"point": 0.0, "near": 0.2, "anywhere": 2.0}[kind] * rng.normal(size=(257, 3))
    origins += rng.normal(size=3) * draw(st.sampled_from([1, 1000]))
    directions = rng.normal(size=3) + spread * rng.normal(size=(257, 3))
    centres = origins[rng.integers(257, size=200)]
    centres = centres + directions[rng.integers(257, size=200)] * rng.uniform(-1, 3, (200, 1))
    corners = centres[:, None] + rng.choice([0.01, 0.4]) * rng.normal(size=(200, 3, 3))
    if draw(st.booleans()):
        origins, directions, corners = (np.round(4 * a) / 4 for a in (origins, directions, corners))
        directions[~directions.any(axis=1)] = 1
    if draw(st.booleans()):
        directions[:, draw(st.integers(0, 2))] = 0
        directions[~directions.any(axis=1)] = 1
    return scale * corners, scale * origins, length * directions


@settings(max_examples=60, deadline=None)
@given(packets_and_triangles())
def test_no_hit_of_brute_force_is_lost(case):
    corners, *rays = case
    soup = rs.Scene([mesh_of("soup", corners.astype(np.float32))])
    reference = rs.Tracer(soup, "brute").intersect(*rays)
    for options in (
        {"traversal": "partition", "least_active": 1},
        {"traversal": "ranged", "packet_size": 4, "simd_width": 4, "least_active": 1},
        {"traversal": "masked", "frustum_culling": False},
    ):
        hits = rs.Tracer(soup, "packet", **options).intersect(*rays)
        for field in FIELDS:
            np.testing.assert_array_equal(getattr(hits, field), getattr(reference, field), field)


def test_auto_takes_ranged_from_one_point_and_partition_else():
    frame = {
        traversal: rs.render(
            rs.scenes.demo(), size=(64, 48), method="packet", primary="trace", traversal=traversal
        ).kinds
        for traversal in ("auto", "ranged", "partition")
    }
    for kind, same, other in (
        ("primary", "ranged", "partition"),
        ("shadow", "ranged", "partition"),
        ("reflection", "partition", "ranged"),
        ("refraction", "partition", "ranged"),
    ):
        ours, like, unlike = (frame[name][kind].by_depth for name in ("auto", same, other))
        assert ours == like and ours != unlike


@pytest.mark.parametrize(("options", "message"), [
    ({"traversal": "sorted"}, "traversal: need one of 'auto', 'masked', 'ranged', 'partition'"),
    ({"packet_size": 3}, "packet_size: need one of 2, 4, 8, 16, 32, got 3"),
    ({"packet_size": "16"}, "packet_size: need one of"),
    ({"frustum_culling": 1}, "frustum_culling: need one of False, True, got 1"),
    ({"simd_width": 8}, "simd_width: need one of 4, 16, got 8"),
    ({"simd_width": 16, "packet_size": 2}, "simd_width: need one of 4, got 16"),
    ({"least_active": 0}, "least_active: need a whole number of at least 1, got 0"),
    ({"arity": 4}, "method 'packet' has no option 'arity'; its options: traversal, packet_size"),
])  # fmt: skip
def test_refused_options(options, message):
    with pytest.raises(ValueError, match=message):
        rs.Tracer(scene(), "packet", **options)


def test_memory_limit():
    tracer = rs.Tracer(scene(), "packet", memory_limit=1000)
    with pytest.raises(MemoryLimitError, match="hierarchy of .* need .*, memory_limit is 1000"):
        tracer.intersect([[0, 0, 0]], [[0, 0, 1]])
