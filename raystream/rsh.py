"""Method `rsh`: the ray-space hierarchy of Roger, Assarsson and Holzschuch (2007).

Per call: the hierarchy is built bottom-up over the rays, and streams of (node, triangle) pairs are
led from the root to the rays, reduced after each level; what is left is intersected exactly.

Memory (section 3.4 of the paper): the streams share `memory_limit`. Whether all survivors of a
level fit is known on the device before one of them is written. Where they do not, the levels below
have nothing to do, and the host cuts the triangles into smaller batches and starts these from the
top: in the same call, so nothing is lost, and since triangles do not depend on each other the sum
of the batches' counts is what one batch would have counted.
"""

from raystream import intersect
from raystream.checks import check_choice, check_count
from raystream.errors import MemoryLimitError
from raystream.hierarchy import ARITIES, BOUNDS, RayHierarchy
from raystream.order import leaf_slots
from raystream.pairs import FUSED, LOADED, PAIR_BYTES, REDUCTIONS, bytes_per_pair
from raystream.statistics import Statistics
from raystream.traverse import Traversal

_MOST_PAIRS = 1 << 31  # lengths and places are 32 bits
_FIRST_PAIRS = 1 << 20  # streams start with room for this many pairs and grow up to the limit


class RayspaceTracer:
    """Ray-space hierarchy over one geometry.

    Parameters
    ----------
    session : raystream.device.Session
    geometry : raystream.geometry.Geometry
    memory_limit : int
        Bytes that the candidate streams may take.
    arity : {4, 8}
        Children per node; 4 in the paper.
    levels : int, optional
        Node levels above the rays; the rays themselves are then not tested against the
        triangles' spheres (as Reis et al. 2017 run it). Default: up to one root, and the rays
        tested, as in the paper.
    reduction : {"fused", "segmented", "scan", "horn", "append"}
        How survivors become the next stream: "fused" writes them straight to their place; the
        others write all children out first and reduce that stream by the method (see
        `stream.reduce`), as the paper does, to show what it costs.
    bound : {"sphere", "tight", "paper"}
        "sphere": triangles are tested by their bounding spheres, as in the paper. "tight": by slabs
        and boxes, too (cl/node.h), which pays where triangles are large or long. "paper": spheres,
        and nodes united as Reis et al. (2017) print it, without the rays' tfar; to reproduce
        counts (cl/paper_bounds.h).

    Raises
    ------
    ValueError
        An option that there is not.
    """

    def __init__(
        self,
        session,
        geometry,
        memory_limit,
        arity=4,
        levels=None,
        reduction=FUSED,
        bound="sphere",
    ):
        check_choice("arity", arity, ARITIES)
        check_choice("bound", bound, BOUNDS)
        check_choice("reduction", reduction, REDUCTIONS)
        if levels is not None:
            check_count("levels", levels)
        self.session, self.geometry = session, geometry
        self._arity, self._levels, self._reduction = arity, levels, reduction
        self._bound, self._test_rays = bound, levels is None
        self._limit, self._bytes_per_pair = memory_limit, bytes_per_pair(arity, reduction)
        fused = reduction == FUSED
        self._most_pairs = min(
            memory_limit // self._bytes_per_pair,
            session.device.max_mem_alloc_size // (PAIR_BYTES * (1 if fused else arity)) - LOADED,
            _MOST_PAIRS,
        )
        self._capacity = min(_FIRST_PAIRS, self._most_pairs)

    def intersect(self, rays):
        """Closest hits of `rays`; returns (HitStream, Statistics)."""
        closest = intersect.no_hits(self.session, len(rays))
        statistics = self._trace("intersect_pairs", rays, closest)
        hits = intersect.resolve(self.session, closest, rays, self.geometry.triangles)
        return hits, statistics

    def occluded(self, rays):
        """Whether anything lies in each ray's segment; returns (uint8 Array, Statistics)."""
        blocked = intersect.not_blocked(self.session, len(rays))
        return blocked, self._trace("occlude_pairs", rays, blocked)

    def _trace(self, kernel, rays, result):
        slots = self._slots(rays)
        hierarchy = RayHierarchy(
            self.session, rays, slots, self._arity, self._levels, self._bound, self._test_rays
        )
        self._check_room(hierarchy)
        objects = self._objects()
        batches = [(0, self.geometry.num_triangles)]
        statistics, totals = Statistics(triangles=self.geometry.num_triangles), 0
        while batches:
            first, last = batches.pop()
            traversal = self._run_batch(kernel, rays, hierarchy, objects, result, first, last)
            overflow = int(traversal.reduction.overflow.get()[0])
            if overflow:
                batches += self._cut(first, last, overflow)
                continue
            counts = traversal.counts.get()
            totals = totals + counts
            statistics.batches += 1
            statistics.mesh_tests += int(traversal.object_tests.get()[0])
            statistics.peak_stream_bytes = max(
                statistics.peak_stream_bytes, self._stream_bytes(counts)
            )
        self._count(statistics, hierarchy, totals)
        return statistics

    def _slots(self, rays):
        """The order of the rays in the leaves."""
        return leaf_slots(self.session, rays)

    def _objects(self):
        """Parts of the scene to test before their triangles."""
        return None

    def _check_room(self, hierarchy):
        """A batch of one triangle must fit: at most one pair per leaf."""
        if hierarchy.num_nodes[0] > self._most_pairs:
            need = hierarchy.num_nodes[0] * self._bytes_per_pair
            raise MemoryLimitError(
                f"memory_limit: {hierarchy.num_nodes[0]} rays need at least {need} bytes, "
                f"got {self._limit} (at most {self._most_pairs} pairs per stream on this device)"
            )

    def _run_batch(self, kernel, rays, hierarchy, objects, result, first, last):
        """One batch of triangles, positions first .. last; returns its `Traversal`."""
        traversal = Traversal(
            self.session,
            self.geometry,
            hierarchy,
            self._capacity,
            self._test_rays,
            self._reduction,
            objects,
        )
        pairs = traversal.run(first, last)
        intersect.test_pairs(
            self.session,
            kernel,
            pairs,
            traversal.rays_per_node,
            hierarchy.slots,
            rays,
            self.geometry.triangles,
            result,
            traversal,
        )
        return traversal

    def _cut(self, first, last, survivors):
        """The batches that replace one that overflowed; the streams grow first, up to the limit."""
        if self._capacity < self._most_pairs:
            self._capacity = min(max(2 * self._capacity, 2 * survivors), self._most_pairs)
            self.session.trim()  # the smaller streams are not needed again
            return [(first, last)]
        # `_check_room` made sure that a batch of one triangle never comes here.
        pieces = max(2, -(-2 * survivors // self._capacity))
        size = -(-(last - first) // pieces)
        return [(i, min(i + size, last)) for i in range(first, last, size)][::-1]

    def _stream_bytes(self, counts):
        """Most bytes of streams in use: a level's input, its masks and its output."""
        inputs = [0, *(int(n) for n in counts[1:, 2])]
        following = [*inputs[1:], 0]
        return max(
            (self._bytes_per_pair - PAIR_BYTES) * a + PAIR_BYTES * b
            for a, b in zip(inputs, following, strict=True)
        )

    def _count(self, statistics, hierarchy, totals):
        nodes = hierarchy.count_nodes()
        order = nodes[::-1] if self._test_rays else nodes[:0:-1]
        statistics.rays = nodes[0]
        statistics.levels = [
            {"nodes": n, "tests": int(t), "hits": int(h), "misses": int(t - h)}
            for n, (t, h) in zip(order, totals[:-1, :2], strict=True)
        ]
        statistics.final_tests, statistics.final_hits = (int(n) for n in totals[-1, :2])
