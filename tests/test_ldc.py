"""Method `ldc`: exact mode loses no hit, published mode is close, planes are closer."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from real_scenes import BUNNY, PATIO
from soup import (
    assert_same_hits,
    awkward_queries,
    box,
    random_rays,
    rays_from_afar,
    triangle_soup,
    tripled,
)

import raystream as rs
from raystream import device, program, scenes
from raystream.cube import LayeredDepthCube
from raystream.rays import from_camera, from_numpy
from raystream.statistics import HIERARCHY_CREATION, TRAVERSAL


def assert_exact(scene, *arguments, **options):
    """The exact mode answers as brute force does, bit for bit."""
    ldc, brute = rs.Tracer(scene, "ldc", exact=True, **options), rs.Tracer(scene, "brute")
    assert_same_hits(ldc.intersect(*arguments), brute.intersect(*arguments))
    blocked = brute.occluded(*arguments)
    np.testing.assert_array_equal(ldc.occluded(*arguments), blocked)
    return ldc.statistics


# ---- exact mode ----


@pytest.mark.parametrize("count", [1, 7, 63, 64, 65, 1009])
@pytest.mark.parametrize("options", [
    {}, {"resolution": 1}, {"resolution": 37, "block": 5}, {"block": None, "resolution": 64},
    {"builder": "peeling", "resolution": 64}, {"resolution": 64, "block": 1},
    {"depth": "half"}, {"depth": "half", "resolution": 37, "block": (3, 16)}, {"block": (16, 4)},
], ids=str)  # fmt: skip
def test_hits_equal_brute_force(rng, options, count):
    scene = triangle_soup(rng, 300)
    assert_exact(scene, *random_rays(rng, count), **options)
    assert_exact(scene, *random_rays(rng, count), 0.01, 2.0, **options)


@settings(max_examples=80, deadline=None)
@given(
    awkward_queries(),
    st.sampled_from([1, 16, 100, 512]),
    st.sampled_from([16, 3, (16, 5), (1, 8), None]),
    st.sampled_from(["full", "half"]),
)
def test_no_hit_is_ever_lost(queries, resolution, block, depth):
    scene, rays = queries
    assert_exact(scene, *rays, resolution=resolution, block=block, depth=depth)


def test_rays_along_the_lines_of_the_grid():
    """A box's rays in its faces, along its edges and on lines between texels and blocks."""
    scene, steps = box(), np.linspace(-0.25, 1.25, 25)
    places = np.stack(np.meshgrid(steps, steps), -1).reshape(-1, 2)
    for axis in range(3):
        origins = np.insert(places, axis, -1.0, axis=1)
        directions = np.tile(np.eye(3)[axis], (len(places), 1))
        for resolution in (16, 64):
            assert_exact(scene, origins, directions, resolution=resolution)
            assert_exact(scene, origins, -directions, resolution=resolution)
            assert_exact(scene, origins + 1.5 * directions, directions, resolution=resolution)


def test_equal_distances_go_to_the_smaller_triangle(rng):
    scene = tripled(triangle_soup(rng, 200))
    assert_exact(scene, *random_rays(rng, 2000, spread=0.2))


def test_rays_from_afar_and_of_extreme_length(rng):
    scene = triangle_soup(rng, 200)
    assert_exact(scene, *rays_from_afar(rng, scene))


@pytest.mark.parametrize("exact", [False, True])
def test_inactive_rays_hit_nothing(rng, exact):
    scene = triangle_soup(rng, 300)
    origins, directions = random_rays(rng, 500, spread=0.0)
    tfar = np.where(np.arange(500) % 3 == 0, 0.5, np.inf)
    ldc = rs.Tracer(scene, "ldc", exact=exact, resolution=64)
    hits = ldc.intersect(origins, directions, 1.0, tfar)
    assert (hits.prim_id[::3] == -1).all()
    assert ldc.statistics.rays == 333 and (hits.prim_id >= 0).any()
    assert not ldc.occluded(origins, directions, 1.0, tfar)[::3].any()


@pytest.mark.parametrize("builder", ["a-buffer", "peeling"])
def test_moving_vertices(rng, builder):
    scene = triangle_soup(rng, 300)
    moving = rs.Tracer(scene, "ldc", exact=True, resolution=64, builder=builder)
    rays = random_rays(rng, 500)
    moving.intersect(*rays)
    vertices = scene.vertices[::-1] * [1, 2, 3]
    moving.update_vertices(vertices)
    brute = rs.Tracer(scene, "brute")
    brute.update_vertices(vertices)
    assert_same_hits(moving.intersect(*rays), brute.intersect(*rays))


def test_a_cube_is_made_once_a_frame(rng):
    ldc = rs.Tracer(triangle_soup(rng, 300), "ldc", resolution=64)
    rays = random_rays(rng, 100)
    ldc.intersect(*rays)
    assert {HIERARCHY_CREATION, TRAVERSAL} <= set(ldc.statistics.stages)
    ldc.occluded(*rays)
    assert HIERARCHY_CREATION not in ldc.statistics.stages
    ldc.update_vertices(ldc.scene.vertices)
    ldc.intersect(*rays)
    assert HIERARCHY_CREATION in ldc.statistics.stages


def test_counts(rng):
    scene = triangle_soup(rng, 300)
    rays = random_rays(rng, 1000)
    ldc, brute = rs.Tracer(scene, "ldc", exact=True, resolution=256), rs.Tracer(scene, "brute")
    hits = ldc.intersect(*rays)
    brute.intersect(*rays)
    counts = ldc.statistics
    assert counts.rays == 1000 and counts.triangles == 300 and counts.batches == 1
    assert (hits.prim_id >= 0).sum() <= counts.final_hits <= counts.final_tests
    assert counts.final_hits <= brute.statistics.final_hits
    assert counts.total_tests == counts.final_tests < 0.01 * brute.statistics.final_tests
    again = rs.Tracer(scene, "ldc", exact=True, resolution=256)
    again.intersect(*rays)
    assert (again.statistics.final_tests, again.statistics.final_hits) == (
        counts.final_tests, counts.final_hits
    )  # fmt: skip


# ---- published mode ----

PAPER = 1e-3  # tolerance


def sphere_hits(resolution, **options):
    """Rays from around a smooth mesh of 20,480 triangles: our hits, brute force's, the rays."""
    rng = np.random.default_rng(3)
    scene = scenes.mirror_ball((1.0, 2.0, 3.0), 2.0)
    origins = rng.normal(size=(20000, 3))
    origins *= 5 / np.linalg.norm(origins, axis=1, keepdims=True)
    directions = 1.5 * rng.normal(size=(20000, 3)) - origins
    rays = origins + [1, 2, 3], directions
    tracers = rs.Tracer(scene, "ldc", resolution=resolution, **options), rs.Tracer(scene, "brute")
    return *(t.intersect(*rays) for t in tracers), rays


def share_differing(ours, theirs, rays):
    """Part of the rays hit by one alone, or further apart than a half percent of the edge."""
    hit, expected = ours.prim_id >= 0, theirs.prim_id >= 0
    apart, both = hit != expected, hit & expected
    lengths = np.linalg.norm(rays[1], axis=1)[both]
    apart[both] = np.abs(ours.t[both] - theirs.t[both]) * lengths > 0.02
    return apart.mean()


def test_the_published_mode_is_close_and_closer_with_resolution():
    """The edge is 4, the tolerance 0.007: most of what differs meets the surface at a low angle."""
    assert share_differing(*sphere_hits(512, tolerance=PAPER)) < 0.08
    coarse, fine = (share_differing(*sphere_hits(n, tolerance=5e-4)) for n in (256, 512))
    assert fine < 0.03 and fine < 0.5 * coarse, (coarse, fine)


def test_published_hits_lie_near_their_triangles():
    ours, _, (origins, directions) = sphere_hits(512, tolerance=PAPER)
    hit = ours.prim_id >= 0
    assert hit.sum() > 10000
    radius = np.linalg.norm(origins + ours.t[:, None] * directions - [1, 2, 3], axis=1)[hit]
    # The tolerance is 0.007 here, a texel 0.008.
    assert np.abs(radius - 2).max() < 0.02
    u, v = ours.u[hit], ours.v[hit]
    assert (u >= 0).all() and (v >= 0).all() and (u + v <= 1 + 1e-6).all()
    scene = scenes.mirror_ball((1.0, 2.0, 3.0), 2.0)
    assert (u > 0).any()
    corners = scene.vertices[scene.faces[ours.prim_id[hit]]].astype(np.float64)
    weights = np.stack([1 - u - v, u, v], -1)
    point = np.einsum("ij,ijk->ik", weights, corners)
    on_ray = (origins + ours.t[:, None] * directions)[hit]
    assert np.linalg.norm(point - on_ray, axis=1).max() < 0.03


def test_published_hits_are_shaded_from_the_stored_sample():
    """u and v are those of a sample: of the middle of a texel in which the triangle has one."""
    scene, resolution = scenes.mirror_ball((1.0, 2.0, 3.0), 2.0), 100
    hits, _, _ = sphere_hits(resolution, tolerance=PAPER)
    cube = LayeredDepthCube.build(scene, resolution)
    texel = np.repeat(np.arange(3 * resolution**2), np.diff(cube.first.get().astype(np.int64)))
    stored = set(zip(cube.samples.get()["triangle"].tolist(), texel.tolist(), strict=True))
    inner = (hits.u > 0) & (hits.v > 0) & (hits.u + hits.v < 0.9999)
    assert inner.sum() > 5000
    u, v, triangle = hits.u[inner, None], hits.v[inner, None], hits.prim_id[inner]
    low, per_unit = cube.grid.get()[0, :3], cube.grid.get()[0, 3]
    a, b, c = np.moveaxis(
        (scene.vertices[scene.faces[triangle]].astype(np.float64) - low) * per_unit, 1, 0
    )
    point = (1 - u - v) * a + u * b + v * c
    axis = np.abs(np.cross(b - a, c - a)).argmax(axis=1)
    rows = np.arange(len(point))
    column, row = point[rows, (axis + 1) % 3], point[rows, (axis + 2) % 3]
    assert max(np.abs(x % 1 - 0.5).max() for x in (column, row)) < 1e-3
    texels = axis * resolution**2 + column.astype(int) * resolution + row.astype(int)
    found = [pair in stored for pair in zip(triangle.tolist(), texels.tolist(), strict=True)]
    assert np.mean(found) > 0.999  # a ray on a line between texels may be taken for its neighbour's


def test_the_tolerance_closes_gaps():
    """Without any, only rays whose depths over a texel enclose a sample's hit it."""
    hits = [np.mean(sphere_hits(256, tolerance=x)[0].prim_id >= 0) for x in (0.0, 1e-3, 1e-2)]
    assert hits[0] < hits[1] < hits[2]


# ---- planes ----


@pytest.mark.parametrize("depth", ["full", "half"])
def test_planes_are_closer_than_points_and_lie_on_the_rays(depth):
    ours, brute, (origins, directions) = sphere_hits(512, depth=depth)
    assert share_differing(ours, brute, (origins, directions)) < 0.01
    scene = scenes.mirror_ball((1.0, 2.0, 3.0), 2.0)
    hit = ours.prim_id >= 0
    a, b, c = np.moveaxis(scene.vertices[scene.faces[ours.prim_id[hit]]].astype(np.float64), 1, 0)
    normal = np.cross(b - a, c - a)
    along = lambda v: np.einsum("ij,ij->i", v, normal)  # noqa: E731
    plane = along(a - origins[hit]) / along(directions[hit])
    steep = np.abs(along(directions[hit])) > 0.1 * np.linalg.norm(directions[hit], axis=1) * (
        np.linalg.norm(normal, axis=1)
    )
    np.testing.assert_allclose(ours.t[hit][steep], plane[steep], rtol=1e-4)
    # Shaded where the ray meets the triangle: its point, but for what lies beside the outline.
    weights = np.stack([1 - ours.u - ours.v, ours.u, ours.v], -1)[hit]
    point = weights[:, :1] * a + weights[:, 1:2] * b + weights[:, 2:] * c
    inner = (weights > 1e-3).all(axis=1) & steep
    assert inner.mean() > 0.5
    met = (origins + ours.t[:, None] * directions)[hit]
    assert np.linalg.norm(point - met, axis=1)[inner].max() < 1e-3


@pytest.mark.parametrize("tolerance", [PAPER, None])
def test_hits_of_samples_respect_the_segment(tolerance):
    scene = scenes.mirror_ball((0, 0, 0), 1.0)
    ldc = rs.Tracer(scene, "ldc", resolution=128, tolerance=tolerance)
    origins, directions = np.tile([[-3.0, 0.01, 0.02]], (4, 1)), np.tile([[2.0, 0, 0]], (4, 1))
    hits = ldc.intersect(origins, directions, [0, 1.2, 0, 2.2], [np.inf, np.inf, 0.8, np.inf])
    np.testing.assert_allclose(hits.t, [1, 2, np.inf, np.inf], atol=0.01)
    blocked = ldc.occluded(origins, directions, [0, 1.2, 0, 2.2], [np.inf, np.inf, 0.8, np.inf])
    np.testing.assert_array_equal(blocked, [True, True, False, False])


@pytest.mark.parametrize("options", [{}, {"tolerance": PAPER}, {"exact": True}], ids=str)
def test_the_coarse_level_changes_nothing(rng, options):
    scene, rays = triangle_soup(rng, 500, size=0.1), random_rays(rng, 2000)
    expected = rs.Tracer(scene, "ldc", resolution=128, block=None, **options).intersect(*rays)
    for block in (8, 16, 11, (5, 24), (24, 5)):
        hits = rs.Tracer(scene, "ldc", resolution=128, block=block, **options).intersect(*rays)
        if options.get("exact"):
            assert_same_hits(hits, expected)
        else:
            np.testing.assert_array_equal(hits.prim_id, expected.prim_id)
            np.testing.assert_allclose(hits.t, expected.t, rtol=1e-5)


def test_it_renders(session):
    scene = scenes.cornell()
    images = [
        rs.render(scene, size=(48, 48), method=rs.Tracer(scene, method, **options)).image
        for method, options in (("brute", {}), ("ldc", {"exact": True}))
    ]
    np.testing.assert_array_equal(*images)


@pytest.mark.parametrize(("tolerance", "share"), [(PAPER, 0.03), (None, 0.01)])
def test_images_of_samples_are_close(tolerance, share):
    """No surface shadows itself, though shadow rays end on it and mirrored rays start there."""
    scene = scenes.cornell("mirrors")
    exact, close = (
        rs.render(scene, size=(96, 96), method=tracer).image
        for tracer in (rs.Tracer(scene, "brute"), rs.Tracer(scene, "ldc", tolerance=tolerance))
    )
    differ = np.abs(np.clip(exact, 0, 1) - np.clip(close, 0, 1)).max(axis=-1) > 0.05
    assert differ.mean() < share, differ.mean()


@pytest.mark.parametrize("real", [BUNNY, PATIO], ids=lambda real: real.name)
def test_real_scenes(scene_folder, session, rng, real):
    scene = real.load(scene_folder)
    stream = from_camera(session, real.camera, (48, 48))
    low, high = scene.vertices.min(axis=0), scene.vertices.max(axis=0)
    origins = low + (high - low) * rng.random((2000, 3))
    inside = from_numpy(session, origins, rng.normal(size=(2000, 3)), 0.0, np.inf)
    ldc, brute = rs.Tracer(scene, "ldc", exact=True), rs.Tracer(scene, "brute")
    for given_rays in (stream, inside):
        ours, theirs = (t.intersect_stream(session, given_rays) for t in (ldc, brute))
        assert np.isfinite(ours.t.get()).sum() > 200
        for field in ("t", "triangle", "u", "v"):
            left, right = (getattr(hits, field).get() for hits in (ours, theirs))
            np.testing.assert_array_equal(left, right, field)
        blocked, expected = (t.occluded_stream(session, given_rays) for t in (ldc, brute))
        np.testing.assert_array_equal(blocked.get(), expected.get())


@pytest.mark.parametrize("options", [{}, {"tolerance": PAPER}, {"exact": True}], ids=str)
def test_the_portable_path_is_the_same(rng, monkeypatch, options):
    scene, given_rays = triangle_soup(rng, 400, size=0.3), random_rays(rng, 1009)
    first = rs.Tracer(scene, "ldc", resolution=100, **options)
    expected = first.intersect(*given_rays)
    monkeypatch.setattr(program, "_OPTIONS", (*program._OPTIONS, "-DPORTABLE"))
    monkeypatch.setattr(device, "_thread", type(device._thread)())
    second = rs.Tracer(scene, "ldc", resolution=100, **options)
    assert_same_hits(second.intersect(*given_rays), expected)
    assert second.statistics.final_tests == first.statistics.final_tests


# ---- options ----


@pytest.mark.parametrize(("options", "message"), [
    ({"resolution": 0}, "resolution: need a whole number of at least 1, got 0"),
    ({"resolution": 64.0}, "resolution: need a whole number"),
    ({"resolution": 20000}, "resolution: need at most 16384, got 20000"),
    ({"exact": 1}, "exact: need one of True, False, got 1"),
    ({"tolerance": -0.1}, "tolerance: need a part of the scene's diagonal, at least 0, got -0.1"),
    ({"tolerance": "near"}, "tolerance: need"),
    ({"builder": "raster"}, "builder: need one of 'a-buffer', 'peeling', got 'raster'"),
    ({"block": 0}, "block: need a whole number of at least 1, got 0"),
    ({"block": (8, 0)}, "block: need a whole number of at least 1, got 0"),
    ({"block": (8, 8, 8)}, "block: need columns and rows, got 3 numbers"),
    ({"depth": "double"}, "depth: need one of 'full', 'half', got 'double'"),
    ({"layers": 4}, "method 'ldc' has no option 'layers'; its options: resolution, exact"),
], ids=str)  # fmt: skip
def test_options_that_there_are_not(rng, options, message):
    with pytest.raises(ValueError, match=message) as error:
        rs.Tracer(triangle_soup(rng, 10), "ldc", **options)
    assert "\n" not in str(error.value)
