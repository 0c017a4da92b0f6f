"""The watertight test of watertight.py in float32: operation for operation that of cl/triangle.h.

Hits, distances and coordinates equal the device's bit for bit, so that counts that depend on them
can be compared exactly. Unlike in watertight.py a hit is missed or found beside an edge within the
rounding of its float32 coordinates.
"""

import numpy as np

LARGEST = np.finfo(np.float32).max


def fma(a, b, c):
    """Return a * b + c of float32 arrays, rounded once.

    The product is exact in float64. The sum is rounded there to odd (Boldo, Melquiond 2008): its
    last bit says whether something was cut off, so that rounding to float32 is that of the sum.
    """
    product = a.astype(np.float64) * b
    c = np.broadcast_to(c, product.shape).astype(np.float64)
    total = product + c
    virtual = total - product
    error = (product - (total - virtual)) + (c - virtual)
    bits = total.view(np.int64)
    inexact = (error != 0) & np.isfinite(total) & (bits & 1 == 0)
    towards = np.where((error > 0) == (total > 0), 1, -1)
    return np.where(inexact, bits + towards, bits).view(np.float64).astype(np.float32)


def intersect_pairs(origins, directions, corners, tnear, tfar):
    """Intersect each ray with the triangle at the same place of its list.

    Parameters
    ----------
    origins, directions : (n, 3) float32
    corners : (n, 3 corners, 3) float32
    tnear, tfar : (n,) float32

    Returns
    -------
    hit : (n,) bool
        Whether the triangle is hit from tnear to tfar, at a distance below infinity.
    t, u, v : (n,) float32
        As in watertight.py; meaningless where `hit` is False.
    """
    with np.errstate(all="ignore"):  # infinities and NaN are misses
        turn, shear_x, shear_y, scale = _frames(directions)
        relative = np.take_along_axis(corners - origins[:, None], turn[:, None], axis=2)
        along = relative[..., 2]
        x, y = (
            fma(shear[:, None], along, relative[..., k])
            for k, shear in enumerate((shear_x, shear_y))
        )
        z = scale[:, None] * along
        edges = [_difference_of_products(x, y, (k + 2) % 3, (k + 1) % 3) for k in range(3)]
        inside = np.all([edge >= 0 for edge in edges], axis=0)
        inside |= np.all([edge <= 0 for edge in edges], axis=0)
        determinant = edges[0] + edges[1] + edges[2]
        u, v = edges[1] / determinant, edges[2] / determinant
        t = edges[0] / determinant * z[:, 0] + u * z[:, 1] + v * z[:, 2] + np.float32(0)
        hit = inside & (determinant != 0) & (determinant - determinant == 0)
        return hit & (t >= tnear) & (t <= np.minimum(tfar, LARGEST)), t, u, v


def _frames(directions):
    """Return the turn (n, 3), x's, y's shear and the scale of each ray's frame."""
    major = np.argmax(np.abs(directions), axis=1)  # of equal components the first
    turn = (major[:, None] + (1, 2, 0)) % 3
    x, y, z = np.take_along_axis(directions, turn, axis=1).T
    return turn, -(x / z), -(y / z), np.float32(1) / z


def _difference_of_products(x, y, i, j):
    """Return x_i y_j - y_i x_j by Kahan's method."""
    w = y[:, i] * x[:, j]
    error = fma(-y[:, i], x[:, j], w)
    return fma(x[:, i], y[:, j], -w) + error
