"""The pinhole camera and its primary rays."""

from dataclasses import dataclass

import numpy as np

from raystream.checks import check_number, check_size, check_vector

_FIT_MARGIN = 1.05  # so that silhouettes do not touch the edge of the picture


@dataclass(frozen=True, eq=False)
class Camera:
    """A pinhole camera.

    Parameters
    ----------
    eye : (3,) float64
        Position.
    target : (3,) float64
        A point in the middle of the picture.
    up : (3,) float64
        A direction that is upright in the picture; need not be normalised or perpendicular.
    fov_y : float
        Full vertical angle of view in degrees, between 0 and 180.

    Raises
    ------
    ValueError
        If a value is not finite, eye and target coincide, `up` is zero or parallel to the
        line of sight, or the angle is out of range.
    """

    eye: np.ndarray
    target: np.ndarray
    up: np.ndarray = (0.0, 1.0, 0.0)
    fov_y: float = 45.0

    def __post_init__(self):
        for field in ("eye", "target", "up"):
            vector = check_vector(field, getattr(self, field), nonzero=field == "up")
            object.__setattr__(self, field, vector)
        object.__setattr__(self, "fov_y", _check_angle(self.fov_y))
        _basis(self.eye, self.target, self.up)  # refuses what has no basis

    @classmethod
    def look_at(cls, eye, target, up=(0, 1, 0), fov_y=45.0):
        """Return the camera at `eye` that looks at `target`; see the class."""
        return cls(eye, target, up, fov_y)

    @classmethod
    def from_matrix(cls, matrix, fov_y=45.0):
        """Return the camera of a pose, as glTF, OpenGL and trimesh write it.

        Parameters
        ----------
        matrix : (4, 4) float
            Takes the camera's axes to the world: it looks along its -z, with its +y up.
        fov_y : float

        Raises
        ------
        ValueError
            If the matrix has another shape, or a value makes no camera.
        """
        pose = np.asarray(matrix, dtype=np.float64)
        if pose.shape != (4, 4):
            raise ValueError(f"matrix: need shape (4, 4), got {pose.shape}")
        eye = pose[:3, 3]
        return cls(eye, eye - pose[:3, 2], pose[:3, 1], fov_y)

    @classmethod
    def fit(cls, bounds, up=(0, 1, 0), fov_y=45.0):
        """Return a camera that sees a whole box, from its front, a little right and above.

        The box is wholly visible in pictures at least as wide as high. The front is the side
        of +z, or of -y where z is the largest component of `up`.

        Parameters
        ----------
        bounds : (2, 3) float
            Smallest and largest corner. A box without extent is seen from distance 1.
        up : (3,) float
        fov_y : float

        Raises
        ------
        ValueError
            If the bounds are not finite or a smallest coordinate exceeds its largest.
        """
        box = np.asarray(bounds, dtype=np.float64)
        if box.shape != (2, 3) or not np.isfinite(box).all() or (box[0] > box[1]).any():
            raise ValueError(f"bounds: need finite (2, 3), smallest first, got {box.tolist()}")
        up = check_vector("up", up, nonzero=True)
        fov_y = _check_angle(fov_y)
        center = box.mean(axis=0)
        basis = _basis(center + _view_side(up / np.linalg.norm(up)), center, up)
        corners = np.array(np.meshgrid(*(box - center).T)).reshape(3, 8)
        right, upward, forward = np.stack(basis) @ corners
        # the nearest distance at which |right| and |upward| are within the tangent of each depth
        half_size = np.maximum(np.abs(right), np.abs(upward))
        distance = (half_size / np.tan(np.radians(fov_y) / 2) - forward).max()
        # a box of almost no extent: not nearer than float32 coordinates can tell apart
        distance = max(_FIT_MARGIN * distance, 1e-6 * np.abs(box).max())
        if distance < np.finfo(np.float32).tiny:
            distance = 1.0
        return cls(center - distance * basis[2], center, up, fov_y)

    @property
    def basis(self):
        """Unit vectors (right, up, forward), each (3,) float64; right = forward x up."""
        return _basis(self.eye, self.target, self.up)

    def rays(self, size, offset=(0.5, 0.5)):
        """Return one ray for each pixel.

        Parameters
        ----------
        size : (2,) int
            (width, height) in pixels.
        offset : (2,) float
            (x, y) position within the pixel, from its left and upper side, 0 to 1.

        Returns
        -------
        origins, directions : (height * width, 3) float32
            Row by row from the top. The component of a direction along the line of sight is 1,
            so `t` of a hit is its depth.

        Raises
        ------
        ValueError
            If the size is not two positive integers.
        """
        width, height = check_size(size)
        right, up, forward = self.basis
        tangent = np.tan(np.radians(self.fov_y) / 2)
        sx = (2 * (np.arange(width) + offset[0]) / width - 1) * tangent * width / height
        sy = (1 - 2 * (np.arange(height) + offset[1]) / height) * tangent
        rows = forward + sy[:, None] * up
        directions = (rows[:, None] + sx[None, :, None] * right).reshape(-1, 3)
        origins = np.tile(self.eye.astype(np.float32), (len(directions), 1))
        return origins, directions.astype(np.float32)


def _check_angle(fov_y):
    return check_number("fov_y", fov_y, lambda x: 0 < x < 180, "degrees between 0 and 180")


def _basis(eye, target, up):
    forward = target - eye
    distance = np.linalg.norm(forward)
    if distance == 0:
        raise ValueError(f"target: need a point apart from the eye, got {target.tolist()} for both")
    forward /= distance
    right = np.cross(forward, up / np.linalg.norm(up))
    sine = np.linalg.norm(right)
    # below this the direction of `right` is rounding noise of the float64 cross product
    if sine < 1e-12:
        raise ValueError(f"up: need a direction not parallel to the view, got {up.tolist()}")
    right /= sine
    return right, np.cross(right, forward), forward


def _view_side(up):
    """Unit vector from a fitted box to its camera: front, a little right and above."""
    axis = np.array([0, -1, 0]) if np.abs(up).argmax() == 2 else np.array([0, 0, 1])
    front = axis - (axis @ up) * up
    front /= np.linalg.norm(front)
    right = np.cross(up, front)
    towards = front + 0.4 * right + 0.35 * up
    return towards / np.linalg.norm(towards)
