"""Method `dual`: rays against a scene hierarchy that is built on the device every frame.

The scene hierarchy is `raystream.tree`'s. Rays walk it alone (cl/single.cl), as bundles of 64
(cl/bundle.cl) or as streams of thousands (cl/ray_stream.cl); all three find the hits of `brute`,
bit for bit. Which of them is faster depends on how many rays of a bundle share a visit of a node:
see `_Coherence.choice`.
"""

import dataclasses
import functools

import numpy as np
import pyopencl.array as cla

from raystream.checks import check_choice
from raystream.errors import MemoryLimitError
from raystream.intersect import HitStream, sum_counts
from raystream.order import leaf_slots, sorted_rays, tiled_slots
from raystream.statistics import TRAVERSAL, Statistics
from raystream.tree import BUILDERS, SceneTree

TRAVERSALS = ("auto", "single", "bundle", "stream")
_FILES = {"single": "single.cl", "bundle": "bundle.cl", "stream": "ray_stream.cl"}
_RAYS = 64  # to a work-item
# The longer a stream, the more rays of it share a visit: 8192 take 0.94 of the time of 4096; of
# 16384 scattered rays gain more, others lose, in caches of 2 MB. Powers of two, as many as can be
# shared out.
_LEAST_STREAM, _LONGEST_STREAM, _STREAMS_PER_UNIT = 1024, 8192, 16
# In the order of `Counts` (cl/single.h).
_COUNTS = (
    "rays", "nodes", "box_tests", "boxes", "leaves", "leaf_tests", "leaf_boxes", "tests", "hits",
    "pairs", "close_pairs",
)  # fmt: skip

# Eight scenes of 24,000 to 331,000 triangles and 262,144 rays of five kinds, two cores: the better
# builder takes some 58 ns more for each triangle, and saves some 4 ns for each visit that bundles
# in the given order make in the fast one's tree, where they make some twice as many.
_VISITS_WORTH_QUALITY = 14.5  # of a triangle
_MORE_VISITS_IN_FAST = 2
_ASSUMED_VISITS = 7  # of a ray
_VISITS_OF_NO_REFIT = 2  # of a triangle: some 8 ns, by which the fast builder takes longer
_MOST_WORSE = 1.15  # a refitted tree, before another is built
_HIGHEST_PRICE = 64  # as many times as worth it, and versions, before another is tried
# See `_Coherence.choice`. Measured with eight scenes, both builders, 262,144 rays from a camera,
# from a light, off smooth and bumpy mirrors and at random, two cores: so chosen, tracing takes
# 1.01 times what the best of bundles and streams, sorted or not, would take (geometric mean; most
# 1.2). Sorted bundles share a visit among up to some 40 of their 64 rays; sorting takes as long as
# bundles for 0.1 visits of each ray and 30,000; bundles of tiles gain less by it, from 0.7 visits
# on. Streams of scattered rays that make many visits take 0.75 to 0.95 of the time when sorted,
# that included.
_FEW_RAYS = 8192
_SAMPLES = 32
_CLOSE_PAIRS = 0.75
_SHARED_BY_BUNDLE, _SHARED_BY_CLOSE_BUNDLE = 6.8, 2.5
_SHARED_WHEN_SORTED = 40
_VISITS_OF_A_SORT, _VISITS_OF_TILES, _VISITS_OF_ANY_SORT = 0.1, 0.7, 30_000
_SHARED_BY_SCATTERED, _MANY_VISITS, _MANY_VISITS_OF_ANY = 2, 3, 250_000
_HASHES = {"bundle": "coarse", "stream": "coarsest"}


@dataclasses.dataclass
class _Plan:
    """A traversal, the order of the rays for it, and the measured visits of each as a bundle's."""

    traversal: str
    slots: cla.Array
    visits: float | None = None


@dataclasses.dataclass
class _Coherence:
    """Of bundles in the given order.

    Attributes
    ----------
    visits : float
        Of nodes and leaves, for each ray, inactive ones too.
    shared : float
        Rays that share a visit.
    close : float
        Share of neighbours whose directions are within 5 degrees.
    """

    visits: float
    shared: float
    close: float

    def choice(self, num_rays, tiled):
        """The traversal that suits so many rays, and whether they should be sorted for it.

        A bundle costs what its nodes and leaves cost, whether one ray enters them or all; a
        stream costs what each ray's nodes and leaves cost, almost whatever their order. So it
        matters how many visits bundles make, and how many rays share one, or would if they were
        sorted: where neighbours are close, sorting brings together what is close to both; where
        they are `tiled`, it brings less.
        """
        few = _SHARED_BY_CLOSE_BUNDLE if self.close >= _CLOSE_PAIRS else _SHARED_BY_BUNDLE
        if self.shared < few:
            many = _MANY_VISITS + _MANY_VISITS_OF_ANY / num_rays
            return "stream", self.shared < _SHARED_BY_SCATTERED and self.visits > many
        saved = self.visits * (1 - self.shared / _SHARED_WHEN_SORTED)
        least = _VISITS_OF_TILES if tiled else _VISITS_OF_A_SORT
        return "bundle", saved > least + _VISITS_OF_ANY_SORT / num_rays


class _Trees:
    """The scene hierarchies of a geometry, by builder, and the choice between them."""

    def __init__(self, session, geometry, memory_limit, builder):
        self.geometry = geometry
        self._session, self._memory_limit, self._builder = session, memory_limit, builder
        self._trees, self._built, self._version = {}, None, None
        self._visits, self._visits_before = 0, 0  # in this version, in the last
        self._affordable = True  # the better one, within the limit
        self._fits = False  # the better one, to the latest vertices as far as has been tried
        self._worse = None  # so many times it meets lines, where it has been refitted to them
        # Visits of the other one since the better one was built, and how many times as many as in
        # one version they must be: twice as many each time that it has not fitted the next. For so
        # many versions it is not tried again.
        self._visits_unpaid, self._price, self._wait = 0, 1, 0

    def current(self):
        """The `SceneTree` of the geometry as it is now."""
        self._notice_change()
        builder = self._chosen() if self._builder == "auto" else self._builder
        if builder not in self._trees:
            self._add(builder)
        if builder != self._built:
            self._trees[builder].build()
            self._built, self._worse = builder, None
            if builder == "quality":
                self._visits_unpaid, self._fits = 0, True
        return self._trees[builder]

    def expect(self, num_rays, visits=None):
        """Rays are about to be traced: they may be worth another hierarchy.

        Parameters
        ----------
        num_rays : int
        visits : float, optional
            Of each ray in the hierarchy as it is now; where they are not measured some are assumed.
        """
        self._notice_change()
        if visits is None:
            visits = _ASSUMED_VISITS
        elif self._built == "quality":
            visits *= _MORE_VISITS_IN_FAST
        visits *= num_rays
        self._visits += visits
        self._visits_unpaid += 0 if self._built == "quality" else visits

    def _notice_change(self):
        if self._version == self.geometry.version:
            return
        if self._built == "fast":
            self._visits_unpaid += _VISITS_OF_NO_REFIT * self.geometry.num_triangles
        self._built, self._worse, self._version = None, None, self.geometry.version
        self._visits, self._visits_before = 0, self._visits
        self._wait = max(0, self._wait - 1)
        if self._builder == "auto" and self._fits:
            self._refit()

    def _refit(self):
        """Fit the better tree to the new vertices, unless that has failed of late."""
        if self._wait > 0:
            self._fits = False
            return
        self._worse = self._trees["quality"].refit()
        self._fits = self._worse <= _MOST_WORSE
        if self._fits:
            self._built, self._price = "quality", 1
        else:
            self._price = self._wait = min(2 * self._price, _HIGHEST_PRICE)

    def _chosen(self):
        worth = _VISITS_WORTH_QUALITY * self.geometry.num_triangles
        if self._built == "quality" and self._worse and self._visits * (self._worse - 1) > worth:
            self._built = None
        if self._built == "quality":
            return "quality"
        # It may be worth it in this version alone, or for the next, if it can be refitted to them.
        paid = max(self._visits, self._visits_before)
        if self._wait == 0:
            paid = max(paid, self._visits_unpaid / self._price)
        if paid < worth or not self._affordable:
            return "fast"
        if "fast" not in self._trees:
            self._add("fast")  # or the better one might leave no room for it
        if "quality" not in self._trees:
            try:
                self._add("quality")
            except MemoryLimitError:
                self._affordable = False
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
        geometry changed, or those between the two changes before, save what it costs, as far as
        their visits tell, and `memory_limit` allows a second hierarchy; else "fast". A tree of
        "quality" is fitted to the next vertices for as long as that leaves it nearly as good, and
        so is built, too, where the rays of several changes are worth it.
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
        """Closest hits of `rays`; returns (HitStream, function that waits for the Statistics)."""
        records = self.session.empty((len(rays), 4), np.float32)
        statistics = self._trace("intersect", rays, records)
        return HitStream.unpack(self.session, records), statistics

    def occluded(self, rays):
        """Whether anything lies in each ray's segment; returns (uint8 Array, as `intersect`)."""
        blocked = self.session.empty(len(rays), np.uint8)
        return blocked, self._trace("occlude", rays, blocked)

    def tree(self):
        """The `SceneTree` of the geometry as it is now."""
        return self._trees.current()

    def _trace(self, query, rays, result):
        plan = self._plan(query, rays, result)
        self._trees.expect(len(rays), plan.visits)
        sums = self._run(query, plan, rays, result)
        facts = self._trees.geometry.num_triangles, self.tree().structure_bytes
        return functools.partial(_statistics, self.session.queue, sums, *facts)

    def _plan(self, query, rays, result):
        """How to trace these rays, and in which order.

        A few bundles, spread over all, are traced to see: in the order given, or that of tiles
        where rays start at one point.
        """
        traversal, slots, visits = self._traversal, None, None
        sort = traversal == "bundle"
        if traversal == "auto" and len(rays) < _FEW_RAYS:
            traversal = "single"
        elif traversal == "auto":
            slots = (tiled_slots if rays.one_origin else leaf_slots)(self.session, rays)
            coherence = self._coherence(query, _Plan("bundle", slots), rays, result)
            traversal, sort = coherence.choice(len(rays), rays.one_origin)
            visits = coherence.visits
        if sort and rays.size is None:  # tiles of a screen are as good as any order
            slots = sorted_rays(self.session, rays, _HASHES[traversal])
        elif slots is None:
            slots = leaf_slots(self.session, rays)
        return _Plan(traversal, slots, visits)

    def _coherence(self, query, plan, rays, result):
        sums = self._run(query, plan, rays, result, most=_SAMPLES)
        counts = _by_name(self.session.queue, sums)
        visits = counts["nodes"] + counts["leaves"]
        places = min(plan.slots.shape[0], _SAMPLES * _RAYS)
        shared = counts["boxes"] / max(1, visits)
        close = counts["close_pairs"] / max(1, counts["pairs"])
        return _Coherence(visits / places, shared, close)

    def _run(self, query, plan, rays, result, most=None):
        """Trace the rays, or up to `most` work-items' spread evenly.

        Returns
        -------
        ndarray of shape (11,) uint64
            `_COUNTS`, there when the queue is done.
        """
        num_slots = plan.slots.shape[0]
        size = self._stream_size(num_slots) if plan.traversal == "stream" else _RAYS
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
        return sum_counts(self.session, counts)

    def _stream_size(self, num_rays):
        """Rays to a stream."""
        share = num_rays // (_STREAMS_PER_UNIT * self.session.device.max_compute_units)
        power = 1 << max(0, share.bit_length() - 1)
        return min(max(power, _LEAST_STREAM), _LONGEST_STREAM)


def _by_name(queue, sums):
    queue.finish()
    return dict(zip(_COUNTS, sums.tolist(), strict=True))


# Of no session, which must go with its thread.
def _statistics(queue, sums, num_triangles, structure_bytes):
    counts = _by_name(queue, sums)
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
        triangles=num_triangles,
        batches=1,
        structure_bytes=structure_bytes,
    )
