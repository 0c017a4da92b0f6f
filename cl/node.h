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
// Build-time constant: ARITY (4, 8 or 16).

#include "common.h"

#define CONCAT_(a, b) a##b
#define CONCAT(a, b) CONCAT_(a, b)
#define FLOATN CONCAT(float, ARITY)
#define INTN CONCAT(int, ARITY)

#define NODE_ROWS 10
#define SLACK 0x1p-19f
#define NULL_REACH (-INFINITY)

#define DEFINE_NODE_TEST(SUFFIX, F, I)                                                             \
    inline F magnitude##SUFFIX(F x) { return x < 0.0f ? -x : x; }                                  \
    inline I node_meets_sphere##SUFFIX(F cx, F cy, F cz, F r, F ax, F ay, F az, F cosine, F sine,  \
                                       F reach, F px, F py, F pz, F d)                             \
    {                                                                                              \
        const F wx = px - cx, wy = py - cy, wz = pz - cz;                                          \
        const F s = r + d + SLACK * (magnitude##SUFFIX(wx) + magnitude##SUFFIX(wy)                 \
                                     + magnitude##SUFFIX(wz));                                     \
        const F h = wx * ax + wy * ay + wz * az;                                                   \
        const F kx = wy * az - wz * ay, ky = wz * ax - wx * az, kz = wx * ay - wy * ax;            \
        const F p2 = kx * kx + ky * ky + kz * kz;                                                  \
        const F q = h * sine + s;                                                                  \
        const F far = reach + s;                                                                   \
        const I in_cone = (q >= 0.0f) & (p2 * cosine * cosine <= q * q) & (h >= -s);               \
        const I in_reach = (far >= 0.0f) & (wx * wx + wy * wy + wz * wz <= far * far);             \
        return in_reach & (in_cone | (cosine <= 0.0f));                                            \
    }

#if ARITY == 4
DEFINE_NODE_TEST(4, float4, int4)
#elif ARITY == 8
DEFINE_NODE_TEST(8, float8, int8)
#endif
DEFINE_NODE_TEST(16, float16, int16)
#define NODES_MEET_SPHERE CONCAT(node_meets_sphere, ARITY)
