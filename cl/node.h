// A node of the ray-space hierarchy and its tests against a triangle's bounding sphere and plane
// (Roger et al. 2007, sections 3.2 and 3.3.1; the plane is ours).
//
// A node bounds a bundle of rays: a sphere (centre C, radius r) around their origins, a cone (unit
// axis a, half-angle alpha) around their directions, the largest distance that any of them reaches,
// and boxes around their origins and their ends. Nodes lie in blocks of ARITY siblings, each field a
// vector over the siblings:
//   block b = NODE_ROWS vectors: Cx Cy Cz r, ax ay az, cos alpha, sin alpha, reach,
//             the origins' box around C: half extents ox oy oz,
//             the box of the ends: middle tx ty tz, half extents ux uy uz, and 1;
//             or, where a ray has no end, the box of the unit directions likewise, and 0
// cos alpha <= 0 says "any direction" (alpha >= pi/2 bounds nothing that is worth testing).
// A null node (no ray below it) has reach = -inf: no test keeps it, and it is not counted.
//
// Equation 1 of the paper with the signed axial distance, and without root or division: with
// w = P - C, h = w.a, s = r + d, q = h sin alpha + s, a sphere (P, d) is rejected where
//   alpha < pi/2 and (q < 0 or |w x a|^2 cos^2 alpha > q^2 or h < -s), or |w| > reach + s.
// |w x a| stands for sqrt(|w|^2 - h^2), which cancels: far from the node its error would be larger
// than the sphere. What is left of rounding (w, the axis, the products: below 12 u |w|, u = 2^-24,
// and the watertight test's own perturbation, below 16 u (|w| + s)) is covered by adding
// SLACK * (|wx| + |wy| + |wz| + s), SLACK = 32 u, to s.
//
// Two tests of our own, beside the sphere's. They cost as much again, and pay where triangles are large or long:
// Segments lie in the hull of their origins and ends: where both boxes are on one side of the
// triangle's slab, no ray of the node meets it. A ray without an end stays on its side where it does
// not turn towards the slab. So the floor around a mirror's rays, and the ceiling above a lamp's, are
// rejected, whose spheres hold the rays' origins.
// No ray comes to the far side of a plane that touches the cone and the origins' box: where the
// triangle's box, or its sphere, lies there whole, it is rejected. Of these planes the one that faces
// P is tried, whose normal is m = c cos alpha - a sin alpha, c the unit vector across the axis to P;
// and the one across the axis behind the origins.
//
// Build-time constants: ARITY (4 or 8); SPHERES_ALONE leaves them out.

#include "bounds.h"
#include "common.h"

#define FLOATN CONCAT(float, ARITY)

#define NODE_ROWS 20
#define SLACK 0x1p-19f
#define NULL_REACH (-INFINITY)

// Fused, so with fewer roundings than the bound above allows for, and a third fewer instructions.
inline float16 dot16(float16 ax, float16 ay, float16 az, float16 bx, float16 by, float16 bz)
{
    return FMA16(ax, bx, FMA16(ay, by, az * bz));
}

#define NODE_FIELD(rows, row) ((float16)((rows)[(row) * ARITY]))

// Lane by lane the spheres `p` (x, y, z, d) against the node whose first field is at `rows`.
inline int16 node_meets_spheres(global const float *rows, const float16 *p)
{
    const float16 r = NODE_FIELD(rows, 3), d = p[3];
    const float16 ax = NODE_FIELD(rows, 4), ay = NODE_FIELD(rows, 5), az = NODE_FIELD(rows, 6);
    const float16 cosine = NODE_FIELD(rows, 7), sine = NODE_FIELD(rows, 8);
    const float16 reach = NODE_FIELD(rows, 9);
    const float16 wx = p[0] - NODE_FIELD(rows, 0), wy = p[1] - NODE_FIELD(rows, 1),
                  wz = p[2] - NODE_FIELD(rows, 2);
    const float16 s
        = FMA16((float16)SLACK, magnitude(wx) + magnitude(wy) + magnitude(wz) + r + d, r + d);
    const float16 h = dot16(wx, wy, wz, ax, ay, az);
    const float16 kx = FMA16(wy, az, -(wz * ay)), ky = FMA16(wz, ax, -(wx * az)),
                  kz = FMA16(wx, ay, -(wy * ax));
    // The cosine first: the square of a distance may leave the range of float where it decides nothing.
    const float16 lx = kx * cosine, ly = ky * cosine, lz = kz * cosine;
    const float16 p2 = dot16(lx, ly, lz, lx, ly, lz);
    const float16 q = FMA16(h, sine, s);
    const float16 far = reach + s;
    const int16 in_cone = (q >= 0.0f) & (p2 <= q * q) & (h >= -s);
    const int16 in_reach = (far >= 0.0f) & (dot16(wx, wy, wz, wx, wy, wz) <= far * far);
    return in_reach & (in_cone | (cosine <= 0.0f));
}

// Whether origins and ends of the node are not all on one side of the slabs p[4 ..] around p[0 ..].
inline int16 node_meets_slabs(global const float *rows, const float16 *p)
{
    const float16 nx = p[4], ny = p[5], nz = p[6];
    const float16 sx = magnitude(nx), sy = magnitude(ny), sz = magnitude(nz);
    const float16 wx = NODE_FIELD(rows, 0) - p[0], wy = NODE_FIELD(rows, 1) - p[1],
                  wz = NODE_FIELD(rows, 2) - p[2];
    const float16 finite = NODE_FIELD(rows, 19);
    const float16 vx = FMA16(-finite, p[0], NODE_FIELD(rows, 13)),
                  vy = FMA16(-finite, p[1], NODE_FIELD(rows, 14)),
                  vz = FMA16(-finite, p[2], NODE_FIELD(rows, 15));
    const float16 far = magnitude(wx) + magnitude(wy) + magnitude(wz) + NODE_FIELD(rows, 3) + p[3];
    const float16 thickness = FMA16((float16)SLACK, far, p[7]);
    const float16 origins = dot16(nx, ny, nz, wx, wy, wz), ends = dot16(nx, ny, nz, vx, vy, vz);
    const float16 origins_half = dot16(sx, sy, sz, NODE_FIELD(rows, 10), NODE_FIELD(rows, 11),
                                       NODE_FIELD(rows, 12))
                                 + thickness;
    const float16 ends_half
        = dot16(sx, sy, sz, NODE_FIELD(rows, 16), NODE_FIELD(rows, 17), NODE_FIELD(rows, 18))
          + FMA16(finite, thickness, SLACK * (magnitude(vx) + magnitude(vy) + magnitude(vz)));
    const int16 above = (origins > origins_half) & (ends > ends_half);
    const int16 below = (origins < -origins_half) & (ends < -ends_half);
    return ~(above | below);
}

// Whether no plane that touches the cone separates the node from the boxes p[8 ..] around p[0 ..].
inline int16 node_meets_boxes(global const float *rows, const float16 *p)
{
    const float16 ax = NODE_FIELD(rows, 4), ay = NODE_FIELD(rows, 5), az = NODE_FIELD(rows, 6);
    const float16 cosine = NODE_FIELD(rows, 7), sine = NODE_FIELD(rows, 8);
    const float16 wx = p[0] - NODE_FIELD(rows, 0), wy = p[1] - NODE_FIELD(rows, 1),
                  wz = p[2] - NODE_FIELD(rows, 2);
    const float16 s = NODE_FIELD(rows, 3) + p[3];
    const float16 slack = SLACK * (magnitude(wx) + magnitude(wy) + magnitude(wz) + s);
    const float16 bx = p[8] + NODE_FIELD(rows, 10), by = p[9] + NODE_FIELD(rows, 11),
                  bz = p[10] + NODE_FIELD(rows, 12);
    const float16 h = dot16(wx, wy, wz, ax, ay, az);
    // What of w is across the axis; twice, since the first time leaves u |w| along it.
    float16 cx = FMA16(-h, ax, wx), cy = FMA16(-h, ay, wy), cz = FMA16(-h, az, wz);
    const float16 along = dot16(cx, cy, cz, ax, ay, az);
    cx = FMA16(-along, ax, cx), cy = FMA16(-along, ay, cy), cz = FMA16(-along, az, cz);
    const float16 length = SQRT16(dot16(cx, cy, cz, cx, cy, cz)), tilt = -length * sine;
    // The plane's normal, of that length: no direction of the cone goes towards it.
    const float16 mx = FMA16(tilt, ax, cosine * cx), my = FMA16(tilt, ay, cosine * cy),
                  mz = FMA16(tilt, az, cosine * cz);
    const float16 box = dot16(magnitude(mx), magnitude(my), magnitude(mz), bx, by, bz);
    const float16 ball = length * s;
    const float16 half_width = FMA16(length, slack, box < ball ? box : ball);
    const float16 depth = dot16(magnitude(ax), magnitude(ay), magnitude(az), bx, by, bz) + slack;
    const float16 height = dot16(mx, my, mz, wx, wy, wz);
    // P on the axis, but for rounding, is in the cone, and its normal is noise; nor does an infinite
    // height say anything.
    const int16 beside = (height > half_width) & (height < INFINITY) & (length > slack);
    const int16 apart = beside | (h < -depth);
    const float16 far = NODE_FIELD(rows, 9) + s + slack;
    const int16 in_reach = (far >= 0.0f) & (dot16(wx, wy, wz, wx, wy, wz) <= far * far);
    return in_reach & (~apart | (cosine <= 0.0f));
}

#ifdef SPHERES_ALONE
#define NODE_MEETS(rows, p) node_meets_spheres(rows, p)
#else
#define NODE_MEETS(rows, p) (node_meets_boxes(rows, p) & node_meets_slabs(rows, p))
#endif
