"""Scenes made by formula: boxes, mirrors, a demo; those of spd.py and packet_scenes.py."""

import numpy as np

from raystream import shapes
from raystream.camera import Camera
from raystream.checks import check_choice, check_count, check_number, check_vector
from raystream.light import PointLight
from raystream.material import Material
from raystream.mesh import Mesh, from_shape
from raystream.packet_scenes import all_reflective, all_refractive, meadow, room, toys
from raystream.scene import Scene
from raystream.spd import balls, gears, mountain, rings

__all__ = [
    "all_reflective",
    "all_refractive",
    "balls",
    "bumpy_mirror",
    "cornell",
    "demo",
    "gears",
    "meadow",
    "mirror_ball",
    "mountain",
    "rings",
    "room",
    "toys",
]

_SMOOTH_LEVEL = 5  # subdivisions of a ball whose outline shows no corners: 20 480 triangles


def mirror_ball(center, radius):
    """A mirror sphere to put into any scene, with exact normals.

    Parameters
    ----------
    center : (3,) float
    radius : float

    Returns
    -------
    Mesh
        20 480 triangles; mesh and material are called "mirror-ball".

    Raises
    ------
    ValueError
        If the center is not three finite numbers or the radius no number above 0.
    """
    center = check_vector("center", center)
    radius = check_number("radius", radius, lambda x: x > 0, "a number > 0")
    normals, faces = shapes.icosphere(_SMOOTH_LEVEL)
    mirror = Material("mirror-ball", diffuse=0.0, specular=0.5, shininess=200.0, reflectivity=0.97)
    return Mesh(center + radius * normals, faces, "mirror-ball", normals, material=mirror)


# --- Cornell box ---


def cornell(variant="measured"):
    """The Cornell box.

    Parameters
    ----------
    variant : {"measured", "mirrors"}
        "measured": the published measurements in millimetres, 32 triangles in 8 meshes, the
        light lowered by 0.1 from the ceiling. "mirrors": a closed box of six mirrors around a
        ring on a block, 790 triangles, the number of the mirror box in Reis et al. (2017).

    Returns
    -------
    Scene

    Raises
    ------
    ValueError
        If the variant is unknown.
    """
    variants = {"measured": _cornell_measured, "mirrors": _cornell_mirrors}
    check_choice("variant", variant, variants)
    return variants[variant]()


_SHORT_BLOCK = [(130, 65), (82, 225), (240, 272), (290, 114)]
_TALL_BLOCK = [(423, 247), (265, 296), (314, 456), (472, 406)]


def _cornell_measured():
    white, green, red = (0.75, 0.75, 0.73), (0.12, 0.45, 0.15), (0.63, 0.06, 0.05)
    walls = {
        "floor": (white, [(552.8, 0, 0), (0, 0, 0), (0, 0, 559.2), (549.6, 0, 559.2)]),
        "light": (
            1.0,
            [(343, 548.7, 227), (343, 548.7, 332), (213, 548.7, 332), (213, 548.7, 227)],
        ),
        "ceiling": (
            white,
            [(556, 548.8, 0), (556, 548.8, 559.2), (0, 548.8, 559.2), (0, 548.8, 0)],
        ),
        "back-wall": (
            white,
            [(549.6, 0, 559.2), (0, 0, 559.2), (0, 548.8, 559.2), (556, 548.8, 559.2)],
        ),
        "right-wall": (green, [(0, 0, 559.2), (0, 0, 0), (0, 548.8, 0), (0, 548.8, 559.2)]),
        "left-wall": (
            red,
            [(552.8, 0, 0), (549.6, 0, 559.2), (556, 548.8, 559.2), (556, 548.8, 0)],
        ),
    }
    meshes = [
        from_shape(
            name,
            shapes.quads([quad]),
            diffuse=color,
            emission=(18, 13, 5) if name == "light" else 0.0,
        )
        for name, (color, quad) in walls.items()
    ]
    meshes.append(from_shape("short-block", shapes.prism(_SHORT_BLOCK, 0, 165), diffuse=white))
    meshes.append(from_shape("tall-block", shapes.prism(_TALL_BLOCK, 0, 330), diffuse=white))
    # the measured lens: focal length 35 mm, film 25 mm
    camera = Camera.look_at(
        (278, 273, -800), (278, 273, 0), fov_y=2 * np.degrees(np.arctan2(0.025 / 2, 0.035))
    )
    # just below the middle of the light, so that the light does not shadow it
    light = PointLight((278, 548, 279.5), (0.9, 0.8, 0.6))
    return Scene(meshes, [light], camera, ambient=0.2, name="cornell")


def _cornell_mirrors():
    names = [
        "left-mirror",
        "right-mirror",
        "floor-mirror",
        "ceiling-mirror",
        "back-mirror",
        "front-mirror",
    ]
    tints = [(0.9, 0.75, 0.75), (0.75, 0.9, 0.75)] + 4 * [(0.85, 0.85, 0.85)]
    walls = shapes.room((-1, 0, -1), (1, 2, 1))
    meshes = [
        from_shape(name, shapes.quads([wall]), diffuse=0.15, reflectivity=tint)
        for name, wall, tint in zip(names, walls, tints, strict=True)
    ]
    meshes.append(
        from_shape(
            "block", shapes.prism(shapes.square(0, 0, 0.35), 0.0, 0.4), diffuse=(0.7, 0.68, 0.6)
        )
    )
    vertices, faces = shapes.torus(0.3, 0.12, 24, 16)
    # upright, standing on the block
    ring = vertices[:, [0, 2, 1]] * (1, 1, -1) + (0, 0.4 + 0.3 + 0.12, 0)
    meshes.append(
        from_shape(
            "ring",
            (ring, faces),
            smooth=True,
            diffuse=(0.75, 0.3, 0.1),
            specular=0.4,
            shininess=40.0,
            reflectivity=0.1,
        )
    )
    camera = Camera.look_at((0.62, 1.35, 0.95), (-0.1, 0.7, 0), fov_y=70)
    lights = [PointLight((0.5, 1.8, 0.5), 0.7), PointLight((-0.7, 1.6, 0.7), 0.4)]
    return Scene(meshes, lights, camera, name="cornell-mirrors")


# --- curved mirror ---


def bumpy_mirror(n=3):
    """A room whose floor is the mirror of equation z = cos(n x) cos(n y) (Roger et al. 2007).

    Parameters
    ----------
    n : int
        Irregularity, >= 1: slopes and curvature grow with it. The mirror covers [-pi, pi]^2
        with 32 n cells a side, 2048 n^2 triangles; its height is along +y here.

    Returns
    -------
    Scene

    Raises
    ------
    ValueError
        If n is no positive integer.
    """
    n = check_count("n", n)
    line = np.linspace(-np.pi, np.pi, 32 * n + 1)
    z, x = np.meshgrid(-line, line, indexing="ij")
    height = np.cos(n * x) * np.cos(n * z)
    slopes = [n * np.sin(n * x) * np.cos(n * z), np.ones_like(x), n * np.cos(n * x) * np.sin(n * z)]
    normals = np.stack(slopes, axis=-1).reshape(-1, 3)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    mirror = Mesh(
        np.stack([x, height, z], axis=-1).reshape(-1, 3),
        shapes.grid_faces(32 * n, 32 * n),
        "mirror",
        normals,
        material=Material("mirror", diffuse=0.03, specular=0.3, reflectivity=0.9),
    )
    camera = Camera.look_at((2.2, 4.2, 2.9), (-0.4, 0.4, -0.6), fov_y=60)
    lights = [PointLight((0, 4.6, 0), 0.6), PointLight((2.5, 3.5, 2.5), 0.4)]
    meshes = [mirror, *_checkered_room(), *_hanging_objects()]
    return Scene(meshes, lights, camera, name=f"bumpy-mirror-{n}")


def _checkered_room():
    """Five walls around the mirror; the two the camera looks at are checkered."""
    walls = shapes.room((-np.pi, -1, -np.pi), (np.pi, 5, np.pi))
    meshes = []
    for wall, light, dark in (
        (walls[0], (0.8, 0.7, 0.5), (0.5, 0.15, 0.1)),
        (walls[4], (0.75, 0.75, 0.7), (0.1, 0.25, 0.5)),
    ):
        side = "left" if wall is walls[0] else "back"
        for name, shape, color in zip(
            ("light", "dark"), shapes.checkers(wall, 8, 8), (light, dark), strict=True
        ):
            meshes.append(from_shape(f"{side}-wall-{name}", shape, diffuse=color))
    plain = shapes.quads([walls[1], walls[3], walls[5]])
    return [*meshes, from_shape("plain-walls", plain, diffuse=(0.6, 0.65, 0.6))]


def _hanging_objects():
    ball, ring = shapes.icosphere(3), shapes.torus(0.45, 0.18, 48, 24)
    things = [
        ("red-ball", ball, 0.5, (-1.2, 2.4, -1.2), (0.8, 0.1, 0.08)),
        ("green-ball", ball, 0.35, (0.9, 2.0, -1.8), (0.1, 0.6, 0.15)),
        ("yellow-ring", ring, 1.0, (-0.2, 2.1, 0.5), (0.85, 0.65, 0.1)),
    ]
    return [
        from_shape(name, shapes.copies(shape, size, [place]), True, diffuse=color, specular=0.4)
        for name, shape, size, place, color in things
    ]


# --- Standard Procedural Databases ---

def demo():
    """A mirror ball, a glass ball and coloured things on a checkered floor among pillars.

    Returns
    -------
    Scene
        All curved meshes with smooth normals; 2 lights.
    """
    floor = [(-7, 0, 7), (7, 0, 7), (7, 0, -7), (-7, 0, -7)]
    light, dark = shapes.checkers(floor, 14, 14)
    ball = shapes.icosphere(4)
    mirror = shapes.copies(ball, 1.0, [(-0.9, 1.0, -0.7)])
    glass = shapes.copies(ball, 0.6, [(0.85, 0.6, 0.75)])
    stand = shapes.prism(shapes.square(1.5, -1.7, 0.6), 0.0, 0.8)
    ring = shapes.copies(shapes.torus(0.62, 0.2, 64, 32), 1.0, [(1.5, 1.0, -1.7)])
    turns = np.linspace(0.35, 2.6, 7)
    places = np.stack([1.5 * np.cos(turns) - 0.1, np.full(7, 0.16), 1.0 * np.sin(turns) + 0.9], 1)
    beads = shapes.copies(shapes.icosphere(3), 0.16, places)
    shiny = {"smooth": True, "specular": 0.6, "shininess": 200}
    polished = {"smooth": True, "specular": 0.5, "shininess": 60.0}
    meshes = [
        from_shape("floor-light", light, diffuse=(0.75, 0.72, 0.66), reflectivity=0.08),
        from_shape("floor-dark", dark, diffuse=(0.10, 0.11, 0.13), reflectivity=0.08),
        from_shape("mirror-ball", mirror, reflectivity=(0.9, 0.9, 0.92), diffuse=0.02, **shiny),
        from_shape(
            "glass-ball", glass, transmission=(0.95, 0.98, 0.96), ior=1.5, diffuse=0.0, **shiny
        ),
        from_shape("stand", stand, diffuse=(0.12, 0.3, 0.55)),
        from_shape("ring", ring, diffuse=(0.8, 0.45, 0.08), reflectivity=0.15, **polished),
        from_shape("beads", beads, diffuse=(0.75, 0.08, 0.1), **polished),
        *_pillars(),
    ]
    lights = [PointLight((-3.5, 5.5, 3.5), 0.75), PointLight((4, 4, 1.5), 0.35)]
    camera = Camera.look_at((0.6, 2.2, 5.2), (0.15, 0.8, -0.3), fov_y=42)
    return Scene(meshes, lights, camera, background=(0.20, 0.32, 0.52), ambient=0.12, name="demo")


def _pillars():
    """Sixteen pillars around the scene, for the mirror ball to show; two materials."""
    turns = np.arange(16) * (2 * np.pi / 16) + np.pi / 16
    pillars = [
        shapes.prism(shapes.square(6 * np.sin(turn), 6 * np.cos(turn), 0.3), 0.0, 3.0)
        for turn in turns
    ]
    looks = (("teal-pillars", (0.08, 0.45, 0.42)), ("sand-pillars", (0.72, 0.55, 0.3)))
    return [
        from_shape(
            name,
            shapes.quads([shape[0].reshape(-1, 4, 3) for shape in pillars[k::2]]),
            diffuse=color,
        )
        for k, (name, color) in enumerate(looks)
    ]
