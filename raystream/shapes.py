"""Triangulated shapes by formula, and vertex normals.

A shape is a pair of vertices (n, 3) float64 and faces (m, 3) int, counter-clockwise from outside.
"""

import numpy as np

# --- flat and swept shapes ---


def quads(corners):
    """Each (4, 3) quad as two triangles: corners 0 1 2 and 2 3 0."""
    vertices = np.asarray(corners, dtype=np.float64).reshape(-1, 3)
    first = np.arange(0, len(vertices), 4)[:, None, None]
    return vertices, (first + [[0, 1, 2], [2, 3, 0]]).reshape(-1, 3)


def checkers(quad, columns, rows):
    """The even and the odd cells of a (4, 3) quad as two shapes."""
    a, b, c, d = np.asarray(quad, dtype=np.float64)
    v, u = np.meshgrid(np.linspace(0, 1, rows + 1), np.linspace(0, 1, columns + 1), indexing="ij")
    u, v = u[..., None], v[..., None]
    grid = (1 - v) * ((1 - u) * a + u * b) + v * ((1 - u) * d + u * c)
    cells = np.stack([grid[:-1, :-1], grid[:-1, 1:], grid[1:, 1:], grid[1:, :-1]], axis=2)
    odd = np.add.outer(np.arange(rows), np.arange(columns)) % 2 == 1
    return quads(cells[~odd]), quads(cells[odd])


def grid_faces(rows, columns):
    """Two triangles for each cell of a (rows + 1, columns + 1) grid of vertices, row by row."""
    i, j = np.mgrid[:rows, :columns].reshape(2, -1, 1, 1)
    stride = columns + 1
    cell = np.array([[0, 1, stride + 1], [stride + 1, stride, 0]])
    return (i * stride + j + cell).reshape(-1, 3)


def square(x, z, half):
    """The footprint of an upright block for `prism`: 4 corners (x, z) around a centre."""
    return [(x - half, z - half), (x - half, z + half), (x + half, z + half), (x + half, z - half)]


def prism(footprint, bottom, top):
    """Top and sides of a block without its base, 10 triangles; footprint: 4 corners (x, z)."""
    lower = np.insert(np.asarray(footprint, dtype=np.float64), 1, bottom, axis=1)
    upper = np.insert(np.asarray(footprint, dtype=np.float64), 1, top, axis=1)
    sides = [[lower[k], upper[k], upper[k - 1], lower[k - 1]] for k in range(4)]
    return quads([upper, *sides])


def room(lower, upper):
    """Six quads, the walls of a box as seen from inside: -x, +x, floor, ceiling, -z, +z."""
    (x0, y0, z0), (x1, y1, z1) = lower, upper
    return [
        [(x0, y0, z1), (x0, y0, z0), (x0, y1, z0), (x0, y1, z1)],
        [(x1, y0, z0), (x1, y0, z1), (x1, y1, z1), (x1, y1, z0)],
        [(x0, y0, z1), (x1, y0, z1), (x1, y0, z0), (x0, y0, z0)],
        [(x0, y1, z0), (x1, y1, z0), (x1, y1, z1), (x0, y1, z1)],
        [(x0, y0, z0), (x1, y0, z0), (x1, y1, z0), (x0, y1, z0)],
        [(x1, y0, z1), (x0, y0, z1), (x0, y1, z1), (x1, y1, z1)],
    ]


def gear(teeth, radius, bottom, top, phase=0.0):
    """A gear around the z axis, 4 * teeth - 2 triangles a face and 8 * teeth on the rim.

    Parameters
    ----------
    teeth : int
    radius : float
        Teeth reach to 0.995 of it, roots to 0.9.
    bottom, top : float
    phase : float
        Angle of the middle of the first tooth, in radians.
    """
    # each tooth: two points on the outer circle, then two on the root circle
    pitch = 2 * np.pi / teeth
    angles = phase + pitch * (np.arange(teeth)[:, None] + [-0.19, 0.19, 0.3, 0.7]).ravel()
    reach = radius * np.tile([0.995, 0.995, 0.9, 0.9], teeth)
    outline = reach[:, None] * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    points = len(outline)
    vertices = np.insert(np.tile(outline, (2, 1)), 2, np.repeat([top, bottom], points), axis=1)
    face = _gear_face(teeth)
    k = np.arange(points)
    after = (k + 1) % points
    rim = np.stack([k + points, after + points, after, after, k, k + points], axis=1)
    return vertices, np.concatenate([face, face[:, ::-1] + points, rim.reshape(-1, 3)])


def _gear_face(teeth):
    """The concave outline as triangles: a quad for each tooth, a fan for the root polygon."""
    first = 4 * np.arange(teeth)
    left_root = (first - 1) % (4 * teeth)
    tooth = np.stack([left_root, first, first + 1, first + 1, first + 2, left_root], axis=1)
    roots = np.sort(np.concatenate([first + 2, first + 3]))
    fan = np.stack([np.full(len(roots) - 2, roots[0]), roots[1:-1], roots[2:]], axis=1)
    return np.concatenate([tooth.reshape(-1, 3), fan])


def fractal_terrain(size):
    """[-1, 1]^2 in 2^size cells a side, 2 * 4^size triangles, heights (z) by midpoint displacement.

    The surface is always the same: that of the Standard Procedural Databases (Haines 1987).
    """
    cells = 2**size
    height = np.zeros((cells + 1, cells + 1))  # indexed [x, y]
    roughness = np.sqrt((2 / 2 ** (1 / (2.2 - 1))) ** 2 - 1)  # fractal dimension 2.2
    width = cells
    while width > 1:
        k = width // 2
        rise = k * 2 / cells * roughness
        corner = height[::width, ::width]
        old, mid = np.arange(0, cells + 1, width), np.arange(k, cells, width)
        mean = (corner[:-1] + corner[1:]) / 2
        height[np.ix_(mid, old)] = mean + rise * _lattice_gauss(mid, old, size)
        mean = (corner[:, :-1] + corner[:, 1:]) / 2
        height[np.ix_(old, mid)] = mean + rise * _lattice_gauss(old, mid, size)
        mean = (corner[:-1, :-1] + corner[1:, :-1] + corner[1:, 1:] + corner[:-1, 1:]) / 4
        height[np.ix_(mid, mid)] = mean + np.sqrt(2) * rise * _lattice_gauss(mid, mid, size)
        width = k
    line = np.linspace(-1, 1, cells + 1)
    x, y = np.meshgrid(line, line, indexing="ij")
    return np.stack([x, y, height], axis=-1).reshape(-1, 3), _terrain_faces(size)


def _terrain_faces(size):
    """Cells in the order of recursion: lower left, lower right, upper right, upper left."""
    cells = np.zeros((1, 2), dtype=np.int64)
    for _ in range(size):
        cells = (2 * cells[:, None] + [(0, 0), (1, 0), (1, 1), (0, 1)]).reshape(-1, 2)
    stride = 2**size + 1
    corners = [0, stride, stride + 1, 1]
    ids = (cells @ [stride, 1])[:, None] + corners
    return ids[:, [0, 1, 2, 2, 3, 0]].reshape(-1, 3)


def _lattice_gauss(px, py, size):
    """Gaussian numbers, fixed by the lattice position: (len(px), len(py)) float64."""
    px, py = np.meshgrid(px, py, indexing="ij")
    # the historic hash; it repeats visibly and is kept so that the mountain is the known one
    state = 21 + ((((px << 23) + (py << 15) + (px << 7)) >> size) & 0xFFFF)
    gauss = np.empty(px.shape)
    todo = np.ones(px.shape, dtype=bool)
    while todo.any():  # polar method: about 1.3 draws each
        first = (28411 + 8121 * state[todo]) % 134456
        state[todo] = (28411 + 8121 * first) % 134456
        v1, v2 = 2 * first / 134456 - 1, 2 * state[todo] / 134456 - 1
        q = v1 * v1 + v2 * v2
        inside = q < 1
        where = np.flatnonzero(todo)[inside]
        gauss.flat[where] = v1[inside] * np.sqrt(-2 * np.log(q[inside]) / q[inside])
        todo.flat[where] = False
    return gauss


# --- round shapes ---


def torus(radius, tube, around, across):
    """A ring about the y axis, 2 * around * across triangles."""
    u = np.arange(around) * (2 * np.pi / around)
    v = np.arange(across) * (2 * np.pi / across)
    u, v = np.meshgrid(u, v, indexing="ij")
    ring = radius + tube * np.cos(v)
    vertices = np.stack([ring * np.sin(u), tube * np.sin(v), ring * np.cos(u)], axis=-1)
    i, j = np.mgrid[:around, :across]
    ids = np.stack([i, (i + 1) % around]) * across
    a, b = ids[0] + j, ids[1] + j
    c, d = ids[1] + (j + 1) % across, ids[0] + (j + 1) % across
    return vertices.reshape(-1, 3), np.stack([a, b, c, c, d, a], axis=-1).reshape(-1, 3)


def cylinders(bases, tips, radius, sides):
    """Open cylinders between pairs of points (k, 3), 2 * sides triangles each."""
    axis = tips - bases
    axis = axis / np.linalg.norm(axis, axis=1, keepdims=True)
    # any direction that is not nearly parallel to the axis
    helper = np.eye(3)[np.abs(axis).argmin(axis=1)]
    u = np.cross(axis, helper)
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    v = np.cross(axis, u)
    angles = 2 * np.pi * np.arange(sides) / sides
    circle = radius * (np.cos(angles)[:, None] * u[:, None] + np.sin(angles)[:, None] * v[:, None])
    vertices = np.concatenate([bases[:, None] + circle, tips[:, None] + circle], axis=1)
    k = np.arange(sides)
    after = (k + 1) % sides
    a, b, c, d = k, after, after + sides, k + sides
    faces = np.stack([a, b, c, c, d, a], axis=1).reshape(-1, 3)
    first = 2 * sides * np.arange(len(bases))
    return vertices.reshape(-1, 3), (first[:, None, None] + faces).reshape(-1, 3)


def icosphere(subdivisions):
    """Unit sphere of 20 * 4^subdivisions triangles; its vertices are its normals."""
    g = (1 + np.sqrt(5)) / 2
    # fmt: off
    vertices = np.array([
        (-1, g, 0), (1, g, 0), (-1, -g, 0), (1, -g, 0), (0, -1, g), (0, 1, g),
        (0, -1, -g), (0, 1, -g), (g, 0, -1), (g, 0, 1), (-g, 0, -1), (-g, 0, 1),
    ])
    faces = np.array([
        (0, 11, 5), (0, 5, 1), (0, 1, 7), (0, 7, 10), (0, 10, 11),
        (1, 5, 9), (5, 11, 4), (11, 10, 2), (10, 7, 6), (7, 1, 8),
        (3, 9, 4), (3, 4, 2), (3, 2, 6), (3, 6, 8), (3, 8, 9),
        (4, 9, 5), (2, 4, 11), (6, 2, 10), (8, 6, 7), (9, 8, 1),
    ])
    # fmt: on
    for _ in range(subdivisions):
        vertices, faces = _subdivide(vertices, faces)
    return vertices / np.linalg.norm(vertices, axis=1, keepdims=True), faces


def rounded_box(half, radius, steps):
    """A box around the origin with round edges and corners, 12 * (2 * steps + 1)^2 triangles.

    Parameters
    ----------
    half : (3,) float
        Half the size along x, y and z.
    radius : float
        Of edges and corners, below every half size.
    steps : int
        Cells from a flat side to the middle of an edge.
    """
    half = np.asarray(half, dtype=np.float64)
    bend = radius * np.tan(np.linspace(0, np.pi / 4, steps + 1))
    bend[-1] = radius  # to the bit, so that the sides meet
    lines = [np.concatenate([-(h - radius) - bend[::-1], h - radius + bend]) for h in half]
    cells = 2 * steps + 1
    vertices, faces = [], []
    for axis in range(3):
        u, v = (axis + 1) % 3, (axis + 2) % 3
        for side in (-1, 1):
            grid = np.empty((cells + 1, cells + 1, 3))
            grid[..., u], grid[..., v] = np.meshgrid(lines[u], lines[v])
            grid[..., axis] = side * half[axis]
            order = slice(None, None, side)
            faces.append(grid_faces(cells, cells)[:, order] + len(vertices) * (cells + 1) ** 2)
            vertices.append(grid.reshape(-1, 3))
    vertices = np.concatenate(vertices)
    inner = np.clip(vertices, radius - half, half - radius)
    return inner + radius * unit(vertices - inner), np.concatenate(faces)


def _subdivide(vertices, faces):
    """Split every triangle into four at its edges' midpoints, which neighbours share."""
    edges = np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    unique, inverse = np.unique(edges, axis=0, return_inverse=True)
    middle = len(vertices) + inverse.reshape(-1, 3)
    (a, b, c), (ab, bc, ca) = faces.T, middle.T
    split = np.stack([a, ab, ca, b, bc, ab, c, ca, bc, ab, bc, ca], axis=1).reshape(-1, 3)
    # on the unit sphere before the next split, so that triangles stay of similar size
    new = vertices[unique].mean(axis=1)
    new *= np.linalg.norm(vertices[0]) / np.linalg.norm(new, axis=1, keepdims=True)
    return np.concatenate([vertices, new]), split


# --- placing ---


def copies(shape, scales, centers):
    """One scaled and moved copy of a shape for each of (k,) scales and (k, 3) centers."""
    vertices, faces = shape
    scales = np.broadcast_to(scales, len(centers))
    placed = scales[:, None, None] * vertices + np.asarray(centers)[:, None]
    first = len(vertices) * np.arange(len(centers))
    return placed.reshape(-1, 3), (first[:, None, None] + faces).reshape(-1, 3)


def turn(points, axis, angle):
    """Points (..., 3) rotated about "x", "y" or "z", counter-clockwise seen from its tip."""
    i, j = {"x": (1, 2), "y": (2, 0), "z": (0, 1)}[axis]
    turned = np.array(points, dtype=np.float64)
    turned[..., i] = np.cos(angle) * points[..., i] - np.sin(angle) * points[..., j]
    turned[..., j] = np.sin(angle) * points[..., i] + np.cos(angle) * points[..., j]
    return turned


def turn_about(points, axis, angle):
    """Points (..., 3) rotated about a unit axis (3,) by Rodrigues' formula."""
    return (
        np.cos(angle) * points
        + np.sin(angle) * np.cross(axis, points)
        + (1 - np.cos(angle)) * (points @ axis)[..., None] * axis
    )


def turn_from_z(directions, points):
    """(n, k, 3): points turned by the shortest rotation that takes +z to each direction."""
    x, y, z = directions.T
    # the rotation matrix I + [w] + [w]^2 / (1 + z) with w = z-axis x direction
    below = np.where(z > -1 + 1e-12, 1 + z, 1.0)
    rows = [[1 - x * x / below, -x * y / below, x], [-x * y / below, 1 - y * y / below, y]]
    matrix = np.stack([np.stack(row, axis=1) for row in (*rows, [-x, -y, z])], axis=1)
    matrix[z <= -1 + 1e-12] = np.diag([-1.0, 1.0, -1.0])  # straight down: half a turn about y
    return np.einsum("nij,kj->nki", matrix, points)


# --- normals ---


def smooth_normals(vertices, faces):
    """Compute vertex normals as the mean of the face normals, weighted by the face angles.

    Parameters
    ----------
    vertices : (n, 3) float
    faces : (m, 3) int

    Returns
    -------
    (n, 3) float32
        Unit vectors; +z at vertices without a face of nonzero area or whose sum vanishes.
    """
    corners = np.asarray(vertices, dtype=np.float64)[faces]
    edges = np.roll(corners, -1, axis=1) - corners  # edge k leaves corner k
    face_normals = unit(np.cross(edges[:, 0], edges[:, 1]))
    away, towards = unit(edges), unit(-np.roll(edges, 1, axis=1))
    # the arc tangent keeps needle-shaped angles exact where the arc cosine would not
    angles = 2 * np.arctan2(
        np.linalg.norm(away - towards, axis=2), np.linalg.norm(away + towards, axis=2)
    )
    sums = np.zeros((len(vertices), 3))
    for corner in range(3):
        weighted = face_normals * angles[:, corner, None]
        for axis in range(3):
            sums[:, axis] += np.bincount(faces[:, corner], weighted[:, axis], len(vertices))
    normals = unit(sums)
    normals[~normals.any(axis=1)] = (0.0, 0.0, 1.0)
    return normals.astype(np.float32)


def unit(vectors):
    """Vectors (..., 3) of length 1; those of length 0 stay 0."""
    lengths = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return vectors / np.where(lengths > 0, lengths, 1.0)
