"""Large ray packets in a bounding volume hierarchy: the readable, counted truth in numpy.

Overbeck, Ramamoorthi and Mark, "Large Ray Packets for Real-time Whitted Ray Tracing" (2008):
Masked, Ranged and Partition traversal (section 3, figure 2, appendix) with the frusta of section
4. A SIMD ray is four rays, 2 x 2 neighbours on the screen, and the smallest primitive; a packet
of size n holds n x n rays, which is n x n / 4 SIMD rays, row by row. A `simd_width` of 16 makes
it 4 x 4 rays, as processors have it now.

Each packet walks the tree by the paper's loop. Here all packets take each turn of their loops
together, so that numpy has much to do at a time; no packet knows of another, and the counts are
those of one packet after another.

What counts, and how:

* A test of a SIMD ray against a box or a triangle counts once, however many of its four rays are
  alive. Lanes without a ray (screen border, fewer rays than lanes, tfar < tnear, zero direction)
  never hit; a SIMD ray of such lanes only is not part of its packet.
* A frustum's test of a box or a triangle counts once.
* Depth is that of the tree node: the root has 0; triangles count at the depth of their leaf.
* A box counts as overlapped from tnear to the closest hit so far.

What is counted is decided in float32, in the order of operations of cl/packet.h: on the device the
same is counted, where triangles are tested in float32, too (`precision`). A ray is o + s q with
q = d / m, m the largest component of |d|, so that nothing leaves float32's range. Rounding,
u = 2^-24 and D the largest coordinate of a triangle seen from the origin: the triangle test in
float32 finds a hit up to 20 u D beside the triangle, the box test errs by 5 u D. Boxes are wider
by BOX_PAD = 64 u of more than D, so that no hit is lost.

Where the paper errs or leaves it open:

* `partRays` returns 0 when the frustum misses (printed: size(R), which would go on with all).
* The partition leaf loops over i < ia; the printed `getLastHit` is that of Ranged and not needed.
* Partition starts with ia = size(R) (printed: 0, which is no ray at all).
* `getLastHit` of Ranged reads R[ie] (printed: R[I[ie]]; Ranged has no I).
* Figure 2, line 13, breaks only where a ray has hit: an inner cell is tested up to the first hit.
* `partRays` swaps dead rays into some order; here they keep theirs. No count depends on it.
* Near child: by the sign of the packet's summed direction along the split axis.
* A packet of `occluded` stops when all its rays are blocked; blocked rays overlap no box.
"""

import copy
import math
from dataclasses import asdict, dataclass, fields

import numpy as np

from . import watertight_single
from .arrays import float32_rays
from .bvh import build_bvh, ranges
from .frustum import PacketRays, bound_packets
from .lighting import direct_light
from .reference import primary_rays, ray_offset, secondary_rays, select_hits, shade
from .surface import SurfacePoints, dot, normalised, surface_points
from .tracer import HostTracer
from .watertight import intersect_pairs

PACKET_SIZES = (2, 4, 8, 16, 32)
# SIMD rays traced together, and pairs of (ray, triangle) intersected at once.
SIMD_RAYS_PER_CHUNK = 1 << 14
PAIRS_PER_CHUNK = 1 << 16
SIMD_WIDTHS = (4, 16)
PRECISIONS = ("double", "single")
# Widening of boxes, in parts of the coordinates and near the end of float32's range.
BOX_PAD, SMALLEST_PAD = np.float32(2.0**-18), np.float32(2.0**-140)
# Stands for 1 / 0, and for what is beyond: along such an axis a ray moves by less than the pad.
LARGEST_INVERSE = np.float32(2.0**60)


@dataclass
class PacketStatistics:
    """What a call counted; exact, and the same for each run.

    Attributes
    ----------
    rays, simd_rays, packets, triangles : int
        Rays without those that cannot hit (tfar < tnear, zero direction).
    hits : int
        Rays that hit.
    visits_by_depth : (levels,) int64
        Turns of the loop: (packet, node) pairs, culled ones included.
    box_tests_by_depth, triangle_tests_by_depth : (levels,) int64
        Tests of SIMD rays.
    box_hits_by_depth : (levels,) int64
        Box tests in which a ray overlapped the box.
    frustum_box_tests_by_depth, frustum_box_culls_by_depth : (levels,) int64
    frustum_triangle_tests_by_depth, frustum_triangle_culls_by_depth : (levels,) int64
    leaves_by_depth : (levels,) int64
        (packet, leaf) pairs whose triangles were reached.
    active_by_depth, alive_by_depth : (levels,) int64
        SIMD rays at these leaves: taken to overlap the leaf's box, and overlapping it.
    """

    rays: int
    simd_rays: int
    packets: int
    triangles: int
    hits: int
    visits_by_depth: np.ndarray
    box_tests_by_depth: np.ndarray
    box_hits_by_depth: np.ndarray
    triangle_tests_by_depth: np.ndarray
    frustum_box_tests_by_depth: np.ndarray
    frustum_box_culls_by_depth: np.ndarray
    frustum_triangle_tests_by_depth: np.ndarray
    frustum_triangle_culls_by_depth: np.ndarray
    leaves_by_depth: np.ndarray
    active_by_depth: np.ndarray
    alive_by_depth: np.ndarray

    @classmethod
    def zero(cls, num_levels=0, triangles=0):
        """Return statistics of a tree of so many levels before any ray."""
        names = [field.name for field in fields(cls) if field.name.endswith("_by_depth")]
        arrays = {name: np.zeros(num_levels, np.int64) for name in names}
        return cls(rays=0, simd_rays=0, packets=0, triangles=triangles, hits=0, **arrays)

    def add(self, other):
        """Add the counts of other rays in the same tree."""
        for field in fields(self):
            if field.name != "triangles":
                total = getattr(self, field.name) + getattr(other, field.name)
                setattr(self, field.name, total)

    @property
    def tests_by_depth(self):
        """Box and triangle tests of SIMD rays, (levels,) int64, the root first (figure 6)."""
        return self.box_tests_by_depth + self.triangle_tests_by_depth

    @property
    def box_tests(self):
        """All tests of SIMD rays against boxes."""
        return int(self.box_tests_by_depth.sum())

    @property
    def triangle_tests(self):
        """All tests of SIMD rays against triangles."""
        return int(self.triangle_tests_by_depth.sum())

    @property
    def total_tests(self):
        """Box tests and triangle tests."""
        return self.box_tests + self.triangle_tests

    def to_dict(self):
        """Return attributes and sums as plain Python objects."""
        plain = {
            name: value.tolist() if isinstance(value, np.ndarray) else int(value)
            for name, value in asdict(self).items()
        }
        names = ("box_tests", "triangle_tests", "total_tests")
        sums = {name: getattr(self, name) for name in names}
        return {**plain, "tests_by_depth": self.tests_by_depth.tolist(), **sums}


class PacketTracer(HostTracer):
    """Closest and any hits by ray packets: watertight, in float64 the hits of BruteForceTracer.

    Parameters
    ----------
    vertices, faces, first_prims
        As for HostTracer.
    traversal : {"masked", "ranged", "partition"}
    packet_size : {2, 4, 8, 16, 32}
        Rays along a side of a packet; 2 is the single SIMD ray.
    frustum_culling : bool
    simd_width : {4, 16}
        Rays of a SIMD ray; at most those of a packet.
    least_active : int
        The frustum is asked where at least so many SIMD rays are active; 1: always, as in the
        paper.
    precision : {"double", "single"}
        Of the triangle test: watertight.py, or watertight_single.py, whose hits are the device's.

    Raises
    ------
    TypeError, ValueError
        One line that names the array or the option.

    Attributes
    ----------
    triangles : Triangles
    bvh : Bvh
    statistics : PacketStatistics
        Of the last call.
    """

    def __init__(
        self,
        vertices,
        faces,
        first_prims=None,
        *,
        traversal="partition",
        packet_size=16,
        frustum_culling=True,
        simd_width=4,
        least_active=1,
        precision="double",
    ):
        if traversal not in TRAVERSALS:
            names = ", ".join(TRAVERSALS)
            raise ValueError(f"traversal: need one of {names}, got {traversal!r}")
        if packet_size not in PACKET_SIZES:
            raise ValueError(f"packet_size: need one of {PACKET_SIZES}, got {packet_size!r}")
        if simd_width not in SIMD_WIDTHS or simd_width > packet_size**2:
            raise ValueError(f"simd_width: need one of {SIMD_WIDTHS}, got {simd_width!r}")
        if precision not in PRECISIONS:
            names = ", ".join(PRECISIONS)
            raise ValueError(f"precision: need one of {names}, got {precision!r}")
        self.traversal, self.packet_size = traversal, int(packet_size)
        self.simd_width, self.least_active, self.precision = simd_width, least_active, precision
        self.frustum_culling = bool(frustum_culling)
        super().__init__(vertices, faces, first_prims)

    def intersect(self, origins, directions, tnear=0.0, tfar=np.inf, *, size=None, pixels=None):
        """Return the closest Hits.

        Parameters
        ----------
        origins, directions, tnear, tfar
            As for EmbreeTracer.intersect.
        size : (int, int), optional
            Width and height of the screen: rays are grouped by screen tiles; default: in the
            order given, neighbours a SIMD ray.
        pixels : (n,) array_like of int, optional
            With `size`: the pixel, y * width + x, of each ray's ancestral camera ray; default:
            one ray for each pixel in turn. The k-th rays of pixels are grouped with each other.
        """
        rays = float32_rays(origins, directions, tnear, tfar)
        face, t, u, v = self._trace(rays, size, pixels, any_hit=False)
        with np.errstate(over="ignore"):  # a hit beyond float32 is at inf
            return self.triangles.hits(face, t, u, v)

    def occluded(self, origins, directions, tnear=0.0, tfar=1.0, *, size=None, pixels=None):
        """Return whether anything is hit between tnear and tfar, (n,) bool; see `intersect`."""
        rays = float32_rays(origins, directions, tnear, tfar)
        return self._trace(rays, size, pixels, any_hit=True)[0] >= 0

    def _prepare(self, triangles):
        corners = triangles.corners()
        self.bvh = build_bvh(corners)
        self._corners = corners
        self.statistics = PacketStatistics.zero(self.bvh.num_levels, len(corners))

    def _trace(self, rays, size, pixels, any_hit):
        """Return flat face (-1 where missed), t, u, v, and count."""
        num_rays = len(rays[0])
        origins, directions, tnear, tfar = rays
        live = directions.any(axis=1) & (tfar >= tnear)
        sides = self.packet_size, math.isqrt(self.simd_width)
        packets = _Packets.grouped(num_rays, *sides, size, pixels, live)
        result = np.full(num_rays, -1), *np.zeros((3, num_rays))
        self.statistics = PacketStatistics.zero(self.bvh.num_levels, len(self._corners))
        for part in packets.chunks(SIMD_RAYS_PER_CHUNK):
            simd = _SimdRays(part.lanes, *rays, self.bvh, self.precision)
            corner_lanes = None if size is None else part.corner_lanes(*sides)
            walk = TRAVERSALS[self.traversal](self, simd, part, corner_lanes, any_hit)
            if self.bvh.num_nodes:
                walk.run()
            self.statistics.add(walk.counts)
            lanes = part.lanes[simd.live]
            for values, found in zip(result, (simd.face, simd.t, simd.u, simd.v), strict=True):
                values[lanes] = found[simd.live]
        return result


@dataclass
class _Packets:
    """Which rays are a SIMD ray and which SIMD rays are a packet.

    Attributes
    ----------
    lanes : (n, width) int
        Rays, -1 where there is none.
    first, count : (p,) int
        SIMD rays of each packet.
    """

    lanes: np.ndarray
    first: np.ndarray
    count: np.ndarray

    @classmethod
    def grouped(cls, num_rays, packet_size, simd_side, size, pixels, live):
        """Group the rays that are `live`, (num_rays,) bool; see PacketTracer.intersect."""
        width = simd_side * simd_side
        simd_per_packet = packet_size * packet_size // width
        if size is None:
            if pixels is not None:
                raise ValueError("pixels: need size=(width, height), too")
            place, lane = np.divmod(np.arange(num_rays), width)
        else:
            place, lane = _screen_places(num_rays, packet_size, simd_side, size, pixels)
        rays = np.flatnonzero(live)
        used, row = np.unique(place[rays], return_inverse=True)
        lanes = np.full((len(used), width), -1)
        lanes[row, lane[rays]] = rays
        _, first, count = np.unique(used // simd_per_packet, return_index=True, return_counts=True)
        return cls(lanes, first, count)

    def chunks(self, num_simd):
        """Yield packets in turn, at most `num_simd` SIMD rays (or one packet) at a time."""
        start = 0
        ends = self.first + self.count
        while start < len(self.first):
            end = np.searchsorted(ends, self.first[start] + num_simd, side="right")
            end = max(int(end), start + 1)
            base = self.first[start]
            yield _Packets(
                self.lanes[base : ends[end - 1]],
                self.first[start:end] - base,
                self.count[start:end],
            )
            start = end

    def corner_lanes(self, packet_size, simd_side):
        """Return the corner rays of packets, around the screen tile, as (p, 4) rows of lanes.

        Rows count as in lanes.reshape(-1); -1 for packets with a SIMD ray missing.
        """
        side, width = packet_size // simd_side, simd_side * simd_side
        simd = np.array([0, side - 1, side * side - 1, side * (side - 1)])
        lanes = np.array([0, simd_side - 1, width - 1, width - simd_side])
        whole = (self.count == side * side)[:, None]
        return np.where(whole, width * (self.first[:, None] + simd) + lanes, -1)


def _screen_places(num_rays, packet_size, simd_side, size, pixels):
    """Return each ray's SIMD ray (numbered by layer, tile, place in it) and lane."""
    width, height = size
    if pixels is None:
        if num_rays != width * height:
            raise ValueError(f"size: {width} x {height} pixels but {num_rays} rays")
        pixels = np.arange(num_rays)
    pixels = np.asarray(pixels)
    if pixels.shape != (num_rays,) or not np.issubdtype(pixels.dtype, np.integer):
        raise ValueError(f"pixels: need {num_rays} integers, got {pixels.dtype} {pixels.shape}")
    if num_rays and not (pixels.min() >= 0 and pixels.max() < width * height):
        raise ValueError(f"pixels: need values from 0 to {width * height - 1}")
    y, x = np.divmod(pixels.astype(np.int64), width)
    side = packet_size // simd_side
    tiles = -(-width // packet_size), -(-height // packet_size)
    tile = (_layers(pixels) * tiles[1] + y // packet_size) * tiles[0] + x // packet_size
    row, column = y % packet_size // simd_side, x % packet_size // simd_side
    lane = simd_side * (y % simd_side) + x % simd_side
    return (tile * side + row) * side + column, lane


def _layers(pixels):
    """Return how many rays before each have the same pixel."""
    order = np.argsort(pixels, kind="stable")
    _, counts = np.unique(pixels, return_counts=True)
    layers = np.empty(len(pixels), np.int64)
    layers[order] = ranges(counts)[1]
    return layers


class _SimdRays:
    """Rays by SIMD ray and lane, (n, width), and the closest hit of each so far."""

    def __init__(self, lanes, origins, directions, tnear, tfar, bvh, precision):
        self.live = lanes >= 0
        self.bvh, self.precision = bvh, precision
        self.origins, self.directions, self.tnear, self.tfar = (
            values[lanes] for values in (origins, directions, tnear, tfar)
        )
        self.directions[~self.live] = 1
        self.t, self.u, self.v = np.zeros((3, *lanes.shape))
        self.face = np.full(lanes.shape, -1)
        with np.errstate(over="ignore", divide="ignore", under="ignore"):
            self._set_up(bvh)

    def _set_up(self, bvh):
        size = max(np.abs(bvh.low).max(initial=0), np.abs(bvh.high).max(initial=0))
        pad = BOX_PAD * (np.float32(size) + np.abs(self.origins).max(axis=2, initial=0))
        pad += SMALLEST_PAD
        self._above = np.moveaxis(self.origins + pad[..., None], 2, 0).copy()
        self._below = np.moveaxis(self.origins - pad[..., None], 2, 0).copy()
        self._largest = np.abs(self.directions).max(axis=2, initial=0)
        self.units = self.directions / self._largest[..., None]
        inverse = np.float32(1) / self.units
        inverse = np.clip(inverse, -LARGEST_INVERSE, LARGEST_INVERSE)
        self._inverse = np.moveaxis(inverse, 2, 0).copy()
        self._enter = self.tnear * self._largest
        # Up to where a box counts: the closest hit.
        self.leave = np.where(self.live, self.tfar * self._largest, np.float32(-np.inf))
        self._low, self._high = bvh.low.T.copy(), bvh.high.T.copy()

    def meet(self, simd, cells):
        """Return which lanes of SIMD rays overlap the boxes of cells, (k, width) bool."""
        entry, leave = self._enter[simd], self.leave[simd]
        with np.errstate(over="ignore", under="ignore"):
            for axis in range(3):
                inverse = self._inverse[axis][simd]
                low = (self._low[axis][cells][:, None] - self._above[axis][simd]) * inverse
                high = (self._high[axis][cells][:, None] - self._below[axis][simd]) * inverse
                np.maximum(entry, np.minimum(low, high), out=entry)
                np.minimum(leave, np.maximum(low, high), out=leave)
        return entry <= leave

    def _hits(self, simd, lane, corners):
        """Return hit, t, u, v of pairs of (ray, triangle), within the rays' segments."""
        origins, directions = self.origins[simd, lane], self.directions[simd, lane]
        tnear, tfar = self.tnear[simd, lane], self.tfar[simd, lane]
        if self.precision == "single":
            return watertight_single.intersect_pairs(origins, directions, corners, tnear, tfar)
        hit, t, u, v = intersect_pairs(
            *(values.astype(np.float64) for values in (origins, directions, corners))
        )
        return hit & (t >= tnear) & (t <= tfar), t, u, v

    def intersect(self, simd, lane, face, corners, any_hit):
        """Test rays against triangles; keep the closest hits, of equal ones the smaller face.

        Parameters
        ----------
        simd, lane, face : (k,) int
            Pairs of (ray, triangle); a ray may stand in many.
        corners : (m, 3, 3) float32
        any_hit : bool
            Rays that hit overlap no box any more.
        """
        hit, t, u, v = self._hits(simd, lane, corners[face])
        rows = np.flatnonzero(hit)
        with np.errstate(over="ignore", under="ignore"):  # a hit beyond float32 is at inf
            rounded = t[rows].astype(np.float32)
        ray = self.live.shape[1] * simd[rows] + lane[rows]
        order = np.lexsort((face[rows], rounded, ray))
        ray, first = np.unique(ray[order], return_index=True)
        best = order[first]
        rows, rounded = rows[best], rounded[best]
        simd, lane, face = simd[rows], lane[rows], face[rows]
        old_face = self.face[simd, lane]
        with np.errstate(over="ignore", under="ignore"):
            old = self.t[simd, lane].astype(np.float32)
        closer = (old_face < 0) | (rounded < old) | ((rounded == old) & (face < old_face))
        rows, simd, lane = rows[closer], simd[closer], lane[closer]
        self.face[simd, lane] = face[closer]
        self.t[simd, lane], self.u[simd, lane], self.v[simd, lane] = t[rows], u[rows], v[rows]
        with np.errstate(over="ignore", under="ignore"):
            # The next number: distances may be so small that they round to 0.
            above = np.nextafter(rounded[closer], np.float32(np.inf))
            leave = above * self._largest[simd, lane]
        self.leave[simd, lane] = -np.inf if any_hit else leave


class _Traversal:
    """The loop that the three traversals share; `enter` and `leaf_rays` are theirs.

    `state` is the integer that the paper calls ia: of each packet, on its stack, too.
    """

    def __init__(self, tracer, simd, packets, corner_lanes, any_hit):
        bvh = self.bvh = tracer.bvh
        self.corners, self.least_active = tracer._corners, tracer.least_active
        self.simd, self.any_hit = simd, any_hit
        self.first, self.size = packets.first, packets.count
        num_packets = len(self.first)
        self.state = np.zeros(num_packets, np.int64)
        self.cell = np.zeros(num_packets, np.int64)
        self.stack = np.zeros((num_packets, max(bvh.num_levels, 1), 2), np.int64)
        self.stack_size = np.zeros(num_packets, np.int64)
        rays = PacketRays(simd.origins, simd.units, simd.live, self.first)
        self.direction = rays.direction()
        self.frusta = None
        if tracer.frustum_culling and bvh.num_nodes:
            box = bvh.low[0], bvh.high[0]
            self.frusta = bound_packets(rays, self.direction, corner_lanes, *box)
        self.counts = PacketStatistics.zero(bvh.num_levels)
        self.counts.rays, self.counts.simd_rays = int(simd.live.sum()), len(simd.live)
        self.counts.packets = num_packets

    def run(self):
        """Take all packets through the tree."""
        running = np.arange(len(self.first))
        while len(running):
            cells = self.cell[running]
            self._count("visits", cells, 1)
            reached = self.enter(running, cells)
            inner = self.bvh.left[cells] >= 0
            leaf, down = reached & ~inner, reached & inner
            if leaf.any():
                self._leaves(running[leaf], cells[leaf])
            self._descend(running[down], cells[down])
            self._pop(running[~down])
            running = running[self.cell[running] >= 0]
        self.counts.hits = int((self.simd.face >= 0).sum())

    def enter(self, packets, cells):
        """Return which packets may have a ray alive in their cells, (k,) bool; update `state`."""
        raise NotImplementedError

    def leaf_rays(self, packets, cells):
        """Return the active SIMD rays at leaves as (row, place in the packet), rows rising."""
        raise NotImplementedError

    def frustum_meets(self, packets, cells, active):
        """Return which packets, with so many active rays, may overlap their cells' boxes."""
        met = np.ones(len(packets), bool)
        rows = self._asked(packets, active)
        packets, cells = packets[rows], cells[rows]
        self._count("frustum_box_tests", cells, 1)
        if len(rows):
            boxes = self.bvh.low[cells], self.bvh.high[cells]
            met[rows] = ~self.frusta.cull_boxes(packets, *boxes)
        self._count("frustum_box_culls", cells, ~met[rows])
        return met

    def _asked(self, packets, active):
        """Return the rows of packets whose frusta are asked."""
        if self.frusta is None:
            return np.zeros(0, int)
        return np.flatnonzero(self.frusta.valid[packets] & (active >= self.least_active))

    def test(self, packets, places, cells):
        """Return which SIMD rays, by their places in packets, overlap the cells' boxes."""
        return self.simd.meet(self.first[packets] + places, cells).any(axis=1)

    def search(self, packets, cells, start, step, count):
        """Test places start, start + step, ... (`count` of them) until one overlaps its cell.

        Returns
        -------
        (k,) int
            The number of places before it; `count` where none overlaps.
        """
        done, found = np.zeros_like(count), count.copy()
        open_rows, block = np.flatnonzero(count > 0), 1
        while len(open_rows):
            length = np.minimum(count[open_rows] - done[open_rows], block)
            row, k = ranges(length)
            rows = open_rows[row]
            k += done[rows]
            hit = self.test(packets[rows], start[rows] + step * k, cells[rows])
            hit_rows, at = np.unique(rows[hit], return_index=True)
            found[hit_rows] = k[hit][at]
            done[open_rows] += length
            missed = found[open_rows] == count[open_rows]
            open_rows = open_rows[missed & (done[open_rows] < count[open_rows])]
            block *= 4  # the more have missed the more are tested at once, whatever counts
        self._count("box_tests", cells, np.minimum(found + 1, count))
        self._count("box_hits", cells, found < count)
        return found

    def _leaves(self, packets, cells):
        """Test the active SIMD rays of packets against the triangles of their leaves."""
        row, place = self.leaf_rays(packets, cells)
        simd = self.first[packets][row] + place
        lanes = self.simd.meet(simd, cells[row])  # of rays that miss the box no triangle is hit
        active = np.bincount(row, minlength=len(packets))
        self._count("leaves", cells, 1)
        self._count("active", cells, active)
        self._count("alive", cells[row], lanes.any(axis=1))
        faces, num_faces = self._leaf_triangles(packets, cells, active)
        self._count("triangle_tests", cells, num_faces * active)
        first_face = np.cumsum(num_faces) - num_faces
        ray, lane = np.nonzero(lanes)
        pairs_of_ray = num_faces[row[ray]]
        for part in _portions(pairs_of_ray, PAIRS_PER_CHUNK):
            pair, k = ranges(pairs_of_ray[part])
            pair += part.start
            face = faces[first_face[row[ray[pair]]] + k]
            self.simd.intersect(simd[ray[pair]], lane[pair], face, self.corners, self.any_hit)
        if self.any_hit:
            self._stop_blocked(packets)

    def _leaf_triangles(self, packets, cells, active):
        """Return the triangles that the frusta leave, leaf by leaf, and their number in each."""
        row, place = ranges(self.bvh.count[cells])
        faces = self.bvh.order[self.bvh.first[cells][row] + place]
        asked = self._asked(packets[row], active[row])
        self._count("frustum_triangle_tests", cells[row[asked]], 1)
        if len(asked):
            culled = np.zeros(len(row), bool)
            culled[asked] = self.frusta.cull_triangles(
                packets[row[asked]], self.corners[faces[asked]]
            )
            self._count("frustum_triangle_culls", cells[row], culled)
            row, faces = row[~culled], faces[~culled]
        return faces, np.bincount(row, minlength=len(packets))

    def _stop_blocked(self, packets):
        """Empty the stacks of packets all of whose rays are blocked."""
        row, place = ranges(self.size[packets])
        open_rays = (self.simd.leave[self.first[packets][row] + place] >= 0).any(axis=1)
        open_packets = np.bincount(row, open_rays, minlength=len(packets)) > 0
        self.stack_size[packets[~open_packets]] = 0

    def _descend(self, packets, cells):
        """Go on with the near child and push the far one with the state."""
        left, axis = self.bvh.left[cells], self.bvh.axis[cells]
        backward = self.direction[packets, axis] < 0
        top = self.stack_size[packets]
        self.stack[packets, top, 0] = left + ~backward
        self.stack[packets, top, 1] = self.state[packets]
        self.stack_size[packets] += 1
        self.cell[packets] = left + backward

    def _pop(self, packets):
        """Go on with what was pushed last; the cell is -1 where the stack is empty."""
        empty = self.stack_size[packets] == 0
        self.cell[packets[empty]] = -1
        packets = packets[~empty]
        self.stack_size[packets] -= 1
        self.cell[packets], self.state[packets] = self.stack[packets, self.stack_size[packets]].T

    def _count(self, name, cells, amounts):
        """Add amounts (a number, or one per cell) at the depths of cells."""
        amounts = np.broadcast_to(np.asarray(amounts, np.int64), cells.shape)
        np.add.at(getattr(self.counts, name + "_by_depth"), self.bvh.depth[cells], amounts)


class MaskedTraversal(_Traversal):
    """Section 3.1, figure 2: all rays go on together; a mask at the leaves."""

    def enter(self, packets, cells):
        """As the base class says; lines 7 to 13."""
        reached = self.frustum_meets(packets, cells, self.size[packets])
        inner = self.bvh.left[cells] >= 0
        rows = np.flatnonzero(reached & inner)
        size = self.size[packets[rows]]
        reached[rows] = self.search(packets[rows], cells[rows], 0 * size, 1, size) < size
        rows = np.flatnonzero(reached & ~inner)
        row, place = ranges(self.size[packets[rows]])
        alive = self.test(packets[rows][row], place, cells[rows][row])
        self._count("box_tests", cells[rows], self.size[packets[rows]])
        self._count("box_hits", cells[rows[row]], alive)
        reached[rows] = np.bincount(row, alive, minlength=len(rows)) > 0
        self._mask = row[alive], place[alive]
        return reached

    def leaf_rays(self, packets, cells):
        """As the base class says: rayMasks, lines 25 and 26."""
        row, place = self._mask
        return np.unique(row, return_inverse=True)[1], place


class RangedTraversal(_Traversal):
    """Section 3.2, appendix A.1: the rays from the first alive one on are active."""

    def enter(self, packets, cells):
        """As the base class says: getFirstHit."""
        start = self.state[packets]
        found = start.copy()
        hit = self.test(packets, start, cells)
        missed = np.flatnonzero(~hit)
        self._count("box_tests", cells, 1)
        self._count("box_hits", cells, hit)
        found[missed] = self.size[packets[missed]]
        active = self.size[packets] - start
        rest = missed[self.frustum_meets(packets[missed], cells[missed], active[missed])]
        count = active[rest] - 1
        found[rest] = start[rest] + 1
        found[rest] += self.search(packets[rest], cells[rest], start[rest] + 1, 1, count)
        self.state[packets] = found
        return found < self.size[packets]

    def leaf_rays(self, packets, cells):
        """As the base class says: from ia to getLastHit."""
        start, size = self.state[packets], self.size[packets]
        end = size - self.search(packets, cells, size - 1, -1, size - 1 - start)
        row, step = ranges(end - start)
        return row, start[row] + step


class PartitionTraversal(_Traversal):
    """Section 3.3, appendix A.2: I holds the places of SIMD rays, the alive ones in front."""

    def __init__(self, *arguments):
        super().__init__(*arguments)
        self.indices = np.tile(np.arange(self.size.max(initial=0)), (len(self.size), 1))
        self.state[:] = self.size

    def enter(self, packets, cells):
        """As the base class says: partRays."""
        old = self.state[packets]
        old = np.where(self.frustum_meets(packets, cells, old), old, 0)
        row, i = ranges(old)
        places = self.indices[packets[row], i]
        alive = self.test(packets[row], places, cells[row])
        self._count("box_tests", cells, old)
        self._count("box_hits", cells[row], alive)
        new = np.bincount(row, alive, minlength=len(packets)).astype(np.int64)
        alive_before = np.cumsum(alive) - alive
        alive_before -= alive_before[(np.cumsum(old) - old)[row]] if len(row) else 0
        goal = np.where(alive, alive_before, new[row] + i - alive_before)
        self.indices[packets[row], goal] = places
        self.state[packets] = new
        return new > 0

    def leaf_rays(self, packets, cells):
        """As the base class says: the places I[0] to I[ia - 1]."""
        row, i = ranges(self.state[packets])
        return row, self.indices[packets[row], i]


TRAVERSALS = {
    "masked": MaskedTraversal,
    "ranged": RangedTraversal,
    "partition": PartitionTraversal,
}


def _portions(counts, most):
    """Yield slices of `counts` whose sums are at most `most` (or that hold one)."""
    ends = np.cumsum(counts)
    start, done = 0, 0
    while start < len(counts):
        end = max(int(np.searchsorted(ends, done + most, side="right")), start + 1)
        yield slice(start, end)
        start, done = end, ends[end - 1]


@dataclass
class PacketFrame:
    """An image and what its rays cost.

    Attributes
    ----------
    image : (height, width, 3) float32
        Linear RGB, top row first.
    kinds : dict of str to PacketStatistics
        Of "primary", "shadow", "reflection" and "refraction" rays.
    """

    image: np.ndarray
    kinds: dict


def render_packets(
    scene, camera, size=(512, 512), max_bounces=2, shadows=True, tracer=None, primary="ranged"
):
    """Render a scene by packets, the shading that of render_reference.

    Rays are followed depth first: those reflected by the hits of one set of packets are the next
    set, those refracted another. So packets hold rays of one kind and history, grouped by the
    screen position of their ancestral camera rays (section 2.4). Only points that a light would
    reach and that would show it send shadow rays.

    Parameters
    ----------
    scene, camera, size, max_bounces, shadows
        As for render_reference.
    tracer : PacketTracer, optional
        Default: 16 x 16 packets, partition traversal and frusta.
    primary : {"masked", "ranged", "partition"}
        Traversal of the camera rays; section 6 takes Ranged.

    Returns
    -------
    PacketFrame

    Raises
    ------
    ValueError
        A size below 1, a negative number of bounces, an unknown traversal.
    """
    if min(size) < 1 or max_bounces < 0:
        raise ValueError("render_packets: need size >= 1 and max_bounces >= 0")
    if primary not in TRAVERSALS:
        raise ValueError(f"primary: need one of {', '.join(TRAVERSALS)}, got {primary!r}")
    tracer = PacketTracer.from_scene(scene) if tracer is None else tracer
    renderer = _Renderer(scene, tracer, primary, size, shadows)
    rays = primary_rays(camera, size, np.array([0.5, 0.5]))
    renderer.trace("primary", rays, max_bounces)
    width, height = size
    image = renderer.radiance.astype(np.float32).reshape(height, width, 3)
    return PacketFrame(image, renderer.kinds)


class _Renderer:
    """The recursion of `render_packets`, its image and its counts."""

    def __init__(self, scene, tracer, primary, size, shadows):
        self.scene, self.size, self.shadows = scene, size, shadows
        self.offset = ray_offset(scene.bounds)
        self.radiance = np.zeros((size[0] * size[1], 3))
        self.secondary = copy.copy(tracer)  # the statistics of the caller's tracer stay
        self.primary = copy.copy(tracer)
        self.primary.traversal = primary
        zero = tracer.bvh.num_levels, len(tracer.bvh.order)
        names = ("primary", "shadow", "reflection", "refraction")
        self.kinds = {name: PacketStatistics.zero(*zero) for name in names}

    def trace(self, kind, rays, bounces_left):
        """Add what rays see, at most one for each pixel and in the order of pixels."""
        tracer = self.primary if kind == "primary" else self.secondary
        hits = tracer.intersect(
            rays.origins.astype(np.float32),
            rays.directions.astype(np.float32),
            size=self.size,
            pixels=rays.pixels,
        )
        self.kinds[kind].add(tracer.statistics)
        hit = hits.prim_id >= 0
        missed = rays[~hit]
        self._add(missed, np.asarray(self.scene.background, np.float64))
        rays = rays[hit]
        if not len(rays.pixels):
            return
        directions = normalised(rays.directions)
        points = surface_points(self.scene, select_hits(hits, hit), directions)
        self._add(rays, self._shade(points, directions, rays.pixels))
        if not bounces_left:
            return
        rest = secondary_rays(rays.weights, rays.pixels, points, directions, self.offset)
        parent = np.searchsorted(rays.pixels, rest.pixels)
        from_surface = rest.origins - points.position[parent]
        outside = dot(from_surface, points.face_normal[parent])[:, 0] > 0
        for name, rows in (("reflection", outside), ("refraction", ~outside)):
            if rows.any():
                self.trace(name, rest[rows], bounces_left - 1)

    def _add(self, rays, colours):
        self.radiance[rays.pixels] += rays.weights * colours

    def _shade(self, points, directions, pixels):
        """Return the radiance (n, 3) that leaves the points; see reference.py."""
        if not self.shadows:
            return shade(self.scene, points, directions, self.offset, None)
        colour = shade(_Unlit(self.scene), points, directions, self.offset, None)
        for light in self.scene.lights:
            lit = direct_light(light, points, directions, self.offset, None).any(axis=1)
            seen = SurfacePoints(*(getattr(points, field.name)[lit] for field in fields(points)))
            grouped = _ShadowTracer(self.secondary, self.size, pixels[lit], self.kinds["shadow"])
            colour[lit] += direct_light(light, seen, directions[lit], self.offset, grouped)
        return colour


class _Unlit:
    """A scene without its lights."""

    lights = ()

    def __init__(self, scene):
        self.ambient = scene.ambient


@dataclass
class _ShadowTracer:
    """Answers `occluded` of one light, one ray for each of the pixels; counts."""

    tracer: PacketTracer
    size: tuple
    pixels: np.ndarray
    counts: PacketStatistics

    def occluded(self, origins, directions, tnear, tfar):
        """Return whether rays are blocked, (n,) bool."""
        blocked = self.tracer.occluded(
            origins, directions, tnear, tfar, size=self.size, pixels=self.pixels
        )
        self.counts.add(self.tracer.statistics)
        return blocked
