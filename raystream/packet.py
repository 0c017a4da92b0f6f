"""Method `packet`: large ray packets in a bounding volume hierarchy, cl/packet.cl.

Overbeck, Ramamoorthi and Mark, "Large Ray Packets for Real-time Whitted Ray Tracing" (2008).
"""

import math

import numpy as np

from raystream.bvh import LEAF_SIZE, Bvh
from raystream.checks import check_choice, check_count
from raystream.intersect import HitStream
from raystream.statistics import TRAVERSAL, Statistics

TRAVERSALS = ("masked", "ranged", "partition")
PACKET_SIZES = (2, 4, 8, 16, 32)
SIMD_WIDTHS = (4, 16)
COUNTERS = (
    "visits",
    "box_tests",
    "box_hits",
    "triangle_tests",
    "frustum_box_tests",
    "frustum_box_culls",
    "frustum_triangle_tests",
    "frustum_triangle_culls",
    "leaves",
    "active",
    "alive",
)
_WORKERS = 64  # work-items that share the packets of a stream
_LEVELS = 64  # kernels are built for trees of so many levels, or a power of two times as many


class PacketTracer:
    """Ray packets; the hierarchy is built anew when the geometry has changed.

    Parameters
    ----------
    session : raystream.device.Session
    geometry : raystream.geometry.Geometry
    memory_limit : int
        Bytes that the hierarchy may take.
    traversal : {"auto", "masked", "ranged", "partition"}
        "auto": Ranged for rays that start in one point, of a camera or a light, Partition for all
        others (section 6).
    packet_size : {2, 4, 8, 16, 32}
        Rays along a side of a packet: tiles of the screen where the rays have one, else
        packet_size squared consecutive rays.
    frustum_culling : bool
    simd_width : {4, 16}, optional
        Rays to a SIMD ray, the smallest primitive: 2 x 2 or 4 x 4 pixels. Default: 16, but 4 for
        packets of 2 x 2.
    least_active : int
        A frustum is asked where at least so many SIMD rays are active; 1: always, as in the paper.

    Raises
    ------
    ValueError
        An option that there is not.
    raystream.errors.MemoryLimitError
        At the first ray traced: the hierarchy would take more than `memory_limit`.
    raystream.errors.DeviceError
        At the first ray traced: see `Bvh`.

    Notes
    -----
    Tests are those of SIMD rays, however many of their rays are alive: in `Statistics.levels`
    (by depth, the root first: `nodes` are visits of packets, `tests` and `hits` of boxes), in
    `Statistics.final_tests` and in `Statistics.by_depth`. `Statistics.final_hits` are rays that
    hit. The counts are those of `raystream.baselines.PacketTracer` with precision="single".
    """

    def __init__(
        self,
        session,
        geometry,
        memory_limit,
        traversal="auto",
        packet_size=16,
        frustum_culling=True,
        simd_width=None,
        least_active=6,
    ):
        check_choice("traversal", traversal, ("auto", *TRAVERSALS))
        check_choice("packet_size", packet_size, PACKET_SIZES)
        check_choice("frustum_culling", frustum_culling, (False, True))
        if simd_width is None:
            simd_width = 4 if packet_size == 2 else 16
        check_choice("simd_width", simd_width, [w for w in SIMD_WIDTHS if w <= packet_size**2])
        self.session, self.geometry = session, geometry
        self._limit, self._traversal, self._packet_size = memory_limit, traversal, packet_size
        self._culling, self._simd_width = frustum_culling, simd_width
        self._least_active = check_count("least_active", least_active)
        self._bvh, self._version = None, None

    def bvh(self):
        """The `Bvh` of the geometry as it is now."""
        if self._version != self.geometry.version:
            self._bvh = None  # its memory may be needed
            self._bvh = Bvh(self.session, self.geometry, self._limit)
            self._version = self.geometry.version
        return self._bvh

    def intersect(self, rays):
        """Closest hits of `rays`; returns (HitStream, Statistics)."""
        hits = HitStream.empty(self.session, len(rays))
        results = self.geometry.triangles, hits.t, hits.triangle, hits.u, hits.v
        return hits, self._trace("intersect_packets", rays, *results)

    def occluded(self, rays):
        """Whether anything lies in each ray's segment; returns (uint8 Array, Statistics)."""
        blocked = self.session.empty(len(rays), np.uint8)
        return blocked, self._trace("occlude_packets", rays, blocked)

    def _trace(self, kernel, rays, *results):
        bvh = self.bvh()
        size = self._packet_size
        width, height = (0, 0) if rays.size is None else rays.size
        num_packets = -(-width // size) * -(-height // size) or -(-len(rays) // size**2)
        totals = self.session.empty((_WORKERS, 4), np.uint64)
        counts = self.session.empty((_WORKERS, bvh.num_levels, len(COUNTERS)), np.uint64)
        self.session.launch(
            TRAVERSAL,
            self._kernels(bvh)[kernel],
            _WORKERS,
            np.uint32(num_packets),
            np.uint32(len(rays)),
            np.uint32(width),
            np.uint32(height),
            np.uint32(size // math.isqrt(self._simd_width)),
            np.uint32(TRAVERSALS.index(self._traversal_of(rays))),
            np.uint32(self._least_active if self._culling else 0),
            np.uint32(bvh.num_levels),
            bvh.nodes,
            bvh.triangles,
            rays.org_tnear,
            rays.dir_tfar,
            *results,
            totals,
            counts,
        )
        return self._statistics(bvh, totals.get().sum(axis=0), counts.get().sum(axis=0))

    def _traversal_of(self, rays):
        if self._traversal != "auto":
            return self._traversal
        return "ranged" if rays.primary or rays.light is not None else "partition"

    def _statistics(self, bvh, totals, counts):
        by_depth = {name: counts[:, k].tolist() for k, name in enumerate(COUNTERS)}
        rays, simd_rays, packets, hits = (int(x) for x in totals)
        levels = [
            {"nodes": nodes, "tests": tests, "hits": hits, "misses": tests - hits}
            for nodes, tests, hits in zip(
                by_depth["visits"], by_depth["box_tests"], by_depth["box_hits"], strict=True
            )
        ]
        return Statistics(
            levels=levels,
            final_tests=sum(by_depth["triangle_tests"]),
            final_hits=hits,
            rays=rays,
            triangles=self.geometry.num_triangles,
            batches=1,
            structure_bytes=bvh.nbytes,
            packets=packets,
            simd_rays=simd_rays,
            by_depth=by_depth,
        )

    def _kernels(self, bvh):
        depth = _LEVELS
        while depth < bvh.num_levels:
            depth *= 2
        return self.session.kernels(
            "packet.cl",
            WIDTH=self._simd_width,
            DEPTH=depth,
            LEAF_SIZE=LEAF_SIZE,
            NUM_COUNTERS=len(COUNTERS),
            **{name.upper(): k for k, name in enumerate(TRAVERSALS)},
        )
