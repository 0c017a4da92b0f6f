"""`Tracer`: ray queries against a scene, by any of the methods."""

import copy
import dataclasses
import functools
import inspect
import weakref

import numpy as np
import pyopencl.array as cla

from raystream import device as devices
from raystream import intersect, rays
from raystream.brute import Brute
from raystream.checks import as_float_array, check_choice, check_count, check_rows
from raystream.crsh import CoherentTracer
from raystream.dual import DualTracer
from raystream.geometry import Geometry
from raystream.ldc import LayeredDepthCubeTracer
from raystream.packet import PacketTracer
from raystream.rsh import RayspaceTracer
from raystream.scene import as_scene
from raystream.statistics import Statistics, seconds_by_stage

_METHODS = {
    "brute": Brute,
    "rsh": RayspaceTracer,
    "crsh": CoherentTracer,
    "ldc": LayeredDepthCubeTracer,
    "packet": PacketTracer,
    "dual": DualTracer,
}
AUTO = "auto"
# Frames of 512 x 512 with two bounces and shadows take a third of the time of `crsh` (four
# scenes of 24,000 to 87,000 triangles). `packet` takes as long or less where nothing moves, but
# needs 56 ms to build its hierarchy over 69,451 triangles anew, `dual` 2 to 6.
_AUTO_METHOD = "dual"
_COMMON = ("self", "session", "geometry", "memory_limit")
# The default memory_limit: a part of the device's memory, and for streams of candidates, which
# are cut into batches, no more than needed to be fast.
_MEMORY_SHARE = 4
_STREAM_METHODS, _MOST_STREAM_MEMORY = ("rsh", "crsh"), 1 << 30


def methods():
    """The names that `Tracer` and `render` take as `method`, besides "auto"."""
    return list(_METHODS)


@dataclasses.dataclass
class Hits:
    """Closest hits, one per ray, in the order of the rays.

    Attributes
    ----------
    t : (n,) float32
        In units of the direction's length, inf where missed.
    prim_id, geom_id : (n,) int32
        Face within its mesh and mesh within the scene, -1 where missed. Where loading dropped
        invalid faces, `Mesh.face_ids` maps prim_id to the face of the file.
    u, v : (n,) float32
        The hit point is (1 - u - v) v0 + u v1 + v v2; 0 where missed.
    """

    t: np.ndarray
    prim_id: np.ndarray
    geom_id: np.ndarray
    u: np.ndarray
    v: np.ndarray


class Tracer:
    """Closest-hit and any-hit queries against a scene whose vertices may change every frame.

    Parameters
    ----------
    scene : raystream.Scene, trimesh.Trimesh or trimesh.Scene
        A mesh's faces and vertices are taken in the given order.
    method : str
        One of `methods`, or "auto": the fastest in most cases, `dual`.
    device : pyopencl.Device, optional
        Default: ``$PYOPENCL_CTX`` if set, else the first GPU, else the CPU.
    memory_limit : int, optional
        Bytes that the candidates of one call, or what a method builds of the scene, may take;
        default: a quarter of the device's memory; of candidates, at most 1 GiB.
    **options
        Of the method: see `raystream.rsh.RayspaceTracer`, `raystream.crsh.CoherentTracer`,
        `raystream.ldc.LayeredDepthCubeTracer`, `raystream.packet.PacketTracer`,
        `raystream.dual.DualTracer`.

    Attributes
    ----------
    statistics : raystream.statistics.Statistics
        Of the last call.

    Raises
    ------
    ValueError, TypeError
        An unknown method or option (with the list), a scene that cannot be traced.
    raystream.errors.DeviceError
        No usable OpenCL device.
    """

    def __init__(self, scene, method=AUTO, device=None, memory_limit=None, **options):
        check_choice("method", method, (*methods(), AUTO))
        method = _AUTO_METHOD if method == AUTO else method
        _check_options(method, options)
        if memory_limit is not None:
            check_count("memory_limit", memory_limit)
        self.scene = copy.copy(as_scene(scene))  # what is added to the scene later is not traced
        self.method = method
        self._statistics = Statistics(triangles=self.scene.num_triangles)
        self.device, self._memory_limit, self._options = device, memory_limit, options
        self._vertices, self._version = self.scene.vertices, 0
        self._used = np.zeros(len(self._vertices), bool)
        self._used[self.scene.faces] = True
        self._backend(devices.session(device))

    @property
    def statistics(self):
        if callable(self._statistics):  # nobody has asked for them yet
            self._statistics = self._statistics()
        return self._statistics

    def intersect(self, origins, directions, tnear=0.0, tfar=np.inf):
        """Closest hits.

        Parameters
        ----------
        origins, directions : array_like or pyopencl.array.Array of shape (n, 3)
            Directions of any length but zero.
        tnear, tfar : float or array of shape (n,)
            Hits with tnear <= t <= tfar count; a ray with tfar < tnear hits nothing.

        Returns
        -------
        Hits
            numpy arrays; device arrays where the origins are one.

        Raises
        ------
        ValueError, TypeError
            Names the argument and the first ray that is wrong.
        """
        on_device = isinstance(origins, cla.Array)
        session, stream = self._rays(on_device, origins, directions, tnear, tfar)
        hits = self.intersect_stream(session, stream)
        geom_id, prim_id = intersect.split_ids(session, hits, self.geometry(session))
        fields = (hits.t, prim_id, geom_id, hits.u, hits.v)
        hits = Hits(*(fields if on_device else session.download(*fields)))
        self._finish(session)
        return hits

    def occluded(self, origins, directions, tnear=0.0, tfar=np.inf):
        """Whether anything is hit between tnear and tfar; parameters as in `intersect`.

        Returns
        -------
        (n,) bool
            A uint8 device array where the origins are a device array.
        """
        on_device = isinstance(origins, cla.Array)
        session, stream = self._rays(on_device, origins, directions, tnear, tfar)
        blocked = self.occluded_stream(session, stream)
        if not on_device:
            (blocked,) = session.download(blocked)
            blocked = blocked.view(bool)
        self._finish(session)
        return blocked

    def update_vertices(self, vertices):
        """A new frame: the same faces with other vertices.

        Parameters
        ----------
        vertices : array_like of shape (n, 3)
            In the mesh's own order; for scenes the meshes' vertices one after another.

        Raises
        ------
        ValueError
            Another shape, or values that are not finite.
        """
        if isinstance(vertices, cla.Array):
            raise TypeError("vertices: need a numpy array, got one on the device")
        vertices = as_float_array("vertices", vertices, self._vertices.shape)
        if not np.isfinite(vertices).all():  # by rows it would take fifty times as long
            # Vertices that no face uses may hold anything, as in a mesh.
            finite = np.isfinite(vertices).all(axis=1) | ~self._used
            check_rows("vertices", "finite values", finite)
        self._vertices, self._version = vertices.copy(), self._version + 1

    def geometry(self, session):
        """The scene's `Geometry` on a session's device, with the vertices of the last update."""
        return self._backend(session).geometry

    def intersect_stream(self, session, stream):
        """Closest hits of a ray stream on the device, as a HitStream; sets `statistics`."""
        backend = self._backend(session)
        if len(stream) == 0 or self.scene.num_triangles == 0:
            self._statistics = Statistics(triangles=self.scene.num_triangles)
            keys = intersect.no_hits(session, len(stream))
            return intersect.resolve(session, keys, stream, backend.geometry.triangles)
        hits, self._statistics = backend.method.intersect(stream)
        return hits

    def occluded_stream(self, session, stream):
        """Any hit of a ray stream on the device, as a uint8 array; sets `statistics`."""
        backend = self._backend(session)
        if len(stream) == 0 or self.scene.num_triangles == 0:
            self._statistics = Statistics(triangles=self.scene.num_triangles)
            return intersect.not_blocked(session, len(stream))
        blocked, self._statistics = backend.method.occluded(stream)
        return blocked

    def _finish(self, session):
        """Wait for the launches of a call; its statistics are read where they are asked for."""
        session.queue.finish()
        events = session.clock.hand_over()
        self._statistics = functools.partial(_read_statistics, self._statistics, events)

    def _rays(self, on_device, origins, directions, tnear, tfar):
        """The session to work in and the packed rays; a caller's context is worked in directly."""
        arguments = {"origins": origins, "directions": directions, "tnear": tnear, "tfar": tfar}
        given = {name: a for name, a in arguments.items() if isinstance(a, cla.Array)}
        if given and not on_device:
            raise TypeError(f"{next(iter(given))}: need a numpy array like the origins")
        session = devices.session_of_arrays(given) if on_device else devices.session(self.device)
        session.clock.forget()
        make = rays.from_device if on_device else rays.from_numpy
        return session, make(session, **arguments)

    def _backend(self, session):
        # The session holds its backends, so those of an ended thread go with it.
        backends = session.cache.setdefault("backends", weakref.WeakKeyDictionary())
        backend = backends.get(self)
        if backend is None:
            geometry = Geometry(session, self.scene)
            limit = self._memory_limit or _default_limit(self.method, session.device)
            method = _METHODS[self.method](session, geometry, limit, **self._options)
            backend = backends[self] = _Backend(geometry, method, version=0)
        if backend.version != self._version:
            backend.geometry.update(self._vertices)
            backend.version = self._version
        return backend


def _read_statistics(counts, events):
    """The statistics of a call: counts as a method gave them, and the times of its events."""
    statistics = counts() if callable(counts) else counts
    statistics.stages = seconds_by_stage(events)
    return statistics


def _default_limit(method, device):
    share = device.global_mem_size // _MEMORY_SHARE
    return min(share, _MOST_STREAM_MEMORY) if method in _STREAM_METHODS else share


@dataclasses.dataclass
class _Backend:
    geometry: Geometry
    method: object
    version: int


def _check_options(method, options):
    known = [p for p in inspect.signature(_METHODS[method]).parameters if p not in _COMMON]
    for name in options:
        if name not in known:
            listed = ", ".join(known) if known else "none"
            raise ValueError(f"method {method!r} has no option {name!r}; its options: {listed}")
