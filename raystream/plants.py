"""Shapes that grow: ground, grass, trees and rocks, from uniform random numbers that are given."""

import numpy as np

from raystream import shapes

_CHILDREN, _GENERATIONS = 3, 5  # of a branch; a tree has 1 + 3 + 9 + 27 + 81 branches
_LEAVES = 60  # on each of the last branches


def terrain(height, half, cells):
    """Ground over [-half, half]^2 by a function height(x, z), 2 * cells^2 triangles.

    Cells are smaller towards the middle.
    """
    line = np.linspace(-1, 1, cells + 1)
    line = half * (0.3 * line + 0.7 * line**3)
    z, x = np.meshgrid(-line, line, indexing="ij")
    vertices = np.stack([x, height(x, z), z], axis=-1).reshape(-1, 3)
    return vertices, shapes.grid_faces(cells, cells)


def grass(places, draw, height, width):
    """Bent, tapered blades of five triangles, one at each of (n, 3) places.

    Parameters
    ----------
    places : (n, 3) float
    draw : callable
        Shape to uniform random numbers in [0, 1), as of `numpy.random.Generator.random`.
    height, width : float
        Of a mean blade.
    """
    n = len(places)
    facing, leaning = 2 * np.pi * draw(n), 2 * np.pi * draw(n)
    tall = height * (0.5 + draw(n))
    lean = tall * (0.1 + 0.6 * draw(n))
    side = 0.5 * width * np.stack([np.cos(facing), np.zeros(n), np.sin(facing)], axis=1)
    away = np.stack([np.cos(leaning), np.zeros(n), np.sin(leaning)], axis=1) * lean[:, None]
    rise = np.stack([np.zeros(n), tall, np.zeros(n)], axis=1)
    rows = []
    for share, wide in ((0.0, 1.0), (0.4, 0.8), (0.75, 0.5)):
        middle = places + share * rise + share**2 * away
        rows += [middle - wide * side, middle + wide * side]
    vertices = np.stack([*rows, places + rise * 0.97 + away], axis=1)
    blade = np.array([(0, 1, 3), (3, 2, 0), (2, 3, 5), (5, 4, 2), (4, 5, 6)])
    faces = 7 * np.arange(n)[:, None, None] + blade
    return vertices.reshape(-1, 3), faces.reshape(-1, 3)


def tree(base, size, draw):
    """Wood and leaves of a tree as two shapes, 121 branches and 4860 leaves.

    Parameters
    ----------
    base : (3,) float
    size : float
        Length of the trunk, a third of the tree's height.
    draw : callable
        As for `grass`.
    """
    starts, along = np.asarray(base, dtype=np.float64)[None], np.array([[0.0, 1.0, 0.0]])
    length, radius, wood = size, 0.09 * size, []
    for generation in range(_GENERATIONS):
        if generation:
            starts = np.repeat(starts, _CHILDREN, axis=0)
            along = _spread(np.repeat(along, _CHILDREN, axis=0), draw)
        tips = starts + length * along
        wood.append(_cones(starts, tips, radius, 0.62 * radius))
        starts, length, radius = tips, 0.74 * length, 0.62 * radius
    first = np.cumsum([0, *(len(vertices) for vertices, _ in wood[:-1])])
    faces = np.concatenate([faces + start for (_, faces), start in zip(wood, first, strict=True)])
    return (np.concatenate([v for v, _ in wood]), faces), _leaves(tips, 0.55 * size, draw)


def _spread(along, draw):
    """Directions turned away from those of the parents, a little upward."""
    sideways = draw(along.shape) * 2 - 1
    sideways -= (sideways * along).sum(axis=1, keepdims=True) * along
    return shapes.unit(along + 0.85 * shapes.unit(sideways) + (0, 0.12, 0))


def _cones(bases, tips, radius, tip_radius, sides=8):
    """Open cylinders that taper to a smaller radius."""
    vertices, faces = shapes.cylinders(bases, tips, radius, sides)
    rings = vertices.reshape(-1, 2, sides, 3)
    rings[:, 1] = tips[:, None] + (rings[:, 1] - tips[:, None]) * (tip_radius / radius)
    return rings.reshape(-1, 3), faces


def _leaves(tips, reach, draw):
    """Two triangles a leaf, folded along the middle, scattered in balls around the tips."""
    centers = np.repeat(tips, _LEAVES, axis=0)
    n = len(centers)
    offset = shapes.unit(draw((n, 3)) * 2 - 1) * np.cbrt(draw((n, 1))) * reach
    along, sideways = shapes.unit(draw((n, 3)) * 2 - 1), draw((n, 3)) * 2 - 1
    across = shapes.unit(np.cross(along, sideways))
    up = np.cross(across, along)
    long, wide = 0.05 + 0.05 * draw((n, 1)), 0.025 + 0.02 * draw((n, 1))
    middle = centers + offset
    corners = [
        middle - long * along,
        middle + wide * across + 0.3 * wide * up,
        middle + long * along,
        middle - wide * across + 0.3 * wide * up,
    ]
    return shapes.quads(np.stack(corners, axis=1))


def rock(center, size, draw):
    """A stone of 1280 triangles: a ball cut flat by twelve planes."""
    ball, faces = shapes.icosphere(3)
    planes = shapes.unit(draw((12, 3)) * 2 - 1)
    depth = 0.72 + 0.25 * draw(12)
    reach = np.max(np.maximum(ball @ planes.T, 0) / depth, axis=1, keepdims=True)
    return center + size * ball / np.maximum(reach, 1.0) * (1, 0.75, 1), faces
