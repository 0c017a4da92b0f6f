"""What `ldc` costs: the paper's table, growth with triangles, Embree's build, the coarse level."""

import csv
import dataclasses
import pathlib
import statistics
import time

import numpy as np
import raystream.data
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene

import raystream as rs
from raystream import device
from raystream.cube import LayeredDepthCube
from raystream.geometry import Geometry
from raystream.rays import from_numpy
from raystream.statistics import TRAVERSAL

RESOLUTIONS = (512, 1024)
VIEWPORT = (1280, 1024)  # of the paper
ROUNDS = 9
GROWTH_RAYS = 1 << 18


def seconds(run):
    """Wall time of a call."""
    start = time.perf_counter()
    run()
    return time.perf_counter() - start


def in_turn(*runs, rounds=ROUNDS):
    """Seconds of every run, (rounds,) each: in every round one after the other; all warmed up."""
    for run in runs:
        run()
    times = [[seconds(run) for run in runs] for _ in range(rounds)]
    return [np.array(column) for column in zip(*times, strict=True)]


class Builder:
    """Builds the cube of a scene from its vertices, again and again.

    Parameters
    ----------
    scene : raystream.Scene
    **options
        Of `LayeredDepthCube`.
    """

    def __init__(self, scene, **options):
        self.session = device.session()
        self.geometry = Geometry(self.session, scene)
        self._vertices, self._options, self.cube = scene.vertices, options, None

    def upload(self):
        """A new frame's vertices onto the device, and what is derived of them there."""
        self.geometry.update(self._vertices)
        self.session.finish()

    def build(self):
        """The cube, of triangles that are on the device."""
        self.cube = LayeredDepthCube(self.session, self.geometry, **self._options)
        self.session.finish()


# ---- table 1 ----


@dataclasses.dataclass
class TableRow:
    """One scene in one resolution, times in seconds; `layers`: (3,) int."""

    triangles: int
    layers: np.ndarray
    samples: int
    construction: float
    tracing: float
    traversal: float
    rays: int


def table_row(scene, resolution):
    """Column A: construction. Column B: a frame in the paper's viewport, the cube being there."""
    builder = Builder(scene, resolution=resolution)
    (construction,) = in_turn(builder.build)
    renderer = rs.Renderer(scene, "ldc", resolution=resolution)
    frames = []
    (tracing,) = in_turn(lambda: frames.append(renderer.render(size=VIEWPORT)), rounds=3)
    counts = frames[-1].statistics
    traversal = statistics.median(f.statistics.stages[TRAVERSAL]["device"] for f in frames[1:])
    return TableRow(
        scene.num_triangles, builder.cube.layers, builder.cube.num_samples,
        float(np.median(construction)), float(np.median(tracing)), traversal, counts.rays,
    )  # fmt: skip


def published():
    """Rows of the paper's table by (scene, resolution)."""
    path = pathlib.Path(raystream.data.__file__).parent / "ldc07.csv"
    with open(path, newline="") as file:
        return {(row["scene"], int(row["resolution"])): row for row in csv.DictReader(file)}


# ---- growth with triangles ----


@dataclasses.dataclass
class Growth:
    """Seconds by resolution for one mesh: of construction, and of each ray."""

    triangles: int
    construction: dict
    tracing: dict


def growth(scene):
    """Of all versions of a model alike: the rays go from a sphere around its box into the box."""
    construction, tracing = {}, {}
    rays = rays_into(scene, np.random.default_rng(7), GROWTH_RAYS)
    for resolution in RESOLUTIONS:
        builder = Builder(scene, resolution=resolution)
        (times,) = in_turn(builder.build)
        construction[resolution] = float(np.median(times))
        tracing[resolution] = traversal_seconds(scene, rays, resolution=resolution) / GROWTH_RAYS
    return Growth(scene.num_triangles, construction, tracing)


def rays_into(scene, rng, count, distance=1.0):
    """Rays from `distance` diagonals around the middle of the box to points within it."""
    low, high = scene.bounds
    away = rng.normal(size=(count, 3))
    away *= distance * scene.diagonal / np.linalg.norm(away, axis=1, keepdims=True)
    origins = (low + high) / 2 + away
    return origins, low + (high - low) * rng.random((count, 3)) - origins


def traversal_seconds(scene, rays, rounds=3, **options):
    """Median device time of the closest hits of some rays."""
    session = device.session()
    stream = from_numpy(session, *rays, 0.0, np.inf)
    tracer, times = rs.Tracer(scene, "ldc", **options), []
    for _ in range(rounds + 1):
        session.finish()
        tracer.intersect_stream(session, stream)
        times.append(session.finish()[TRAVERSAL]["device"])
    return statistics.median(times[1:])


# ---- Embree's build ----


def embree_build(scene):
    """Embree's tree of the same triangles: made by the first ray, in all its threads."""
    embree = EmbreeScene()
    TriangleMesh(embree, scene.vertices, scene.faces)
    embree.run(np.zeros((1, 3), np.float32), np.ones((1, 3), np.float32), output=1)


# ---- the coarse level ----


def frame_traversals(scene, camera, size, rounds=3, **options):
    """Device seconds in traversal of a frame's rays with the coarse level and without, in turn."""
    renderers = [rs.Renderer(scene, "ldc", **options, **block) for block in ({}, {"block": None})]
    for renderer in renderers:
        renderer.render(camera, size)
    return np.array([
        [
            renderer.render(camera, size).statistics.stages[TRAVERSAL]["device"]
            for renderer in renderers
        ]
        for _ in range(rounds)
    ])  # fmt: skip
