"""Frusta around ray packets: section 4 of Overbeck, Ramamoorthi and Mark (2008).

A frustum is four corner rays and the four planes between them. It culls a box or a triangle that
no ray of its packet can meet:

* by planes (equation 1): all vertices lie outside of one plane;
* by corner rays: all of them miss a triangle outside of one edge, or a box by the same pair of
  slabs, or have left the same slab before they start.

Frusta of section 4.1, corners of the screen tile, are used for packets that share an origin and
lie inside their corner rays; the planes are tilted outwards by what rounding has moved the rays.
All others are made of a near and a far plane (section 4.3). The point light's frustum (section
4.2) is that construction with all origins in one point: then the near rectangle is that point.
A packet whose rays do not all advance along its dominant axis, or hardly, has no frustum.

Why four corner rays suffice though the rays of a packet do not meet in a point: at each k between
the planes the rays lie in the rectangle of the corner rays. Let all four pierce a triangle's plane
from the same side and outside of one edge. The plane cuts that rectangle in a segment, whose ends
lie on sides between a corner that has pierced the plane and one that has yet to; the frustum's
side there is a plane, too, so the end lies on the line, and between the points, where these two
pierce. All four points are outside of the edge, so the ends are, and so is all between. Slabs
likewise: the bounds of u and v rise and fall with k as the corner rays do.

What differs from the paper:

* A plane is made from the bounding (u, v) lines, not from the cross product of equation 2, which
  is zero for the parallel corner rays of parallel light.
* The far plane is at least FAR of the scene's size beyond the near one, so that quotients keep
  their digits.

All in float64. A frustum is wider than its rays by PAD of the coordinates (more than the boxes of
packet.py are widened), so that it never culls what a test of one of its rays would meet.
"""

from dataclasses import dataclass

import numpy as np

PAD = 1e-10
FAR = 1e-3
# By how much rays may lie outside of their corner rays: some roundings of float32.
CORNER_TILT = 1e-5
# Frusta wider than this, in sizes of scene and origins, cull nothing and are not made.
WIDEST = 1e6
# u, v and dominant axis: a cyclic order, so that orientation is kept.
_CYCLE = np.array([1, 2, 0])
# Corners of a rectangle, around it: which end of the u interval, which of the v interval.
_U_END, _V_END = np.array([0, 1, 1, 0]), np.array([0, 0, 1, 1])


@dataclass
class Frusta:
    """One frustum for each of p packets; all arrays float64.

    Attributes
    ----------
    valid : (p,) bool
        Whether there is one; the rest is meaningless where not.
    shared : (p,) bool
        Whether all rays of the packet start in one point.
    primary : (p,) bool
        Whether it is made of the tile's corner rays.
    normals : (p, 4, 3)
        Outward, of any length.
    offsets : (p, 4)
        A point x is outside of a plane where normal . x - offset > 0.
    origins, directions : (p, 4, 3)
        Corner rays, around the frustum.
    size : (p,)
        Largest |coordinate| that the frustum is made from and used with.
    """

    valid: np.ndarray
    shared: np.ndarray
    primary: np.ndarray
    normals: np.ndarray
    offsets: np.ndarray
    origins: np.ndarray
    directions: np.ndarray
    size: np.ndarray

    def cull_boxes(self, packets, low, high, planes=True, corner_rays=True):
        """Return which boxes no ray of their packet can meet.

        Parameters
        ----------
        packets : (k,) int
        low, high : (k, 3) float
        planes, corner_rays : bool
            Which of the two ways to use.

        Returns
        -------
        (k,) bool
            False for packets without a frustum.
        """
        pad = (PAD * self.size[packets])[:, None]
        low, high = low - pad, high + pad
        culled = np.zeros(len(packets), bool)
        if planes:
            culled |= self._planes_cull_boxes(packets, low, high)
        if corner_rays:
            culled |= self._by_corner_rays(_rays_cull_boxes, packets, culled, low, high)
        return culled

    def cull_triangles(self, packets, corners, planes=True, corner_rays=True):
        """Return which triangles, (k, 3, 3), no ray of their packet can meet; see cull_boxes."""
        culled = np.zeros(len(packets), bool)
        if planes:
            culled |= self._planes_cull_triangles(packets, corners)
        if corner_rays:
            pad = PAD * self.size[packets] ** 2
            culled |= self._by_corner_rays(_rays_cull_triangles, packets, culled, corners, pad)
        return culled

    def _planes_cull_boxes(self, packets, low, high):
        normals, offsets = self.normals[packets], self.offsets[packets]
        # The box's vertex that lies least outside has the smallest product along each axis.
        least = np.minimum(normals * low[:, None], normals * high[:, None]).sum(axis=2)
        return self.valid[packets] & (least - offsets > self._plane_pads(packets)).any(axis=1)

    def _planes_cull_triangles(self, packets, corners):
        heights = np.einsum("kic,kjc->kij", self.normals[packets], corners)
        outside = heights.min(axis=2) - self.offsets[packets] > self._plane_pads(packets)
        return self.valid[packets] & outside.any(axis=1)

    def _plane_pads(self, packets):
        lengths = np.abs(self.normals[packets]).sum(axis=2)
        return PAD * self.size[packets, None] * lengths

    def _by_corner_rays(self, test, packets, culled, *arguments):
        """Return `test` of the corner rays for what is not culled yet."""
        rows = np.flatnonzero(self.valid[packets] & ~culled)
        result = np.zeros(len(packets), bool)
        chosen = packets[rows]
        arguments = (argument[rows] for argument in arguments)
        result[rows] = test(self.origins[chosen], self.directions[chosen], *arguments)
        return result


def _rays_cull_boxes(origins, directions, low, high):
    """Return which boxes (k, 3) all corner rays (k, 4, 3) miss in the same way.

    A ray that rises along axis a leaves the slab of a at high[a], one that falls at low[a]. It
    misses the box if it leaves one slab before it enters another, or before it starts.
    """
    rising = (directions > 0).all(axis=1)
    sign = np.where(rising, 1.0, -1.0)
    steady = rising | (directions < 0).all(axis=1)
    leave = np.where(rising, high, low)[:, None] - origins
    enter = np.where(rising, low, high)[:, None] - origins
    missed = (steady & (sign[:, None] * leave < 0).all(axis=1)).any(axis=1)
    for a in range(3):
        for b in {0, 1, 2} - {a}:
            # leave_a / d_a < enter_b / d_b, times d_a d_b, which is not 0
            left = leave[..., a] * directions[..., b]
            right = enter[..., b] * directions[..., a]
            slack = PAD * (np.abs(left) + np.abs(right))
            before = (sign[:, a] * sign[:, b])[:, None] * (right - left) > slack
            missed |= steady[:, a] & steady[:, b] & before.all(axis=1)
    return missed


def _rays_cull_triangles(origins, directions, corners, pad):
    """Return which triangles (k, 3, 3) all corner rays (k, 4, 3) pass outside of one edge.

    `pad` times the length of the direction is the rounding allowed for.
    """
    relative = corners[:, None] - origins[:, :, None]
    moments = np.cross(relative, np.roll(relative, -1, axis=2))
    sides = np.einsum("kmec,kmc->kme", moments, directions)
    slack = pad[:, None] * np.abs(directions).sum(axis=2)
    facing = sides.sum(axis=2)
    culled = np.zeros(len(corners), bool)
    for sign in (1, -1):
        faced = (sign * facing > slack).all(axis=1)
        outside = (sign * sides < -slack[..., None]).all(axis=1).any(axis=1)
        culled |= faced & outside
    return culled


def bound_packets(origins, directions, live, first, corner_lanes, scene_low, scene_high):
    """Make the frusta of packets.

    Parameters
    ----------
    origins, directions : (n, 4, 3) float64
        SIMD rays, those of a packet side by side.
    live : (n, 4) bool
        Lanes that hold a ray; every packet has one.
    first : (p,) int
        First SIMD ray of each packet.
    corner_lanes : (p, 4) int or None
        Rows of origins.reshape(-1, 3) around the screen tile; -1 where a corner is missing.
    scene_low, scene_high : (3,) float

    Returns
    -------
    Frusta
    """
    origins, directions = origins.reshape(-1, 3), directions.reshape(-1, 3)
    lanes = np.flatnonzero(live)
    packet = np.repeat(np.arange(len(first)), np.diff(np.append(first, len(live))))[lanes // 4]
    rays = _Rays(origins[lanes], directions[lanes], packet, len(first))
    scene = np.array([scene_low, scene_high], np.float64)
    frusta = near_far_frusta(rays, scene)
    if corner_lanes is not None:
        asked = np.flatnonzero((corner_lanes >= 0).all(axis=1) & frusta.shared)
        asked = asked[live.reshape(-1)[corner_lanes[asked]].all(axis=1)]
        _use_corner_rays(frusta, rays, asked, directions[corner_lanes[asked]], scene)
    return frusta


class _Rays:
    """Rays (n, 3) in order of their packets, and reductions over each packet."""

    def __init__(self, origins, directions, packet, num_packets):
        self.origins, self.directions, self.packet = origins, directions, packet
        self._starts = np.searchsorted(packet, np.arange(num_packets))

    def least(self, values):
        """Return the minima by packet."""
        return np.minimum.reduceat(values, self._starts)

    def most(self, values):
        """Return the maxima by packet."""
        return np.maximum.reduceat(values, self._starts)

    def sum(self, values):
        """Return the sums by packet."""
        return np.add.reduceat(values, self._starts)


def near_far_frusta(rays, scene):
    """Return frusta by a near and a far plane (section 4.3; for one origin, section 4.2).

    The dominant axis k is that of the largest component of the summed directions, taken so that
    the sum is positive. The near plane goes through the smallest k of the origins.
    """
    total = rays.sum(rays.directions)
    axis = np.argmax(np.abs(total), axis=1)
    order = (axis[:, None] + _CYCLE) % 3  # u, v, k
    sign = np.where(np.take_along_axis(total, order[:, 2:], axis=1)[:, 0] < 0, -1.0, 1.0)
    flip = np.stack([np.ones_like(sign), np.ones_like(sign), sign], axis=1)
    ray_order, ray_flip = order[rays.packet], flip[rays.packet]
    o = np.take_along_axis(rays.origins, ray_order, axis=1) * ray_flip
    d = np.take_along_axis(rays.directions, ray_order, axis=1) * ray_flip
    size = np.maximum(np.abs(scene).max(), rays.most(np.abs(rays.origins).max(axis=1)))
    near = rays.least(o[:, 2])
    scene_far = (scene[:, order[:, 2]] * sign).max(axis=0)
    far = np.maximum(scene_far, near + np.where(size > 0, FAR * size, 1.0))
    advancing = d[:, 2] > 0
    slopes = d[:, :2] / np.where(advancing, d[:, 2], 1.0)[:, None]
    bounds = np.empty((2, 2, len(near), 2))  # near and far, least and most, packet, u and v
    for k, plane in enumerate((near, far)):
        place = o[:, :2] + slopes * (plane[rays.packet] - o[:, 2])[:, None]
        bounds[k] = rays.least(place), rays.most(place)
    same = (rays.least(rays.origins) == rays.most(rays.origins)).all(axis=1)
    normals, offsets = _side_planes(bounds, near, far)
    starts, ends = (_rectangle(bounds[k], plane) for k, plane in enumerate((near, far)))
    inverse = np.broadcast_to(np.argsort(order, axis=1)[:, None], normals.shape)
    normals, starts, ends = (
        np.take_along_axis(values * flip[:, None], inverse, axis=2)
        for values in (normals, starts, ends)
    )
    width = np.abs(bounds).max(axis=(0, 1, 3))
    return Frusta(
        valid=(rays.least(advancing.astype(np.int8)) > 0) & (width <= WIDEST * size),
        shared=same,
        primary=np.zeros(len(near), bool),
        normals=normals,
        offsets=offsets,
        origins=starts,
        directions=ends - starts,
        size=np.maximum(size, width),
    )


def _side_planes(bounds, near, far):
    """Return normals (p, 4, 3) in (u, v, k) and offsets (p, 4).

    The plane of the least u holds the line from (u_near, near) to (u_far, far) and the v axis:
    outside is u_near + s (k - near) - u > 0 with the slope s; of the most u, the opposite.
    """
    slopes = (bounds[1] - bounds[0]) / (far - near)[:, None]
    normals = np.zeros((len(near), 4, 3))
    offsets = np.empty((len(near), 4))
    for end, outward in ((0, -1.0), (1, 1.0)):
        for axis in range(2):
            plane = 2 * end + axis
            normals[:, plane, axis] = outward
            normals[:, plane, 2] = -outward * slopes[end, :, axis]
            offsets[:, plane] = outward * (bounds[0, end, :, axis] - slopes[end, :, axis] * near)
    return normals, offsets


def _rectangle(bounds, plane):
    """Return the corners, (p, 4, 3) in (u, v, k), around a rectangle."""
    return np.stack(
        [bounds[_U_END, :, 0].T, bounds[_V_END, :, 1].T, np.tile(plane[:, None], 4)], axis=2
    )


def _use_corner_rays(frusta, rays, asked, corners, scene):
    """Replace the frusta of the packets `asked` by those of their corner rays (section 4.1).

    Parameters
    ----------
    frusta : Frusta
    rays : _Rays
    asked : (q,) int
        Packets that share an origin.
    corners : (q, 4, 3) float64
        Directions of the corner rays, around the tile.
    scene : (2, 3) float64
    """
    if not len(asked):
        return
    normals = np.cross(corners, np.roll(corners, -1, axis=1))  # equation 2
    lengths = np.linalg.norm(normals, axis=2, keepdims=True)
    axes = corners.sum(axis=1)
    axes /= np.maximum(np.linalg.norm(axes, axis=1, keepdims=True), np.finfo(float).tiny)
    inward = np.einsum("qic,qc->qi", normals, axes)
    proper = (lengths[..., 0] > 0).all(axis=1) & (inward != 0).all(axis=1)
    proper &= (inward > 0).all(axis=1) | (inward < 0).all(axis=1)
    normals = normals / np.where(lengths > 0, lengths, 1.0) * -np.sign(inward)[..., None]
    row = np.full(len(frusta.valid), -1)
    row[asked] = np.arange(len(asked))
    row = row[rays.packet]
    mine = np.flatnonzero(row >= 0)
    row, directions = row[mine], rays.directions[mine]
    starts = np.searchsorted(row, np.arange(len(asked)))
    along = np.einsum("nc,nc->n", axes[row], directions)
    proper &= np.minimum.reduceat(along, starts) > 0
    outside = np.einsum("nic,nc->ni", normals[row], directions)
    tilt = np.maximum.reduceat(outside / np.where(along > 0, along, 1.0)[:, None], starts)
    tilt = np.maximum(tilt, 0) + PAD
    proper &= (tilt < CORNER_TILT).all(axis=1)
    normals = normals - tilt[..., None] * axes[:, None]
    edges = np.cross(np.roll(normals, 1, axis=1), normals)
    edges *= np.sign(np.einsum("qic,qc->qi", edges, axes))[..., None]
    # A cone of four planes has their intersections as its edges only if it holds all of these.
    held = np.einsum("qic,qjc->qij", normals, edges) <= PAD * np.abs(edges).sum(axis=2)[:, None]
    proper &= held.all(axis=(1, 2)) & edges.any(axis=2).all(axis=1)
    chosen = asked[proper]
    frusta.valid[chosen] = frusta.primary[chosen] = True
    frusta.normals[chosen] = normals[proper]
    apexes = rays.least(rays.origins)[chosen]
    frusta.offsets[chosen] = np.einsum("qic,qc->qi", normals[proper], apexes)
    frusta.origins[chosen] = apexes[:, None]
    frusta.directions[chosen] = edges[proper]
    frusta.size[chosen] = np.maximum(np.abs(scene).max(), np.abs(apexes).max(axis=1))
