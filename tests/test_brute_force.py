"""BruteForceTracer: watertight, tie rule, and agreement with Embree on random triangles."""

from fractions import Fraction

import numpy as np
import pytest
from raystream.baselines import BruteForceTracer, EmbreeTracer
from raystream.baselines.watertight import _edge_function, _product_error


def octahedron(subdivisions):
    """Return vertices and faces of a closed, subdivided octahedron pushed onto the sphere."""
    vertices = np.concatenate([np.eye(3), -np.eye(3)])
    corners = np.array([[0, 1, 2], [1, 3, 2], [3, 4, 2], [4, 0, 2]])
    triangles = vertices[np.concatenate([corners, (corners[:, ::-1] + 3) % 6])]
    for _ in range(subdivisions):
        middles = (triangles + np.roll(triangles, -1, axis=1)) / 2
        parts = [np.stack([triangles[:, k], middles[:, k], middles[:, k - 1]], 1) for k in range(3)]
        triangles = np.concatenate([*parts, middles])
    triangles /= np.linalg.norm(triangles, axis=2, keepdims=True)
    flat = triangles.reshape(-1, 3).astype(np.float32)
    vertices, faces = np.unique(flat, axis=0, return_inverse=True)
    return vertices, faces.reshape(-1, 3)


def soup(rng, num_triangles, size=0.1):
    centres = rng.random((num_triangles, 1, 3))
    vertices = centres + size * rng.normal(size=(num_triangles, 3, 3))
    return vertices.reshape(-1, 3).astype(np.float32), np.arange(3 * num_triangles).reshape(-1, 3)


def test_octahedron_is_closed():
    vertices, faces = octahedron(2)
    assert len(vertices) - 3 * len(faces) // 2 + len(faces) == 2


@pytest.mark.parametrize("target", ["vertices", "edges", "middles"])
def test_no_ray_from_inside_is_lost(target):
    rng = np.random.default_rng(5)
    vertices, faces = octahedron(3)
    count = 4096
    weights = {
        "vertices": np.ones(count),
        "edges": rng.random(count),
        "middles": np.full(count, 0.5),
    }
    weights = weights[target][:, None]
    face, corner = rng.integers(len(faces), size=count), rng.integers(3, size=count)
    start, end = vertices[faces[face, corner]], vertices[faces[face, (corner + 1) % 3]]
    points = weights * start + (1 - weights) * end
    origins = rng.uniform(-0.4, 0.4, (count, 3)).astype(np.float32)
    origins[::2] = np.round(origins[::2] * 4) / 4  # many coordinates and products are equal
    hits = BruteForceTracer(vertices, faces).intersect(origins, points - origins)
    assert (hits.prim_id >= 0).all()
    np.testing.assert_allclose(hits.t, 1, atol=1e-4)


def test_axis_parallel_rays_through_a_grid_are_not_lost():
    x, y = np.meshgrid(np.arange(9.0), np.arange(9.0))
    vertices = np.stack([x.ravel(), y.ravel(), np.full(81, 3.0)], axis=1)
    corner = (np.arange(8)[:, None] * 9 + np.arange(8)).ravel()
    faces = np.concatenate([corner[:, None] + [0, 1, 10], corner[:, None] + [0, 10, 9]])
    origins = vertices * [1, 1, 0]
    forward = np.tile([0.0, 0, 1], (81, 1))
    tracer = BruteForceTracer(vertices, faces)
    hits = tracer.intersect(origins, forward)
    assert (hits.t == 3).all()
    lowest = [np.flatnonzero((faces == k).any(axis=1)).min() for k in range(81)]
    np.testing.assert_array_equal(hits.prim_id, lowest)
    assert tracer.occluded(origins, forward, 3, 3).all()


def test_a_ray_in_the_plane_of_a_triangle_misses_it():
    tracer = BruteForceTracer([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]])
    assert not tracer.occluded([[-1, 0.25, 0], [-1, 0, 0]], [[1, 0, 0]] * 2, 0, np.inf).any()


@pytest.mark.parametrize("third", [[0, 0, 0], [0.5, 0.5, 0.5], [0, 0, 0.0]])
def test_triangles_without_area_are_never_hit(third):
    vertices = np.float32([[0, 0, 0], [1, 1, 1], third])
    directions = np.random.default_rng(0).normal(size=(100, 3)).astype(np.float32)
    origins = np.float32([0.25, 0.25, 0.25]) - directions
    assert (
        BruteForceTracer(vertices, [[0, 1, 2]]).intersect(origins, directions).prim_id < 0
    ).all()


def test_equal_distances_go_to_the_smaller_ids():
    vertices, _ = soup(np.random.default_rng(1), 1)
    faces = np.array([[0, 1, 2], [1, 2, 0], [2, 0, 1], [0, 2, 1]])
    centre = vertices.mean(axis=0)
    for order in ([0, 1, 2, 3], [3, 1, 0, 2], [2, 3, 1, 0]):
        tracer = BruteForceTracer(vertices, faces[order], first_prims=[0, 0, 2, 4])
        hits = tracer.intersect([centre - [0, 0, 3]], [[0, 0, 1]])
        assert (hits.geom_id, hits.prim_id) == ([1], [0])


def test_candidates_lists_all_hits_near_a_distance():
    heights = np.array([2, 1, 1, 3])
    vertices = np.tile([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]], (4, 1))
    vertices[:, 2] = heights.repeat(3)
    tracer = BruteForceTracer(vertices, np.arange(12).reshape(-1, 3))
    face, distances = tracer.candidates([0.25, 0.25, 0], [0, 0, 1], t=1.5, tolerance=0.5)
    assert face.tolist() == [1, 2, 0] and distances.tolist() == [1, 1, 2]


def test_product_error_is_exact():
    rng = np.random.default_rng(3)
    a, b = rng.normal(size=(2, 200)) * 10.0 ** rng.integers(-20, 20, (2, 200))
    for x, y, error in zip(a, b, _product_error(a, b), strict=True):
        assert Fraction(x * y) + Fraction(error) == Fraction(x) * Fraction(y)


def test_edge_function_has_the_exact_sign():
    rng = np.random.default_rng(4)
    point = rng.normal(size=(500, 2))
    scale = 1 + rng.integers(-2, 3, (500, 2)) * np.finfo(float).eps
    x, y = np.stack([point, 3 * point * scale], axis=1).transpose(2, 0, 1)
    signs = np.sign(_edge_function(x, y, 0, 1))
    exact = []
    for (x_0, x_1), (y_0, y_1) in zip(x, y, strict=True):
        exact.append(Fraction(x_0) * Fraction(y_1) - Fraction(y_0) * Fraction(x_1))
    np.testing.assert_array_equal(signs, [(value > 0) - (value < 0) for value in exact])
    assert (x[:, 0] * y[:, 1] == y[:, 0] * x[:, 1]).any()  # rounding alone would say 0


@pytest.mark.parametrize("scale", [1e-3, 1, 1e3])
@pytest.mark.parametrize("limits", [(0, np.inf), (0.3, 0.8), (0, 1)])
def test_agrees_with_embree_on_random_triangles(scale, limits):
    rng = np.random.default_rng(6)
    vertices, faces = soup(rng, 300)
    first_prims = [0, 100, 100, 300]
    tracers = [
        cls(scale * vertices, faces, first_prims) for cls in (EmbreeTracer, BruteForceTracer)
    ]
    origins = scale * rng.random((3000, 3))
    directions = scale * rng.normal(size=(3000, 3)) * 10 ** rng.uniform(-1, 1, (3000, 1))
    embree, exact = (tracer.intersect(origins, directions, *limits) for tracer in tracers)
    same = (embree.prim_id == exact.prim_id) & (embree.geom_id == exact.geom_id)
    assert (~same).sum() <= 1
    both = same & (exact.prim_id >= 0)
    assert both.sum() > 200
    np.testing.assert_allclose(embree.t[both], exact.t[both], rtol=2e-3, atol=1e-6)
    np.testing.assert_allclose(embree.u[both], exact.u[both], atol=1e-3)
    np.testing.assert_allclose(embree.v[both], exact.v[both], atol=1e-3)
    blocked = [tracer.occluded(origins, directions, *limits) for tracer in tracers]
    assert (blocked[0] != blocked[1]).sum() <= 1
    np.testing.assert_array_equal(blocked[1], exact.prim_id >= 0)


def test_sphere_filter_loses_no_hit_far_from_the_origin():
    rng = np.random.default_rng(7)
    vertices, faces = soup(rng, 40)
    shift = np.float32([4096, -2048, 8192])  # float32 keeps both scenes on one grid
    vertices = np.round(vertices * 256) / 256
    origins = np.round(rng.random((500, 3)) * 256) / 256
    directions = rng.normal(size=(500, 3)).astype(np.float32)
    near = BruteForceTracer(vertices, faces).intersect(origins, directions)
    far = BruteForceTracer(vertices + shift, faces).intersect(origins + shift, directions)
    for name in ("t", "prim_id", "u", "v"):
        np.testing.assert_array_equal(getattr(near, name), getattr(far, name))
