import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from raystream.camera import Camera

finite = st.floats(-100, 100)
points = st.tuples(finite, finite, finite)


def test_basis_of_a_camera_looking_along_minus_z():
    right, up, forward = Camera.look_at((0, 0, 5), (0, 0, 0)).basis
    assert right.tolist() == [1, 0, 0]
    assert up.tolist() == [0, 1, 0]
    assert forward.tolist() == [0, 0, -1]


@given(points, points, points)
def test_basis_is_orthonormal_and_right_is_forward_cross_up(eye, target, up):
    offset = np.subtract(target, eye)
    sine = np.linalg.norm(np.cross(offset, up))
    if sine <= 1e-6 * np.linalg.norm(offset) * np.linalg.norm(up) or sine < 1e-100:
        return
    basis = np.stack(Camera.look_at(eye, target, up).basis)
    np.testing.assert_allclose(basis @ basis.T, np.eye(3), atol=1e-9)
    np.testing.assert_allclose(np.cross(basis[2], basis[1]), basis[0], atol=1e-9)
    assert basis[1] @ np.asarray(up) > 0


def test_rays_of_the_four_pixels_of_a_2_by_2_picture():
    origins, directions = Camera.look_at((1, 2, 3), (1, 2, 0), fov_y=90).rays((2, 2))
    assert origins.dtype == directions.dtype == np.float32
    assert origins.tolist() == [[1, 2, 3]] * 4
    # top row first; tan 45 degrees = 1, so pixel centers lie at +-1/2
    np.testing.assert_allclose(
        directions, [[-0.5, 0.5, -1], [0.5, 0.5, -1], [-0.5, -0.5, -1], [0.5, -0.5, -1]], atol=1e-7
    )


def test_rays_lie_in_memory_as_tracers_take_them():
    for array in Camera.look_at((1, 2, 3), (0, 0, 0)).rays((3, 2)):
        assert array.shape == (6, 3) and array.flags.c_contiguous


def test_offset_moves_within_the_pixel_from_its_upper_left_corner():
    camera = Camera.look_at((0, 0, 1), (0, 0, 0), fov_y=90)
    np.testing.assert_allclose(camera.rays((1, 1), (0, 0))[1], [[-1, 1, -1]], atol=1e-7)
    np.testing.assert_allclose(camera.rays((1, 1), (1, 1))[1], [[1, -1, -1]], atol=1e-7)


def test_width_extends_the_horizontal_angle_only():
    camera = Camera.look_at((0, 0, 1), (0, 0, 0), fov_y=40)
    corner = camera.rays((3, 2), (0, 0))[1][0]
    tangent = np.tan(np.radians(20))
    np.testing.assert_allclose(corner, [-1.5 * tangent, tangent, -1], rtol=1e-6)


@given(points, st.floats(1, 170))
def test_forward_component_of_every_ray_is_one(eye, fov_y):
    camera = Camera.look_at(eye, (200, 10, 5), fov_y=fov_y)
    _, directions = camera.rays((4, 3))
    np.testing.assert_allclose(directions @ camera.basis[2], 1, atol=2e-5)


@given(
    points,
    points,
    st.sampled_from([(0, 1, 0), (0, 0, 1), (1, 0, 0), (0, -1, 1)]),
    st.floats(5, 120),
)
def test_fit_sees_every_corner_of_the_box(a, b, up, fov_y):
    bounds = np.sort([a, b], axis=0)
    camera = Camera.fit(bounds, up, fov_y)
    corners = np.array(np.meshgrid(*bounds.T)).reshape(3, 8).T - camera.eye
    x, y, depth = np.stack(camera.basis) @ corners.T
    limit = depth * np.tan(np.radians(fov_y) / 2) * (1 + 1e-9)
    assert (depth > 0).all()
    assert (np.abs(x) <= limit).all() and (np.abs(y) <= limit).all()


def test_fit_of_a_scene_whose_z_is_up_shows_z_upright_from_the_side_of_minus_y():
    camera = Camera.fit([[-8, -6, 0], [7, 5, 1]], up=(0, 0, 1))
    right, up, forward = camera.basis
    assert up[2] > 0.9 and forward[1] > 0.8 and right[0] > 0.9
    assert camera.eye[1] < -6 and camera.eye[2] > 1


def test_a_camera_of_a_matrix_looks_along_its_minus_z():
    # columns: the camera's x, y, z axes and its place
    matrix = [[0, 0, 2, 7], [0, 2, 0, 8], [-2, 0, 0, 9], [0, 0, 0, 1]]
    camera = Camera.from_matrix(matrix, 30)
    assert camera.eye.tolist() == [7, 8, 9] and camera.fov_y == 30
    assert [axis.tolist() for axis in camera.basis] == [[0, 0, -1], [0, 1, 0], [-1, 0, 0]]
    with pytest.raises(ValueError, match=r"^matrix: need shape \(4, 4\), got \(3, 4\)"):
        Camera.from_matrix(np.eye(4)[:3])


def test_fit_of_a_point_looks_at_it():
    camera = Camera.fit(np.zeros((2, 3)))
    assert np.linalg.norm(camera.eye) == pytest.approx(1)
    assert camera.target.tolist() == [0, 0, 0]


@pytest.mark.parametrize(
    "arguments, field",
    [
        (((0, 0, 0), (0, 0, 0)), "target"),
        (((0, 0, 0), (0, 5, 0)), "up"),
        (((0, 0, 0), (0, 0, 1), (0, 0, 0)), "up"),
        (((0, 0, np.nan), (0, 0, 1)), "eye"),
        (((0, 0, 0), (0, 0)), "target"),
        (((0, 0, 0), (0, 0, 1), (0, 1, 0), 0), "fov_y"),
        (((0, 0, 0), (0, 0, 1), (0, 1, 0), 180), "fov_y"),
        (((0, 0, 0), (0, 0, 1), (0, 1, 0), np.nan), "fov_y"),
    ],
)
def test_a_camera_without_a_picture_is_refused(arguments, field):
    with pytest.raises(ValueError, match=f"^{field}: need .*got"):
        Camera.look_at(*arguments)


@pytest.mark.parametrize("size", [(0, 4), (4, -1), (4,), (4.0, 4.0), "4x4", 4])
def test_sizes_other_than_two_positive_integers_are_refused(size):
    with pytest.raises(ValueError, match="^size: need"):
        Camera.look_at((0, 0, 1), (0, 0, 0)).rays(size)


@pytest.mark.parametrize(
    "bounds", [[[1, 0, 0], [0, 1, 1]], [[0, 0, 0]], [[0, 0, 0], [1, np.inf, 1]]]
)
def test_fit_refuses_what_is_no_box(bounds):
    with pytest.raises(ValueError, match="^bounds: need"):
        Camera.fit(bounds)
