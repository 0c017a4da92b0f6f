"""A bounding volume hierarchy with binned SAH splits, built on the device (cl/bvh.cl)."""

import numpy as np

from raystream.errors import DeviceError, MemoryLimitError
from raystream.statistics import HIERARCHY_CREATION

_NUM_BINS = 16
LEAF_SIZE = 8  # leaves hold at most this many triangles; fewer where the SAH says so
_BUILDERS = 64  # work-items that split the nodes of a level
_LOCAL = 64
# Of a triangle, while the tree is built: two nodes, their spans, number and scratch, box, corners.
_BYTES = 2 * 32 + 2 * 16 + 2 * 4 + 32 + 48


class Bvh:
    """The tree over the triangles of a `Geometry` as they are now.

    Parameters
    ----------
    session : raystream.device.Session
    geometry : raystream.geometry.Geometry
        With at least one triangle.
    memory_limit : int
        Bytes that the tree may take while it is built.

    Attributes
    ----------
    nodes : Array of shape (2 m, 8) float32
        Level by level, the root first; low and high as float4, whose fourth components are
        integers: see cl/bvh.h. Only the first `num_nodes` are used.
    num_nodes, num_levels : int
    order : Array of shape (m,) uint32
        The triangles, those of a leaf side by side.
    triangles : Array of shape (m, 12) float32
        The triangles in that order, v0, v1, v2 as float4; the number in the w of v0, as an integer.
    nbytes : int

    Raises
    ------
    raystream.errors.MemoryLimitError
        The tree needs more than `memory_limit`.
    raystream.errors.DeviceError
        The device has no double precision, in which splits are priced.
    """

    def __init__(self, session, geometry, memory_limit):
        if "cl_khr_fp64" not in session.device.extensions:
            raise DeviceError(f"{session.device.name}: need double precision (cl_khr_fp64)")
        self.session, count = session, geometry.num_triangles
        if _BYTES * count > memory_limit:
            raise MemoryLimitError(
                f"hierarchy of {count} triangles: need {_BYTES * count} bytes, "
                f"memory_limit is {memory_limit}"
            )
        self._kernels = session.kernels("bvh.cl", NUM_BINS=_NUM_BINS, LEAF_SIZE=LEAF_SIZE)
        self.nodes = session.empty((2 * count, 8), np.float32)
        self.order = session.empty(count, np.uint32)
        self.triangles = session.empty((count, 12), np.float32)
        self.nbytes = self.nodes.nbytes + self.order.nbytes + self.triangles.nbytes
        boxes = session.empty((2 * count, 4), np.float32)
        number = np.uint32(count)
        self._launch("bound_triangles", count, number, geometry.triangles, boxes, self.order)
        self.num_levels, self.num_nodes = self._split(count, boxes)
        self._launch(
            "order_triangles", count, number, self.order, geometry.triangles, self.triangles
        )

    def _split(self, count, boxes):
        """Split level by level; returns the numbers of levels and nodes."""
        spans = self.session.empty((2 * count, 4), np.uint32)
        scratch = self.session.empty(count, np.uint32)
        level = self.session.upload(HIERARCHY_CREATION, np.array([0, 1], np.uint32))
        self.session.upload(HIERARCHY_CREATION, np.array([0, count, 0, 0], np.uint32), spans)
        num_levels, begin, end = 0, 0, 1
        while begin < end:  # the depth is known only when a level has no nodes
            stage, splitters = HIERARCHY_CREATION, self._kernels["split_nodes"]
            self.session.launch(
                stage, splitters, _BUILDERS, level, boxes, self.order, scratch, spans, self.nodes
            )
            self.session.launch(
                stage, self._kernels["number_children"], 1, level, spans, self.nodes
            )
            begin, end = (int(x) for x in level.get())
            num_levels += 1
        return num_levels, end

    def _launch(self, name, size, *arguments):
        self.session.launch(HIERARCHY_CREATION, self._kernels[name], size, *arguments, local=_LOCAL)
