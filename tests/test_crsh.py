"""The coherent ray-space hierarchy as a tracer: nothing is lost, counts tie up."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from soup import (
    assert_nothing_lost,
    grid_of_rays,
    mesh_of,
    random_rays,
    triangle_soup,
)

import raystream as rs
from raystream import scenes
from raystream.statistics import COMPRESSION, DECOMPRESSION, RAY_CREATION, SORTING

PAPER = {"hash": "paper", "bound": "paper", "arity": 8, "levels": 2}
OPTIONS = [
    {}, PAPER, {"hash": None}, {"clusters": None}, {"cull_meshes": False}, {"clusters": 16},
    {"arity": 4, "levels": 5}, {"levels": 1}, {"bound": "paper", "levels": 3},
    {"reduction": "segmented"}, {"bound": "sphere"},
]  # fmt: skip


@pytest.mark.parametrize("options", OPTIONS, ids=str)
@pytest.mark.parametrize("count", [1, 7, 8, 9, 64, 65, 1009])
def test_hits_equal_brute_force(rng, options, count):
    assert_nothing_lost(triangle_soup(rng, 300), "crsh", *random_rays(rng, count), **options)


@pytest.mark.parametrize("triangles", [1, 2, 15, 16, 17, 63, 64, 65, 129])
@pytest.mark.parametrize("clusters", [None, 16, 64])
def test_scenes_of_any_size(rng, triangles, clusters):
    scene = triangle_soup(rng, triangles)
    assert_nothing_lost(scene, "crsh", *random_rays(rng, 200), clusters=clusters)


@settings(max_examples=60, deadline=None)
@given(
    st.integers(0, 2**32 - 1),
    st.sampled_from([0.0, 1e-3, 0.1, 1.0]),  # spread of directions
    st.sampled_from([0.0, 1e-3, 1.0]),  # spread of origins
    st.sampled_from([1e-3, 0.05, 1.0]),  # size of triangles
    st.sampled_from([(1.0, 0.0), (1e-3, 0.0), (1e3, 0.0), (1.0, 100.0)]),  # scale, offset
    st.sampled_from([{}, PAPER, {"clusters": 16, "arity": 4, "levels": 3}]),
)
def test_no_hit_is_ever_lost(seed, angular, spatial, size, place, options):
    rng = np.random.default_rng(seed)
    scale, offset = place
    corners = rng.random((97, 1, 3)) + size * (rng.random((97, 3, 3)) - 0.5)
    corners = (scale * corners + offset).astype(np.float32)
    scene = rs.Scene([mesh_of("a", corners[:40]), mesh_of("b", corners[40:])])
    origins = scale * (0.5 + rng.normal(size=3) + spatial * rng.normal(size=(130, 3))) + offset
    aim = corners[rng.integers(0, 97, 130)].mean(axis=1) - origins
    towards = aim[0] + angular * np.linalg.norm(aim[0]) * rng.normal(size=(130, 3))
    mixed = np.where(rng.random((130, 1)) < 0.5, aim, towards)
    directions = np.where(mixed.any(axis=1, keepdims=True), mixed, 1.0)
    tfar = np.where(rng.random(130) < 0.5, np.inf, 2 * rng.random(130)).astype(np.float32)
    assert_nothing_lost(scene, "crsh", origins, directions, tfar, **options)


def test_counts_of_the_paper_tie_up(rng, session):
    """Table 1: level-1 tests are 8 x level-2 hits, final tests 8 x level-1 hits."""
    scene = triangle_soup(rng, 500)
    tracer = rs.Tracer(scene, "crsh", **PAPER)
    tracer.intersect_stream(session, grid_of_rays(64, 64))
    counts = tracer.statistics
    top, below = counts.levels
    assert [top["nodes"], below["nodes"]] == [64, 512]
    assert counts.mesh_tests == 64 * 2
    assert below["tests"] == 8 * top["hits"] and counts.final_tests == 8 * below["hits"]
    assert top["tests"] % 250 == 0 and top["tests"] <= 64 * 500  # whole meshes
    for level in counts.levels:
        assert level["hits"] + level["misses"] == level["tests"]
    parts = counts.mesh_tests + top["tests"] + below["tests"] + counts.final_tests
    assert counts.total_tests == parts
    assert counts.rays == 64 * 64 and counts.triangles == 500 and counts.batches == 1


def test_a_node_is_tested_against_the_triangles_of_the_meshes_it_meets(rng, session):
    """Two distant meshes: rays towards one of them are never tested against the other's."""
    near = triangle_soup(rng, 100).meshes
    far = [mesh_of("far", near[0].vertices.reshape(-1, 3, 3) + [0, 0, 1000])]
    scene = rs.Scene([*near, *far])
    tracer = rs.Tracer(scene, "crsh", **PAPER)
    origins = np.tile([0.5, 0.5, 10.0], (64, 1)) + 0.01 * rng.random((64, 3))
    tracer.intersect(origins, np.tile([0.0, 0.0, -1.0], (64, 1)))
    assert tracer.statistics.mesh_tests == 3
    assert tracer.statistics.levels[0]["tests"] == 100
    tracer.intersect(origins, np.tile([0.0, 0.0, 1.0], (64, 1)))
    assert tracer.statistics.levels[0]["tests"] == 50


def test_missing_rays_are_trimmed(rng, session):
    stream = grid_of_rays(33, 17)
    tfar = stream.dir_tfar.get()
    tfar[rng.random(len(stream)) < 0.6, 3] = -1.0
    stream.dir_tfar = session.upload("holes", tfar)
    active = int((tfar[:, 3] >= 0).sum())
    crsh = rs.Tracer(triangle_soup(rng, 200), "crsh", **PAPER)
    brute = rs.Tracer(crsh.scene, "brute")
    ours, theirs = (t.intersect_stream(session, stream) for t in (crsh, brute))
    np.testing.assert_array_equal(ours.triangle.get(), theirs.triangle.get())
    np.testing.assert_array_equal(ours.t.get(), theirs.t.get())
    # Without gaps: as many nodes as the rays fill.
    assert crsh.statistics.rays == active
    assert crsh.statistics.levels[1]["nodes"] == -(-active // 8)
    assert crsh.statistics.levels[0]["nodes"] == -(-active // 64)


def test_sorting_saves_tests_of_incoherent_rays(rng):
    """Shuffled rays of a bundle: nodes of neighbours are what the order is for."""
    scene = triangle_soup(rng, 2000, size=0.05)
    origins = np.tile([0.5, 0.5, -2.0], (4096, 1))
    directions = np.concatenate([rng.random((4096, 2)) - 0.5, np.full((4096, 1), 2.0)], axis=1)
    totals = {}
    for name in (None, "paper", "octahedral"):
        tracer = rs.Tracer(scene, "crsh", **{**PAPER, "hash": name})
        tracer.intersect(origins, directions)
        totals[name] = tracer.statistics.total_tests
    assert totals["paper"] < 0.6 * totals[None] and totals["octahedral"] < 0.6 * totals[None]


@pytest.mark.parametrize("options", [PAPER, {}, {"clusters": 16, "levels": 3}], ids=str)
def test_a_memory_limit_changes_nothing_but_batches(rng, session, options):
    scene = triangle_soup(rng, 3000, size=0.3)
    stream = grid_of_rays(64, 64)
    free, bounded = (
        rs.Tracer(scene, "crsh", memory_limit=limit, **options) for limit in (None, 400_000)
    )
    expected, hits = (t.intersect_stream(session, stream) for t in (free, bounded))
    np.testing.assert_array_equal(hits.triangle.get(), expected.triangle.get())
    np.testing.assert_array_equal(hits.t.get(), expected.t.get())
    assert bounded.statistics.batches > 1
    assert bounded.statistics.peak_stream_bytes <= 400_000
    for name in ("levels", "mesh_tests", "final_tests", "final_hits"):
        assert getattr(bounded.statistics, name) == getattr(free.statistics, name), name


@pytest.mark.parametrize("clusters", [None, 64])
def test_moving_vertices_move_what_is_culled(rng, clusters):
    scene = triangle_soup(rng, 300)
    moving = rs.Tracer(scene, "crsh", clusters=clusters)
    rays_given = random_rays(rng, 500)
    moving.intersect(*rays_given)
    moved = scene.vertices[::-1] * [1, 2, 3]
    moving.update_vertices(moved)
    hits = moving.intersect(*rays_given)
    brute = rs.Tracer(scene, "brute")
    brute.update_vertices(moved)
    expected = brute.intersect(*rays_given)
    np.testing.assert_array_equal(hits.prim_id, expected.prim_id)
    np.testing.assert_array_equal(hits.t, expected.t)
    assert moving.statistics.final_hits == brute.statistics.final_hits


def test_every_stage_of_the_paper_is_timed(rng):
    tracer = rs.Tracer(triangle_soup(rng, 100), "crsh")
    tracer.intersect(*random_rays(rng, 1000))
    assert {RAY_CREATION, COMPRESSION, SORTING, DECOMPRESSION} <= set(tracer.statistics.stages)


def test_shadow_rays_of_a_light_know_it(session):
    scene = scenes.cornell()
    seen = []

    class Recorder(rs.Tracer):
        def occluded_stream(self, session, stream):
            seen.append(stream.light)
            return super().occluded_stream(session, stream)

    lights = [rs.PointLight((278, 500, 200)), rs.DirectionalLight((0, -1, 0.5))]
    scene.set_lights(lights)
    rs.Renderer(scene, Recorder(scene, "crsh")).render(size=(16, 16), max_bounces=0)
    assert seen == [0, None]


@pytest.mark.parametrize(("options", "message"), [
    ({"hash": "morton"}, "hash: need one of 'paper', 'octahedral', None, got 'morton'"),
    ({"bound": "loose"}, "bound: need one of"),
    ({"clusters": 40}, "clusters: need a multiple of 16, got 40"),
    ({"clusters": 0}, "clusters"),
    ({"cull_meshes": 1}, "cull_meshes: need one of True, False, got 1"),
    ({"levels": None}, "levels"),
    ({"arity": 2}, "arity: need one of 4, 8, got 2"),
])  # fmt: skip
def test_options_that_there_are_not(rng, options, message):
    with pytest.raises(ValueError, match=message):
        rs.Tracer(triangle_soup(rng, 10), "crsh", **options)
