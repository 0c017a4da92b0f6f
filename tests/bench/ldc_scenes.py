"""What `bench_ldc.py` shows pictures of: the kinds of scenes of Buerger et al. (2007).

Models that mirror what is around them and themselves, two teapots above a mirror, a moving
model, the shadows of a tree. Each is one scene with its camera.
"""

import dataclasses
import pathlib

import numpy as np

import raystream as rs
from raystream import shapes
from raystream.mesh import from_shape

_SKY = (0.30, 0.42, 0.60)
_LACQUER = {"specular": 0.5, "shininess": 100.0}
ELEPHANT_KEYS = (0, 5, 10)


def _file(folder, path):
    """Its meshes, with smooth normals."""
    return rs.load_scene(pathlib.Path(folder) / path, smooth=True).meshes


def _floor(middle, height, half, tiles=8):
    x, _, z = middle
    quad = [(x - half, height, z + half), (x + half, height, z + half),
            (x + half, height, z - half), (x - half, height, z - half)]  # fmt: skip
    light, dark = shapes.checkers(quad, tiles, tiles)
    return [
        from_shape("floor-light", light, diffuse=(0.75, 0.72, 0.66)),
        from_shape("floor-dark", dark, diffuse=(0.12, 0.14, 0.18)),
    ]


def _balls(middle, height, size):
    """Four coloured balls on the floor around a model of that size."""
    colours = ((0.8, 0.1, 0.08), (0.1, 0.6, 0.15), (0.85, 0.65, 0.1), (0.15, 0.25, 0.8))
    places = ((-0.62, 0.45), (0.62, 0.5), (0.75, -0.3), (-0.7, -0.35))
    return [
        from_shape(
            f"ball-{k}",
            shapes.copies(
                shapes.icosphere(3),
                0.13 * size,
                [(middle[0] + size * x, height + 0.13 * size, middle[2] + size * z)],
            ),
            True,
            diffuse=colour,
            specular=0.3,
        )
        for k, (colour, (x, z)) in enumerate(zip(colours, places, strict=True))
    ]


def _stage(name, models, turn=0.3):
    """Models on a checkered floor between balls, and a camera in front of them."""
    used = np.concatenate([mesh.vertices[mesh.faces].reshape(-1, 3) for mesh in models])
    low, high = used.min(axis=0).astype(float), used.max(axis=0).astype(float)
    middle, size = (low + high) / 2, float((high - low).max())
    camera = rs.Camera.look_at(
        middle + size * np.array([turn, 0.45, 1.75]), middle - [0, 0.06 * size, 0], fov_y=40.0
    )
    lights = [
        rs.PointLight(middle + size * np.array(place), power)
        for place, power in (((-1.2, 1.8, 1.6), 0.75), ((1.5, 1.2, 1.0), 0.35))
    ]
    surroundings = [*_floor(middle, low[1], 1.1 * size), *_balls(middle, low[1], size)]
    return rs.Scene([*models, *surroundings], lights, camera, _SKY, 0.12, name)


def _mirrored(mesh, diffuse, reflectivity):
    material = dataclasses.replace(
        mesh.material, diffuse=diffuse, reflectivity=reflectivity, **_LACQUER
    )
    return dataclasses.replace(mesh, material=material)


def _statue(path, diffuse):
    def make(folder):
        (mesh,) = _file(folder, path)
        return _stage(pathlib.Path(path).stem, [_mirrored(mesh, diffuse, 0.6)])

    return make


def _teapots(folder):
    """Two teapots that mirror, above a mirror, as in figure 8."""
    (teapot,) = _file(folder, "teapot/teapot-6320.obj")
    pots = []
    for side, angle, colour in ((-1, 0.5, (0.5, 0.2, 0.1)), (1, 2.4, (0.12, 0.3, 0.45))):
        c, s = np.cos(angle), np.sin(angle)
        turned = teapot.vertices @ np.array([[c, 0, -s], [0, 1, 0], [s, 0, c]])
        placed = turned + [side * 3.2, 0.4, 0.0]
        pots.append(_mirrored(teapot.with_vertices(placed), colour, 0.5))
    x, z = 9.0, 6.0
    mirror = from_shape("mirror", shapes.quads([[(-x, 0, z), (x, 0, z), (x, 0, -z), (-x, 0, -z)]]),
                        diffuse=0.05, reflectivity=0.8, specular=0.5, shininess=200.0)  # fmt: skip
    camera = rs.Camera.look_at((0.0, 6.5, 15.0), (0.0, 0.8, 0.0), fov_y=45.0)
    lights = [rs.PointLight((-6, 10, 8), 0.75), rs.PointLight((8, 7, 6), 0.35)]
    balls = _balls((0.0, 0.0, 0.0), 0.0, 6.5)
    return rs.Scene([*pots, mirror, *balls], lights, camera, _SKY, 0.12, "teapots")


def _maple(folder):
    """A tree of 198,396 triangles, whose leaves throw shadows on each other and on the ground."""
    tree = _file(folder, "foliage/japanese-maple.glb")
    x, z, half = 70.0, 75.0, 395.0  # as wide as the tree: the cube is the tree's
    quad = [(x - half, -0.02, z + half), (x + half, -0.02, z + half),
            (x + half, -0.02, z - half), (x - half, -0.02, z - half)]  # fmt: skip
    ground = from_shape("ground", shapes.quads([quad]), diffuse=(0.7, 0.68, 0.6))
    camera = rs.Camera.look_at((70, 650, 1350), (70, 300, 60), fov_y=42.0)
    light = rs.PointLight((-300, 2000, 500), 0.9)
    return rs.Scene([*tree, ground], [light], camera, _SKY, 0.15, "japanese-maple")


def _ring(_folder):
    """A ring of 20,480 triangles, the number of the paper's car, that mirrors its inside."""
    vertices, faces = shapes.torus(1.0, 0.32, 160, 64)
    upright = shapes.turn(vertices, "x", 1.1)
    ring = from_shape("ring", (upright, faces), True)
    return _stage("ring", [_mirrored(ring, (0.5, 0.35, 0.1), 0.6)])


def _bumpy(_folder):
    return rs.scenes.bumpy_mirror(3)


SCENES = {
    "bunny": _statue("bunny/bunny-16301.ply", (0.35, 0.3, 0.25)),
    "ring": _ring,
    "dragon": _statue("dragon/dragon-47794.ply", (0.12, 0.35, 0.22)),
    **{
        f"elephant-{key:02}": _statue(f"elephant-skin/elephant-{key:02}.ply", (0.3, 0.3, 0.35))
        for key in ELEPHANT_KEYS
    },
    "teapots": _teapots,
    "maple": _maple,
    "bumpy-mirror": _bumpy,
}
