"""Traversal of a ray-space hierarchy, level by level (cl/traverse.cl)."""

import numpy as np

from raystream.pairs import CHUNKS, LOADED, PairStream, make_reduction
from raystream.statistics import TRAVERSAL

COUNTS = 3  # tests, hits, stream length of a level: cl/pairs.h


class Traversal:
    """Leads streams of (node, triangle) pairs from the top level of a hierarchy down.

    Parameters
    ----------
    session : raystream.device.Session
    geometry : raystream.geometry.Geometry
    hierarchy : raystream.hierarchy.RayHierarchy
    capacity : int
        Pairs that one stream can hold.
    test_rays : bool
        Whether the rays themselves (level 0) are tested against the triangles' spheres, as in the
        ray-space hierarchy's paper, or the pairs of level 1 are handed on.
    reduction : str
        One of `pairs.REDUCTIONS`.
    objects : raystream.objects.Objects, optional
        Parts of the scene whose bounding spheres the top level is tested against first.

    Attributes
    ----------
    counts : Array of shape (levels + 1, 3) uint64
        Per level, top first, and last the final tests: tests, hits, input stream length.
    object_tests : Array of shape (1,) uint64
        Tests of top-level nodes against the objects' spheres.
    """

    def __init__(
        self, session, geometry, hierarchy, capacity, test_rays, reduction, objects=None
    ):
        self.session, self.geometry, self.hierarchy = session, geometry, hierarchy
        self._objects = objects
        defines = {} if objects is None else {"OBJECTS": 1}
        if hierarchy.bound != "tight":
            defines["SPHERES_ALONE"] = 1
        self._kernels = session.kernels(
            "traverse.cl", ARITY=hierarchy.arity, CHUNKS=CHUNKS, **defines
        )
        self.reduction = make_reduction(session, hierarchy.arity, reduction, capacity)
        self._last = 0 if test_rays else 1
        self.levels = list(range(hierarchy.num_levels, self._last - 1, -1))
        self.counts = session.empty((len(self.levels) + 1, COUNTS), np.uint64)
        session.fill(TRAVERSAL, self.counts, 0)
        self.object_tests = session.empty(1, np.uint64)
        session.fill(TRAVERSAL, self.object_tests, 0)
        self._streams = [PairStream.empty(session, capacity) for _ in range(2)]
        self._masks = session.empty(capacity + LOADED, np.uint8)

    @property
    def rays_per_node(self):
        """Rays below a node of the last stream."""
        return self.hierarchy.arity**self._last

    def run(self, first, last):
        """The stream of (node, triangle) pairs that survive all levels.

        Of the triangles, or the objects' order of them, positions first .. last.
        """
        target = self._streams[0]
        self._top(first, last, target)
        for row in range(1, len(self.levels)):
            source, target = target, self._streams[row % 2]
            self._level(row, source, target)
        return target

    def _top(self, first, last, target):
        level, reduction, objects = self.levels[0], self.reduction, self._objects
        scene = self.geometry if objects is None else objects
        args = (
            np.uint32(self.hierarchy.num_nodes[level]),
            np.uint32(first),
            np.uint32(last),
            self.hierarchy.blocks[level],
            scene.bound_rows,
        )
        culling = () if objects is None else self._object_arguments()
        chunks = reduction.chunk_tests, reduction.chunk_hits
        self._launch("count_top", *args, *chunks, self.object_tests, *culling)
        tasks = self.hierarchy.num_nodes[level] * (last - first)
        reduction.scan(None, target, self.counts, 0, tasks)
        self._launch("write_top", *args, reduction.offsets, target.length, target.pairs, *culling)

    def _object_arguments(self):
        objects = self._objects
        number = np.uint32(objects.num_objects)
        return number, objects.object_rows, objects.ranges, objects.order

    def _level(self, row, source, target):
        level, reduction = self.levels[row], self.reduction
        self._launch(
            "test_children",
            source.length,
            source.pairs,
            self.hierarchy.blocks[level],
            self.hierarchy.valid[level + 1],
            self.geometry.bounds,
            self._masks,
            reduction.chunk_tests,
            reduction.chunk_hits,
        )
        reduction.scan(source, target, self.counts, row)
        reduction.scatter(source, self._masks, target)

    def _launch(self, kernel, *args):
        self.session.launch(TRAVERSAL, self._kernels[kernel], CHUNKS, *args)
