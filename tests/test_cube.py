"""The layered depth cube: both builders agree, samples are where they should be, memory is told."""

import numpy as np
import pytest
from soup import box, mesh_of, random_rays, triangle_soup

import raystream as rs
from raystream import scenes
from raystream.cube import LayeredDepthCube
from raystream.errors import MemoryLimitError


@pytest.mark.parametrize("depth", ["full", "half"])
@pytest.mark.parametrize("exact", [False, True])
@pytest.mark.parametrize("resolution", [1, 3, 64, 100])
def test_both_builders_make_the_same_layers(rng, exact, resolution, depth):
    scene = triangle_soup(rng, 400, size=0.5)
    one, many = (
        LayeredDepthCube.build(scene, resolution, exact=exact, builder=builder, depth=depth)
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


@pytest.mark.parametrize("exact", [False, True])
@pytest.mark.parametrize(("resolution", "block"), [
    (64, 8), (50, 8), (50, 7), (5, 64), (50, (7, 16)), (50, (16, 1)), (50, None),
])  # fmt: skip

def test_blocks_hold_the_depths_of_their_texels(rng, exact, resolution, block):
    options = {"exact": exact, "block": block}
    cube = LayeredDepthCube.build(triangle_soup(rng, 60), resolution, **options)
    samples, first = cube.samples.get(), cube.first.get()
    blocks = cube.blocks.get()
    expected = np.full(blocks.shape, [np.inf, -np.inf], np.float32)
    texel = np.repeat(np.arange(3 * resolution**2), np.diff(first.astype(np.int64)))
    n, m = cube.block
    index = (
        texel // resolution**2, texel // resolution % resolution // n,
        texel % resolution // m,
    )  # fmt: skip
    np.minimum.at(expected, (*index, 0), samples["near"])
    np.maximum.at(expected, (*index, 1), samples["far" if exact else "near"])
    np.testing.assert_array_equal(blocks, expected)
    if exact:
        assert (samples["far"] >= samples["near"]).all() and (samples["far"] <= resolution).all()
    slabs = np.zeros(cube.slabs.shape, np.uint64)
    first_slab, last_slab = (
        np.clip(samples[name] * np.float32(64 / resolution), 0, 63).astype(np.uint64)
        for name in ("near", "far" if exact else "near")
    )
    bits = (np.uint64(2) << last_slab) - (np.uint64(1) << first_slab)
    np.bitwise_or.at(slabs, index, bits)
    np.testing.assert_array_equal(cube.slabs.get(), slabs)


def test_an_empty_scene_has_an_empty_cube():
    vertices = np.zeros((3, 3), np.float32)
    scene = rs.Scene([rs.Mesh(vertices, np.empty((0, 3), np.int32), name="none")])
    cube = LayeredDepthCube.build(scene, 8)
    assert cube.num_samples == 0 and not cube.layers.any() and np.isinf(cube.blocks.get()).all()
    hits = rs.Tracer(scene, "ldc").intersect([[0, 0, 0]], [[0, 0, 1]])
    assert hits.prim_id[0] == -1


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


@pytest.mark.parametrize("exact", [False, True])
def test_bytes_are_in_the_statistics(rng, exact):
    tracer = rs.Tracer(triangle_soup(rng, 500), "ldc", exact=exact, resolution=64)
    tracer.intersect(*random_rays(rng, 10))
    cube = LayeredDepthCube.build(tracer.scene, 64, exact=exact)
    told = tracer.statistics.to_dict()
    assert told["structure_bytes"] == cube.nbytes and told["texels"] == 3 * 64 * 64
    assert told["bytes_per_triangle"] == cube.bytes_per_triangle
    assert told["bytes_per_texel"] == cube.bytes_per_texel


# ---- half depths ----


@pytest.mark.parametrize("resolution", [3, 500, 2048])
def test_half_depths_are_rounded_outwards_where_exact(rng, resolution):
    scene = triangle_soup(rng, 200, size=0.5)
    full, half = (
        LayeredDepthCube.build(scene, resolution, exact=True, depth=depth).samples.get()
        for depth in ("full", "half")
    )
    np.testing.assert_array_equal(half["triangle"], full["triangle"])
    for name, side in (("near", -1), ("far", 1)):
        expected = full[name].astype(np.float16)  # to nearest
        beyond = side * (expected.astype(np.float32) - full[name]) < 0
        towards = np.nextafter(expected, np.float16(side * np.inf))
        expected = np.where(beyond & ~(full[name] < 2.0**-14), towards, expected)
        normal = full[name] >= 2.0**-14  # below, halves lose bits
        np.testing.assert_array_equal(half[name][normal], expected[normal], name)
        assert (side * (half[name].astype(np.float32) - full[name]) >= -(2.0**-24)).all()


def test_half_depths_are_the_nearest_where_published(rng):
    scene = triangle_soup(rng, 200, size=0.5)
    full, half = (
        LayeredDepthCube.build(scene, 500, depth=depth).samples.get() for depth in ("full", "half")
    )
    exact = full["near"].astype(np.float64)
    steps = np.spacing(half["near"]).astype(np.float64)
    assert half["near"].dtype == np.float16
    assert (np.abs(half["near"] - exact) <= 0.5 * steps).all()


def test_half_depths_take_less_memory(rng):
    scene = triangle_soup(rng, 2000, size=0.5)
    for exact, saved in ((False, 2), (True, 4)):
        full, half = (
            LayeredDepthCube.build(scene, 64, exact=exact, depth=depth)
            for depth in ("full", "half")
        )
        assert full.nbytes - half.nbytes == saved * (full.num_samples + 16)


# ---- attributes ----


@pytest.mark.parametrize("exact", [False, True])
def test_attributes_are_those_of_the_triangles(exact):
    """Normal, colour, depth and numbers of every sample, from float64 planes and weights."""
    scene = scenes.demo()
    cube = LayeredDepthCube.build(scene, 64, exact=exact)
    attributes = cube.attributes(scene)
    samples = cube.samples.get()
    triangle = samples["triangle"].astype(np.int64)
    prim_id, geom_id = attributes.prim_id.get(), attributes.geom_id.get()
    np.testing.assert_array_equal(scene.first_prims[geom_id] + prim_id, triangle)
    np.testing.assert_array_equal(geom_id, scene.geom_ids[triangle])
    per_unit = cube.grid.get()[0, 3]
    np.testing.assert_allclose(attributes.depth.get(), samples["near"] / per_unit, rtol=1e-6)
    texel = np.repeat(np.arange(3 * 64**2), np.diff(cube.first.get().astype(np.int64)))
    corners = scene.vertices[scene.faces[triangle]].astype(np.float64)
    face = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    view = np.eye(3)[texel // 64**2]
    normal = attributes.normal.get()[:, :3]
    np.testing.assert_allclose(np.linalg.norm(normal, axis=1), 1, atol=1e-5)
    toward = -np.sign(np.einsum("ij,ij->i", face, view))[:, None] * face
    toward /= np.linalg.norm(toward, axis=1, keepdims=True)
    for k, mesh in enumerate(scene.meshes):
        mine = geom_id == k
        assert mine.any()
        agree = np.einsum("ij,ij->i", normal[mine], toward[mine])
        assert (agree > (0.999999 if mesh.normals is None else 0.5)).all(), mesh.name
        if mesh.material.texture is None and mesh.colors is None:
            expected = np.broadcast_to(mesh.material.diffuse, (mine.sum(), 3))
            np.testing.assert_allclose(attributes.colour.get()[mine, :3], expected, rtol=1e-6)


def test_attributes_of_an_empty_cube():
    scene = rs.Scene([rs.Mesh(np.zeros((3, 3), np.float32), np.empty((0, 3), np.int32), name="x")])
    attributes = LayeredDepthCube.build(scene, 8).attributes(scene)
    assert attributes.depth.shape == (0,) and attributes.normal.shape == (0, 4)
