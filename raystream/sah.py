"""The better builder of the scene hierarchy: splits by surface area, top down (cl/sah.cl)."""

import numpy as np

from raystream.statistics import HIERARCHY_CREATION

_LEAST_FILL = 4  # triangles to a leaf, on average: splits by surface area leave some 7
# Tasks should be enough to share out evenly; smaller ones cost launches.
_TASKS_PER_UNIT, _LEAST_TASK, _MOST_LEVELS = 8, 512, 8
_PIECES_PER_UNIT, _MOST_PIECES = 8, 64
_WORKERS_PER_UNIT = 4
_TOP_BYTES, _BINS_BYTES, _TASK_WORDS = 96, 3 * 16 * 40, 16  # cl/sah.cl


class SurfaceAreaBuilder:
    """Builds trees over as many triangles as a geometry has.

    Parameters
    ----------
    session : raystream.device.Session
    geometry : raystream.geometry.Geometry

    Attributes
    ----------
    num_nodes, num_leaves : int
        The most that a tree may need.
    nbytes : int
        Of the arrays that it works in.
    """

    def __init__(self, session, geometry):
        self.session, self._geometry = session, geometry
        count, units = geometry.num_triangles, session.device.max_compute_units
        self._target = max(count // (_TASKS_PER_UNIT * units), _LEAST_TASK)
        # Parts are not of one size: three levels more than halves would take.
        halvings = (count // self._target).bit_length() - 1
        self._levels = min(halvings + 3, _MOST_LEVELS) if count > self._target else 0
        self._pieces = min(_PIECES_PER_UNIT * units, _MOST_PIECES)
        self._workers = _WORKERS_PER_UNIT * units
        tops = 2 << self._levels
        self.num_leaves = count // _LEAST_FILL + tops
        self.num_nodes = tops // 2 + 4 * self.num_leaves // 7 + 1
        self._shapes = {
            "even": ((count, 8), np.float32),
            "odd": ((count, 8), np.float32),
            "tops": ((tops, _TOP_BYTES), np.uint8),
            "pieces": ((tops, self._pieces, 2), np.uint32),
            "bins": ((max(1, tops // 4) * self._pieces, _BINS_BYTES), np.uint8),
            "tasks": (4 + tops // 2 * _TASK_WORDS, np.uint32),
            "areas": (2, np.float32),
        }
        self.nbytes = sum(
            int(np.prod(shape)) * np.dtype(dtype).itemsize for shape, dtype in self._shapes.values()
        )
        self._kernels = session.kernels("sah.cl", PIECES=self._pieces, LEVELS=self._levels)

    def allocate(self):
        """The arrays that it works in."""
        self._arrays = {k: self.session.empty(*of) for k, of in self._shapes.items()}

    def build(self, nodes, leaves):
        """Fill arrays of `num_nodes` and `num_leaves`, as those of `SceneTree`."""
        a, geometry, target = self._arrays, self._geometry, np.uint32(self._target)
        triangles, boxes = geometry.triangles, geometry.middles
        splits, things = (a["tops"], a["pieces"]), (a["even"], a["odd"])
        self._launch(
            "start_build", self._pieces, np.uint32(geometry.num_triangles), target, triangles,
            np.uint32(boxes.shape[0]), boxes, a["even"], *splits, a["bins"],
        )  # fmt: skip
        for level in range(self._levels):
            ranges, number = 1 << level, np.uint32(level)
            self._launch("choose_planes", ranges, number, target, *splits, a["bins"])
            source, to = things[level % 2], things[1 - level % 2]
            size = ranges * self._pieces
            self._launch("split_ranges", size, number, *splits, source, to, a["bins"])
        self._launch("plan_tasks", 1, a["tops"], a["tasks"], nodes)
        self._launch(
            "build_tasks", self._workers, *splits, a["tasks"], triangles, *things, nodes, leaves
        )
        self._areas = self._finish(False, nodes, leaves)

    def refit(self, nodes, leaves):
        """Fit the tree that was built last to where the triangles are now.

        Returns
        -------
        float
            Times as many nodes and leaves as when it was built a line meets, through where the
            scene was or is, whichever is smaller: what flies off must not hide the rest.
        """
        a = self._arrays
        arrays = a["tasks"], self._geometry.triangles, nodes, leaves
        self._launch("refit_tasks", self._workers, *arrays)
        areas = self._finish(True, nodes, leaves)
        self.session.queue.finish()
        area, root = areas.astype(float)
        area_before, root_before = self._areas.astype(float)
        with np.errstate(divide="ignore", invalid="ignore"):
            return area / min(root, root_before) * root_before / area_before

    def _finish(self, refit, nodes, leaves):
        """Areas of all boxes and of the root's, there when the queue is done."""
        a = self._arrays
        self._launch("finish_tree", 1, np.uint32(refit), a["tasks"], nodes, leaves, a["areas"])
        return self.session.fetch(HIERARCHY_CREATION, a["areas"])

    def _launch(self, kernel, size, *args):
        self.session.launch(HIERARCHY_CREATION, self._kernels[kernel], size, *args)
