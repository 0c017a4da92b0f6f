"""Watertight ray-triangle intersection in float64 (Woop, Benthin and Wald 2013), on pair lists.

The ray is turned into the z axis by a permutation and a shear, the same for every triangle, so
that a shared vertex has one 2-D position. A ray hits when the three 2-D edge functions do not
differ in sign. Neighbours compute the edge function of their shared edge from the same two
points, so the ray is never outside both, provided that the signs are right:

* A product is rounded monotonically, so rounded a b - c d has the sign of the exact one or is 0.
* Where it is 0 the rounding errors of the two products, exact by Dekker (1971), decide. The
  paper recomputes in double at this place; from double this is the step that remains.

Hence every sign is that of the exact function of the (rounded) 2-D points, and no ray is lost.
"""

import numpy as np


def intersect_pairs(origins, directions, corners):
    """Intersect each ray with the triangle at the same place of its list.

    Parameters
    ----------
    origins, directions : (n, 3) float64
        A zero direction hits nothing.
    corners : (n, 3 corners, 3) float64

    Returns
    -------
    hit : (n,) bool
        Whether the line through the ray, in both directions, meets the triangle.
    t, u, v : (n,) float64
        Distance in units of the direction's length (may be negative) and barycentric
        coordinates of the second and third corner; meaningless where `hit` is False.
    """
    x, y, z, t_scale = _sheared(origins, directions, corners)
    edges = np.stack([_edge_function(x, y, (k + 2) % 3, (k + 1) % 3) for k in range(3)], axis=1)
    determinant = edges.sum(axis=1)  # of one sign where inside, so 0 only if all three are
    inside = (edges >= 0).all(axis=1) | (edges <= 0).all(axis=1)
    hit = inside & (determinant != 0) & directions.any(axis=1)
    weights = edges / np.where(hit, determinant, 1.0)[:, None]
    t = t_scale * (weights * z).sum(axis=1)
    return hit, t, weights[:, 1], weights[:, 2]


def _sheared(origins, directions, corners):
    """Return corner coordinates x, y, z (n, 3 corners) with the ray as z axis, and 1 / d_z."""
    z_axis = np.argmax(np.abs(directions), axis=1)
    # The paper swaps x and y to keep the winding; the signs may all be flipped here instead.
    order = (z_axis[:, None] + np.array([1, 2, 0])) % 3
    d = np.take_along_axis(directions, order, axis=1)
    relative = np.take_along_axis(corners - origins[:, None], order[:, None], axis=2)
    d_z = np.where(d[:, 2] == 0, 1.0, d[:, 2])
    z = relative[:, :, 2]
    x = relative[:, :, 0] - (d[:, 0] / d_z)[:, None] * z
    y = relative[:, :, 1] - (d[:, 1] / d_z)[:, None] * z
    return x, y, z, 1.0 / d_z


def _edge_function(x, y, i, j):
    """Return x_i y_j - y_i x_j with the exact sign, unless a product of errors underflows."""
    value = x[:, i] * y[:, j] - y[:, i] * x[:, j]
    zero = np.flatnonzero(value == 0)  # the rounded products are equal, so their errors decide
    if len(zero):
        error = _product_error(x[zero, i], y[zero, j])
        value[zero] = error - _product_error(y[zero, i], x[zero, j])
    return value


def _product_error(a, b):
    """Return a b minus its rounded value, exactly (Dekker 1971)."""
    a_high, a_low = _split(a)
    b_high, b_low = _split(b)
    product = a * b
    return ((a_high * b_high - product) + a_high * b_low + a_low * b_high) + a_low * b_low


def _split(a):
    """Return a as a sum of two numbers of at most 26 bits each (Veltkamp 1968)."""
    scaled = 134217729.0 * a  # 2**27 + 1
    high = scaled - (scaled - a)
    return high, a - high
