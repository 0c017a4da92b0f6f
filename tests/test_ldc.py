"""The layered depth cube: both builders agree, exact mode loses no hit, published mode is close."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from real_scenes import BUNNY, PATIO
from soup import mesh_of, random_rays, triangle_soup

import raystream as rs
from raystream import device, program, scenes
from raystream.errors import MemoryLimitError
from raystream.ldc import LayeredDepthCube
from raystream.rays import from_camera, from_numpy
from raystream.statistics import HIERARCHY_CREATION, TRAVERSAL

FIELDS = ("t", "prim_id", "geom_id", "u", "v")


def assert_same_hits(ours, theirs):
    for field in FIELDS:
        np.testing.assert_array_equal(getattr(ours, field), getattr(theirs, field), field)


def assert_exact(scene, *arguments, **options):
    """The exact mode answers as brute force does, bit for bit."""
    ldc, brute = rs.Tracer(scene, "ldc", exact=True, **options), rs.Tracer(scene, "brute")
    assert_same_hits(ldc.intersect(*arguments), brute.intersect(*arguments))
    blocked = brute.occluded(*arguments)
    np.testing.assert_array_equal(ldc.occluded(*arguments), blocked)
    return ldc.statistics


# ---- construction ----


@pytest.mark.parametrize("exact", [False, True])
@pytest.mark.parametrize("resolution", [1, 3, 64, 100])
def test_both_builders_make_the_same_layers(rng, exact, resolution):
    scene = triangle_soup(rng, 400, size=0.5)
    one, many = (
        LayeredDepthCube.build(scene, resolution, exact=exact, builder=builder)
        for builder in ("a-buffer", "peeling")
    )
    assert one.num_samples == many.num_samples
    np.testing.assert_array_equal(one.layers, many.layers)
    for name in ("first", "samples", "blocks"):
        np.testing.assert_array_equal(getattr(one, name).get(), getattr(many, name).get(), name)


def test_texels_of_any_depth_are_sorted(rng):
    """Hundreds of layers in a texel: nothing is cut off, and heaps sort as insertion does."""
    heights = rng.permutation(300)[:, None, None] // 3
    corners = np.concatenate(
        [np.tile([[[0, 0], [1, 0], [0, 1]]], (300, 1, 1)), np.tile(heights / 300, (1, 3, 1))], 2
    )
    scene = rs.Scene([mesh_of("stack", corners.astype(np.float32))])
    one, many = (
        LayeredDepthCube.build(scene, 4, exact=True, builder=b) for b in ("a-buffer", "peeling")
    )
    np.testing.assert_array_equal(one.layers, [0, 0, 300])
    samples, first = one.samples.get(), one.first.get()
    np.testing.assert_array_equal(samples, many.samples.get())
    for begin, end in zip(first[:-1], first[1:], strict=True):
        part = samples[begin:end]
        assert (np.lexsort((part["triangle"], part["near"])) == np.arange(len(part))).all()


def test_each_triangle_is_in_the_image_its_normal_looks_along(rng):
    corners = np.zeros((3, 3, 3), np.float32)
    for axis in range(3):
        corners[axis, 1, (axis + 1) % 3] = corners[axis, 2, (axis + 2) % 3] = 1
        corners[axis, :, axis] = 0.25
    cube = LayeredDepthCube.build(rs.Scene([mesh_of("three", corners)]), 16)
    np.testing.assert_array_equal(cube.layers, [1, 1, 1])
    triangles = cube.samples.get()["triangle"]
    first = cube.first.get()[:: 16 * 16]
    for axis in range(3):
        assert set(triangles[first[axis] : first[axis + 1]]) == {axis}


def test_samples_lie_on_their_triangles(rng):
    """Published mode: the depth at each texel's centre, from a float64 plane."""
    scene = triangle_soup(rng, 50, size=0.7)
    resolution = 64
    cube = LayeredDepthCube.build(scene, resolution)
    samples, first = cube.samples.get(), cube.first.get().astype(np.int64)
    assert cube.num_samples == len(samples) == first[-1] > 5000
    texel = np.repeat(np.arange(3 * resolution**2), np.diff(first))
    direction, column = texel // resolution**2, texel // resolution % resolution
    low, per_unit = cube.grid.get()[0, :3], cube.grid.get()[0, 3]
    corners = (scene.vertices[scene.faces].astype(np.float64) - low) * per_unit
    a, b, c = np.moveaxis(corners[samples["triangle"]], 1, 0)
    normal = np.cross(b - a, c - a)
    rows = np.arange(len(samples))
    assert (np.abs(normal[rows, direction]) >= 0.999 * np.abs(normal).max(axis=1)).all()
    point = np.empty((len(samples), 3))
    point[rows, (direction + 1) % 3] = column + 0.5
    point[rows, (direction + 2) % 3] = texel % resolution + 0.5
    point[rows, direction] = samples["near"]
    off = np.einsum("ij,ij->i", point - a, normal) / np.abs(normal).max(axis=1)
    assert np.abs(off).max() < 1e-3


def test_a_mesh_has_no_holes_and_no_double_samples():
    """A closed box seen along each axis: two layers in every texel."""
    cube = LayeredDepthCube.build(box(), 33)
    counts = np.diff(cube.first.get().astype(np.int64))
    assert set(counts) == {2}


def box():
    corners = np.stack(np.meshgrid([0, 1], [0, 1], [0, 1], indexing="ij"), -1).reshape(-1, 3)
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    faces = [t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))]
    return rs.Scene([rs.Mesh(corners.astype(np.float32), np.array(faces, np.int32), name="box")])


@pytest.mark.parametrize("exact", [False, True])
@pytest.mark.parametrize(("resolution", "block"), [(64, 8), (50, 8), (50, 7), (5, 64)])
def test_blocks_hold_the_depths_of_their_texels(rng, exact, resolution, block):
    options = {"exact": exact, "block": block}
    cube = LayeredDepthCube.build(triangle_soup(rng, 60), resolution, **options)
    samples, first = cube.samples.get(), cube.first.get()
    blocks = cube.blocks.get()
    expected = np.full(blocks.shape, [np.inf, -np.inf], np.float32)
    texel = np.repeat(np.arange(3 * resolution**2), np.diff(first.astype(np.int64)))
    edge = cube.block
    index = (
        texel // resolution**2, texel // resolution % resolution // edge,
        texel % resolution // edge,
    )  # fmt: skip
    np.minimum.at(expected, (*index, 0), samples["near"])
    np.maximum.at(expected, (*index, 1), samples["far" if exact else "near"])
    np.testing.assert_array_equal(blocks, expected)
    if exact:
        assert (samples["far"] >= samples["near"]).all()


def test_an_empty_scene_has_an_empty_cube():
    vertices = np.zeros((3, 3), np.float32)
    scene = rs.Scene([rs.Mesh(vertices, np.empty((0, 3), np.int32), name="none")])
    cube = LayeredDepthCube.build(scene, 8)
    assert cube.num_samples == 0 and not cube.layers.any() and np.isinf(cube.blocks.get()).all()
    hits = rs.Tracer(scene, "ldc").intersect([[0, 0, 0]], [[0, 0, 1]])
    assert hits.prim_id[0] == -1


# ---- exact mode ----


@pytest.mark.parametrize("count", [1, 7, 63, 64, 65, 1009])
@pytest.mark.parametrize("options", [
    {}, {"resolution": 1}, {"resolution": 37, "block": 5}, {"block": None, "resolution": 64},
    {"builder": "peeling", "resolution": 64}, {"resolution": 64, "block": 1},
], ids=str)  # fmt: skip
def test_hits_equal_brute_force(rng, options, count):
    scene = triangle_soup(rng, 300)
    assert_exact(scene, *random_rays(rng, count), **options)
    assert_exact(scene, *random_rays(rng, count), 0.01, 2.0, **options)


def moved(scale, offset, values):
    return (scale * values + offset).astype(np.float32)


@settings(max_examples=80, deadline=None)
@given(
    st.integers(0, 2**32 - 1),
    st.sampled_from([1e-4, 0.05, 1.0, 30.0]),  # size of triangles
    st.sampled_from(["any", "flat", "sliver", "point", "line"]),
    st.sampled_from([(1.0, 0.0), (1e-3, 0.0), (1e3, 0.0), (1.0, 100.0), (1e-3, 100.0)]),
    st.sampled_from([0.0, 1.0, 30.0, 3e3, 1e5, 1e7]),  # how far away the rays start
    st.sampled_from([1, 16, 100, 512]),
    st.sampled_from([8, 3, None]),
)
def test_no_hit_is_ever_lost(seed, size, shape, place, distance, resolution, block):
    rng = np.random.default_rng(seed)
    corners = rng.random((97, 1, 3)) + size * (rng.random((97, 3, 3)) - 0.5)
    if shape == "flat":  # parallel to the axes, on lines of the grid and in front of each other
        corners = np.round(8 * corners) / 8
        corners[np.arange(97), :, rng.integers(0, 3, 97)] = rng.integers(0, 3, (97, 1)) / 2
    elif shape == "sliver":
        corners[:, 2] = corners[:, 0] + 1e-4 * rng.normal(size=(97, 3)) * size
    elif shape == "point":
        corners[::2] = corners[::2, :1]
    elif shape == "line":
        corners[::2, 2] = (corners[::2, 0] + corners[::2, 1]) / 2
    corners = moved(*place, corners)
    scene = rs.Scene([mesh_of("a", corners[:40]), mesh_of("b", corners[40:])])
    weights = rng.dirichlet([0.5, 0.5, 0.5], 160)
    weights[::3] = np.eye(3)[rng.integers(0, 3, len(weights[::3]))]  # at vertices
    weights[1::3, 0] = 0  # about edges
    aim = np.einsum("ij,ijk->ik", weights, corners[rng.integers(0, 97, 160)].astype(np.float64))
    origins = moved(*place, 0.5 + (0.3 + distance) * rng.normal(size=(160, 3)))
    directions = (aim - origins).astype(np.float32)
    straight = rng.random(160) < 0.4  # along an axis, or in a plane of two
    axis = rng.integers(0, 3, 160)
    origins[straight] = aim[straight]
    along = np.eye(3)[axis] * rng.choice([-1, 1], (160, 1))
    along[::5] += np.roll(along[::5], 1, axis=1)
    origins -= np.where(straight[:, None], along * distance * place[0], 0).astype(np.float32)
    directions = np.where(straight[:, None], along, directions)
    directions[~directions.any(axis=1)] = 1
    directions = (directions * 10.0 ** rng.uniform(-3, 3, (160, 1))).astype(np.float32)
    tnear = np.where(rng.random(160) < 0.7, 0, rng.random(160)).astype(np.float32)
    tfar = np.where(rng.random(160) < 0.5, np.inf, 2 * rng.random(160)).astype(np.float32)
    assert_exact(scene, origins, directions, tnear, tfar, resolution=resolution, block=block)


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
    """Every triangle three times, in another order of meshes."""
    meshes = triangle_soup(rng, 200).meshes
    scene = rs.Scene([*meshes, *meshes[::-1], *meshes])
    assert_exact(scene, *random_rays(rng, 2000, spread=0.2))


def test_rays_from_afar_and_of_extreme_length(rng):
    scene = triangle_soup(rng, 200)
    aim = scene.vertices[rng.integers(0, len(scene.vertices), 200)]
    away = rng.normal(size=(200, 3)) * 10.0 ** rng.uniform(-2, 9, (200, 1))
    directions = -away * 10.0 ** rng.uniform(-20, 8, (200, 1))
    assert_exact(scene, aim + away, directions)


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
    assert share_differing(*sphere_hits(512)) < 0.08
    coarse, fine = (share_differing(*sphere_hits(n, tolerance=5e-4)) for n in (256, 512))
    assert fine < 0.03 and fine < 0.5 * coarse, (coarse, fine)


def test_published_hits_lie_near_their_triangles():
    ours, _, (origins, directions) = sphere_hits(512)
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


def test_the_tolerance_closes_gaps():
    """Without any, only rays whose depths over a texel enclose a sample's hit it."""
    hits = [np.mean(sphere_hits(256, tolerance=x)[0].prim_id >= 0) for x in (0.0, 1e-3, 1e-2)]
    assert hits[0] < hits[1] < hits[2]


def test_published_hits_respect_the_segment():
    scene = scenes.mirror_ball((0, 0, 0), 1.0)
    ldc = rs.Tracer(scene, "ldc", resolution=128)
    origins, directions = np.tile([[-3.0, 0.01, 0.02]], (4, 1)), np.tile([[2.0, 0, 0]], (4, 1))
    hits = ldc.intersect(origins, directions, [0, 1.2, 0, 2.2], [np.inf, np.inf, 0.8, np.inf])
    np.testing.assert_allclose(hits.t, [1, 2, np.inf, np.inf], atol=0.01)
    blocked = ldc.occluded(origins, directions, [0, 1.2, 0, 2.2], [np.inf, np.inf, 0.8, np.inf])
    np.testing.assert_array_equal(blocked, [True, True, False, False])


@pytest.mark.parametrize("exact", [False, True])
def test_the_coarse_level_changes_nothing(rng, exact):
    scene, rays = triangle_soup(rng, 500, size=0.1), random_rays(rng, 2000)
    expected = rs.Tracer(scene, "ldc", exact=exact, resolution=128, block=None).intersect(*rays)
    for block in (8, 16, 11):
        hits = rs.Tracer(scene, "ldc", exact=exact, resolution=128, block=block).intersect(*rays)
        if exact:
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


def test_published_images_are_close():
    """No surface shadows itself, though shadow rays end on it and mirrored rays start there."""
    scene = scenes.cornell("mirrors")
    exact, close = (
        rs.render(scene, size=(96, 96), method=rs.Tracer(scene, method)).image
        for method in ("brute", "ldc")
    )
    differ = np.abs(np.clip(exact, 0, 1) - np.clip(close, 0, 1)).max(axis=-1) > 0.05
    assert differ.mean() < 0.03


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


@pytest.mark.parametrize("exact", [False, True])
def test_the_portable_path_is_the_same(rng, monkeypatch, exact):
    scene, given_rays = triangle_soup(rng, 400, size=0.3), random_rays(rng, 1009)
    first = rs.Tracer(scene, "ldc", exact=exact, resolution=100)
    expected = first.intersect(*given_rays)
    monkeypatch.setattr(program, "_OPTIONS", (*program._OPTIONS, "-DPORTABLE"))
    monkeypatch.setattr(device, "_thread", type(device._thread)())
    second = rs.Tracer(scene, "ldc", exact=exact, resolution=100)
    assert_same_hits(second.intersect(*given_rays), expected)
    assert second.statistics.final_tests == first.statistics.final_tests


# ---- options and memory ----


@pytest.mark.parametrize(("options", "message"), [
    ({"resolution": 0}, "resolution: need a whole number of at least 1, got 0"),
    ({"resolution": 64.0}, "resolution: need a whole number"),
    ({"resolution": 20000}, "resolution: need at most 16384, got 20000"),
    ({"exact": 1}, "exact: need one of True, False, got 1"),
    ({"tolerance": -0.1}, "tolerance: need a part of the scene's diagonal, at least 0, got -0.1"),
    ({"tolerance": "near"}, "tolerance: need"),
    ({"builder": "raster"}, "builder: need one of 'a-buffer', 'peeling', got 'raster'"),
    ({"block": 0}, "block: need a whole number of at least 1, got 0"),
    ({"layers": 4}, "method 'ldc' has no option 'layers'; its options: resolution, exact"),
], ids=str)  # fmt: skip
def test_options_that_there_are_not(rng, options, message):
    with pytest.raises(ValueError, match=message) as error:
        rs.Tracer(triangle_soup(rng, 10), "ldc", **options)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("exact", [False, True])
@pytest.mark.parametrize("limit", [2_000_000, 100_000])
def test_memory_limit(rng, exact, limit):
    """Refused before the memory is taken; the resolution it names does fit."""
    scene, rays = triangle_soup(rng, 500, size=0.5), random_rays(rng, 50)
    ldc = rs.Tracer(scene, "ldc", exact=exact, resolution=512, memory_limit=limit)
    with pytest.raises(MemoryLimitError, match=f"512 needs .* of memory_limit {limit};") as error:
        ldc.intersect(*rays)
    assert "\n" not in str(error.value)
    fits = int(str(error.value).split()[-2])
    assert 1 < fits < 512
    cube = LayeredDepthCube.build(scene, fits, exact=exact, memory_limit=limit)
    assert 0.4 * limit < cube.nbytes <= limit
    rs.Tracer(scene, "ldc", exact=exact, resolution=fits, memory_limit=limit).intersect(*rays)


def test_no_resolution_fits(rng):
    with pytest.raises(MemoryLimitError, match="no resolution fits"):
        LayeredDepthCube.build(triangle_soup(rng, 500), 64, exact=True, memory_limit=100)


def test_bytes_are_told(rng):
    cube = LayeredDepthCube.build(triangle_soup(rng, 500), 64, exact=True)
    arrays = (cube.samples, cube.first, cube.blocks, cube.slabs)
    assert cube.nbytes == sum(array.nbytes for array in arrays)
    assert cube.bytes_per_triangle == cube.nbytes / 500
    assert cube.bytes_per_texel == cube.nbytes / (3 * 64 * 64)
