"""The ray-space hierarchy: cone-spheres over a ray stream, built bottom-up (cl/hierarchy.cl)."""

import numpy as np

from raystream import device
from raystream.checks import check_choice, check_count
from raystream.hash import DEFAULT_HASH
from raystream.order import hashed_slots, leaf_slots
from raystream.rays import Rays, from_numpy
from raystream.statistics import HIERARCHY_CREATION

ARITIES = (4, 8)
BOUNDS = ("tight", "sphere", "paper")
NODE_ROWS = 20  # cl/node.h
_PER_ITEM = 16  # nodes that one work-item of cl/hierarchy.cl makes


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
        Per level the node blocks of cl/node.h; ``blocks[0]`` is None where no leaves were wanted.
    valid : list of Array
        ``valid[k]`` (k >= 1): children of each node of level k that are not null.
    slots : Array of shape (num_nodes[0],) uint32
        Ray of each leaf, 0xffffffff where there is none.
    """

    def __init__(self, session, rays, slots, arity, levels, bound="tight", leaves=True):
        self.session, self.arity, self.slots = session, arity, slots
        self.bound = bound
        defines = {"PAPER_BOUNDS": 1} if bound == "paper" else {}
        self._kernels = session.kernels("hierarchy.cl", ARITY=arity, **defines)
        count = above = slots.shape[0]
        self.num_nodes = [count]
        while len(self.num_nodes) == 1 or above > 1:
            above = -(-above // arity)
            self.num_nodes.append(above)
            if len(self.num_nodes) - 1 == levels:
                break
        self.num_levels = len(self.num_nodes) - 1
        self.blocks = [None, *(self._empty_blocks(n) for n in self.num_nodes[1:])]
        self.valid = [None]
        if leaves:
            self.blocks[0] = self._empty_blocks(count)
            self._build_leaves(rays)
        self._build_level(1, "build_parents_of_rays", slots, rays.org_tnear, rays.dir_tfar)
        for level in range(2, self.num_levels + 1):
            self._build_level(level, "build_parents", self.blocks[level - 1])

    @classmethod
    def build(cls, rays, arity=4, levels=None, order="screen", bound="tight"):
        """Build the hierarchy of a ray stream.

        Parameters
        ----------
        rays : raystream.rays.Rays or (origins, directions)
            Rays on the device, or arrays as for `Tracer.intersect`.
        arity : {4, 8}
        levels : int, optional
            Levels above the rays; default: up to a single root.
        order : {"screen", "hash"}
            The leaves follow the screen (`order.screen_slots`), or the order of the rays where
            these have no `size`; or they are sorted by their hash, as `crsh` does by default.
        bound : {"tight", "sphere", "paper"}
            How nodes are united: see cl/hierarchy.cl and cl/paper_bounds.h. A traversal tests
            "tight" nodes against slabs and boxes, too (cl/node.h).

        Raises
        ------
        ValueError
            An arity, level, order or bound that there is not.
        """
        check_choice("arity", arity, ARITIES)
        check_choice("order", order, ("screen", "hash"))
        check_choice("bound", bound, BOUNDS)
        if levels is not None:
            check_count("levels", levels)
        if not isinstance(rays, Rays):
            origins, directions = rays
            rays = from_numpy(device.session(), origins, directions, 0.0, np.inf)
        session = device.session_of(rays.org_tnear)
        slots = leaf_slots(session, rays)
        if order == "hash":
            slots = hashed_slots(session, rays, slots, DEFAULT_HASH)
        hierarchy = cls(session, rays, slots, arity, levels, bound)
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
        """Level `k` as it is stored: (num_nodes, 20) float32, the columns the rows of cl/node.h."""
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
        size = -(-nodes // _PER_ITEM)
        self.session.launch(HIERARCHY_CREATION, self._kernels[kernel], size, *args)

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

    def _build_level(self, level, kernel, *children):
        nodes = self._padded(self.num_nodes[level])
        self.valid.append(self.session.empty(nodes, np.uint32))
        self._launch(
            kernel,
            nodes,
            np.uint32(self.num_nodes[level - 1]),
            np.uint32(nodes),
            *children,
            self.blocks[level],
            self.valid[level],
        )
