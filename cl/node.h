// A node of the ray-space hierarchy and its test against a triangle's bounding sphere
// (Roger et al. 2007, sections 3.2 and 3.3.1).
//
// A node bounds a bundle of rays: a sphere (centre C, radius r) around their origins, a cone (unit
// axis a, half-angle alpha) around their directions, and the largest distance that any of them
// reaches. Nodes lie in blocks of ARITY siblings, each field a vector over the siblings, so one
// vector test decides all children of a parent:
//   block b = NODE_ROWS vectors: Cx Cy Cz r, ax ay az, cos alpha, sin alpha, reach
// cos alpha <= 0 says "any direction" (alpha >= pi/2 bounds nothing that is worth testing).
// A null node (no ray below it) has reach = -inf: no test keeps it, and it is not counted.
//
// Equation 1 of the paper with the signed axial distance, and without root or division: with
// w = P - C, h = w.a, s = r + d, q = h sin alpha + s, a sphere (P, d) is rejected where
//   alpha < pi/2 and (q < 0 or |w x a|^2 cos^2 alpha > q^2 or h < -s), or |w| > reach + s.
// |w x a| stands for sqrt(|w|^2 - h^2), which cancels: far from the node its error would be larger
// than the sphere. What is left of rounding (w, the axis, the products: below 12 u |w|, u = 2^-24,
// and the watertight test's own perturbation, below 4 u |w|) is covered by adding
// SLACK * (|wx| + |wy| + |wz|), SLACK = 32 u, to s.
//
// Build-time constant: ARITY (4 or 8).

#include "common.h"

#define FLOATN CONCAT(float, ARITY)

#define NODE_ROWS 10
#define SLACK 0x1p-19f
#define NULL_REACH (-INFINITY)

inline float16 magnitude(float16 x) { return as_float16(as_int16(x) & 0x7fffffff); }

// Fused, so with fewer roundings than the bound above allows for, and a third fewer instructions.
inline float16 dot16(float16 ax, float16 ay, float16 az, float16 bx, float16 by, float16 bz)
{
    return FMA16(ax, bx, FMA16(ay, by, az * bz));
}

// Lane by lane; the arguments are the node's fields in the order of its rows, then P and d.
inline int16 node_meets_sphere(float16 cx, float16 cy, float16 cz, float16 r, float16 ax, float16 ay,
                               float16 az, float16 cosine, float16 sine, float16 reach, float16 px,
                               float16 py, float16 pz, float16 d)
{
    const float16 wx = px - cx, wy = py - cy, wz = pz - cz;
    const float16 s
        = FMA16((float16)SLACK, magnitude(wx) + magnitude(wy) + magnitude(wz), r + d);
    const float16 h = dot16(wx, wy, wz, ax, ay, az);
    const float16 kx = FMA16(wy, az, -(wz * ay)), ky = FMA16(wz, ax, -(wx * az)),
                  kz = FMA16(wx, ay, -(wy * ax));
    const float16 p2 = dot16(kx, ky, kz, kx, ky, kz);
    const float16 q = FMA16(h, sine, s);
    const float16 far = reach + s;
    const int16 in_cone = (q >= 0.0f) & (p2 * cosine * cosine <= q * q) & (h >= -s);
    const int16 in_reach = (far >= 0.0f) & (dot16(wx, wy, wz, wx, wy, wz) <= far * far);
    return in_reach & (in_cone | (cosine <= 0.0f));
}
