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
# What a ray of `ldc` hits: samples as published, samples as planes (the default), triangles.
PUBLISHED, PLANES, EXACT = "as published", "planes", "exact"
MODES = {PUBLISHED: {"tolerance": 0.001}, PLANES: {}, EXACT: {"exact": True}}
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
        self.cube = None  # its memory is used again, as between frames
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
    traversal_published: float
    rays: int


def table_row(scene, resolution):
    """Column A: construction. Column B: a frame in the paper's viewport, the cube being there.

    By planes, and the time in traversal as published, too, in turn.
    """
    builder = Builder(scene, resolution=resolution)
    (construction,) = in_turn(builder.build)
    planes, as_published = (Frames(scene, resolution, mode) for mode in (PLANES, PUBLISHED))
    tracing, _ = in_turn(planes.render, as_published.render, rounds=3)
    return TableRow(
        scene.num_triangles, builder.cube.layers, builder.cube.num_samples,
        float(np.median(construction)), float(np.median(tracing)), planes.traversal,
        as_published.traversal, planes.statistics[-1].rays,
    )  # fmt: skip


class Frames:
    """Renders a frame in the paper's viewport, again and again."""

    def __init__(self, scene, resolution, mode):
        self._renderer = rs.Renderer(scene, "ldc", resolution=resolution, **MODES[mode])
        self.statistics = []

    def render(self):
        """A frame, of which the statistics are kept."""
        self.statistics.append(self._renderer.render(size=VIEWPORT).statistics)

    @property
    def traversal(self):
        """Median device seconds in traversal of all frames but the first."""
        return statistics.median(s.stages[TRAVERSAL]["device"] for s in self.statistics[1:])


def published():
    """Rows of the paper's table by (scene, resolution)."""
    path = pathlib.Path(raystream.data.__file__).parent / "ldc07.csv"
    with open(path, newline="") as file:
        return {(row["scene"], int(row["resolution"])): row for row in csv.DictReader(file)}


# ---- growth with triangles ----


def growth(scenes, resolution):
    """Median seconds of construction, and of each ray, for versions of a model, in turn.

    The rays go from a sphere around a version's box into the box.
    """
    construction = in_turn(*(Builder(scene, resolution=resolution).build for scene in scenes))
    tracing = in_turn(*(tracing_of(scene, resolution) for scene in scenes))
    return [np.median(t) for t in construction], [np.median(t) / GROWTH_RAYS for t in tracing]


def rays_into(scene, rng, count, distance=1.0):
    """Rays from `distance` diagonals around the middle of the box to points within it."""
    low, high = scene.bounds
    away = rng.normal(size=(count, 3))
    away *= distance * scene.diagonal / np.linalg.norm(away, axis=1, keepdims=True)
    origins = (low + high) / 2 + away
    return origins, low + (high - low) * rng.random((count, 3)) - origins


def tracing_of(scene, resolution):
    """A call that traces `GROWTH_RAYS` rays through the scene's cube, which stays."""
    session, rng = device.session(), np.random.default_rng(7)
    stream = from_numpy(session, *rays_into(scene, rng, GROWTH_RAYS), 0.0, np.inf)
    tracer = rs.Tracer(scene, "ldc", resolution=resolution)

    def trace():
        tracer.intersect_stream(session, stream)
        session.finish()

    return trace


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
