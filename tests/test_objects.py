"""Objects: runs of an order of the triangles, each in a small sphere that holds its vertices."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import nnls
from soup import mesh_of, triangle_soup

import raystream as rs
from raystream import device, objects
from raystream.geometry import Geometry
from raystream.objects import Objects

COUNTS = [1, 2, 15, 16, 17, 31, 33, 1009]
SIZES = [16, 48, 64, 256]
MESH_FILES = [
    "bunny/bunny-69451.ply", "sponza/sponza-dabrovic.obj", "office/mgf-office.glb",
    "bart-kitchen/bart-kitchen.glb", "munich/munich.glb", "foliage/japanese-maple.glb",
    "dragon/dragon-47794.ply", "fox/fox.glb", "cornell-box/cornell-box-measured.obj",
]  # fmt: skip


def soup_of(*meshes):
    """A scene of one mesh for each (m, 3, 3) array of corners."""
    return rs.Scene([mesh_of(f"mesh-{k}", np.float32(mesh)) for k, mesh in enumerate(meshes)])


def from_rows(array):
    """(blocks, rows, 16) on the device as (blocks * 16, rows) on the host."""
    return array.get().transpose(0, 2, 1).reshape(-1, array.shape[1])


def parts_of(made, geometry):
    """Of every object its vertices (n, 3) and its sphere, float64; checks the padding."""
    corners = geometry.triangles.get().reshape(-1, 3, 4)[:, :, :3].astype(np.float64)
    order, ranges = made.order.get(), made.ranges.get()
    spheres = from_rows(made.object_rows).astype(np.float64)
    assert len(ranges) == made.num_objects + 1
    assert np.isneginf(spheres[made.num_objects :, 3]).all()
    parts = [order[a:b] for a, b in zip(ranges[:-1], ranges[1:], strict=True)]
    return [(corners[part].reshape(-1, 3), s) for part, s in zip(parts, spheres, strict=False)]


def assert_partition(made, geometry):
    """The order is a permutation with the bounds in it; the ranges share it out."""
    count = geometry.num_triangles
    order, ranges = made.order.get(), made.ranges.get()
    np.testing.assert_array_equal(np.sort(order[:count]), np.arange(count))
    assert len(order) == -(-count // 16) * 16 and (order[count:] == 0xFFFFFFFF).all()
    assert ranges[0] == 0 and ranges[-1] == count and (np.diff(ranges.astype(int)) >= 0).all()
    bounds = geometry.bounds.get()
    rows = from_rows(made.bound_rows)
    np.testing.assert_array_equal(rows[:count], bounds[order[:count]])
    np.testing.assert_array_equal(rows[count:], bounds[count:])


def assert_held(vertices, sphere):
    """All vertices lie in the sphere, in float64."""
    if len(vertices) == 0:
        assert np.isneginf(sphere[3])
    else:
        assert (np.linalg.norm(vertices - sphere[:3], axis=1) <= sphere[3]).all()


def assert_nearly_smallest(vertices, sphere, most):
    """No sphere with a radius below sphere[3] / most holds the vertices, but for 0.1 %.

    Proof: the centre, moved by at most 0.1 % of the radius, lies in the hull of the vertices that
    are farther from it than that. So every other point is still farther from one of them.
    """
    offsets = (vertices - sphere[:3]) / sphere[3]
    far = offsets[np.linalg.norm(offsets, axis=1) >= 1 / most]
    weights_sum_to_one = np.vstack([far.T, np.ones(len(far))])
    _, distance = nnls(weights_sum_to_one, np.array([0, 0, 0, 1.0]), maxiter=10 * len(far) + 100)
    assert distance < 1e-3


def all_kinds(session, geometry):
    return [Objects.meshes(session, geometry)] + [
        Objects.clusters(session, geometry, size) for size in SIZES
    ]


@pytest.mark.parametrize("count", COUNTS)
def test_objects_share_the_triangles_out_and_hold_their_vertices(session, rng, count):
    geometry = Geometry(session, triangle_soup(rng, count))
    for made in all_kinds(session, geometry):
        assert_partition(made, geometry)
        for vertices, sphere in parts_of(made, geometry):
            assert_held(vertices, sphere)


def test_a_mesh_is_an_object_and_the_order_stays(session, rng):
    counts = [0, 5, 0, 0, 40, 1, *[3] * 20, 4000, 0]
    scene = soup_of(*(rng.random((count, 3, 3)) for count in counts))
    geometry = Geometry(session, scene)
    made = Objects.meshes(session, geometry)
    assert made.num_objects == len(counts) and made.bound_rows is geometry.bound_rows
    np.testing.assert_array_equal(made.ranges.get(), scene.first_prims)
    np.testing.assert_array_equal(made.order.get()[: sum(counts)], np.arange(sum(counts)))
    for vertices, sphere in parts_of(made, geometry):
        assert_held(vertices, sphere)
        if len(vertices):
            assert_nearly_smallest(vertices, sphere, 1.02)


@pytest.mark.parametrize("count, size", [(1, 16), (47, 16), (48, 16), (49, 16), (49, 1024)])
def test_clusters_have_the_size_asked_for(session, rng, count, size):
    made = Objects.clusters(session, Geometry(session, triangle_soup(rng, count)), size)
    sizes = np.diff(made.ranges.get().astype(int))
    assert made.num_objects == -(-count // size) and (sizes[:-1] == size).all()
    assert 1 <= sizes[-1] <= size


@pytest.mark.parametrize("size", [0, 8, 24, -16])
def test_other_sizes_are_refused(session, rng, size):
    geometry = Geometry(session, triangle_soup(rng, 20))
    with pytest.raises(ValueError, match=f"size: .*{size}"):
        Objects.clusters(session, geometry, size)


@pytest.mark.parametrize("meshes", [0, 1, 17])
def test_a_scene_without_triangles_has_objects_without_a_sphere(session, meshes):
    geometry = Geometry(session, soup_of(*[np.zeros((0, 3, 3))] * meshes))
    for made in all_kinds(session, geometry):
        made.update()
        assert made.num_objects == (meshes if made.bound_rows is geometry.bound_rows else 0)
        spheres = from_rows(made.object_rows)
        assert len(spheres) == -(-made.num_objects // 16) * 16 and np.isneginf(spheres[:, 3]).all()


@settings(max_examples=60, deadline=None)
@given(
    st.integers(0, 2**32 - 1),
    st.sampled_from([1, 16, 47, 400]),  # triangles
    st.sampled_from(["ball", "sphere", "disc", "needle", "grid", "point"]),
    st.sampled_from([1e-3, 1.0, 1e3]),
    st.sampled_from([0.0, 100.0]),
)
def test_every_vertex_lies_inside_whatever_the_shape(seed, count, shape, scale, offset):
    rng = np.random.default_rng(seed)
    corners = rng.normal(size=(count, 3, 3))
    if shape == "sphere":
        corners /= np.linalg.norm(corners, axis=2, keepdims=True)
    elif shape == "grid":
        corners = np.rint(corners)
    else:
        corners *= {"ball": 1, "disc": (1, 1, 1e-6), "needle": (1, 1e-6, 0), "point": 0}[shape]
    corners = scale * corners + offset
    geometry = Geometry(device.session(), soup_of(corners, corners[: count // 2]))
    for made in all_kinds(device.session(), geometry):
        for vertices, sphere in parts_of(made, geometry):
            assert_held(vertices, sphere)


@pytest.mark.parametrize("shape", ["ball", "cube", "half sphere", "disc", "tetrahedron", "tail"])
def test_random_meshes_are_in_nearly_smallest_spheres(session, rng, shape):
    def points(count):
        p = rng.normal(size=(count, 3))
        if shape in ("ball", "half sphere"):
            p /= np.linalg.norm(p, axis=1, keepdims=True)
        return {
            "ball": lambda: p * np.cbrt(rng.random((count, 1))),
            "cube": lambda: rng.random((count, 3)),
            "half sphere": lambda: p * np.sign(p[:, 2:]) ** [0, 0, 1],
            "disc": lambda: p * (1, 1, 1e-4),
            "tetrahedron": lambda: rng.dirichlet([0.3] * 4, count) @ rng.normal(size=(4, 3)),
            "tail": lambda: rng.standard_cauchy((count, 3)),
        }[shape]()

    scene = soup_of(*(points(3 * n).reshape(-1, 3, 3) for n in [1, 2, 4, 10, 100, 1000, 3000] * 5))
    geometry = Geometry(session, scene)
    for vertices, sphere in parts_of(Objects.meshes(session, geometry), geometry):
        assert_nearly_smallest(vertices, sphere, 1.02)


@pytest.mark.parametrize("file", MESH_FILES)
def test_real_meshes_and_clusters_are_in_nearly_smallest_spheres(session, scene_folder, file):
    geometry = Geometry(session, rs.load_scene(scene_folder / file))
    meshes = parts_of(Objects.meshes(session, geometry), geometry)
    clusters = parts_of(Objects.clusters(session, geometry, 64), geometry)
    for vertices, sphere in meshes + clusters:
        assert_held(vertices, sphere)
    for vertices, sphere in meshes:
        assert_nearly_smallest(np.unique(vertices, axis=0), sphere, 1.001)
    for vertices, sphere in clusters[:: 1 + len(clusters) // 300]:
        assert_nearly_smallest(np.unique(vertices, axis=0), sphere, 1.1)


def test_a_regular_simplex_has_its_circumsphere(session):
    """All four vertices hold the ball; the middle of the box is elsewhere."""
    simplex = np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]]) + [7, 0, 0.25]
    flat = np.stack([simplex[[0, 1, 2]], simplex[[1, 2, 3]]])
    made = Objects.meshes(session, Geometry(session, soup_of(flat, flat * [1, 1, 0.5])))
    spheres = from_rows(made.object_rows)
    np.testing.assert_allclose(spheres[0], [7, 0, 0.25, np.sqrt(3)], rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("make", [Objects.meshes, lambda s, g: Objects.clusters(s, g, 32)])
def test_new_vertices_give_what_building_anew_gives(session, rng, make):
    scene = triangle_soup(rng, 1009)
    geometry = Geometry(session, scene)
    made = make(session, geometry)
    arrays = made.ranges, made.order, made.bound_rows, made.object_rows
    moved = (scene.vertices @ rng.normal(size=(3, 3))).astype(np.float32)
    geometry.update(moved)
    made.update()
    anew = make(session, Geometry(session, scene.with_vertices(moved)))
    for array, name in zip(arrays, ("ranges", "order", "bound_rows", "object_rows"), strict=True):
        assert array is getattr(made, name)
        np.testing.assert_array_equal(array.get(), getattr(anew, name).get(), name)
    again = make(session, geometry)
    np.testing.assert_array_equal(again.object_rows.get(), anew.object_rows.get())


def test_results_do_not_depend_on_how_the_work_is_shared(session, rng, monkeypatch):
    geometry = Geometry(session, triangle_soup(rng, 5000))
    expected = all_kinds(session, geometry)
    monkeypatch.setattr(objects, "_CHUNKS_PER_UNIT", 1)
    for made, one in zip(all_kinds(session, geometry), expected, strict=True):
        np.testing.assert_array_equal(made.order.get(), one.order.get())
        np.testing.assert_array_equal(made.object_rows.get(), one.object_rows.get())


def test_many_triangles_in_one_point(session):
    corners = np.tile(np.float32([3, -2, 1e-3]), (100_000, 3, 1))
    geometry = Geometry(session, soup_of(corners))
    for made in all_kinds(session, geometry):
        assert_partition(made, geometry)
        for sphere in from_rows(made.object_rows)[: made.num_objects]:
            np.testing.assert_array_equal(sphere, np.float32([3, -2, 1e-3, 0]))


@pytest.mark.parametrize("scale", [1e-37, 1e-25, 1e18, 1e37, 1e38])
def test_sizes_at_the_ends_of_float32(session, rng, scale):
    corners = (rng.random((300, 3, 3)) - 0.5) * 6 * scale
    geometry = Geometry(session, soup_of(corners, corners[:7]))
    for made in all_kinds(session, geometry):
        assert_partition(made, geometry)
        for vertices, sphere in parts_of(made, geometry):
            assert_held(vertices, sphere)
            assert sphere[3] < 6 * scale or scale == 1e38  # beyond the largest float


def test_clusters_are_compact_and_large_triangles_lie_apart(session, rng):
    """A floor of many small triangles, some as large as the scene, far from the origin."""
    small = rng.random((16384, 1, 3)) * (1, 0, 1) + 0.002 * rng.random((16384, 3, 3))
    large = np.eye(3) + 0.2 * rng.random((60, 3, 3))
    corners = rng.permutation(np.concatenate([small, large]))
    geometry = Geometry(session, soup_of(corners + 100))
    made = Objects.clusters(session, geometry, 64)
    radii = np.array([sphere[3] for _, sphere in parts_of(made, geometry)])
    assert made.num_objects == 257 and radii[-1] > 0.7
    # 64 of 16384 points on a unit square cover 1/256 of it: a square of side 1/16.
    assert np.median(radii[:-1]) < 0.06 and radii[:-1].max() < 0.4


def test_neighbours_in_the_order_are_neighbours_in_space(session, rng):
    """The curve through a grid of 8 x 8 x 8 goes from each cell to one that shares a side."""
    cells = rng.permutation(np.stack(np.meshgrid(*[np.arange(8.0)] * 3), axis=-1).reshape(-1, 3))
    triangles = cells[:, None] + 0.01 * np.eye(3)
    made = Objects.clusters(session, Geometry(session, soup_of(triangles)), 16)
    np.testing.assert_array_equal(np.abs(np.diff(cells[made.order.get()], axis=0)).sum(axis=1), 1)
