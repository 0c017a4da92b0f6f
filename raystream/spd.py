"""Standard Procedural Databases (Haines 1987, version 3.14): the same primitives, tessellated.

Their coordinates are left-handed with z up; here x is negated for geometry, lights and camera
alike, so that the picture is not mirrored.
"""

import numpy as np

from raystream import shapes
from raystream.camera import Camera
from raystream.checks import check_count
from raystream.light import PointLight
from raystream.mesh import from_shape
from raystream.scene import Scene

_SPHERE_LEVEL = 1  # subdivisions of the many small spheres: 80 triangles each
_GLASS_LEVEL = 3  # of the mountain's glass balls: 1280 each
_CYLINDER_SIDES = 12
_TEETH = 36
_RING_COLORS = [
    ("red", (1, 0, 0)),
    ("green", (0, 1, 0)),
    ("blue", (0, 0, 1)),
    ("cyan", (0, 1, 1)),
    ("magenta", (1, 0, 1)),
    ("yellow", (1, 1, 0)),
]


def rings(size=7):
    """Interlocked rings in a pyramid before a wall.

    Parameters
    ----------
    size : int
        Layers of the pyramid, >= 1: N = size (size + 1) (2 size + 1) / 6 objects of 30 spheres
        (80 triangles) and 30 cylinders (24 triangles), and the wall. rings(3): 43 682 triangles.

    Returns
    -------
    Scene
        Meshes: the wall, then cylinders and spheres of each of the six colours.

    Raises
    ------
    ValueError
        If the size is no positive integer.
    """
    size = check_count("size", size)
    tube, h = 0.07412, 1 / np.sin(np.pi / 8)
    layers = [
        (2 * i - d, (d + 1) * h, 2 * k - d)
        for d in range(size)
        for i in range(d + 1)
        for k in range(d + 1)
    ]
    centers = np.array(layers, dtype=np.float64)
    y, half = h * (size + 1), 1.01 * h * (size + 2) * np.tan(np.pi / 8)
    wall = [(-1 + sx * half, y, 0.5 + sz * half) for sx, sz in ((1, 1), (-1, 1), (-1, -1), (1, -1))]
    meshes = [_spd_mesh("wall", shapes.quads([wall]), 1.0)]
    for ring, (color, rgb) in enumerate(_RING_COLORS):
        points = (centers[:, None] + _ring_points(ring) / (1 + tube)).reshape(-1, 5, 3)
        previous = np.roll(points, 1, axis=1).reshape(-1, 3)
        points = points.reshape(-1, 3)
        look = {"color": rgb, "kd": 0.5, "ks": 0.2, "shine": 3.0827, "smooth": True}
        meshes.append(
            _spd_mesh(
                f"{color}-cylinders",
                shapes.cylinders(points, previous, tube, _CYLINDER_SIDES),
                **look,
            )
        )
        meshes.append(
            _spd_mesh(
                f"{color}-spheres",
                shapes.copies(shapes.icosphere(_SPHERE_LEVEL), tube, points),
                **look,
            )
        )
    return _spd_scene(
        "rings",
        meshes,
        eye=(-1, -h, 0.5),
        target=(-1, 1 - h, 0.5),
        lights=[(3, -h, 3), (-4, -h, 1), (2, -h, -4)],
    )


def _ring_points(ring):
    """(5, 3) corners of one of six linked pentagons: edge midpoints of a dodecahedron."""
    angles = 2 * np.pi * np.arange(5) / 5
    points = np.stack([np.cos(angles), np.sin(angles), np.zeros(5)], axis=1)
    if ring == 0:
        return points
    tilt = 2 * np.arccos(np.cos(np.pi / 3) / np.sin(np.pi / 5))
    return shapes.turn(shapes.turn(points, "x", tilt), "z", np.pi * (2 * ring - 1) / 5)


def gears(size=4):
    """A cube of meshing gears on a reflecting ground; some are transparent.

    Parameters
    ----------
    size : int
        Gears along each axis, >= 1: size^3 gears of 36 teeth (572 triangles) and the ground.
        gears(4): 36 610 triangles.

    Returns
    -------
    Scene
        Meshes: the ground, then the gears in the order of their x, y, z indices.

    Raises
    ------
    ValueError
        If the size is no positive integer.
    """
    size = check_count("size", size)
    ground = [(-2, -2, 0), (2, -2, 0), (2, 2, 0), (-2, 2, 0)]
    meshes = [
        _spd_mesh("ground", shapes.quads([ground]), (1, 0.85, 0.7), kd=0.3, ks=0.6, shine=3.0827)
    ]
    for ix, iy, iz in np.ndindex(size, size, size):
        clear = (4 * ix + 2 * iy + iz) % 5 == 0
        look = {"kd": 0.2, "transmission": 0.8, "ior": 1.1} if clear else {}
        meshes.append(
            _spd_mesh(
                f"gear-{ix}-{iy}-{iz}", _gear(size, ix, iy, iz), _gear_color(ix, iy, iz), **look
            )
        )
    return _spd_scene(
        "gears",
        meshes,
        eye=(-1.1, -2.1, 2.6),
        target=(0, 0, 0),
        lights=[(2, 4, 4), (-2, 4, 3), (2, -2.5, 2.5), (-1, -4, 2), (-1.111, -2.121, 2.626)],
    )


def _gear(size, ix, iy, iz):
    """The gear of these indices in its place."""
    radius = 1 / (size - 0.05 * (size - 1))
    top = 1 - iz / size
    bottom = top - min(0.1, 1 / (2 * size))
    phase = np.pi / _TEETH * ((ix + iy + iz) % 2)
    vertices, faces = shapes.gear(_TEETH, radius, bottom, top, phase)
    x, y = -1 + radius + 1.9 * radius * np.array([ix, iy])
    return vertices + (x, y, 0), faces


def _gear_color(ix, iy, iz):
    color = [
        5 * (3 * ix + 2 * iy + iz + 1),
        3 * (3 * iy + 2 * iz + ix + 1),
        2 * (3 * iz + 2 * ix + iy + 1),
    ]
    color = np.array(color) / 7 % 1 + 0.01
    return color / color.max()


def balls(size=4):
    """The sphereflake: every sphere bears nine of a third its radius.

    Parameters
    ----------
    size : int
        Generations after the first sphere, >= 0: sum of 9^k spheres (80 triangles each) on a
        square floor. balls(3): 65 602 triangles.

    Returns
    -------
    Scene
        Meshes: the floor, the spheres.

    Raises
    ------
    ValueError
        If the size is no integer >= 0.
    """
    size = check_count("size", size, 0)
    floor = [(12, 12, -0.5), (-12, 12, -0.5), (-12, -12, -0.5), (12, -12, -0.5)]
    centers, radii = _sphereflake(size)
    meshes = [
        _spd_mesh("floor", shapes.quads([floor]), (1, 0.75, 0.33), kd=0.8),
        _spd_mesh(
            "spheres",
            shapes.copies(shapes.icosphere(_SPHERE_LEVEL), radii, centers),
            (1, 0.9, 0.7),
            kd=0.5,
            ks=0.5,
            shine=3.0827,
            smooth=True,
        ),
    ]
    return _spd_scene(
        "balls",
        meshes,
        eye=(2.1, 1.3, 1.7),
        target=(0, 0, 0),
        lights=[(4, 3, 2), (1, -4, 4), (-3, 1, 5)],
    )


def _sphereflake(size):
    """Centers (n, 3) and radii (n,) of all spheres, generation by generation."""
    nine = _flake_directions()
    centers, outward, radius = np.zeros((1, 3)), np.array([[0.0, 0.0, 1.0]]), 0.5
    all_centers, all_radii = [centers], [np.array([radius])]
    for _ in range(size):
        outward = shapes.turn_from_z(outward, nine).reshape(-1, 3)
        centers = np.repeat(centers, 9, axis=0) + radius * 4 / 3 * outward
        radius /= 3
        all_centers.append(centers)
        all_radii.append(np.full(len(centers), radius))
    return np.concatenate(all_centers), np.concatenate(all_radii)


def _flake_directions():
    """(9, 3) unit vectors to the children of a sphere whose parent lies towards -z."""
    group = np.array([(1, 1, 0), (1, 0, -1), (0, 1, -1)]) / np.sqrt(2)
    axis = np.array([1, -1, 0]) / np.sqrt(2)
    tilted = shapes.turn_about(group, axis, np.arcsin(2 / np.sqrt(6)))
    return np.concatenate([shapes.turn(tilted, "z", angle) for angle in np.radians((0, 120, 240))])


def mountain(size=6):
    """A fractal mountain below four glass balls.

    Parameters
    ----------
    size : int
        Number of subdivisions, 1 to 10: 2 * 4^size triangles of rock, and four spheres of 1280.
        mountain(6): 13 312 triangles. The published databases end at 7.

    Returns
    -------
    Scene
        Meshes: the glass balls, the rock.

    Raises
    ------
    ValueError
        If the size is no integer from 1 to 10.
    """
    size = check_count("size", size)
    if size > 10:
        raise ValueError(f"size: need a whole number from 1 to 10, got {size}")
    low = 0.930598
    centers = [
        (-0.8, 0.8, 1.20821),
        (-0.661196, 0.661196, low),
        (-0.749194, 0.98961, low),
        (-0.98961, 0.749194, low),
    ]
    glass = shapes.copies(shapes.icosphere(_GLASS_LEVEL), 0.17, centers)
    clear = {"kd": 0.1, "ks": 0.1, "shine": 101.148, "transmission": 0.9, "ior": 1.5}
    meshes = [
        _spd_mesh("glass", glass, 1.0, smooth=True, **clear),
        _spd_mesh("rock", shapes.fractal_terrain(size), (0.5, 0.45, 0.35)),
    ]
    return _spd_scene(
        "mountain", meshes, eye=(-1.6, 1.6, 1.7), target=(0, 0, 0), lights=[(-100, -100, 100)]
    )


def _spd_mesh(
    name, shape, color, kd=1.0, ks=0.0, shine=32.0, transmission=0.0, ior=1.5, smooth=False
):
    """A mesh from left-handed coordinates; the faces' sides are kept.

    The databases add kd * color, ks * mirror ray and transmission * refracted ray; here the
    opaque share (1 - transmission) (1 - ks) of `diffuse` is what kd * color was.
    """
    vertices, faces = shape
    right_handed = vertices * (-1, 1, 1), faces[:, [0, 2, 1]]
    opaque = (1 - transmission) * (1 - ks)
    return from_shape(
        name,
        right_handed,
        smooth,
        diffuse=np.multiply(min(kd / opaque, 1), color),
        specular=ks,
        shininess=shine,
        reflectivity=ks,
        transmission=transmission,
        ior=ior,
    )


def _spd_scene(name, meshes, eye, target, lights):
    flip = np.array([-1, 1, 1])
    weight = np.sqrt(len(lights)) / (2 * len(lights))
    return Scene(
        meshes,
        [PointLight(light * flip, weight) for light in lights],
        Camera.look_at(eye * flip, target * flip, up=(0, 0, 1), fov_y=45),
        background=(0.078, 0.361, 0.753),
        ambient=weight,
        name=name,
    )


# --- demo ---
