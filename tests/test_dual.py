"""Method `dual`: every traversal answers as brute force does, bit for bit."""

import numpy as np
import pytest
from hypothesis import given, settings
from raystream.baselines import EmbreeTracer
from raystream.baselines.tolerance import differing
from real_scenes import BUNNY, PATIO
from soup import (
    assert_same_hits,
    awkward_queries,
    box,
    grid_of_rays,
    mesh_of,
    random_rays,
    rays_from_afar,
    triangle_soup,
    tripled,
)

import raystream as rs
from raystream import device, program
from raystream.errors import MemoryLimitError
from raystream.rays import from_camera, from_numpy
from raystream.sah import SurfaceAreaBuilder
from raystream.statistics import HIERARCHY_CREATION, TRAVERSAL

TRAVERSALS = ("single", "bundle", "stream", "auto")
every_traversal = pytest.mark.parametrize("traversal", TRAVERSALS)


def assert_exact(scene, *rays, traversals=TRAVERSALS, **options):
    """Closest and any hits equal those of brute force; returns the closest."""
    brute = rs.Tracer(scene, "brute")
    hits, blocked = brute.intersect(*rays), brute.occluded(*rays)
    for traversal in traversals:
        dual = rs.Tracer(scene, "dual", traversal=traversal, **options)
        assert_same_hits(dual.intersect(*rays), hits)
        np.testing.assert_array_equal(dual.occluded(*rays), blocked)
    return hits


# ---- exactness ----


@pytest.mark.parametrize("count", [1, 15, 16, 17, 63, 64, 65, 1009, 10007])
@pytest.mark.parametrize("triangles", [1, 2, 8, 9, 500])
def test_hits_equal_brute_force(rng, triangles, count):
    scene = triangle_soup(rng, triangles)
    assert_exact(scene, *random_rays(rng, count))
    assert_exact(scene, *random_rays(rng, count), 0.01, 2.0)


@settings(max_examples=60, deadline=None)
@given(awkward_queries())
def test_no_hit_is_ever_lost(queries):
    scene, rays = queries
    assert_exact(scene, *rays)


def test_rays_along_the_faces_of_boxes():
    """In faces, along edges, through vertices of boxes; zero components of both signs."""
    steps = np.linspace(-0.25, 1.25, 25)
    places = np.stack(np.meshgrid(steps, steps), -1).reshape(-1, 2)
    for scene in (box(), boxes_in_a_grid(4)):
        for axis in range(3):
            origins = np.insert(places, axis, -1.0, axis=1)
            directions = np.tile(np.eye(3)[axis], (len(places), 1))
            directions[::2] = np.where(directions[::2] == 0, -0.0, directions[::2])
            assert_exact(scene, origins, directions)
            assert_exact(scene, origins, -directions)
            assert_exact(scene, origins + 1.5 * directions, directions)


def boxes_in_a_grid(count):
    """Unit boxes that share their faces, scaled to the unit cube."""
    unit = box().meshes[0]
    offsets = np.stack(np.meshgrid(*[np.arange(count)] * 3), -1).reshape(-1, 3)
    return rs.Scene([
        rs.Mesh(((unit.vertices + o) / count).astype(np.float32), unit.faces, name=str(o))
        for o in offsets
    ])  # fmt: skip


@pytest.mark.parametrize("origin", [(0.1, 0.2, 0.3), (0.0, 0.0, 0.0), (1e-3, 0.0, 2.0)])
def test_no_ray_at_an_edge_or_vertex_of_a_closed_mesh_misses(rng, origin):
    """From inside, 10^5 rays: at vertices, edges' midpoints and edges' points of a sphere."""
    scene = rs.scenes.mirror_ball((0.0, 0.0, 0.0), 5.0)
    corners = scene.vertices[scene.faces].astype(np.float64)
    weights = np.zeros((33_334, 3, 3))
    weights[:, 0] = np.eye(3)[rng.integers(0, 3, len(weights))]
    weights[:, 1] = (1 - np.eye(3)[rng.integers(0, 3, len(weights))]) / 2
    weights[:, 2, 0] = rng.random(len(weights))
    weights[:, 2, 1] = 1 - weights[:, 2, 0]
    triangle = rng.integers(0, len(corners), len(weights))
    aim = np.einsum("nkj,njx->nkx", weights, corners[triangle]).reshape(-1, 3)
    for traversal in TRAVERSALS:
        dual = rs.Tracer(scene, "dual", traversal=traversal)
        origins = np.tile(np.float32(origin), (len(aim), 1))
        assert (dual.intersect(origins, aim - origins).prim_id >= 0).all()
        assert dual.occluded(origins, aim - origins, 0.0, 2.0).all()


@pytest.mark.parametrize("count", [1, 7, 8, 9, 1000, 4097])
def test_all_triangles_in_one_place(rng, count):
    """Duplicates: the smallest number wins; points and lines are never hit."""
    triangle = np.array([[[0, 0, 1], [1, 0, 1], [0, 1, 1]]], np.float32)
    rays = np.zeros((200, 3)), np.append(rng.random((200, 2)), np.ones((200, 1)), axis=1)
    hits = assert_exact(rs.Scene([mesh_of("same", np.repeat(triangle, count, axis=0))]), *rays)
    assert set(hits.prim_id) == {-1, 0}
    point = rs.Scene([mesh_of("point", np.ones((count, 3, 3), np.float32))])
    assert (assert_exact(point, *rays).prim_id == -1).all()


def test_one_huge_triangle_among_tiny_ones(rng):
    tiny = rng.random((1000, 1, 3)) + 0.02 * rng.random((1000, 3, 3))
    tiny[500] = [[-1e4, -1e4, 0.4], [1e4, -1e4, 0.5], [0, 1e4, 0.6]]
    scene = rs.Scene([mesh_of("all", tiny.astype(np.float32))])
    triangles = assert_exact(scene, *random_rays(rng, 2000)).prim_id
    assert (triangles == 500).any() and ((triangles >= 0) & (triangles != 500)).any()


def test_a_flat_scene(rng):
    flat = rng.random((1000, 1, 3)) + 0.1 * rng.random((1000, 3, 3))
    flat[:, :, 1] = 0.25
    rays = random_rays(rng, 2000)
    rays[1][::4, 1] = 0
    rays[0][::8, 1] = 0.25
    assert_exact(rs.Scene([mesh_of("flat", flat.astype(np.float32))]), *rays)


def test_equal_distances_go_to_the_smaller_triangle(rng):
    scene = tripled(triangle_soup(rng, 200))
    assert_exact(scene, *random_rays(rng, 2000, spread=0.2))


def test_rays_from_afar_and_of_extreme_length(rng):
    scene = triangle_soup(rng, 200)
    assert_exact(scene, *rays_from_afar(rng, scene))


@every_traversal
def test_inactive_rays_hit_nothing(rng, traversal):
    scene = triangle_soup(rng, 300)
    origins, directions = random_rays(rng, 500, spread=0.0)
    tfar = np.where(np.arange(500) % 3 == 0, 0.5, np.inf)
    dual = rs.Tracer(scene, "dual", traversal=traversal)
    hits = dual.intersect(origins, directions, 1.0, tfar)
    assert (hits.prim_id[::3] == -1).all()
    assert dual.statistics.rays == 333 and (hits.prim_id >= 0).any()
    assert not dual.occluded(origins, directions, 1.0, tfar)[::3].any()


def test_rays_of_one_origin(rng):
    """Shadow rays, as from a light: any hit and closest hit, with an end and without."""
    scene = triangle_soup(rng, 2000, size=0.05)
    light = np.tile(np.float32([0.5, 2.0, 0.5]), (4000, 1))
    ends = rng.random((4000, 3)).astype(np.float32)
    assert_exact(scene, light, ends - light, 0.0, 1.0)
    assert_exact(scene, light, ends - light)


@every_traversal
@pytest.mark.parametrize("size", [(64, 64), (37, 23), (1, 1), (130, 9)])
def test_rays_of_a_screen(rng, session, traversal, size):
    scene, stream = triangle_soup(rng, 2000, size=0.1), grid_of_rays(*size)
    dual, brute = rs.Tracer(scene, "dual", traversal=traversal), rs.Tracer(scene, "brute")
    ours, theirs = (t.intersect_stream(session, stream) for t in (dual, brute))
    for field in ("t", "triangle", "u", "v"):
        np.testing.assert_array_equal(
            *(getattr(hits, field).get() for hits in (ours, theirs)), field
        )
    assert dual.statistics.rays == size[0] * size[1]


@pytest.mark.parametrize("real", [BUNNY, PATIO], ids=lambda real: real.name)
def test_real_scenes(scene_folder, session, rng, real):
    scene = real.load(scene_folder)
    stream = from_camera(session, real.camera, (48, 48))
    low, high = scene.vertices.min(axis=0), scene.vertices.max(axis=0)
    origins = low + (high - low) * rng.random((2000, 3))
    inside = from_numpy(session, origins, rng.normal(size=(2000, 3)), 0.0, np.inf)
    brute = rs.Tracer(scene, "brute")
    for rays in (stream, inside):
        theirs = brute.intersect_stream(session, rays)
        blocked = brute.occluded_stream(session, rays).get()
        assert np.isfinite(theirs.t.get()).sum() > 200
        for traversal in TRAVERSALS:
            dual = rs.Tracer(scene, "dual", traversal=traversal)
            ours = dual.intersect_stream(session, rays)
            for field in ("t", "triangle", "u", "v"):
                left, right = (getattr(hits, field).get() for hits in (ours, theirs))
                np.testing.assert_array_equal(left, right, field)
            np.testing.assert_array_equal(dual.occluded_stream(session, rays).get(), blocked)


def test_embree_agrees(rng):
    scene = triangle_soup(rng, 20_000, size=0.03)
    triangles = (scene.vertices, scene.faces, scene.first_prims)
    rays = random_rays(rng, 20_000)
    expected = EmbreeTracer.from_scene(scene).intersect(*rays)
    for traversal in TRAVERSALS:
        hits = rs.Tracer(scene, "dual", traversal=traversal).intersect(*rays)
        agreement = differing(hits, expected, *triangles, *rays)
        assert agreement.num_wrong == 0, (traversal, agreement)


# ---- frames, counts, options ----


@every_traversal
def test_moving_vertices(rng, traversal):
    scene, rays = triangle_soup(rng, 300), random_rays(rng, 500)
    dual, brute = rs.Tracer(scene, "dual", traversal=traversal), rs.Tracer(scene, "brute")
    for vertices in (scene.vertices, scene.vertices[::-1] * [1, 2, 3], scene.vertices * 0):
        dual.update_vertices(vertices)
        brute.update_vertices(vertices)
        assert_same_hits(dual.intersect(*rays), brute.intersect(*rays))


@pytest.mark.parametrize("count", [8000, 10_000])  # alone, and after a look at some
def test_the_better_builder_is_left_where_it_does_not_fit(rng, count):
    scene, rays = triangle_soup(rng, 1000), random_rays(rng, count)
    bytes_of = {}
    for builder in ("fast", "quality"):
        tracer = rs.Tracer(scene, "dual", builder=builder)
        tracer.intersect(*rays)
        bytes_of[builder] = tracer.statistics.structure_bytes
    both = sum(bytes_of.values())
    for limit, built in ((both, "quality"), (both - 1, "fast"), (bytes_of["fast"], "fast")):
        tracer = rs.Tracer(scene, "dual", memory_limit=limit)
        for _ in range(2):
            tracer.intersect(*rays)
        assert tracer.statistics.structure_bytes == bytes_of[built]
    with pytest.raises(MemoryLimitError, match="1000 triangles need"):
        rs.Tracer(scene, "dual", memory_limit=bytes_of["fast"] - 1).intersect(*rays)


def test_a_tree_is_made_once_a_frame_and_takes_no_new_memory(rng, session):
    dual = rs.Tracer(triangle_soup(rng, 300), "dual")
    rays = random_rays(rng, 100)
    dual.intersect(*rays)
    assert {HIERARCHY_CREATION, TRAVERSAL} <= set(dual.statistics.stages)
    dual.occluded(*rays)
    assert HIERARCHY_CREATION not in dual.statistics.stages
    held = None
    for _ in range(3):
        dual.update_vertices(dual.scene.vertices)
        dual.intersect(*rays)
        assert HIERARCHY_CREATION in dual.statistics.stages
        assert held is None or session.pool.managed_bytes == held
        held = session.pool.managed_bytes


@every_traversal
def test_counts(rng, traversal):
    scene, rays = triangle_soup(rng, 3000, size=0.05), random_rays(rng, 3000)
    dual, again = (rs.Tracer(scene, "dual", traversal=traversal) for _ in range(2))
    hits = dual.intersect(*rays)
    counts = dual.statistics
    assert counts.rays == 3000 and counts.triangles == 3000 and counts.batches == 1
    assert (hits.prim_id >= 0).sum() <= counts.final_hits <= counts.final_tests
    assert counts.final_tests < 0.02 * 3000 * 3000
    for level in counts.levels:
        assert level["hits"] + level["misses"] == level["tests"]
    assert counts.structure_bytes > 3000 * 40
    again.intersect(*rays)
    for name in ("levels", "final_tests", "final_hits"):
        assert getattr(again.statistics, name) == getattr(counts, name)


def test_auto_takes_the_traversal_that_suits_the_rays(rng, session):
    """Few rays alone, a camera's as bundles, scattered ones as a stream: the counts tell."""
    scene = triangle_soup(rng, 20_000, size=0.02)
    scattered = from_numpy(session, *random_rays(rng, 20_000), 0.0, np.inf)
    few = from_numpy(session, *random_rays(rng, 500), 0.0, np.inf)
    cases = (("single", few), ("bundle", grid_of_rays(256, 256)), ("stream", scattered))
    for traversal, rays in cases:
        counts = []
        for choice in ("auto", *TRAVERSALS[:3]):
            dual = rs.Tracer(scene, "dual", builder="fast", traversal=choice)
            dual.intersect_stream(session, rays)
            counts.append(dual.statistics.levels[0])
        auto, *others = counts
        assert auto == others[TRAVERSALS.index(traversal)], traversal
        assert sum(auto == other for other in others) == 1


@pytest.mark.parametrize("more", [0, 1])
@pytest.mark.parametrize("length", [2048, 8192])
def test_streams_are_long_where_there_are_enough(length, more, rng, session):
    """From so many rays on streams are twice as long: the hits are the same."""
    count = length * 16 * session.device.max_compute_units - 1 + more
    scene, rays = triangle_soup(rng, 60, size=0.3), random_rays(rng, count)
    tracers = [rs.Tracer(scene, "dual", traversal=t) for t in ("single", "stream")]
    found = [tracer.intersect(*rays) for tracer in tracers]
    for field in ("t", "prim_id", "u", "v"):
        np.testing.assert_array_equal(*(getattr(hits, field) for hits in found))
    streams = -(-count // (length if more else length // 2))
    assert tracers[1].statistics.levels[0]["nodes"] >= streams  # each visits the root


def test_a_stream_without_room_for_its_lists_finishes_as_single_rays(rng, session):
    """All rays enter all boxes, deeper than there is room for: hits are the same."""
    triangle = np.float32([[-9, -9, 0], [9, -9, 0], [0, 9, 0]])
    heights = rng.random(20_000, np.float32)[:, None, None] * np.float32([0, 0, 1])
    scene = rs.Scene([mesh_of("layers", triangle + heights)])
    origins = rng.random((3000, 3), np.float32) * np.float32([0.1, 0.1, 0]) + [0, 0, 5]
    rays = origins, np.tile([0, 0, -1], (3000, 1))
    assert_exact(scene, *rays, traversals=("stream",), builder="fast")
    dual = rs.Tracer(scene, "dual", traversal="stream", builder="fast")
    dual.intersect(*rays)
    assert dual.statistics.levels[0]["nodes"] > 3000  # as lists they would be some hundreds


def test_auto_sorts_rays_whose_bundles_it_improves(rng, session):
    """Runs of 32 neighbours in any order: asked for bundles, `dual` always sorts such rays."""
    scene = triangle_soup(rng, 20_000, size=0.02)
    side = (np.arange(256) + 0.5) / 128 - 1
    directions = np.stack((*np.meshgrid(side, side), np.full((256, 256), 2.0)), axis=-1)
    runs = rng.permutation(directions.reshape(-1, 32, 3))
    rays = np.broadcast_to([0.5, 0.5, -1.5], (256 * 256, 3)), runs.reshape(-1, 3)
    auto, bundle = (
        rs.Tracer(scene, "dual", builder="fast", traversal=t) for t in ("auto", "bundle")
    )
    for tracer in (auto, bundle):
        tracer.intersect(*rays)
    assert "sorting" in auto.statistics.stages
    assert auto.statistics.levels == bundle.statistics.levels


def test_auto_takes_rows_of_a_picture_in_tiles(rng, session):
    """Rays from one point, of which some are missing: the hits of any order, in fewer visits."""
    scene = triangle_soup(rng, 20_000, size=0.02)
    x, y = np.meshgrid(*2 * [(np.arange(400) + 0.5) / 200 - 1])
    directions = np.stack((x, y, np.full_like(x, 2.0)), axis=-1)[np.hypot(x + 1, y) > 0.4]
    rays = np.broadcast_to([0.5, 0.5, -1.5], directions.shape), directions
    auto, single = (
        rs.Tracer(scene, "dual", builder="fast", traversal=t) for t in ("auto", "single")
    )
    assert_same_hits(*(tracer.intersect(*rays) for tracer in (auto, single)))
    in_tiles = auto.statistics.levels[0]["nodes"]
    stream = from_numpy(session, *rays, 0.0, np.inf)
    assert stream.one_origin and stream.size is None
    stream.one_origin = False
    auto.intersect_stream(session, stream)
    assert in_tiles < 0.9 * auto.statistics.levels[0]["nodes"]


@pytest.mark.parametrize("spread, traversal", [(0.001, "bundle"), (1.0, "stream")])
def test_auto_takes_bundles_where_neighbours_are_close(spread, traversal, rng):
    """A bundle is eight times eight rays from about one place, in one direction or in any."""
    scene = triangle_soup(rng, 20_000, size=0.02)
    origins, directions = (np.repeat(array, 8, axis=0) for array in random_rays(rng, 8000))
    origins = origins + rng.normal(size=origins.shape, scale=1e-3)
    directions = directions + rng.normal(size=origins.shape, scale=spread)
    auto, stream = (
        rs.Tracer(scene, "dual", builder="fast", traversal=t) for t in ("auto", "stream")
    )
    assert_same_hits(*(tracer.intersect(origins, directions) for tracer in (auto, stream)))
    assert (auto.statistics.levels == stream.statistics.levels) == (traversal == "stream")


@pytest.mark.parametrize("count, is_sorted", [(20_000, False), (100_000, True)])
def test_auto_sorts_streams_of_many_scattered_rays(count, is_sorted, rng):
    """Visits enough for the sort of so many; the hits are those of the order given."""
    scene, rays = triangle_soup(rng, 20_000, size=0.3), random_rays(rng, count)
    auto, stream = (
        rs.Tracer(scene, "dual", builder="fast", traversal=t) for t in ("auto", "stream")
    )
    assert_same_hits(auto.intersect(*rays), stream.intersect(*rays))
    assert ("sorting" in auto.statistics.stages) == is_sorted
    assert "sorting" not in stream.statistics.stages
    assert auto.statistics.rays == stream.statistics.rays == count


def test_the_better_builder_is_taken_for_many_rays(rng):
    """Where those since the last change are enough, or those of the frame before."""
    scene, rays = triangle_soup(rng, 1000), random_rays(rng, 1600)
    auto, fast, quality = (rs.Tracer(scene, "dual", builder=b) for b in ("auto", "fast", "quality"))

    def trace(expected):
        for tracer in (auto, expected):
            tracer.intersect(*rays)
        assert auto.statistics.levels == expected.statistics.levels

    for expected in (fast, quality, quality):  # 1.6 rays to a triangle each, 2.1 are worth it
        trace(expected)
    for expected in (quality, quality):  # 4.8 rays to a triangle in the frame before; fitted
        auto.update_vertices(scene.vertices)
        trace(expected)
    auto.update_vertices(scene.vertices)
    auto.intersect(*(array[:500] for array in rays))
    elsewhere = triangle_soup(rng, 1000).vertices
    for tracer in (auto, fast):
        tracer.update_vertices(elsewhere)
    trace(fast)  # it does not fit, and half a ray to a triangle is not worth another


def test_the_better_tree_is_built_for_the_frames_to_come_and_refitted(rng):
    """2.1 rays to a triangle are worth it, those of two frames here."""
    scene, rays = triangle_soup(rng, 1000), random_rays(rng, 1600)
    auto, fast, quality = (rs.Tracer(scene, "dual", builder=b) for b in ("auto", "fast", "quality"))
    for frame, expected in enumerate((fast, quality, quality, quality)):
        moved = scene.vertices + np.float32(1e-3) * rng.random(scene.vertices.shape)
        for tracer in (auto, expected):
            tracer.update_vertices(moved.astype(np.float32))
        assert_same_hits(auto.intersect(*rays), expected.intersect(*rays))
        visits, fitting = (
            sum(level["nodes"] for level in tracer.statistics.levels) for tracer in (auto, expected)
        )
        assert visits == fitting if frame < 2 else 0.95 < visits / fitting < 1.05


def test_trees_that_do_not_fit_the_next_frame_are_built_ever_more_seldom(rng, monkeypatch):
    """1.6 rays to a triangle, and triangles that are elsewhere in every frame."""
    scene, rays = triangle_soup(rng, 1000), random_rays(rng, 1600)
    builds, build = [0], SurfaceAreaBuilder.build

    def counted(self, *arrays):
        builds[-1] += 1
        build(self, *arrays)

    monkeypatch.setattr(SurfaceAreaBuilder, "build", counted)
    tracer = rs.Tracer(scene, "dual")
    for _ in range(64):
        tracer.update_vertices(triangle_soup(rng, 1000).vertices)
        tracer.intersect(*rays)
        builds.append(builds[-1])
    assert np.flatnonzero(np.diff(builds[:-1])).tolist() == [0, 3, 8, 17, 35]


def test_incoherent_rays_are_worth_the_better_builder_sooner(rng, session):
    """As many rays of a camera and at random: the first visit little, the second much."""
    scene = triangle_soup(rng, 1000, size=0.08)
    scattered = from_numpy(session, *random_rays(rng, 128 * 128), 0.0, np.inf)
    for rays, builder in ((grid_of_rays(128, 128), "fast"), (scattered, "quality")):
        auto, expected = (rs.Tracer(scene, "dual", builder=b) for b in ("auto", builder))
        for tracer in (auto, expected):
            tracer.intersect_stream(session, rays)
        assert auto.statistics.levels == expected.statistics.levels


def test_single_rays_count_what_they_visit():
    """A ray that misses the scene meets the root; one triangle is one node and one leaf."""
    scene = rs.Scene([mesh_of("one", np.array([[[0, 0, 1], [1, 0, 1], [0, 1, 1]]], np.float32))])
    dual = rs.Tracer(scene, "dual", traversal="single")
    dual.intersect([[0.2, 0.2, 0], [5, 5, 0]], [[0, 0, 1]] * 2)
    nodes, leaves = dual.statistics.levels
    assert nodes == {"nodes": 2, "tests": 16, "hits": 1, "misses": 15}
    assert leaves["nodes"] == 1 and dual.statistics.final_tests == 8
    assert dual.statistics.final_hits == 1


@every_traversal
def test_the_portable_path_is_the_same(rng, monkeypatch, traversal):
    scene, rays = triangle_soup(rng, 400, size=0.3), random_rays(rng, 1009)
    first = rs.Tracer(scene, "dual", traversal=traversal)
    expected, blocked = first.intersect(*rays), first.occluded(*rays)
    monkeypatch.setattr(program, "_OPTIONS", (*program._OPTIONS, "-DPORTABLE"))
    monkeypatch.setattr(device, "_thread", type(device._thread)())
    second = rs.Tracer(scene, "dual", traversal=traversal)
    assert_same_hits(second.intersect(*rays), expected)
    np.testing.assert_array_equal(second.occluded(*rays), blocked)
    assert second.statistics.final_tests == first.statistics.final_tests
    assert second.statistics.levels == first.statistics.levels


def test_it_renders():
    scene = rs.scenes.cornell()
    images = [rs.render(scene, size=(48, 48), method=m).image for m in ("brute", "dual")]
    np.testing.assert_array_equal(*images)


@pytest.mark.parametrize(("options", "message"), [
    ({"traversal": "packet"}, "traversal: need one of 'auto', 'single', .*, got 'packet'"),
    ({"builder": "sah"}, "builder: need one of .*, got 'sah'"),
    ({"arity": 4}, "method 'dual' has no option 'arity'; its options: builder, traversal"),
], ids=str)  # fmt: skip
def test_options_that_there_are_not(rng, options, message):
    with pytest.raises(ValueError, match=message) as error:
        rs.Tracer(triangle_soup(rng, 10), "dual", **options)
    assert "\n" not in str(error.value)
