"""Method `dual`: rays against a scene hierarchy that is built on the device every frame.

The scene hierarchy is `raystream.tree`'s. Rays walk it alone (cl/single.cl), as bundles of 64
(cl/bundle.cl) or as streams of thousands (cl/ray_stream.cl); all three find the hits of `brute`,
bit for bit. Which of them is faster depends on how many rays of a bundle share a visit of a node:
see `DualTracer._choice`.
"""

import dataclasses

import numpy as np
import pyopencl.array as cla

from raystream.checks import check_choice
from raystream.errors import MemoryLimitError
from raystream.hash import DEFAULT_HASH
from raystream.intersect import HitStream, sum_counts
from raystream.order import leaf_slots, sorted_slots
from raystream.statistics import TRAVERSAL, Statistics
from raystream.tree import BUILDERS, SceneTree

TRAVERSALS = ("auto", "single", "bundle", "stream")
_FILES = {"single": "single.cl", "bundle": "bundle.cl", "stream": "ray_stream.cl"}
_RAYS = {"single": 64, "bundle": 64, "stream": 2048}  # to a work-item
# In the order of `Counts` (cl/single.h).
_COUNTS = (
    "rays", "nodes", "box_tests", "boxes", "leaves", "leaf_tests", "leaf_boxes", "tests", "hits"
)  # fmt: skip

# Nanoseconds, medians of eight scenes of 24,000 to 331,000 triangles and 262,144 rays of five
# kinds, two cores: what the better builder takes more for each triangle, and saves of a ray.
_COST_OF_QUALITY = 58
_SAVED_BY_QUALITY = {"single": 28, "bundle": 7, "stream": 28}
# See `DualTracer._choice`. Measured with eight scenes, 8,281 to 1,048,576 rays from a camera, from
# a light, off mirrors and at random, two cores. Where fewer than 3.6 rays shared a visit of a
# bundle, streams in the given order took 0.7 to 1.04 (in one case of ten 1.16) of the time of
# sorting and the better of bundles and streams. Where more did, sorted bundles shared a visit among
# some 30 of their 64 rays; sorting took as long as bundles for 0.3 visits of each ray and 40,000.
_FEW_RAYS = 8192
_SAMPLES = 32
_SHARED_BY_BUNDLE = 3.6
_SHARED_WHEN_SORTED = 30
_VISITS_OF_A_SORT, _VISITS_OF_ANY_SORT = 0.3, 40_000
_VISITS_OF_A_SORTED_STREAM = 20  # more miss the cache


@dataclasses.dataclass
class _Plan:
    """A traversal, and the order of the rays for it."""

    traversal: str
    slots: cla.Array


@dataclasses.dataclass
class _Coherence:
    """Of bundles: visits of nodes and leaves for each ray, inactive ones too; rays sharing one."""

    visits: float
    shared: float

    def worth_a_sort(self, num_rays):
        """Whether so many rays are likely to save more visits by being sorted than it costs."""
        saved = self.visits * (1 - self.shared / _SHARED_WHEN_SORTED)
        return saved > _VISITS_OF_A_SORT + _VISITS_OF_ANY_SORT / num_rays


class _Trees:
    """The scene hierarchies of a geometry, by builder, and the choice between them."""

    def __init__(self, session, geometry, memory_limit, builder):
        self.geometry = geometry
        self._session, self._memory_limit, self._builder = session, memory_limit, builder
        self._trees, self._built, self._version = {}, None, None
        self._saved, self._saved_before = 0, 0  # by quality: in this version, in the last
        self._quality_fits = True

    def current(self):
        """The `SceneTree` of the geometry as it is now."""
        self._notice_change()
        builder = self._chosen() if self._builder == "auto" else self._builder
        if builder not in self._trees:
            self._add(builder)
        if builder != self._built:
            self._trees[builder].build()
            self._built = builder
        return self._trees[builder]

    def expect(self, traversal, num_rays):
        """Rays that are about to be traced: they may be worth another hierarchy."""
        self._notice_change()
        self._saved += _SAVED_BY_QUALITY[traversal] * num_rays

    def _notice_change(self):
        if self._version != self.geometry.version:
            self._built, self._version = None, self.geometry.version
            self._saved, self._saved_before = 0, self._saved

    def _chosen(self):
        cost = _COST_OF_QUALITY * self.geometry.num_triangles
        if max(self._saved, self._saved_before) < cost or not self._quality_fits:
            return "fast"
        if "quality" not in self._trees:
            try:
                self._add("quality")
            except MemoryLimitError:
                self._quality_fits = False
                return "fast"
        return "quality"

    def _add(self, builder):
        taken = sum(tree.structure_bytes for tree in self._trees.values())
        limit = self._memory_limit - taken
        self._trees[builder] = SceneTree(self._session, self.geometry, builder, limit)


class DualTracer:
    """Rays against a scene hierarchy, which is built anew when the geometry has changed.

    Parameters
    ----------
    session : raystream.device.Session
    geometry : raystream.geometry.Geometry
    memory_limit : int
        Bytes that the scene hierarchy may take.
    builder : {"auto", "fast", "quality"}
        See `raystream.tree.SceneTree`. "auto" takes "quality" where the rays traced since the
        geometry changed, or those between the two changes before, gain what it costs, and
        `memory_limit` allows a second hierarchy; else "fast".
    traversal : {"auto", "single", "bundle", "stream"}
        How rays walk the hierarchy. "auto" measures which is the fastest for the rays of each call.

    Raises
    ------
    ValueError
        An option that there is not.
    raystream.errors.MemoryLimitError
        The hierarchy needs more than `memory_limit`.

    Notes
    -----
    `Statistics.levels` has two rows, nodes and leaves: ``nodes`` visits of them, by a ray, a bundle
    or the rays of a stream that are there; ``tests`` of boxes there, ``hits`` boxes entered.
    `Statistics.final_tests` counts triangles tested with a ray, `final_hits` those hit within the
    ray's segment as far as it then reached.
    """

    def __init__(self, session, geometry, memory_limit, builder="auto", traversal="auto"):
        check_choice("builder", builder, ("auto", *BUILDERS))
        check_choice("traversal", traversal, TRAVERSALS)
        self.session, self._traversal = session, traversal
        self._trees = _Trees(session, geometry, memory_limit, builder)

    def intersect(self, rays):
        """Closest hits of `rays`; returns (HitStream, Statistics)."""
        records = self.session.empty((len(rays), 4), np.float32)
        statistics = self._trace("intersect", rays, records)
        return HitStream.unpack(self.session, records), statistics

    def occluded(self, rays):
        """Whether anything lies in each ray's segment; returns (uint8 Array, Statistics)."""
        blocked = self.session.empty(len(rays), np.uint8)
        return blocked, self._trace("occlude", rays, blocked)

    def tree(self):
        """The `SceneTree` of the geometry as it is now."""
        return self._trees.current()

    def _trace(self, query, rays, result):
        plan = self._plan(query, rays, result)
        self._trees.expect(plan.traversal, len(rays))
        return self._statistics(self._run(query, plan, rays, result))

    def _plan(self, query, rays, result):
        """How to trace these rays, and in which order: only bundles gain by one."""
        given, traversal = leaf_slots(self.session, rays), self._traversal
        sort = traversal == "bundle"
        if traversal == "auto":
            traversal, sort = self._choice(query, rays, given, result)
        sort &= rays.size is None  # tiles of a screen are as good as any order
        return _Plan(
            traversal, sorted_slots(self.session, rays, given, DEFAULT_HASH) if sort else given
        )

    def _choice(self, query, rays, given, result):
        """The traversal that suits the rays, and whether they should be sorted for it.

        A bundle costs what its nodes and leaves cost, whether one ray enters them or all; a
        stream costs what each ray's nodes and leaves cost, almost whatever their order. So it
        matters how many visits bundles make, and how many rays share one: a few bundles in the
        given order, spread over all, are traced to see.
        """
        if len(rays) < _FEW_RAYS:
            return "single", False
        coherence = self._coherence(query, _Plan("bundle", given), rays, result)
        if coherence.shared < _SHARED_BY_BUNDLE:
            return "stream", coherence.visits > _VISITS_OF_A_SORTED_STREAM
        return "bundle", coherence.worth_a_sort(len(rays))

    def _coherence(self, query, plan, rays, result):
        counts = self._run(query, plan, rays, result, most=_SAMPLES)
        visits = counts["nodes"] + counts["leaves"]
        places = min(plan.slots.shape[0], _SAMPLES * _RAYS[plan.traversal])
        return _Coherence(visits / places, counts["boxes"] / max(1, visits))

    def _run(self, query, plan, rays, result, most=None):
        """Trace the rays, or up to `most` work-items' spread evenly; returns the counts."""
        size, num_slots = _RAYS[plan.traversal], plan.slots.shape[0]
        groups = -(-num_slots // size)
        launched = groups if most is None else min(groups, most)
        counts, tree = self.session.empty((launched, len(_COUNTS)), np.uint64), self.tree()
        constants = {} if plan.traversal == "bundle" else {"RAYS": size}
        self.session.launch(
            TRAVERSAL,
            self.session.kernels(_FILES[plan.traversal], **constants)[f"{query}_{plan.traversal}"],
            launched,
            np.uint32(num_slots),
            np.uint32((groups // launched - 1) | 1),  # odd: no column of a screen alone
            plan.slots,
            rays.org_tnear,
            rays.dir_tfar,
            tree.nodes,
            tree.leaves,
            counts,
            result,
        )
        return dict(zip(_COUNTS, sum_counts(self.session, counts), strict=True))

    def _statistics(self, counts):
        levels = [
            {"nodes": nodes, "tests": tests, "hits": hits, "misses": tests - hits}
            for nodes, tests, hits in (
                (counts["nodes"], counts["box_tests"], counts["boxes"]),
                (counts["leaves"], counts["leaf_tests"], counts["leaf_boxes"]),
            )
        ]
        return Statistics(
            levels=levels,
            final_tests=counts["tests"],
            final_hits=counts["hits"],
            rays=counts["rays"],
            triangles=self._trees.geometry.num_triangles,
            batches=1,
            structure_bytes=self.tree().structure_bytes,
        )
