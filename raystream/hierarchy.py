"""The ray-space hierarchy: cone-spheres over a ray stream, built bottom-up (cl/hierarchy.cl)."""

import functools

import numpy as np

from raystream import device
from raystream.checks import check_choice, check_count
from raystream.rays import Rays, from_numpy
from raystream.statistics import HIERARCHY_CREATION

ARITIES = (4, 8)
NODE_ROWS = 10  # cl/node.h
_INVALID = np.uint32(0xFFFFFFFF)
_TILE = 8
_PER_ITEM = 16  # nodes that one work-item of cl/hierarchy.cl makes


def screen_slots(width, height):
    """The rays of a screen in the order of the hierarchy's leaves.

    Pixels follow the Z-order curve within tiles of 8 x 8, and the tiles that the screen has
    follow it, too: every 4^k consecutive leaves of a tile are a square, 8 leaves are 4 x 2. Where
    the side is a power of two this is the quad-tree of the paper; elsewhere only the tiles at the
    right and lower edge carry null leaves.

    Returns
    -------
    ndarray of shape (m,) uint32
        Ray (pixel) of each leaf, 0xffffffff for a null leaf.
    """
    return _screen_slots(width, height).copy()


@functools.lru_cache(maxsize=8)
def _screen_slots(width, height):
    columns, rows = -(-width // _TILE), -(-height // _TILE)
    tile_y, tile_x = np.divmod(np.arange(columns * rows, dtype=np.uint64), np.uint64(columns))
    order = np.argsort(_interleave(tile_x, tile_y), kind="stable")
    within = np.arange(_TILE * _TILE, dtype=np.uint64)
    x = tile_x[order, None] * _TILE + _deinterleave(within)
    y = tile_y[order, None] * _TILE + _deinterleave(within >> np.uint64(1))
    pixels = np.where((x < width) & (y < height), y * width + x, _INVALID)
    return pixels.ravel().astype(np.uint32)


def _interleave(x, y):
    """Bits of x at the even places, bits of y at the odd places."""
    return sum(
        ((x >> np.uint64(b) & np.uint64(1)) << np.uint64(2 * b))
        | ((y >> np.uint64(b) & np.uint64(1)) << np.uint64(2 * b + 1))
        for b in range(24)
    )


def _deinterleave(code):
    """The number made of the even bits of `code`."""
    return sum((code >> np.uint64(2 * b) & np.uint64(1)) << np.uint64(b) for b in range(3))


class RayHierarchy:
    """Cone-spheres over rays, level 0 the rays themselves; inspect with `level`.

    Attributes
    ----------
    arity : int
        Children per node.
    num_levels : int
        Levels above the rays.
    num_nodes : list of int
        Nodes per level, null nodes included; ``num_nodes[0]`` is the number of leaf slots.
    blocks : list of Array
        Per level the node blocks of cl/node.h.
    valid : list of Array
        ``valid[k]`` (k >= 1): children of each node of level k that are not null.
    slots : Array of shape (num_nodes[0],) uint32
        Ray of each leaf, 0xffffffff where there is none.
    """

    def __init__(self, session, rays, slots, arity, levels):
        self.session, self.arity, self.slots = session, arity, slots
        count = slots.shape[0]
        self.num_nodes = [count]
        while len(self.num_nodes) == 1 or count > 1:
            count = -(-count // arity)
            self.num_nodes.append(count)
            if len(self.num_nodes) - 1 == levels:
                break
        self.num_levels = len(self.num_nodes) - 1
        self.blocks = [self._empty_blocks(n) for n in self.num_nodes]
        self.valid = [None]
        self._build_leaves(rays)
        for level in range(1, self.num_levels + 1):
            self._build_level(level)

    @classmethod
    def build(cls, rays, arity=4, levels=None, order="screen"):
        """Build the hierarchy of a ray stream.

        Parameters
        ----------
        rays : raystream.rays.Rays or (origins, directions)
            Rays on the device, or arrays as for `Tracer.intersect`. With a `size` the leaves
            follow the screen (`screen_slots`), else the order of the rays.
        arity : {4, 8}
        levels : int, optional
            Levels above the rays; default: up to a single root.
        order : {"screen"}

        Raises
        ------
        ValueError
            An arity, level or order that there is not.
        """
        check_choice("arity", arity, ARITIES)
        check_choice("order", order, ("screen",))
        if levels is not None:
            check_count("levels", levels)
        if not isinstance(rays, Rays):
            origins, directions = rays
            rays = from_numpy(device.session(), origins, directions, 0.0, np.inf)
        session = device.session_of(rays.org_tnear)
        hierarchy = cls(session, rays, leaf_slots(session, rays), arity, levels)
        session.clock.forget()
        return hierarchy

    def level(self, k):
        """The nodes of level `k`, 0 the rays, in the order of the hierarchy.

        Returns
        -------
        spheres : (num_nodes, 4) float32
            Centre and radius of the sphere around the rays' origins.
        cones : (num_nodes, 4) float32
            Unit axis and half-angle in radians; pi stands for any direction, from pi / 2 up.
            Null nodes are NaN in both.
        """
        nodes = self.nodes(k)
        spheres, cones = nodes[:, :4].copy(), nodes[:, 4:8].copy()
        angle = np.arctan2(nodes[:, 8], nodes[:, 7])
        cones[:, 3] = np.where(nodes[:, 7] > 0, angle, np.pi)
        null = nodes[:, 9] < 0
        spheres[null] = cones[null] = np.nan
        return spheres, cones

    def nodes(self, k):
        """Level `k` as it is stored: (num_nodes, 10) float32, the columns the rows of cl/node.h."""
        blocks = self.blocks[k].get().reshape(-1, NODE_ROWS, self.arity)
        return blocks.transpose(0, 2, 1).reshape(-1, NODE_ROWS)[: self.num_nodes[k]]

    def count_nodes(self):
        """Nodes per level that are not null, the rays first: a list, read from the device."""
        valid = [v.get() for v in self.valid[1:]]
        return [int(valid[0].sum(dtype=np.uint64)), *(int(np.count_nonzero(v)) for v in valid)]

    def _padded(self, nodes):
        return -(-nodes // self.arity) * self.arity

    def _empty_blocks(self, nodes):
        return self.session.empty(self._padded(nodes) * NODE_ROWS, np.float32)

    def _launch(self, kernel, nodes, *args):
        kernels = self.session.kernels("hierarchy.cl", ARITY=self.arity)
        size = -(-nodes // _PER_ITEM)
        self.session.launch(HIERARCHY_CREATION, kernels[kernel], size, *args)

    def _build_leaves(self, rays):
        nodes = self._padded(self.num_nodes[0])
        self._launch(
            "build_leaves",
            nodes,
            np.uint32(nodes),
            np.uint32(self.slots.shape[0]),
            self.slots,
            rays.org_tnear,
            rays.dir_tfar,
            self.blocks[0],
        )

    def _build_level(self, level):
        nodes = self._padded(self.num_nodes[level])
        self.valid.append(self.session.empty(nodes, np.uint32))
        self._launch(
            "build_parents",
            nodes,
            np.uint32(self.num_nodes[level - 1]),
            np.uint32(nodes),
            self.blocks[level - 1],
            self.blocks[level],
            self.valid[level],
        )


def leaf_slots(session, rays):
    """The leaves' order on the device, kept by the session: uploaded once per size."""
    key = rays.size if rays.size is not None else len(rays)
    cache = session.cache.setdefault("leaf_slots", {})
    if key not in cache:
        host = (
            np.arange(len(rays), dtype=np.uint32)
            if rays.size is None
            else _screen_slots(*rays.size)
        )
        cache.clear()  # one order at a time: sizes change rarely
        cache[key] = session.upload(HIERARCHY_CREATION, host)
    return cache[key]
