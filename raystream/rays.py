"""Rays on the device: the layout that every tracer takes, made from the caller's arrays."""

import dataclasses

import numpy as np
import pyopencl.array as cla

from raystream.checks import as_float_array, check_rows
from raystream.statistics import RAY_CREATION

_LOCAL = 64
_CHUNKS_PER_UNIT = 8


@dataclasses.dataclass
class Rays:
    """A ray stream.

    Attributes
    ----------
    org_tnear, dir_tfar : pyopencl.array.Array of shape (n, 4) float32
        Origin and tnear, direction and tfar. A ray with tfar < tnear is inactive: it hits nothing.
    size : (int, int) or None
        (width, height) where ray i belongs to pixel i of a screen, row by row.
    light : int or None
        Of shadow rays that all start at one light: its number.
    primary : bool
        Whether these are a camera's rays.
    one_origin : bool
        Whether these are not known to be a screen's and start at one point, as far as some tell.
    """

    org_tnear: cla.Array
    dir_tfar: cla.Array
    size: tuple | None = None
    light: int | None = None
    primary: bool = False
    one_origin: bool = False

    def __len__(self):
        return self.org_tnear.shape[0]


def from_numpy(session, origins, directions, tnear, tfar):
    """Check and upload rays given as arrays.

    Parameters
    ----------
    session : raystream.device.Session
    origins, directions : array_like of shape (n, 3)
        Finite; directions not zero, of any length.
    tnear, tfar : float or array_like of shape (n,)
        In units of the direction's length; tnear >= 0, tfar may be infinite.

    Raises
    ------
    TypeError, ValueError
        Names the argument and the first element that is wrong.
    """
    origins = as_float_array("origins", origins, (None, 3))
    directions = as_float_array("directions", directions, (len(origins), 3))
    tnear = _per_ray("tnear", tnear, len(origins))
    tfar = _per_ray("tfar", tfar, len(origins))
    shared = [session.share(RAY_CREATION, array) for array in (origins, directions)]
    bounds = [_on_device(session, value) for value in (tnear, tfar)]
    packed, first_refused = _pack(session, len(origins), *shared, *bounds)
    if first_refused < len(origins):
        _refuse(origins, directions, tnear, tfar)
    return packed


def _refuse(origins, directions, tnear, tfar):
    """Name what is wrong with the first ray that cannot be taken."""
    check_rows("origins", "finite values", np.isfinite(origins).all(axis=1))
    check_rows("directions", "finite values", np.isfinite(directions).all(axis=1))
    check_rows("directions", "a direction that is not zero", directions.any(axis=1))
    check_rows("tnear", "a value of at least 0", np.atleast_1d(tnear >= 0))
    check_rows("tfar", "a value that is not NaN", np.atleast_1d(~np.isnan(tfar)))


def _per_ray(name, value, count):
    return as_float_array(name, value, () if np.ndim(value) == 0 else (count,))


def from_device(session, origins, directions, tnear, tfar):
    """Pack rays given as `pyopencl.array` arrays of the session's context; see `from_numpy`."""
    count = origins.shape[0]
    if origins.ndim != 2 or origins.shape[1] != 3:
        raise ValueError(f"origins: need shape (n, 3), got {origins.shape}")
    for name, array in (("origins", origins), ("directions", directions)):
        _check_device_array(name, array, (count, 3))
    bounds = [_per_ray_on_device(session, *x, count) for x in (("tnear", tnear), ("tfar", tfar))]
    packed, first_refused = _pack(session, count, origins, directions, *bounds)
    if first_refused < count:
        raise ValueError(
            "rays: need finite origins and directions, directions that are not zero, tnear >= 0 "
            f"and tfar not NaN, not so at index {first_refused}"
        )
    return packed


def _pack(session, count, origins, directions, tnear, tfar):
    """Rays, and the index of the first that no tracer can take; a larger one where all are good."""
    packed = Rays(*(session.empty((count, 4), np.float32) for _ in range(2)))
    if count == 0:
        return packed, 0
    chunks = _chunks(session)
    facts = session.empty(chunks + 2, np.uint32)
    session.launch(
        RAY_CREATION,
        _kernels(session)["pack_rays"],
        chunks + 1,
        np.uint32(count),
        origins,
        directions,
        *tnear,
        *tfar,
        packed.org_tnear,
        packed.dir_tfar,
        facts,
    )
    # Waits: shared arrays may change from here on.
    *refused, width, one_origin = facts.get().tolist()
    packed.size = (width, count // width) if width else None
    packed.one_origin = bool(one_origin and not width)
    return packed, min(refused)


def _chunks(session):
    return _CHUNKS_PER_UNIT * session.device.max_compute_units


def _kernels(session):
    return session.kernels("rays.cl", CHUNKS=_chunks(session))


def from_camera(session, camera, size, offset=(0.5, 0.5)):
    """The camera's rays through `offset` of every pixel of a (width, height) screen."""
    width, height = size
    org_tnear = session.empty((width * height, 4), np.float32)
    dir_tfar = session.empty((width * height, 4), np.float32)
    right, up, forward = camera.basis
    tangent = np.tan(np.radians(camera.fov_y) / 2)
    vectors = (camera.eye, right * tangent * width / height, up * tangent, forward)
    session.launch(
        RAY_CREATION,
        _kernels(session)["camera_rays"],
        width * height,
        np.uint32(width),
        np.uint32(height),
        np.array(offset, np.float32),
        *(float4(v) for v in vectors),
        org_tnear,
        dir_tfar,
        local=_LOCAL,
    )
    return Rays(org_tnear, dir_tfar, tuple(size), primary=True)


def float4(vector):
    """Three numbers as a kernel's float4 argument, w = 0."""
    return np.array([*vector, 0.0], np.float32)


def _check_device_array(name, array, shape):
    if not isinstance(array, cla.Array):
        raise TypeError(f"{name}: need a pyopencl array like the origins, got {type(array)}")
    if array.shape != shape:
        raise ValueError(f"{name}: need shape {shape}, got {array.shape}")
    if array.dtype != np.float32:
        raise TypeError(f"{name}: need dtype float32 on the device, got {array.dtype}")
    if not array.flags.c_contiguous or array.offset:
        raise ValueError(f"{name}: need a C-contiguous device array that starts its buffer")


def _per_ray_on_device(session, name, value, count):
    """The array and the stride with which ray i reads it: 0 for one value for all."""
    if isinstance(value, cla.Array):
        _check_device_array(name, value, (count,))
        return value, np.uint32(1)
    return _on_device(session, _per_ray(name, value, count))


def _on_device(session, value):
    value = np.atleast_1d(value)
    return session.share(RAY_CREATION, value), np.uint32(len(value) > 1)
