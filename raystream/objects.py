"""Parts of a scene in bounding spheres: whole meshes, or clusters of triangles (cl/objects.cl)."""

import numpy as np

from raystream.checks import check_count
from raystream.sort import sort_by_key
from raystream.statistics import GEOMETRY

_BLOCK = 16  # triangles, objects or vertices to a vector, see cl/objects.cl
_BALL_ROWS = 20  # Balls in cl/objects.cl
_CHUNKS_PER_UNIT = 8
_RUN = 64  # groups of 16 vertices that one work-item measures
# The radius of every mesh of the test scenes is then within 1e-5 of the smallest (8: 5e-5, 6: 5 %),
# of random points within 0.3 %; the sum of clusters' squared radii within 2e-4 (5: 3e-3, 3: 9 %).
_PASSES, _CLUSTER_PASSES = 10, 6
_KEY_BITS = 32
# Larger triangles are clustered apart; in units of a cluster's usual size, that of `size` of all
# triangles on a square as wide as the scene. Of 1 to 8 the best for the sum of squared radii.
_OVERSIZE = 6.0
_INVALID = np.uint32(0xFFFFFFFF)


class Objects:
    """Parts of a scene: consecutive runs of an order of its triangles, each in a bounding sphere.

    Made by `meshes` or `clusters`.

    Attributes
    ----------
    num_objects : int
    ranges : Array of shape (num_objects + 1,) uint32
        Positions ranges[o] .. ranges[o + 1] - 1 of the order belong to object o.
    order : Array of shape (num_blocks * 16,) uint32
        Flat triangle at each position; padding is 0xffffffff.
    bound_rows : Array of shape (num_blocks, 12, 16) float32
        The triangles' bounds in that order, as `Geometry.bound_rows`; the geometry's own array
        where the order is the identity.
    object_rows : Array of shape (object_blocks, 4, 16) float32
        The objects' spheres as rows x, y, z and radius of 16; the radius is -inf in the padding and
        for objects without triangles.
    """

    def __init__(self, session, geometry, ranges):
        self.session, self.geometry = session, geometry
        self.num_objects = len(ranges) - 1
        self.ranges = session.upload(GEOMETRY, ranges.astype(np.uint32))
        self.object_rows = session.empty((_blocks(self.num_objects), 4, _BLOCK), np.float32)
        self._chunks = _CHUNKS_PER_UNIT * session.device.max_compute_units
        self._kernels = session.kernels("objects.cl", CHUNKS=self._chunks)

    @classmethod
    def meshes(cls, session, geometry):
        """One object per mesh, the triangles in the geometry's order (Reis et al. 2017)."""
        return _Meshes(session, geometry)

    @classmethod
    def clusters(cls, session, geometry, size):
        """Objects of `size` triangles that lie close together; the last may have fewer.

        Parameters
        ----------
        session : raystream.device.Session
        geometry : raystream.geometry.Geometry
        size : int
            A multiple of 16.

        Raises
        ------
        TypeError, ValueError
            Not such a size.
        """
        return _Clusters(session, geometry, size)

    def update(self):
        """The geometry has new vertices: take them, in the same arrays. Nothing is read back."""
        raise NotImplementedError

    def _launch(self, kernel, size, *args):
        self.session.launch(GEOMETRY, self._kernels[kernel], size, *args)


class _Meshes(Objects):
    """One object per mesh; its vertices are shared out in runs."""

    def __init__(self, session, geometry):
        firsts = geometry.first_prims.get()
        super().__init__(session, geometry, firsts)
        order = np.full(geometry.bounds.shape[0], _INVALID)
        order[: geometry.num_triangles] = np.arange(geometry.num_triangles)
        self.order = session.upload(GEOMETRY, order)
        corners, first_groups = _distinct_corners(geometry.faces.get(), firsts)
        first_runs, run_groups = _runs(first_groups)
        self._num_runs = len(run_groups) - 1
        run_objects = np.repeat(np.arange(self.num_objects), np.diff(first_runs))
        self._corners, self._first_runs, self._run_groups, self._run_objects = (
            session.upload(GEOMETRY, array.astype(np.uint32))
            for array in (corners, first_runs, run_groups, run_objects)
        )
        self._rows = session.empty((len(corners) // _BLOCK, 3, _BLOCK), np.float32)
        self._boxes = session.empty((self._num_runs, 2, 4), np.float32)
        self._farthest = session.empty((self._num_runs, 4), np.float32)
        self._balls = session.empty((_blocks(self.num_objects), _BALL_ROWS, _BLOCK), np.float32)
        self.update()

    @property
    def bound_rows(self):
        return self.geometry.bound_rows

    def update(self):
        rows, balls, farthest = self._rows, self._balls, self._farthest
        arrays = self._corners, self.geometry.triangles, rows, self._boxes
        self._launch_runs("gather_run", *arrays)
        self._launch_meshes("start_balls", self._boxes, balls)
        for _ in range(_PASSES):
            self._launch_runs("measure_run", self._run_objects, rows, balls, farthest)
            self._launch_meshes("move_balls", farthest, balls, self.object_rows)

    def _launch_runs(self, kernel, *args):
        count = np.uint32(self._num_runs)
        self._launch(kernel, self._num_runs, count, self._run_groups, *args)

    def _launch_meshes(self, kernel, *args):
        count = np.uint32(self.num_objects)
        self._launch(kernel, len(self._balls), count, self._first_runs, *args)


class _Clusters(Objects):
    """Runs of triangles sorted along a space-filling curve."""

    def __init__(self, session, geometry, size):
        check_count("size", size)
        if size % _BLOCK:
            raise ValueError(f"size: need a multiple of {_BLOCK}, got {size}")
        count, padded = geometry.num_triangles, geometry.bounds.shape[0]
        clusters = -(-count // size)
        super().__init__(session, geometry, np.minimum(np.arange(clusters + 1) * size, count))
        self.size = min(size, padded)  # no room for triangles that there are not
        self.order = session.empty(padded, np.uint32)
        self.bound_rows = session.empty(geometry.bound_rows.shape, np.float32)
        self._identity = session.upload(GEOMETRY, np.arange(padded, dtype=np.uint32))
        self._keys = session.empty(padded, np.uint32)
        self._boxes = session.empty((self._chunks, 2, 4), np.float32)
        self._scratch = session.empty((self._chunks, 9 * self.size, _BLOCK), np.float32)
        self.update()

    def update(self):
        if self.num_objects == 0:
            return
        self._sort()
        counts = self.geometry.num_triangles, self.num_objects, self.size, _CLUSTER_PASSES
        arrays = self.order, self.geometry.triangles, self._scratch, self.object_rows
        self._launch("enclose_clusters", self._chunks, *map(np.uint32, counts), *arrays)

    def _sort(self):
        triangles, bounds = np.uint32(self.geometry.num_triangles), self.geometry.bound_rows
        blocks = np.uint32(len(bounds))
        oversize = np.float32(_OVERSIZE * np.sqrt(self.size / triangles))
        self._launch("bound_centres", self._chunks, blocks, bounds, self._boxes)
        self._launch("make_keys", self._chunks, blocks, oversize, bounds, self._boxes, self._keys)
        _, order = sort_by_key(
            self.session, self._keys, self._identity, _KEY_BITS, keep_keys=False
        )
        arrays = order, self.geometry.bounds, self.order, self.bound_rows
        self._launch("arrange_bounds", self._chunks, blocks, triangles, *arrays)


def _blocks(count):
    return -(-count // _BLOCK)


def _distinct_corners(faces, first_prims):
    """Of every mesh one corner of a face for each of its vertices, padded to whole groups.

    Parameters
    ----------
    faces : (m, 3) uint32
    first_prims : (meshes + 1,) uint32

    Returns
    -------
    corners : (groups * 16,) uint32
        3 * face + corner; the last of each mesh fills its last group up.
    first_groups : (meshes + 1,) int64
        First group of each mesh.
    """
    flat = faces.ravel()
    first = np.full(int(flat.max(initial=0)) + 1, -1)
    first[flat[::-1]] = np.arange(len(flat))[::-1]  # the last one written stays
    # No two meshes share a vertex, so that in ascending order each mesh has a run of its own.
    distinct = np.sort(first[first >= 0])
    ends = np.searchsorted(distinct, 3 * first_prims.astype(np.int64))
    counts = np.diff(ends)
    groups = _blocks(counts)
    first_groups = _firsts(groups)
    mesh = np.repeat(np.arange(len(groups)), groups * _BLOCK)
    place = np.arange(len(mesh)) - _BLOCK * first_groups[mesh]
    return distinct[ends[mesh] + np.minimum(place, counts[mesh] - 1)], first_groups


def _runs(first_groups):
    """Cut every mesh's groups into runs.

    Returns
    -------
    first_runs : (meshes + 1,) int64
        First run of each mesh.
    run_groups : (runs + 1,) int64
        First group of each run.
    """
    runs = -(-np.diff(first_groups) // _RUN)
    first_runs = _firsts(runs)
    mesh = np.repeat(np.arange(len(runs)), runs)
    starts = first_groups[mesh] + _RUN * (np.arange(len(mesh)) - first_runs[mesh])
    return first_runs, np.append(starts, first_groups[-1])


def _firsts(counts):
    return np.concatenate([[0], np.cumsum(counts)])
