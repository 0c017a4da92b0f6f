"""The better builder of the scene hierarchy: splits by surface area, top down (cl/sah.cl)."""

import numpy as np

from raystream.statistics import HIERARCHY_CREATION

_WIDTH = 8  # children of a node, triangles of a leaf: cl/tree.h
# A task should be small enough to stay in a core's cache, and there must be enough of them to share
# out evenly; the bound of 513 tasks (cl/sah.cl) follows from the second.
_TASK_SHARE, _LEAST_TASK = 64, 512
_CHUNKS_PER_UNIT = 8
_WORKERS_PER_UNIT = 4


class SurfaceAreaBuilder:
    """Builds trees over as many triangles as a geometry has.

    Parameters
    ----------
    session : raystream.device.Session
    num_triangles : int
    cell_bits : int
        Of a place along an axis, in the keys.

    Attributes
    ----------
    num_nodes, num_leaves : int
        The most that a tree may need.
    nbytes : int
        Of the arrays that it works in.
    """

    def __init__(self, session, num_triangles, cell_bits):
        self.session, self._count = session, num_triangles
        self._target = max(num_triangles // _TASK_SHARE, _LEAST_TASK)
        tasks = 2 * (num_triangles // (self._target // 4)) + 1
        self._first_node = _nodes_over(tasks)  # behind those above the tasks
        self.num_leaves = -(-num_triangles // _WIDTH) + tasks
        self.num_nodes = self._first_node + _nodes_over(self.num_leaves) + tasks
        self._shapes = {
            "things": ((num_triangles, _WIDTH), np.float32),
            "scratch": ((num_triangles, _WIDTH), np.float32),
            "order": ((self.num_leaves + 1) // 2 * 2 * _WIDTH, np.uint32),
            "roots": ((tasks, _WIDTH), np.float32),
            "top_scratch": ((tasks, _WIDTH), np.float32),
            "tasks": ((tasks + 1, 3), np.uint32),
            "all": (3, np.uint32),
        }
        self.nbytes = sum(
            int(np.prod(shape)) * np.dtype(dtype).itemsize for shape, dtype in self._shapes.values()
        )
        self._arrays = None
        units = session.device.max_compute_units
        self._chunks, self._workers = _CHUNKS_PER_UNIT * units, _WORKERS_PER_UNIT * units
        self._kernels = session.kernels("sah.cl", CHUNKS=self._chunks, CELL_BITS=cell_bits)

    def build(self, triangles, keys, order, nodes, leaves):
        """Fill `nodes` and `leaves`.

        Parameters
        ----------
        triangles : Array
            Of the geometry.
        keys : Array of shape (n,) uint32
            Places along a Hilbert curve of `cell_bits` an axis, ascending.
        order : Array of shape (n,) uint32
            The triangles at these places.
        nodes, leaves : Array
            As those of `SceneTree`, of `num_nodes` and `num_leaves`.
        """
        if self._arrays is None:
            self._arrays = {k: self.session.empty(*of) for k, of in self._shapes.items()}
        a = self._arrays
        sizes = map(np.uint32, (self._count, self._target, self._first_node))
        self._launch("cut_tasks", 1, *sizes, keys, a["tasks"], a["all"])
        self._launch(
            "build_tasks", self._workers, order, triangles, a["tasks"], a["all"], a["things"],
            a["scratch"], a["order"], nodes, a["roots"],
        )  # fmt: skip
        self._launch("build_top", 1, a["all"], a["roots"], a["top_scratch"], nodes)
        self._launch("fill_leaves", self._chunks, a["all"], a["order"], triangles, leaves)

    def _launch(self, kernel, size, *args):
        self.session.launch(HIERARCHY_CREATION, self._kernels[kernel], size, *args)


def _nodes_over(leaves):
    """The most nodes over so many leaves: cl/sah.cl."""
    return 4 * leaves // 7 + 1
