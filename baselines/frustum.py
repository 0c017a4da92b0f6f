"""Frusta around ray packets: section 4 of Overbeck, Ramamoorthi and Mark (2008).

A frustum is four corner rays and the four planes between them. It culls a box or a triangle that
no ray of its packet can meet:

* by planes (equation 1): all vertices lie outside of one plane;
* by corner rays: all of them miss a triangle outside of one edge, or a box by the same pair of
  slabs, or have left the same slab before they start.

Frusta of section 4.1, corners of the screen tile, are used for packets that share an origin and
lie inside their corner rays, which are moved outwards by GROW of their distance to the middle.
All others are made of a near and a far plane (section 4.3). The point light's frustum (section
4.2) is that construction with all origins in one point: then the near rectangle is that point.
A packet whose rays do not all advance along its dominant axis, by MIN_ADVANCE of their largest
component, has no frustum.

Why four corner rays suffice though the rays of a packet do not meet in a point: at each k between
the planes the rays lie in the rectangle of the corner rays. Let all four pierce a triangle's plane
from the same side and outside of one edge. The plane cuts that rectangle in a segment, whose ends
lie on sides between a corner that has pierced the plane and one that has yet to; the frustum's
side there is a plane, too, so the end lies on the line, and between the points, where these two
pierce. All four points are outside of the edge, so the ends are, and so is all between. Slabs
likewise: the bounds of u and v rise and fall with k as the corner rays do.

What differs from the paper:

* A plane is made from lines in (u, v, k), not from the cross product of equation 2, which is zero
  for the parallel corner rays of parallel light and loses digits where tiles are small.
* The far plane is at least FAR of the scene's size beyond the near one, so that quotients keep
  their digits.

All in float32, in the order of operations of cl/frustum.h, so that the same is culled. Rounding,
u = 2^-24: let `extent` bound the coordinates of scene, origins and frustum. Slopes are at most 16,
so what is computed of a ray between the planes errs by at most 120 u extent; a hit of a float32
triangle test lies up to 40 u extent beside its triangle. PAD is 256 u: near and far rectangle,
boxes, and the planes once more, are wider by PAD extent.
"""

from dataclasses import dataclass

import numpy as np

PAD = np.float32(2.0**-16)
# Rounding of products: 16 u of them.
SLACK = np.float32(2.0**-20)
FAR = np.float32(2.0**-10)
MIN_ADVANCE = np.float32(2.0**-4)
GROW = np.float32(2.0**-10)
# Scenes of other sizes have no frusta: products of four coordinates must stay in float32's range.
SMALLEST_SIZE, LARGEST_SIZE = 2.0**-30, 2.0**60
# Corners of a rectangle, around it: which end of the u interval, which of the v interval.
_U_END, _V_END = np.array([0, 1, 1, 0]), np.array([0, 0, 1, 1])
# The planes u min, v min, u max, v max: which way is out.
_OUTWARD = np.float32([-1, -1, 1, 1])


@dataclass
class Frusta:
    """One frustum for each of p packets; all arrays float32.

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
        A point x is outside of a plane where normal . x > offset.
    origins, directions : (p, 4, 3)
        Corner rays, around the frustum.
    pad : (p,)
        By how much a box is widened for the corner rays.
    """

    valid: np.ndarray
    shared: np.ndarray
    primary: np.ndarray
    normals: np.ndarray
    offsets: np.ndarray
    origins: np.ndarray
    directions: np.ndarray
    pad: np.ndarray

    def cull_boxes(self, packets, low, high, planes=True, corner_rays=True):
        """Return which boxes no ray of their packet can meet.

        Parameters
        ----------
        packets : (k,) int
        low, high : (k, 3) float32
        planes, corner_rays : bool
            Which of the two ways to use.

        Returns
        -------
        (k,) bool
            False for packets without a frustum.
        """
        culled = np.zeros(len(packets), bool)
        if planes:
            culled |= self._planes_cull_boxes(packets, low, high)
        if corner_rays:
            pad = self.pad[packets, None]
            culled |= self._by_corner_rays(
                _rays_cull_boxes, packets, culled, low - pad, high + pad
            )
        return culled

    def cull_triangles(self, packets, corners, planes=True, corner_rays=True):
        """Return which triangles, (k, 3, 3), no ray of their packet can meet; see cull_boxes."""
        culled = np.zeros(len(packets), bool)
        if planes:
            culled |= self._planes_cull_triangles(packets, corners)
        if corner_rays:
            pad = self.pad[packets]
            culled |= self._by_corner_rays(_rays_cull_triangles, packets, culled, corners, pad)
        return culled

    def _planes_cull_boxes(self, packets, low, high):
        normals = self.normals[packets]
        # The box's vertex that lies least outside has the smallest product along each axis.
        x, y, z = np.moveaxis(np.minimum(normals * low[:, None], normals * high[:, None]), 2, 0)
        return self.valid[packets] & (x + y + z > self.offsets[packets]).any(axis=1)

    def _planes_cull_triangles(self, packets, corners):
        heights = dot(self.normals[packets][:, :, None], corners[:, None])
        outside = heights.min(axis=2) > self.offsets[packets]
        return self.valid[packets] & outside.any(axis=1)

    def _by_corner_rays(self, test, packets, culled, *arguments):
        """Return `test` of the corner rays for what is not culled yet."""
        rows = np.flatnonzero(self.valid[packets] & ~culled)
        result = np.zeros(len(packets), bool)
        chosen = packets[rows]
        arguments = (argument[rows] for argument in arguments)
        result[rows] = test(self.origins[chosen], self.directions[chosen], *arguments)
        return result


def dot(a, b):
    """Return the scalar products along the last axis, summed in order."""
    return a[..., 0] * b[..., 0] + a[..., 1] * b[..., 1] + a[..., 2] * b[..., 2]


def cross(a, b):
    """Return the cross products along the last axis."""
    (ax, ay, az), (bx, by, bz) = np.moveaxis(a, -1, 0), np.moveaxis(b, -1, 0)
    return np.stack([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx], axis=-1)


def sum_of_components(a):
    """Return |x| + |y| + |z| along the last axis."""
    x, y, z = np.moveaxis(np.abs(a), -1, 0)
    return x + y + z


def _rays_cull_boxes(origins, directions, low, high):
    """Return which boxes (k, 3) all corner rays (k, 4, 3) miss in the same way.

    A ray that rises along axis a leaves the slab of a at high[a], one that falls at low[a]. It
    misses the box if it leaves one slab before it enters another, or before it starts.
    """
    rising = (directions > 0).all(axis=1)
    sign = np.where(rising, np.float32(1), np.float32(-1))
    steady = rising | (directions < 0).all(axis=1)
    leave = np.where(rising, high, low)[:, None] - origins
    enter = np.where(rising, low, high)[:, None] - origins
    missed = (steady & (sign[:, None] * leave < 0).all(axis=1)).any(axis=1)
    for a in range(3):
        for b in {0, 1, 2} - {a}:
            # leave_a / d_a < enter_b / d_b, times d_a d_b, which is not 0
            left = leave[..., a] * directions[..., b]
            right = enter[..., b] * directions[..., a]
            before = (sign[:, a] * sign[:, b])[:, None] * (right - left)
            before = before > SLACK * (np.abs(left) + np.abs(right))
            missed |= steady[:, a] & steady[:, b] & before.all(axis=1)
    return missed


def _rays_cull_triangles(origins, directions, corners, pad):
    """Return which triangles (k, 3, 3) all corner rays (k, 4, 3) pass outside of one edge.

    They do so, too, when moved by `pad`. On which side of an edge a ray passes is the sign of the
    volume of edge, way from the ray's origin to the edge, and direction.
    """
    edges = np.roll(corners, -1, axis=1) - corners
    lengths, sizes = sum_of_components(directions), sum_of_components(edges)
    facing = dot(directions, cross(edges[:, 0], edges[:, 1])[:, None])
    slack = SLACK * (sizes[:, 0] * sizes[:, 1])[:, None] * lengths
    front, back = (facing > slack).all(axis=1), (facing < -slack).all(axis=1)
    relative = corners[:, None] - origins[:, :, None]  # packet, ray, edge
    x, y, z = np.moveaxis(relative, 3, 0)
    ex, ey, ez = np.moveaxis(edges[:, None], 3, 0)
    dx, dy, dz = np.moveaxis(directions[:, :, None], 3, 0)
    sides = dx * (y * ez - z * ey) + dy * (z * ex - x * ez) + dz * (x * ey - y * ex)
    margin = (pad[:, None] * sizes)[:, None] * lengths[..., None]
    sides = np.where(front[:, None, None], sides, -sides)
    return (front | back) & (sides < -margin).all(axis=1).any(axis=1)


class PacketRays:
    """The rays of packets, (n, width) SIMD rays of which packet k has the rows from first[k] on.

    Parameters
    ----------
    origins, units : (n, width, 3) float32
        `units` have 1 or -1 as their largest component.
    live : (n, width) bool
        Lanes that hold a ray; every packet has one.
    first : (p,) int
    """

    def __init__(self, origins, units, live, first):
        self.origins, self.units, self.live, self.first = origins, units, live, first
        self.count = np.diff(np.append(first, len(live)))
        self.packet = np.repeat(np.arange(len(first)), self.count)

    def least(self, values):
        """Return the minima by packet of (n, width, ...), dead lanes left out."""
        return np.minimum.reduceat(self._over_lanes(np.minimum, values, np.inf), self.first)

    def most(self, values):
        """Return the maxima by packet."""
        return np.maximum.reduceat(self._over_lanes(np.maximum, values, -np.inf), self.first)

    def _over_lanes(self, function, values, neutral):
        live = self.live.reshape(self.live.shape + (1,) * (values.ndim - 2))
        return function.reduce(np.where(live, values, np.float32(neutral)), axis=1)

    def direction(self):
        """Return the sums of unit directions, (p, 3).

        In the order of the device: SIMD rays onto each other, then halves of the lanes.
        """
        units = np.where(self.live[..., None], self.units, np.float32(0))
        total = np.zeros((len(self.first), *units.shape[1:]), np.float32)
        for place in range(self.count.max(initial=0)):
            rows = np.flatnonzero(self.count > place)
            total[rows] += units[self.first[rows] + place]
        while total.shape[1] > 1:
            half = total.shape[1] // 2
            total = total[:, :half] + total[:, half:]
        return total[:, 0]


def bound_packets(rays, direction, corner_lanes, scene_low, scene_high):
    """Make the frusta of packets.

    Parameters
    ----------
    rays : PacketRays
    direction : (p, 3) float32
        rays.direction().
    corner_lanes : (p, 4) int or None
        Rows of origins.reshape(-1, 3) around the screen tile; -1 where a corner is missing.
    scene_low, scene_high : (3,) float32

    Returns
    -------
    Frusta
    """
    scene = np.array([scene_low, scene_high], np.float32)
    with np.errstate(all="ignore"):  # where a packet has no frustum anything may come out
        axes = _Axes(direction)
        frusta = near_far_frusta(rays, axes, scene)
        if corner_lanes is not None:
            asked = np.flatnonzero(
                (corner_lanes >= 0).all(axis=1) & frusta.valid & frusta.shared
            )
            live = rays.live.reshape(-1)[corner_lanes[asked]].all(axis=1)
            _use_corner_rays(frusta, rays, axes, asked[live], corner_lanes[asked[live]], scene)
    return frusta


class _Axes:
    """The axes u, v and k of packets, in a cyclic order; k is the dominant one.

    It counts along the rays: values of k are times `sign`.
    """

    def __init__(self, direction):
        k = np.argmax(np.abs(direction), axis=1)
        self.order = (k[:, None] + [1, 2, 0]) % 3
        along = np.take_along_axis(direction, self.order[:, 2:], axis=1)
        self.flip = np.ones((len(k), 3), np.float32)
        self.flip[:, 2:] = np.where(along < 0, -1, 1)

    def turned(self, values, packet=slice(None)):
        """Return vectors (..., 3) of packets as u, v, k."""
        return np.take_along_axis(values, self._wide(self.order, packet, values), -1) * self._wide(
            self.flip, packet, values
        )

    def turned_back(self, values, packet=slice(None)):
        """Return vectors (..., 3) of u, v, k as x, y, z."""
        inverse = np.argsort(self.order, axis=1)
        return np.take_along_axis(
            values * self._wide(self.flip, packet, values), self._wide(inverse, packet, values), -1
        )

    @staticmethod
    def _wide(by_packet, packet, values):
        """Return rows of (p, 3) for the axes between the first and the last one of `values`."""
        rows = by_packet[packet]
        rows = rows.reshape(len(rows), *(1,) * (values.ndim - 2), 3)
        return np.broadcast_to(rows, values.shape)


def near_far_frusta(rays, axes, scene):
    """Return frusta by a near and a far plane (section 4.3; for one origin, section 4.2).

    The near plane goes through the smallest k of the origins.
    """
    o, d = (axes.turned(values, rays.packet) for values in (rays.origins, rays.units))
    lows, highs = rays.least(rays.origins), rays.most(rays.origins)
    size = np.maximum(np.maximum(np.abs(lows), np.abs(highs)).max(axis=1), np.abs(scene).max())
    near = rays.least(o[..., 2])
    corners = axes.turned(np.broadcast_to(scene, (len(near), 2, 3)))
    far = np.maximum(corners[..., 2].max(axis=1), near + FAR * size)
    slopes = d[..., :2] / d[..., 2:]
    ends = []  # the planes u min, v min, u max, v max
    for plane in (near, far):
        place = o[..., :2] + slopes * (plane[rays.packet, None] - o[..., 2])[..., None]
        ends.append(np.concatenate([rays.least(place), rays.most(place)], axis=1))
    extent = np.maximum(size, np.abs(ends).max(axis=(0, 2)))
    pad = PAD * extent
    at_near, at_far = (places + _OUTWARD * pad[:, None] for places in ends)
    normals, offsets = _side_planes(at_near, at_far, near, far, pad)
    starts, stops = _rectangle(at_near, near), _rectangle(at_far, far)
    directions = stops - starts
    valid = (size >= SMALLEST_SIZE) & (size <= LARGEST_SIZE)
    valid &= rays.least(d[..., 2]) >= MIN_ADVANCE
    return Frusta(
        valid=valid,
        shared=(lows == highs).all(axis=1),
        primary=np.zeros(len(near), bool),
        normals=axes.turned_back(normals),
        offsets=offsets,
        origins=axes.turned_back(starts),
        directions=axes.turned_back(directions),
        pad=pad,
    )


def _side_planes(at_near, at_far, near, far, pad):
    """Return normals (p, 4, 3) in (u, v, k) and offsets (p, 4).

    The plane of the least u holds the line from (u_near, near) to (u_far, far) and the v axis:
    outside is u_near + s (k - near) - u > 0 with the slope s; of the most u, the opposite.
    """
    slopes = (at_far - at_near) / (far - near)[:, None]
    normals = np.zeros((len(near), 4, 3), np.float32)
    normals[:, range(4), [0, 1, 0, 1]] = _OUTWARD
    normals[..., 2] = -_OUTWARD * slopes
    offsets = _OUTWARD * (at_near - slopes * near[:, None])
    return normals, offsets + pad[:, None] * (np.float32(1) + np.abs(slopes))


def _rectangle(bounds, plane):
    """Return the corners, (p, 4, 3) in (u, v, k), around a rectangle."""
    u, v = bounds[:, 2 * _U_END], bounds[:, 2 * _V_END + 1]
    return np.stack([u, v, np.broadcast_to(plane[:, None], u.shape)], axis=2)


def _use_corner_rays(frusta, rays, axes, asked, lanes, scene):
    """Replace the frusta of the packets `asked` by those of their corner rays (section 4.1).

    Parameters
    ----------
    frusta : Frusta
    rays : PacketRays
    axes : _Axes
    asked : (q,) int
        Packets that share an origin.
    lanes : (q, 4) int
        Rows of their corner rays, around the tile.
    scene : (2, 3) float32
    """
    if not len(asked):
        return
    corners = axes.turned(rays.units.reshape(-1, 3)[lanes], asked)
    u, v = _grown(corners[..., 0] / corners[..., 2]), _grown(corners[..., 1] / corners[..., 2])
    du, dv = (np.roll(values, -1, axis=1) - values for values in (u, v))
    turn = du * np.roll(dv, -1, axis=1) - dv * np.roll(du, -1, axis=1)
    left, right = (turn > 0).all(axis=1), (turn < 0).all(axis=1)
    nu, nv = (np.where(left[:, None], values, -values) for values in (dv, -du))
    width = np.abs(nu) + np.abs(nv)
    margin = -SLACK * width * (np.float32(1) + (np.abs(u) + np.abs(v)))
    row = np.full(len(frusta.valid), -1)
    row[asked] = np.arange(len(asked))
    mine = np.flatnonzero(row[rays.packet] >= 0)
    d = axes.turned(rays.units[mine], rays.packet[mine])
    row = row[rays.packet[mine]]
    su, sv = d[..., 0] / d[..., 2], d[..., 1] / d[..., 2]
    outside = np.zeros(len(asked), bool)
    for k in range(4):
        across = nu[row, k, None] * (su - u[row, k, None]) + nv[row, k, None] * (
            sv - v[row, k, None]
        )
        beyond = ~(across < margin[row, k, None]) & rays.live[mine]
        outside[row[beyond.any(axis=1)]] = True
    good = (left | right) & ~outside
    chosen, u, v, nu, nv, width = (values[good] for values in (asked, u, v, nu, nv, width))
    apexes = rays.least(rays.origins)[chosen]
    o = axes.turned(apexes, chosen)[:, None]
    nk = -(nu * u + nv * v)
    size = np.maximum(np.abs(scene).max(), np.abs(apexes).max(axis=1))
    frusta.pad[chosen] = PAD * size
    offsets = nu * o[..., 0] + nv * o[..., 1] + nk * o[..., 2]
    frusta.offsets[chosen] = offsets + frusta.pad[chosen, None] * (width + np.abs(nk))
    frusta.primary[chosen] = True
    frusta.normals[chosen] = axes.turned_back(np.stack([nu, nv, nk], axis=2), chosen)
    frusta.origins[chosen] = apexes[:, None]
    forward = np.ones_like(u)
    frusta.directions[chosen] = axes.turned_back(np.stack([u, v, forward], axis=2), chosen)


def _grown(corners):
    """Return coordinates (q, 4) moved away from their mean."""
    mean = np.float32(0.25) * (
        (corners[:, 0] + corners[:, 1]) + (corners[:, 2] + corners[:, 3])
    )
    return corners + GROW * (corners - mean[:, None])
