"""Random triangles and rays, for many tests."""

import numpy as np
from hypothesis import strategies as st

import raystream as rs
from raystream import device, rays

FIELDS = ("t", "prim_id", "geom_id", "u", "v")


def triangle_soup(rng, count, size=0.2):
    """A scene of `count` random triangles in the unit cube, in two meshes."""
    corners = rng.random((count, 1, 3)) + size * (rng.random((count, 3, 3)) - 0.5)
    halves = np.array_split(corners.astype(np.float32), 2)
    return rs.Scene([mesh_of(f"soup-{k}", half) for k, half in enumerate(halves)])


def mesh_of(name, corners):
    """A mesh of unconnected triangles, (m, 3, 3)."""
    vertices = corners.reshape(-1, 3)
    faces = np.arange(len(vertices), dtype=np.int32).reshape(-1, 3)
    return rs.Mesh(vertices, faces, name=name)


def box():
    """A closed unit cube of twelve triangles."""
    corners = np.stack(np.meshgrid([0, 1], [0, 1], [0, 1], indexing="ij"), -1).reshape(-1, 3)
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    faces = [t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))]
    return rs.Scene([rs.Mesh(corners.astype(np.float32), np.array(faces, np.int32), name="box")])


def random_rays(rng, count, spread=1.0):
    """Rays that start in a cube around the unit cube, directions of any length."""
    origins = (rng.random((count, 3)) * (1 + 2 * spread) - spread).astype(np.float32)
    directions = rng.normal(size=(count, 3)) * 10.0 ** rng.uniform(-3, 3, (count, 1))
    return origins, directions.astype(np.float32)


@st.composite
def awkward_queries(draw):
    """Scenes of 97 degenerate, huge, tiny or far triangles, and 160 rays at their rims.

    Draws a scene, and origins, directions, tnear and tfar.
    """
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    size = draw(st.sampled_from([1e-4, 0.05, 1.0, 30.0]))
    shape = draw(st.sampled_from(["any", "flat", "sliver", "point", "line"]))
    places = [(1.0, 0.0), (1e-3, 0.0), (1e3, 0.0), (1.0, 100.0), (1e-3, 100.0)]
    scale, offset = draw(st.sampled_from(places))
    away = draw(st.sampled_from([0.0, 1.0, 30.0, 3e3, 1e5, 1e7]))
    corners = (scale * _awkward_corners(rng, size, shape) + offset).astype(np.float32)
    scene = rs.Scene([mesh_of("a", corners[:40]), mesh_of("b", corners[40:])])
    return scene, _rays_at_rims(rng, corners, scale, offset, away)


def _awkward_corners(rng, size, shape):
    corners = rng.random((97, 1, 3)) + size * (rng.random((97, 3, 3)) - 0.5)
    if shape == "flat":  # parallel to the axes, on lines of a grid and in front of each other
        corners = np.round(8 * corners) / 8
        corners[np.arange(97), :, rng.integers(0, 3, 97)] = rng.integers(0, 3, (97, 1)) / 2
    elif shape == "sliver":
        corners[:, 2] = corners[:, 0] + 1e-4 * rng.normal(size=(97, 3)) * size
    elif shape == "point":
        corners[::2] = corners[::2, :1]
    elif shape == "line":
        corners[::2, 2] = (corners[::2, 0] + corners[::2, 1]) / 2
    return corners


def _rays_at_rims(rng, corners, scale, offset, away):
    """At vertices, points of edges and of triangles, some of them along axes."""
    weights = rng.dirichlet([0.5, 0.5, 0.5], 160)
    weights[::3] = np.eye(3)[rng.integers(0, 3, len(weights[::3]))]  # at vertices
    weights[1::3, 0] = 0  # about edges
    aim = np.einsum("ij,ijk->ik", weights, corners[rng.integers(0, 97, 160)].astype(np.float64))
    origins = 0.5 + (0.3 + away) * rng.normal(size=(160, 3))
    origins = (scale * origins + offset).astype(np.float32)
    directions = (aim - origins).astype(np.float32)
    straight = rng.random(160) < 0.4  # along an axis, or in a plane of two
    along = np.eye(3)[rng.integers(0, 3, 160)] * rng.choice([-1, 1], (160, 1))
    along[::5] += np.roll(along[::5], 1, axis=1)
    origins[straight] = aim[straight]
    origins -= np.where(straight[:, None], along * away * scale, 0).astype(np.float32)
    directions = np.where(straight[:, None], along, directions)
    directions[~directions.any(axis=1)] = 1
    directions = (directions * 10.0 ** rng.uniform(-3, 3, (160, 1))).astype(np.float32)
    tnear = np.where(rng.random(160) < 0.7, 0, rng.random(160)).astype(np.float32)
    tfar = np.where(rng.random(160) < 0.5, np.inf, 2 * rng.random(160)).astype(np.float32)
    return origins, directions, tnear, tfar


def exact_tracer(scene, method):
    """A tracer whose hits are exact: `ldc` as published is not."""
    return rs.Tracer(scene, method, **({"exact": True} if method == "ldc" else {}))


def tripled(scene):
    """Every triangle three times, in another order of meshes: all distances are equal ones."""
    return rs.Scene([*scene.meshes, *scene.meshes[::-1], *scene.meshes])


def rays_from_afar(rng, scene, count=200):
    """At vertices, from up to 1e9 away; directions of a length from 1e-20 to 1e17."""
    aim = scene.vertices[rng.integers(0, len(scene.vertices), count)]
    away = rng.normal(size=(count, 3)) * 10.0 ** rng.uniform(-2, 9, (count, 1))
    return aim + away, -away * 10.0 ** rng.uniform(-20, 8, (count, 1))


def grid_of_rays(width, height):
    """Camera rays of a screen that looks at the unit cube, on the device."""
    camera = rs.Camera.look_at((0.5, 0.5, 3.0), (0.5, 0.5, 0.5), fov_y=30.0)
    return rays.from_camera(device.session(), camera, (width, height))


def assert_same_hits(ours, reference):
    """Every field of the hits is equal, bit for bit."""
    for field in FIELDS:
        np.testing.assert_array_equal(getattr(ours, field), getattr(reference, field), field)


def assert_nothing_lost(scene, method, origins, directions, tfar=np.inf, **options):
    """`method` finds every (ray, triangle) hit that brute force finds: the counts are equal."""
    tracer, brute = rs.Tracer(scene, method, **options), rs.Tracer(scene, "brute")
    arguments = (origins, directions, 0.0, tfar)
    assert_same_hits(tracer.intersect(*arguments), brute.intersect(*arguments))
    assert tracer.statistics.final_hits == brute.statistics.final_hits
    blocked = brute.occluded(*arguments)
    np.testing.assert_array_equal(tracer.occluded(*arguments), blocked)
    return tracer.statistics
