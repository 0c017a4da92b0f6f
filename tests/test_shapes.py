import numpy as np
import pytest
import trimesh

from raystream import shapes

SQUARE = np.array([(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)], dtype=np.float64)


def area(shape):
    vertices, faces = shape
    a, b, c = vertices[faces].transpose(1, 0, 2)
    return np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2


def volume(shape):
    vertices, faces = shape
    return np.linalg.det(vertices[faces]).sum() / 6


def is_watertight(shape):
    return trimesh.Trimesh(*shape).is_watertight


def test_quads_are_two_triangles_each():
    vertices, faces = shapes.quads([SQUARE, SQUARE + (0, 0, 1)])
    assert vertices.shape == (8, 3)
    assert faces.tolist() == [[0, 1, 2], [2, 3, 0], [4, 5, 6], [6, 7, 4]]


def test_checkers_share_the_quad_between_them():
    light, dark = shapes.checkers(2 * SQUARE, 3, 2)
    assert len(light[1]) == len(dark[1]) == 6
    assert area(light) == pytest.approx(2) and area(dark) == pytest.approx(2)
    # the cell at the first corner is a light one
    assert (light[0] == 0).all(axis=1).any() and not (dark[0] == 0).all(axis=1).any()


def test_grid_faces_of_one_row_of_two_cells():
    assert shapes.grid_faces(1, 2).tolist() == [[0, 1, 4], [4, 3, 0], [1, 2, 5], [5, 4, 1]]


def test_a_prism_has_a_top_and_four_sides_that_face_outward():
    vertices, faces = shapes.prism(shapes.square(3, -1, 2), 0.5, 1.5)
    assert len(faces) == 10
    assert area((vertices, faces)) == pytest.approx(16 + 4 * 4)
    a, b, c = vertices[faces].transpose(1, 0, 2)
    outward = (a + b + c) / 3 - (3, 1, -1)
    assert (np.einsum("ij,ij->i", np.cross(b - a, c - a), outward) > 0).all()


def test_a_room_is_closed_and_faces_inward():
    vertices, faces = shapes.quads(shapes.room((0, 0, 0), (1, 2, 3)))
    assert volume((vertices, faces)) == pytest.approx(-6)
    assert is_watertight(trimesh.triangles.to_kwargs(vertices[faces]).values())


@pytest.mark.parametrize("subdivisions", [0, 1, 3])
def test_an_icosphere_is_closed_and_its_vertices_are_unit_vectors(subdivisions):
    vertices, faces = shapes.icosphere(subdivisions)
    assert len(faces) == 20 * 4**subdivisions
    np.testing.assert_allclose(np.linalg.norm(vertices, axis=1), 1, rtol=1e-14)
    assert is_watertight((vertices, faces)) and volume((vertices, faces)) > 0


def test_an_icosphere_tends_to_the_volume_of_the_sphere():
    # the error of a finely triangulated surface falls by 4 with each subdivision
    errors = [4 * np.pi / 3 - volume(shapes.icosphere(level)) for level in (3, 4)]
    assert errors[0] / errors[1] == pytest.approx(4, rel=0.02)


def test_a_torus_has_the_volume_of_pappus():
    shape = shapes.torus(2, 0.5, 200, 100)
    assert len(shape[1]) == 2 * 200 * 100 and is_watertight(shape)
    assert volume(shape) == pytest.approx(2 * np.pi * 2 * np.pi * 0.5**2, rel=2e-3)
    assert shape[0][:, 1].max() == pytest.approx(0.5)  # the axis is y


def test_cylinders_have_the_area_of_their_sides():
    bases, tips = np.array([(0, 0, 0), (5, 0, 0)]), np.array([(0, 0, 2), (5, 3, 0)])
    shape = shapes.cylinders(bases, tips, 0.5, 12)
    assert len(shape[1]) == 48
    assert area(shape) == pytest.approx(12 * 2 * 0.5 * np.sin(np.pi / 12) * (2 + 3))


@pytest.mark.parametrize("teeth", [3, 36])
def test_a_gear_is_closed_and_between_its_planes(teeth):
    vertices, faces = shapes.gear(teeth, 2.0, -1.0, 0.5)
    assert len(faces) == 2 * (4 * teeth - 2) + 8 * teeth
    assert is_watertight((vertices, faces)) and volume((vertices, faces)) > 0
    reach = np.linalg.norm(vertices[:, :2], axis=1)
    assert reach.max() == pytest.approx(1.99) and reach.min() == pytest.approx(1.8)
    assert np.unique(vertices[:, 2]).tolist() == [-1.0, 0.5]


def test_fractal_terrain_is_a_height_field_over_the_square():
    vertices, faces = shapes.fractal_terrain(3)
    assert len(faces) == 2 * 4**3
    a, b, c = vertices[faces][:, :, :2].transpose(1, 0, 2)
    shadow = (b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]
    assert (shadow > 0).all() and shadow.sum() / 2 == pytest.approx(4)


def test_copies_are_scaled_then_moved():
    vertices, faces = shapes.copies((SQUARE, np.array([(0, 1, 2)])), (1, 2), [(0, 0, 0), (9, 0, 0)])
    assert faces.tolist() == [[0, 1, 2], [4, 5, 6]]
    assert vertices[4:].tolist() == (2 * SQUARE + (9, 0, 0)).tolist()


@pytest.mark.parametrize(
    "axis, expected", [("x", (1, -3, 2)), ("y", (3, 2, -1)), ("z", (-2, 1, 3))]
)
def test_a_quarter_turn_about_each_axis_by_both_functions(axis, expected):
    point = np.array([1.0, 2.0, 3.0])
    np.testing.assert_allclose(shapes.turn(point, axis, np.pi / 2), expected, atol=1e-15)
    unit = np.eye(3)["xyz".index(axis)]
    np.testing.assert_allclose(shapes.turn_about(point, unit, np.pi / 2), expected, atol=1e-15)


def test_turn_from_z_takes_z_to_each_direction_and_keeps_lengths(rng):
    directions = shapes.unit(rng.normal(size=(50, 3)))
    directions[:2] = (0, 0, 1), (0, 0, -1)
    points = np.vstack([(0, 0, 1), rng.normal(size=(4, 3))])
    turned = shapes.turn_from_z(directions, points)
    np.testing.assert_allclose(turned[:, 0], directions, atol=1e-12)
    np.testing.assert_allclose(turned @ turned.transpose(0, 2, 1), [points @ points.T] * 50)


def test_smooth_normals_of_a_cube_point_along_its_diagonals():
    # angle weights make this hold although faces are split along one diagonal
    cube = trimesh.creation.box((2, 2, 2))
    normals = shapes.smooth_normals(cube.vertices, cube.faces)
    np.testing.assert_allclose(normals, cube.vertices / np.sqrt(3), atol=1e-7)


def test_smooth_normals_of_unused_vertices_and_zero_area_faces_are_unit_vectors():
    normals = shapes.smooth_normals(SQUARE, np.array([(0, 0, 1), (1, 1, 1)]))
    assert normals.tolist() == [[0, 0, 1]] * 4
