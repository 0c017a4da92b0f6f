"""Where rays pass triangles: the geometry behind the rules of tolerance.py, in float64."""

import numpy as np


def largest_coordinate(points):
    """Return the largest |coordinate| of each row, as float64."""
    axes = tuple(range(1, points.ndim))
    return np.abs(points).max(axis=axes, initial=0).astype(np.float64)


def distance_outside(points, corners):
    """Return the largest distance of a point from its triangle's plane and edge planes.

    It is 0 on the triangle, inf for one without area and at most the distance from it.
    """
    a, b, c = corners.transpose(1, 0, 2)
    normals = np.cross(b - a, c - a)
    distances = [np.abs(_along(points - a, normals))]
    for start, end in ((a, b), (b, c), (c, a)):
        distances.append(_along(points - start, np.cross(end - start, normals)))
    return np.where(normals.any(axis=1), np.maximum(0, np.max(distances, axis=0)), np.inf)


def _along(vectors, axes):
    """Return the components of `vectors` along `axes` of any length."""
    lengths = np.linalg.norm(axes, axis=1)
    return (vectors * axes).sum(axis=1) / np.where(lengths > 0, lengths, 1.0)


def with_neighbours(origins, directions, radii):
    """Return (n, 9, 3) float64 origins: each one itself, then eight on a circle around it."""
    origins, directions = origins.astype(np.float64), directions.astype(np.float64)
    least = np.eye(3)[np.argmin(np.abs(directions), axis=1)]
    first = np.cross(directions, least)
    second = np.cross(directions, first)
    first, second = (
        axis / np.maximum(np.linalg.norm(axis, axis=1, keepdims=True), np.finfo(float).tiny)
        for axis in (first, second)
    )
    angle = np.arange(8)[:, None] * (np.pi / 4) + 0.1  # not along the edges of a square scene
    circle = np.cos(angle) * first[:, None] + np.sin(angle) * second[:, None]
    around = np.concatenate([np.zeros((len(origins), 1, 3)), circle], axis=1)
    return origins[:, None] + radii[:, None, None] * around


def slopes(corners, directions):
    """Return by how much t changes, per distance, when a ray is moved across its direction."""
    a, b, c = corners.transpose(1, 0, 2)
    normals, directions = np.cross(b - a, c - a), directions.astype(np.float64)
    lengths = np.linalg.norm(directions, axis=1)
    across = np.linalg.norm(np.cross(normals, directions), axis=1) * lengths
    # Seen edge-on a face may be hit at any distance; 1e12 stands for that.
    along = np.maximum(np.abs((normals * directions).sum(axis=1)) * lengths, 1e-12 * across)
    return across / np.where(along > 0, along * lengths, 1.0)
