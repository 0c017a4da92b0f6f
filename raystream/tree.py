"""The scene hierarchy of `dual`, built on the device every frame (cl/tree.cl).

Its layout is in cl/tree.h.
"""

import numpy as np

from raystream.checks import check_choice
from raystream.errors import MemoryLimitError
from raystream.sah import SurfaceAreaBuilder
from raystream.sort import sort_by_key
from raystream.statistics import HIERARCHY_CREATION

BUILDERS = ("fast", "quality")
_WIDTH, _NODE_ROWS, _LEAF_ROWS = 8, 8, 10  # cl/tree.h
_NODE_BYTES, _LEAF_BYTES = 4 * _NODE_ROWS * _WIDTH, 4 * _LEAF_ROWS * _WIDTH
# Bits of a place along an axis, and of a pass of the sort. 256 cells an axis are 65,000 of a
# surface: where there are many more triangles leaves grow, by 6 % with 871,414. Two passes of 12
# bits take 0.85 of the time of three of 10 with 331,179 triangles.
_MANY_TRIANGLES = 400_000
_BITS, _BITS_OF_MANY = (8, 12), (10, 10)
_BLOCK = 16
_CHUNKS_PER_UNIT = 8


class SceneTree:
    """An eight-ary tree of boxes around the triangles of a geometry.

    Parameters
    ----------
    session : raystream.device.Session
    geometry : raystream.geometry.Geometry
    builder : {"fast", "quality"}
        "fast": leaves are runs of eight triangles along a Hilbert curve. "quality": splits by the
        surface area heuristic; takes about five times as long, and rays visit half the nodes.
    memory_limit : int, optional
        Bytes that the tree and what it is built in may take.

    Attributes
    ----------
    nodes : Array of shape (num_nodes, 8, 8) float32
        Rows of eight lanes, a child each: low x, y, z, high x, y, z, the child's number (uint32).
        Node 0 is the root; what no node names as a child means nothing.
    leaves : Array of shape (num_leaves, 10, 8) float32
        Rows of eight lanes, a triangle each: three vertices, the flat triangle's number (uint32).
    structure_bytes : int
        Of the tree and of what it is built in, without what the sort takes.

    Raises
    ------
    ValueError
        No such builder.
    raystream.errors.MemoryLimitError
        The tree needs more than `memory_limit`.
    """

    def __init__(self, session, geometry, builder="fast", memory_limit=None):
        check_choice("builder", builder, BUILDERS)
        self.session, self.geometry = session, geometry
        count = geometry.num_triangles
        builders = {"fast": _RunBuilder, "quality": SurfaceAreaBuilder}
        self._builder = builders[builder](session, geometry)
        num_nodes, num_leaves = self._builder.num_nodes, self._builder.num_leaves
        self.structure_bytes = (
            num_nodes * _NODE_BYTES + num_leaves * _LEAF_BYTES + self._builder.nbytes
        )
        if memory_limit is not None and self.structure_bytes > memory_limit:
            raise MemoryLimitError(
                f"scene hierarchy: {count} triangles need {self.structure_bytes} bytes "
                f"of memory_limit {memory_limit}"
            )
        self._builder.allocate()
        self.nodes = session.empty((num_nodes, _NODE_ROWS, _WIDTH), np.float32)
        self.leaves = session.empty((num_leaves, _LEAF_ROWS, _WIDTH), np.float32)

    def build(self):
        """Build the tree of the geometry's vertices as they are now, in the same arrays."""
        self._builder.build(self.nodes, self.leaves)

    def refit(self):
        """Fit a tree of builder "quality", built before, to the vertices as they are now.

        Returns
        -------
        float
            Times as many nodes and leaves as when it was built a line through the scene meets.
        """
        return self._builder.refit(self.nodes, self.leaves)


class _RunBuilder:
    """Runs of eight triangles are leaves, runs of eight leaves nodes, and so on.

    Attributes as those of `SurfaceAreaBuilder`.
    """

    def __init__(self, session, geometry):
        self.session, self._geometry = session, geometry
        count = geometry.num_triangles
        self.num_leaves = -(-count // _WIDTH)
        self._levels = _levels(self.num_leaves)
        self.num_nodes = sum(self._levels)
        self._cell_bits, self._digit_bits = _BITS_OF_MANY if count > _MANY_TRIANGLES else _BITS
        self._chunks = _CHUNKS_PER_UNIT * session.device.max_compute_units
        self._kernels = session.kernels(
            "tree.cl", CHUNKS=self._chunks, CELL_BITS=self._cell_bits
        )
        self._padded = -(-count // _BLOCK) * _BLOCK
        self.nbytes = 2 * np.dtype(np.uint32).itemsize * self._padded

    def allocate(self):
        """As that of `SurfaceAreaBuilder`."""
        identity = np.arange(self._padded, dtype=np.uint32)
        keys = self.session.empty(self._padded, np.uint32)
        self._pairs = keys, self.session.upload(HIERARCHY_CREATION, identity)

    def build(self, nodes, leaves):
        """As that of `SurfaceAreaBuilder`."""
        count, triangles = np.uint32(self._geometry.num_triangles), self._geometry.triangles
        firsts = np.cumsum([0, *self._levels])
        sizes = map(np.uint32, (self._levels[-1], firsts[-2]))
        self._launch("make_leaves", count, *sizes, self._sorted(), triangles, leaves, nodes)
        for level in reversed(range(len(self._levels) - 1)):
            above = self._levels[level], firsts[level]
            below = self._levels[level + 1], firsts[level + 1]
            self._launch("make_nodes", *map(np.uint32, above + below), nodes)

    def _sorted(self):
        """The triangles in the order of the curve."""
        if self._padded == 0:
            return self._pairs[1]
        geometry, middles = self._geometry, self._geometry.middles
        count, boxes = map(np.uint32, (geometry.num_triangles, middles.shape[0]))
        self._launch("place_triangles", count, geometry.triangles, boxes, middles, self._pairs[0])
        with self.session.clock.under(HIERARCHY_CREATION):
            options = {"digit_bits": self._digit_bits, "keep_keys": False}
            return sort_by_key(self.session, *self._pairs, 3 * self._cell_bits, **options)[1]

    def _launch(self, kernel, *args):
        """Run a kernel, a work-item for each chunk."""
        self.session.launch(HIERARCHY_CREATION, self._kernels[kernel], self._chunks, *args)


def _levels(num_leaves):
    """Nodes of each level, the root's first."""
    levels = [max(1, -(-num_leaves // _WIDTH))]
    while levels[0] > 1:
        levels.insert(0, -(-levels[0] // _WIDTH))
    return levels
