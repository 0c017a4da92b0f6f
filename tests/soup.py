"""Random triangles and rays, for many tests."""

import numpy as np

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


def exact_tracer(scene, method):
    """A tracer whose hits are exact: `ldc` as published is not."""
    return rs.Tracer(scene, method, **({"exact": True} if method == "ldc" else {}))


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
