"""Checks shared by the host tracers: what comes in is float32, finite and of the right shape."""

import numpy as np


def float32_array(name, values, shape):
    """Return `values` as a contiguous, native float32 array.

    Parameters
    ----------
    name : str
        What to call the array in an error.
    values : array_like
        Numbers of any memory order, byte order and real dtype.
    shape : tuple
        Required shape; None stands for any length.

    Raises
    ------
    TypeError
        Not numbers, or complex ones.
    ValueError
        Another shape.
    """
    array = np.asarray(values)
    if not np.can_cast(array.dtype, np.float32, "same_kind"):
        raise TypeError(f"{name}: need real numbers, got dtype {array.dtype}")
    fits = len(array.shape) == len(shape) and all(
        want in (None, have) for want, have in zip(shape, array.shape, strict=True)
    )
    if not fits:
        wanted = ", ".join("n" if length is None else str(length) for length in shape)
        raise ValueError(f"{name}: need shape ({wanted}), got {array.shape}")
    with np.errstate(over="ignore"):  # beyond float32 becomes inf, which the callers refuse
        return np.ascontiguousarray(array, np.float32)


def check_finite(name, array):
    """Raise ValueError, naming the first bad row, when `array` holds a NaN or an infinity."""
    bad = ~np.isfinite(array).all(axis=1)
    if bad.any():
        raise ValueError(f"{name}: row {int(np.argmax(bad))} is not finite in float32")


def float32_rays(origins, directions, tnear, tfar):
    """Return checked float32 rays.

    Parameters
    ----------
    origins, directions : (n, 3) array_like
        Finite; directions need not be normalised.
    tnear, tfar : float or (n,) array_like
        The segment in which a hit counts, both ends included; tnear is finite and >= 0,
        tfar may be inf.

    Returns
    -------
    origins, directions : (n, 3) float32
    tnear, tfar : (n,) float32

    Raises
    ------
    TypeError, ValueError
        One line that names the argument.
    """
    origins = float32_array("origins", origins, (None, 3))
    directions = float32_array("directions", directions, (None, 3))
    if len(origins) != len(directions):
        raise ValueError(f"rays: {len(origins)} origins but {len(directions)} directions")
    check_finite("origins", origins)
    check_finite("directions", directions)
    tnear = _limits("tnear", tnear, len(origins))
    tfar = _limits("tfar", tfar, len(origins))
    if not ((tnear >= 0) & (tnear < np.inf)).all():
        raise ValueError("tnear: need finite values >= 0")
    return origins, directions, tnear, tfar


def _limits(name, values, num_rays):
    """Return one float32 limit per ray from a scalar or an array."""
    if np.ndim(values) == 0:
        values = np.full(num_rays, float32_array(name, values, ()))
    limits = float32_array(name, values, (num_rays,))
    if np.isnan(limits).any():
        raise ValueError(f"{name}: must not be NaN")
    return limits
