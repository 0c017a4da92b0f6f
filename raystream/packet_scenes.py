"""Scenes of the kinds that Overbeck et al. (2008) study: a bare room, toys, a meadow.

Simple and flat, of a game's level, and complex with large and tiny objects (section 5.1). All
triangles follow from fixed seeds: a scene is the same each time. Lengths in metres, +y is up.
"""

import numpy as np

from raystream import shapes
from raystream.camera import Camera
from raystream.light import PointLight
from raystream.mesh import from_shape
from raystream.plants import grass, rock, terrain, tree
from raystream.scene import Scene

# --- room ---


def room():
    """A dining room with a mirror, 804 triangles, all of them flat; as ERW6 in the paper.

    Returns
    -------
    Scene
        Closed: no ray from inside sees the background. 2 lights.
    """
    x, y, z = 2.5, 2.6, 2.0
    left, right, floor, ceiling, back, front = shapes.room((-x, 0, -z), (x, y, z))
    walls = [
        ("left-wall", [left], {"diffuse": (0.55, 0.2, 0.14)}),
        ("right-wall", [right], {"diffuse": (0.2, 0.36, 0.42)}),
        ("plain-walls", [back, front], {"diffuse": (0.74, 0.7, 0.6)}),
        ("ceiling", [ceiling], {"diffuse": 0.85}),
        ("floor", [floor], {"diffuse": (0.42, 0.26, 0.14), "reflectivity": 0.15}),
    ]
    wood, dark_wood, brass = (0.5, 0.3, 0.13), (0.22, 0.12, 0.06), (0.7, 0.5, 0.2)
    seats = [(-0.55, 0.62, 0), (0.55, 0.62, 0), (-0.55, -0.62, 2), (0.55, -0.62, 2),
             (-1.25, 0, 3), (1.25, 0, 1)]  # fmt: skip
    cherry = (0.45, 0.14, 0.07)
    furniture = [
        ("table", _table(), {"diffuse": wood, "specular": 0.2, "reflectivity": 0.08}),
        ("chairs", [box for seat in seats for box in _chair(*seat)], {"diffuse": cherry}),
        ("shelf", _shelf(), {"diffuse": dark_wood}),
        ("red-books", _books(0), {"diffuse": (0.6, 0.1, 0.08)}),
        ("green-books", _books(1), {"diffuse": (0.1, 0.35, 0.16)}),
        ("door", [((2.44, 0, 0.5), (2.5, 2.05, 1.4))], {"diffuse": (0.8, 0.76, 0.66)}),
        ("frames", [((-1.05, 0.95, -2), (1.05, 2.05, -1.96)),
                    ((-2.5, 1.15, -0.2), (-2.46, 1.95, 1.0))], {"diffuse": brass}),
        ("mirror", [((-0.98, 1.02, -2), (0.98, 1.98, -1.95))],
         {"diffuse": 0.02, "reflectivity": 0.92, "specular": 0.4}),
        ("picture", [((-2.5, 1.21, -0.14), (-2.45, 1.89, 0.94))],
         {"diffuse": (0.16, 0.3, 0.55)}),
        ("lamp", [((-0.01, 1.85, -0.01), (0.01, 2.6, 0.01)),
                  ((-0.22, 1.7, -0.22), (0.22, 1.87, 0.22))], {"diffuse": (0.9, 0.75, 0.35)}),
    ]  # fmt: skip
    meshes = [from_shape(name, shapes.quads(quads), **look) for name, quads, look in walls]
    meshes += [from_shape(name, _boxes(boxes), **look) for name, boxes, look in furniture]
    lights = [PointLight((-1.4, 2.4, 1.2), 0.55), PointLight((1.5, 2.3, 0.6), 0.4)]
    camera = Camera.look_at((1.7, 1.65, 1.85), (-0.35, 0.75, -0.6), fov_y=68)
    return Scene(meshes, lights, camera, ambient=0.15, name="room")


def _boxes(corners):
    """Closed boxes between pairs of corners, 12 triangles each, facing outward."""
    outward = [np.asarray(shapes.room(*pair))[:, ::-1] for pair in corners]
    return shapes.quads(outward)


def _table():
    top = ((-0.95, 0.72, -0.45), (0.95, 0.76, 0.45))
    legs = [((x, 0, z), (x + 0.07, 0.73, z + 0.07)) for x in (-0.9, 0.83) for z in (-0.4, 0.33)]
    return [top, *legs]


def _chair(x, z, quarter):
    """Seven boxes: seat, legs of which two bear the back, and its slats; turned by quarters."""
    half, leg = 0.2, 0.04
    boxes = [((-half, 0.43, -half), (half, 0.47, half))]
    for left in (-half, half - leg):
        boxes.append(((left, 0, -half), (left + leg, 0.44, -half + leg)))
        boxes.append(((left, 0, half - leg), (left + leg, 0.95, half)))
    for height in (0.62, 0.82):
        boxes.append(((-half, height, half - 0.03), (half, height + 0.1, half - 0.01)))
    turned = shapes.turn(np.array(boxes), "y", quarter * np.pi / 2) + (x, 0, z)
    return [(pair.min(axis=0), pair.max(axis=0)) for pair in turned]


def _shelf():
    sides = [((x, 0, -2), (x + 0.04, 1.9, -1.7)) for x in (-2.45, -1.5)]
    boards = [((-2.43, y, -2), (-1.48, y + 0.03, -1.71)) for y in (0.1, 0.65, 1.2, 1.85)]
    return [*sides, *boards]


def _books(color):
    """Three blocks of books, every second of the six on the two middle boards."""
    places = [(-2.35, 0.68), (-2.1, 0.68), (-1.8, 0.68), (-2.3, 1.23), (-1.95, 1.23), (-1.7, 1.23)]
    tall = [0.3, 0.36, 0.26, 0.34, 0.28, 0.38]
    return [
        ((x, y, -1.97), (x + 0.16, y + height, -1.76))
        for (x, y), height in list(zip(places, tall, strict=True))[color::2]
    ]


# --- toys ---

_TOASTERS = [  # x, z, heading in degrees, colour
    (-0.05, 0.1, 14, (0.75, 0.1, 0.08)),
    (-1.5, -0.55, 38, (0.1, 0.28, 0.62)),
    (1.35, -0.45, -24, (0.9, 0.6, 0.08)),
    (-0.5, -2.1, 8, (0.15, 0.5, 0.25)),
    (1.05, -2.3, -48, (0.8, 0.78, 0.72)),
]


def toys():
    """Five wind-up toasters on a checkered floor, 11 208 triangles; as Toasters in the paper.

    Returns
    -------
    Scene
        Curved meshes with smooth normals, the floor reflects; 2 lights.
    """
    floor = [(-8, 0, 8), (8, 0, 8), (8, 0, -8), (-8, 0, -8)]
    light, dark = shapes.checkers(floor, 12, 12)
    meshes = [
        from_shape("floor-light", light, diffuse=(0.7, 0.66, 0.56), reflectivity=0.2),
        from_shape("floor-dark", dark, diffuse=(0.2, 0.15, 0.13), reflectivity=0.2),
    ]
    for k, (x, z, heading, color) in enumerate(_TOASTERS):
        for part, shape, smooth, look in _toaster(color):
            vertices = shapes.turn(shape[0], "y", np.radians(heading)) + (x, 0, z)
            meshes.append(from_shape(f"toaster-{k}-{part}", (vertices, shape[1]), smooth, **look))
    lights = [PointLight((-3, 6, 4), 0.75), PointLight((4, 5, 3), 0.35)]
    camera = Camera.look_at((0.5, 2.3, 4.6), (0, 0.5, -0.55), fov_y=46)
    return Scene(meshes, lights, camera, background=(0.35, 0.45, 0.6), ambient=0.15, name="toys")


def _toaster(color):
    """(name, shape, smooth, material) of the parts of a toaster that faces +z, 2184 triangles."""
    body = _moved(shapes.rounded_box((0.62, 0.4, 0.34), 0.14, 3), (0, 0.6, 0))
    slots = _boxes([((-0.42, 0.95, z - 0.06), (0.42, 1.003, z + 0.06)) for z in (-0.13, 0.13)])
    slices = [_moved(shapes.rounded_box((0.34, 0.26, 0.04), 0.035, 1), (0, y, z))
              for y, z in ((1.1, -0.13), (1.02, 0.13))]  # fmt: skip
    feet = [_moved(shapes.rounded_box((0.2, 0.1, 0.27), 0.09, 2), (x, 0.1, z))
            for x, z in ((-0.3, 0.22), (0.3, -0.06))]  # fmt: skip
    legs = _boxes([((x - 0.05, 0.15, z - 0.05), (x + 0.05, 0.3, z + 0.05))
                   for x, z in ((-0.3, 0.12), (0.3, -0.12))])  # fmt: skip
    eyes = shapes.copies(shapes.icosphere(1), 0.1, [(-0.2, 0.75, 0.34), (0.2, 0.75, 0.34)])
    pupils = shapes.copies(shapes.icosphere(1), 0.05, [(-0.18, 0.76, 0.41), (0.22, 0.76, 0.41)])
    ring = shapes.torus(0.12, 0.035, 20, 10)
    key = _moved((ring[0][:, [1, 0, 2]] * (1, 1, -1), ring[1]), (0.83, 0.6, 0))
    shaft = _boxes([((0.6, 0.575, -0.025), (0.75, 0.625, 0.025))])
    chrome = {"diffuse": 0.12, "specular": 0.6, "shininess": 150, "reflectivity": 0.7}
    paint = {"diffuse": color, "specular": 0.35, "shininess": 60, "reflectivity": 0.12}
    return [
        ("body", body, True, paint),
        ("slots", slots, False, {"diffuse": 0.03}),
        ("bread", _joined(slices), True, {"diffuse": (0.72, 0.45, 0.18)}),
        ("feet", _joined(feet), True, chrome),
        ("legs", legs, False, {"diffuse": 0.15}),
        ("eyes", eyes, True, {"diffuse": 0.9, "specular": 0.5, "shininess": 100}),
        ("pupils", pupils, True, {"diffuse": 0.02, "specular": 0.6, "shininess": 100}),
        ("key", key, True, chrome),
        ("shaft", shaft, False, chrome),
    ]


# --- meadow ---

_WATER = -0.08  # height of the pond
_TREES = [(-2.6, -3.4, 1.0), (2.9, -5.6, 1.25), (-5.8, -8.2, 1.4), (0.4, -10.2, 1.5)]  # x, z, size


def meadow():
    """Grass, toadstools and a dragonfly before trees and a pond, 172 688 triangles; as Fairy.

    Returns
    -------
    Scene
        Blades of some millimetres beside trees of some metres; the pond reflects, the wings of
        the dragonfly are glass. 1 light.
    """
    draw = np.random.default_rng(2008).random  # uniform numbers: a stream that numpy keeps
    meshes = [
        from_shape("ground", terrain(_height, 16.0, 64), True, diffuse=(0.2, 0.15, 0.07)),
        from_shape("pond", shapes.quads([_pond()]), diffuse=(0.03, 0.06, 0.07),
                   specular=0.5, shininess=300, reflectivity=0.65),
        *_grass(draw),
        *_trees(draw),
        *_rocks(draw),
        *_toadstools(draw),
        *_dragonfly(),
    ]  # fmt: skip
    camera = Camera.look_at((0.25, 0.62, 3.1), (0.0, 0.5, 0), fov_y=50)
    lights = [PointLight((-14, 22, 12), (1.0, 0.95, 0.82))]
    background = (0.42, 0.58, 0.78)
    return Scene(meshes, lights, camera, background, ambient=0.22, name="meadow")


def _height(x, z):
    """The ground: low hills and a hollow for the pond."""
    hills = 0.12 * np.sin(0.9 * x + 1.0) * np.cos(0.8 * z) + 0.05 * np.sin(2.3 * x - 1.7 * z)
    hollow = 0.55 * np.exp(-((x - 1.1) ** 2 / 1.6 + (z - 0.2) ** 2 / 1.1))
    return hills - hollow + 0.004 * (x * x + z * z)


def _pond():
    return [(x, _WATER, z) for x, z in ((-1.5, 2.2), (3.6, 2.2), (3.6, -1.8), (-1.5, -1.8))]


def _dry(places, margin=0.02):
    """Places (n, 2) on the ground above the water, as points (m, 3)."""
    height = _height(*places.T)
    wet_hollow = np.abs(places - (1.05, 0.2)) < (2.55, 2.0)
    dry = (height > _WATER + margin) | ~wet_hollow.all(axis=1)
    return np.insert(places, 1, height, axis=1)[dry]


def _grass(draw):
    """Blades of three greens, denser towards the camera."""
    looks = ("dark", (0.10, 0.26, 0.05)), ("fresh", (0.2, 0.42, 0.07)), ("dry", (0.5, 0.46, 0.16))
    counts = 7_250, 8_500, 2_000
    for (name, color), count in zip(looks, counts, strict=True):
        spread = draw((2 * count, 2)) * 2 - 1
        places = _dry(spread * np.abs(spread) * 7.0 + (0.1, 0.4))[:count]
        blades = grass(places, draw, height=0.3, width=0.014)
        yield from_shape(f"{name}-grass", blades, diffuse=color)


def _trees(draw):
    """Trunks with their branches, and leaves in one mesh of each tree."""
    bark, leaf = (0.3, 0.2, 0.12), [(0.16, 0.36, 0.08), (0.3, 0.4, 0.08), (0.12, 0.28, 0.1)]
    for k, (x, z, size) in enumerate(_TREES):
        base = np.array([x, _height(x, z) - 0.1, z])
        wood, leaves = tree(base, size, draw)
        yield from_shape(f"trunk-{k}", wood, diffuse=bark)
        yield from_shape(f"leaves-{k}", leaves, diffuse=leaf[k % 3])


def _rocks(draw):
    # fmt: off
    places = [(-1.15, 0.75, 0.2), (-1.0, -0.9, 0.34), (0.62, -1.55, 0.42), (2.4, -1.6, 0.6),
              (2.35, 1.0, 0.28), (-0.55, 1.45, 0.1), (-3.2, -1.6, 0.7), (1.2, 1.75, 0.1)]
    # fmt: on
    stones = [rock((x, _height(x, z) + 0.2 * size, z), size, draw) for x, z, size in places]
    yield from_shape("rocks", _joined(stones), True, diffuse=(0.42, 0.4, 0.38))


def _toadstools(draw):
    """Red caps on white stems."""
    near = np.array([(-0.5, 1.2), (-0.66, 1.05), (-0.36, 0.98), (-0.8, 1.4), (0.55, 2.05)])
    far = _dry((draw((60, 2)) * 2 - 1) * (3.5, 2.5) + (0, -2.0))[:35, [0, 2]]
    roots = np.insert(np.concatenate([near, far]), 1, 0, axis=1)
    roots[:, 1] = _height(roots[:, 0], roots[:, 2]) - 0.02
    sizes = np.concatenate([[0.11, 0.075, 0.06, 0.085, 0.07], 0.05 + 0.08 * draw(len(far))])
    tops = roots + 3.0 * sizes[:, None] * (0, 1, 0)
    stems = [shapes.cylinders(root[None], top[None], 0.22 * size, 12)
             for root, top, size in zip(roots, tops, sizes, strict=True)]  # fmt: skip
    ball, faces = shapes.icosphere(2)
    cap = np.where(ball[:, 1:2] > 0, ball * (1, 0.7, 1), ball * (1, 0.2, 1)), faces
    caps = shapes.copies(cap, sizes, tops)
    yield from_shape("stems", _joined(stems), True, diffuse=(0.85, 0.82, 0.72))
    yield from_shape("caps", caps, True, diffuse=(0.72, 0.07, 0.04), specular=0.3)


def _dragonfly():
    """Above the pond: a tail of beads, mirror eyes, four wings of glass."""
    place, ball = np.array([0.3, 0.62, 1.35]), shapes.icosphere(2)
    heading = np.radians(-50)

    def part(name, shape, smooth=True, **look):
        vertices = shapes.turn(shape[0], "y", heading) + place
        return from_shape(f"dragonfly-{name}", (vertices, shape[1]), smooth, **look)

    beads = np.array([(0, 0, -0.045 * k) for k in range(10)])
    sizes = np.array([0.038, 0.04, 0.034, *np.linspace(0.024, 0.016, 7)])
    eyes = [(-0.025, 0.015, 0.045), (0.025, 0.015, 0.045)]
    wings = [
        _moved((ball[0] * (0.2, 0.003, 0.042), ball[1]), (side * 0.21, 0.03, z), side * turn)
        for side in (-1, 1)
        for z, turn in ((-0.02, 0.2), (-0.085, -0.18))
    ]
    body = shapes.copies(shapes.icosphere(2), sizes, beads)
    yield part("body", body, diffuse=(0.05, 0.3, 0.5), specular=0.6, reflectivity=0.15)
    yield part("eyes", shapes.copies(ball, 0.024, eyes), diffuse=0.05, reflectivity=0.7)
    yield part("wings", _joined(wings), diffuse=0.0, specular=0.5, shininess=200,
               transmission=(0.85, 0.95, 1.0), ior=1.3)  # fmt: skip


# --- all of a kind ---


def all_reflective(scene):
    """The scene with every material a mirror to one half, as section 5.1 of the paper asks.

    Parameters
    ----------
    scene : Scene
        Left as it is.

    Returns
    -------
    Scene
        Every hit sends one reflection ray.
    """
    return _with_materials(scene, "reflective", reflectivity=0.5, transmission=0.0)


def all_refractive(scene):
    """The scene with every material glass to four fifths, as section 5.1 of the paper asks.

    Parameters
    ----------
    scene : Scene
        Left as it is.

    Returns
    -------
    Scene
        Every hit sends a refraction ray, but for total reflection, and a reflection ray.
    """
    return _with_materials(scene, "refractive", reflectivity=0.0, transmission=0.8, ior=1.5)


def _with_materials(scene, kind, **changes):
    lit = scene.lights, scene.camera, scene.background, scene.ambient
    changed = Scene(scene.meshes, *lit, name=f"{scene.name}-{kind}")
    changed.set_material("*", **changes)
    return changed


def _moved(shape, offset, angle=0.0):
    """A shape turned about z, then about the place where it stands: moved."""
    vertices, faces = shape
    return shapes.turn(vertices, "z", angle) + offset, faces


def _joined(parts):
    """Several shapes as one."""
    first = np.cumsum([0, *(len(vertices) for vertices, _ in parts[:-1])])
    faces = [faces + start for (_, faces), start in zip(parts, first, strict=True)]
    return np.concatenate([vertices for vertices, _ in parts]), np.concatenate(faces)
