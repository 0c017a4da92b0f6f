"""The ray-space hierarchy as a tracer: nothing is lost, counts are exact, memory is bounded."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from soup import (
    assert_nothing_lost,
    assert_same_hits,
    grid_of_rays,
    mesh_of,
    random_rays,
    triangle_soup,
)

import raystream as rs
from raystream.errors import MemoryLimitError
from raystream.hierarchy import BOUNDS


@pytest.mark.parametrize("options", [
    {}, {"reduction": "segmented"}, {"reduction": "scan"}, {"reduction": "horn"},
    {"reduction": "append", "arity": 8}, {"arity": 8}, {"levels": 1}, {"arity": 8, "levels": 2},
    {"levels": 5}, {"bound": "tight"}, {"bound": "tight", "arity": 8, "levels": 2},
    {"bound": "paper"},
])  # fmt: skip
@pytest.mark.parametrize("count", [1, 3, 4, 5, 64, 65, 1009])
def test_hits_equal_brute_force(rng, options, count):
    scene = triangle_soup(rng, 300)
    assert_nothing_lost(scene, "rsh", *random_rays(rng, count), **options)


@settings(max_examples=80, deadline=None)
@given(
    st.integers(0, 2**32 - 1),
    st.sampled_from([0.0, 1e-3, 0.1, 1.0]),  # spread of directions: parallel to all around
    st.sampled_from([0.0, 1e-3, 1.0]),  # spread of origins: one point (zero-size nodes) to wide
    st.sampled_from([1e-3, 0.05, 1.0]),  # size of triangles
    st.sampled_from([(1.0, 0.0), (1e-3, 0.0), (1e3, 0.0), (1.0, 100.0)]),  # scale, offset
    st.sampled_from(BOUNDS),
)
def test_no_hit_is_ever_lost(seed, angular, spatial, size, place, bound):
    rng = np.random.default_rng(seed)
    scale, offset = place
    corners = rng.random((97, 1, 3)) + size * (rng.random((97, 3, 3)) - 0.5)
    corners = (scale * corners + offset).astype(np.float32)
    scene = rs.Scene([mesh_of("soup", corners)])
    origins = scale * (0.5 + rng.normal(size=3) + spatial * rng.normal(size=(130, 3))) + offset
    aim = corners[rng.integers(0, 97, 130)].mean(axis=1) - origins
    towards = aim[0] + angular * np.linalg.norm(aim[0]) * rng.normal(size=(130, 3))
    mixed = np.where(rng.random((130, 1)) < 0.5, aim, towards)
    directions = np.where(mixed.any(axis=1, keepdims=True), mixed, 1.0)
    tfar = np.where(rng.random(130) < 0.5, np.inf, 2 * rng.random(130)).astype(np.float32)
    assert_nothing_lost(scene, "rsh", origins, directions, tfar, bound=bound)


def test_rays_aimed_at_edges_and_vertices_of_a_closed_mesh_hit():
    import trimesh

    ball = trimesh.creation.icosphere(3)
    weights = np.random.default_rng(3).random((len(ball.edges_unique), 1))
    ends = ball.vertices[ball.edges_unique]
    targets = np.concatenate([ball.vertices, weights * ends[:, 0] + (1 - weights) * ends[:, 1]])
    origins = np.tile([0.1, -0.2, 0.05], (len(targets), 1))
    for method in ("rsh", "brute"):
        hits = rs.Tracer(ball, method).intersect(origins, targets - origins)
        assert (hits.prim_id >= 0).all(), method


@pytest.mark.parametrize("method", ["rsh", "crsh"])
def test_a_triangle_centred_on_the_axis_is_kept(method):
    """What is left of P across the axis is rounding, whose square is zero."""
    corners = [[[0.9375, 1.0625, 1], [1.0625, 0.9375, 1], [1.03125, 1.03125, 0.9375]]]
    scene = rs.Scene([mesh_of("diagonal", np.array(corners, np.float32))])
    hits = rs.Tracer(scene, method, bound="tight").intersect(np.zeros((1, 3)), np.ones((1, 3)))
    assert hits.prim_id[0] == 0 and hits.t[0] == 1


@pytest.mark.parametrize("method", ["rsh", "crsh"])
def test_voxels_seen_along_their_diagonal(method):
    """Rays through vertices and edges of a grid, along the diagonal of its cells."""
    x, y, z = (a.ravel() for a in np.meshgrid(*[np.arange(6.0)] * 3, indexing="ij"))
    square = np.array([[[0, 0], [1, 0], [1, 1]], [[0, 0], [1, 1], [0, 1]]])
    corners = np.zeros((len(x), 2, 3, 3))
    corners[..., :2] = np.stack([x, y], axis=-1)[:, None, None] + square
    corners[..., 2] = z[:, None, None]
    scene = rs.Scene([mesh_of("sheets", corners.reshape(-1, 3, 3).astype(np.float32))])
    starts = np.stack(np.meshgrid(*[np.arange(0, 3, 0.5)] * 3), axis=-1).reshape(-1, 3) - 0.5
    arguments = starts, np.ones_like(starts)
    ours, brute = rs.Tracer(scene, method, bound="tight"), rs.Tracer(scene, "brute")
    assert_same_hits(ours.intersect(*arguments), brute.intersect(*arguments))
    assert ours.statistics.final_hits == brute.statistics.final_hits > 100


@pytest.mark.parametrize("bound", BOUNDS)
def test_scenes_near_the_limits_of_float(bound, rng):
    for exponent in (-18, -12, 12, 18):
        centre = rng.normal(size=3) * 10.0**exponent
        size = 10.0 ** (exponent - 1)
        corners = centre + size * rng.normal(size=(64, 3, 3))
        scene = rs.Scene([mesh_of("far", corners.astype(np.float32))])
        towards = corners.mean(axis=1) / np.abs(centre).max()
        assert_nothing_lost(scene, "rsh", np.zeros((64, 3)), towards, bound=bound)


@pytest.mark.parametrize("size", [(1, 1), (7, 5), (8, 8), (33, 17), (64, 64)])
def test_screens_of_any_size_with_holes(rng, session, size):
    scene = triangle_soup(rng, 200)
    stream = grid_of_rays(*size)
    tfar = stream.dir_tfar.get()
    tfar[rng.random(len(stream)) < 0.4, 3] = -1.0
    stream.dir_tfar = session.upload("holes", tfar)
    rsh, brute = rs.Tracer(scene, "rsh"), rs.Tracer(scene, "brute")
    ours, theirs = (t.intersect_stream(session, stream) for t in (rsh, brute))
    np.testing.assert_array_equal(ours.triangle.get(), theirs.triangle.get())
    np.testing.assert_array_equal(ours.t.get(), theirs.t.get())
    active = int((tfar[:, 3] >= 0).sum())
    assert rsh.statistics.rays == brute.statistics.rays == active
    assert rsh.statistics.final_hits == brute.statistics.final_hits


def test_counts_follow_from_each_other(rng, session):
    scene = triangle_soup(rng, 500)
    tracer = rs.Tracer(scene, "rsh")
    tracer.intersect_stream(session, grid_of_rays(64, 64))
    counts = tracer.statistics
    assert [level["nodes"] for level in counts.levels] == [1, 4, 16, 64, 256, 1024, 4096]
    assert counts.levels[0]["tests"] == scene.num_triangles
    for above, below in zip(counts.levels, counts.levels[1:], strict=False):
        assert below["tests"] == 4 * above["hits"]
        assert below["hits"] + below["misses"] == below["tests"]
    assert counts.final_tests == counts.levels[-1]["hits"]
    assert counts.total_tests == counts.final_tests + sum(x["tests"] for x in counts.levels)
    assert counts.batches == 1 and counts.to_dict()["total_tests"] == counts.total_tests


def test_limited_levels_end_with_all_rays_of_a_node(rng, session):
    scene = triangle_soup(rng, 500)
    tracer = rs.Tracer(scene, "rsh", arity=8, levels=2)
    tracer.intersect_stream(session, grid_of_rays(64, 64))
    counts = tracer.statistics
    assert [level["nodes"] for level in counts.levels] == [64, 512]
    assert counts.levels[0]["tests"] == 64 * scene.num_triangles
    assert counts.levels[1]["tests"] == 8 * counts.levels[0]["hits"]
    assert counts.final_tests == 8 * counts.levels[1]["hits"]


def test_counts_are_the_same_from_run_to_run_and_in_any_number_of_batches(rng):
    scene = triangle_soup(rng, 3000, size=0.5)
    origins, directions = random_rays(rng, 2000)
    unlimited = rs.Tracer(scene, "rsh")
    hits = unlimited.intersect(origins, directions)
    first = unlimited.statistics.to_dict()
    assert first["batches"] == 1
    limit = 100_000
    limited = rs.Tracer(scene, "rsh", memory_limit=limit)
    for _ in range(2):
        assert_same_hits(limited.intersect(origins, directions), hits)
        second = limited.statistics.to_dict()
        assert second["batches"] > 1
        assert second["peak_stream_bytes"] <= limit
        for key in ("levels", "final_tests", "final_hits", "total_tests", "rays"):
            assert second[key] == first[key], key


@pytest.mark.parametrize("reduction", ["segmented", "scan", "horn", "append"])
def test_counts_do_not_depend_on_the_reduction(rng, reduction):
    scene, rays = triangle_soup(rng, 800, size=0.4), random_rays(rng, 500)
    fused = rs.Tracer(scene, "rsh")
    hits = fused.intersect(*rays)
    other = rs.Tracer(scene, "rsh", reduction=reduction, memory_limit=500_000)
    assert_same_hits(other.intersect(*rays), hits)
    assert other.statistics.levels == fused.statistics.levels
    assert other.statistics.final_hits == fused.statistics.final_hits
    assert other.statistics.peak_stream_bytes <= 500_000


def test_streams_grow_before_batches_are_cut(rng, monkeypatch):
    from raystream import rsh

    monkeypatch.setattr(rsh, "_FIRST_PAIRS", 64)
    scene = triangle_soup(rng, 500, size=0.5)
    tracer = rs.Tracer(scene, "rsh")
    hits = tracer.intersect(*random_rays(np.random.default_rng(5), 500))
    assert tracer.statistics.batches == 1
    reference = rs.Tracer(scene, "brute").intersect(*random_rays(np.random.default_rng(5), 500))
    assert_same_hits(hits, reference)


def test_too_little_memory_is_one_clear_error(rng):
    tracer = rs.Tracer(triangle_soup(rng, 50), "rsh", memory_limit=1000)
    with pytest.raises(MemoryLimitError, match="memory_limit: 500 rays need at least 8500 bytes"):
        tracer.intersect(*random_rays(rng, 500))


def test_equal_distances_go_to_the_smaller_number():
    triangle = np.array([[[0, 0, 0], [1, 0, 0], [0, 1, 0]]], np.float32)
    twice = mesh_of("twice", np.concatenate([triangle + [0, 0, 1], triangle, triangle]))
    scene = rs.Scene([mesh_of("behind", triangle - [0, 0, 1]), twice, mesh_of("again", triangle)])
    origins = np.tile([0.2, 0.2, 0.5], (70, 1))
    for method in ("rsh", "brute"):
        hits = rs.Tracer(scene, method).intersect(origins, [[0, 0, -1]] * 70)
        assert set(hits.geom_id) == {1} and set(hits.prim_id) == {1}
        assert set(hits.t) == {0.5}


@pytest.mark.parametrize("scale", [1e-12, 1e-8, 1e-4, 1e4, 1e8, 1e12])
def test_scenes_of_any_size(scale):
    import trimesh

    ball = trimesh.creation.icosphere(2)
    ball.apply_scale(scale)
    directions = np.random.default_rng(8).normal(size=(500, 3))
    rays = np.zeros((500, 3)), directions
    tracers = [rs.Tracer(ball, method) for method in ("rsh", "brute")]
    ours, theirs = (tracer.intersect(*rays) for tracer in tracers)
    assert_same_hits(ours, theirs)
    assert (ours.prim_id >= 0).all()
    assert tracers[0].statistics.final_hits == tracers[1].statistics.final_hits
    length = ours.t * np.linalg.norm(directions, axis=1)
    assert (length > 0.9 * scale).all() and (length < 1.01 * scale).all()


def test_origins_far_apart_lose_nothing(rng):
    scene = triangle_soup(rng, 200, size=0.6)
    origins, directions = random_rays(rng, 200, spread=0.3)
    origins[::16] = [-3e19, 0, 3e19]
    assert_nothing_lost(scene, "rsh", origins, directions)


def test_a_huge_direction_with_no_length_left():
    corner = np.array([[[0, 0, 0], [1, 0, 0], [0, 1, 0]]], np.float32)
    scene = rs.Scene([mesh_of("corner", corner)])
    origins, directions = np.zeros((5, 3)), np.full((5, 3), 3e38)
    assert_nothing_lost(scene, "rsh", origins, directions, tfar=0.0)


def test_statistics_are_plain_objects(rng):
    import json

    tracer = rs.Tracer(triangle_soup(rng, 50))
    tracer.intersect(*random_rays(rng, 100))
    assert json.loads(json.dumps(tracer.statistics.to_dict())) == tracer.statistics.to_dict()
