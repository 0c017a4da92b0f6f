// Watertight ray-triangle intersection (Woop, Benthin, Wald 2013), for one ray and for sixteen.
//
// A ray's frame is an affine map that takes the ray to the z axis: rows 0 and 1 shear the two minor
// axes, row 2 scales the major one, so that z is the ray parameter t. A vertex maps to the same
// point whichever triangle it is seen from, and the 2-D edge functions below have the exact sign for
// these points; so a ray through a shared edge or vertex always hits one of the triangles there.
// The paper falls back to double precision where an edge function is zero; a difference of products
// by Kahan's method is within 1.5 ulp of the exact value of its float inputs, hence never zero or of
// the wrong sign by rounding (products of coordinates below 1e-19 underflow) (Jeannerod, Louvet, Muller 2013), and needs no second precision.
//
// The vector form does the same operations in the same order: hits are equal bit for bit.

#include "common.h"

// A triangle is three float4 (v0, v1, v2, each with an unused w) in a row.
#define TRIANGLE_FLOAT4S 3

#define DEFINE_TRIANGLE_TEST(SUFFIX, F, I)                                                         \
    typedef struct {                                                                               \
        F ox, oy, oz;                                                                              \
        F x0, y0, z0, x1, y1, z1, x2, y2, z2; /* rows 0, 1, 2 */                                   \
        F tnear, tfar;                                                                             \
    } RayFrame##SUFFIX;                                                                            \
                                                                                                   \
    typedef struct {                                                                               \
        F t, u, v;                                                                                 \
        I hit; /* SIMD truth: -1 in vectors, 1 in the scalar form, 0 where missed */               \
    } TriangleHit##SUFFIX;                                                                         \
                                                                                                   \
    inline F difference_of_products##SUFFIX(F a, F b, F c, F d)                                    \
    {                                                                                              \
        const F w = c * d;                                                                         \
        const F error = FMA##SUFFIX(-c, d, w);                                                     \
        return FMA##SUFFIX(a, b, -w) + error;                                                      \
    }                                                                                              \
                                                                                                   \
    /* Edges only: whether a hit of the triangle's plane would lie inside. */                      \
    inline I inside_edges##SUFFIX(const RayFrame##SUFFIX *r, float4 v0, float4 v1, float4 v2,      \
                                  F *edges, F *depths)                                             \
    {                                                                                              \
        const F ax = v0.x - r->ox, ay = v0.y - r->oy, az = v0.z - r->oz;                           \
        const F bx = v1.x - r->ox, by = v1.y - r->oy, bz = v1.z - r->oz;                           \
        const F cx = v2.x - r->ox, cy = v2.y - r->oy, cz = v2.z - r->oz;                           \
        const F px = FMA##SUFFIX(r->x0, ax, FMA##SUFFIX(r->y0, ay, r->z0 * az));                   \
        const F py = FMA##SUFFIX(r->x1, ax, FMA##SUFFIX(r->y1, ay, r->z1 * az));                   \
        const F qx = FMA##SUFFIX(r->x0, bx, FMA##SUFFIX(r->y0, by, r->z0 * bz));                   \
        const F qy = FMA##SUFFIX(r->x1, bx, FMA##SUFFIX(r->y1, by, r->z1 * bz));                   \
        const F sx = FMA##SUFFIX(r->x0, cx, FMA##SUFFIX(r->y0, cy, r->z0 * cz));                   \
        const F sy = FMA##SUFFIX(r->x1, cx, FMA##SUFFIX(r->y1, cy, r->z1 * cz));                   \
        edges[0] = difference_of_products##SUFFIX(sx, qy, sy, qx);                                 \
        edges[1] = difference_of_products##SUFFIX(px, sy, py, sx);                                 \
        edges[2] = difference_of_products##SUFFIX(qx, py, qy, px);                                 \
        depths[0] = FMA##SUFFIX(r->x2, ax, FMA##SUFFIX(r->y2, ay, r->z2 * az));                    \
        depths[1] = FMA##SUFFIX(r->x2, bx, FMA##SUFFIX(r->y2, by, r->z2 * bz));                    \
        depths[2] = FMA##SUFFIX(r->x2, cx, FMA##SUFFIX(r->y2, cy, r->z2 * cz));                    \
        return ((edges[0] >= 0.0f) & (edges[1] >= 0.0f) & (edges[2] >= 0.0f))                      \
               | ((edges[0] <= 0.0f) & (edges[1] <= 0.0f) & (edges[2] <= 0.0f));                   \
    }                                                                                              \
                                                                                                   \
    /* The rest. A zero determinant (edge-on or zero-area) is a miss; comparisons with its NaN are \
       false. + 0.0f turns -0.0 into 0.0, which sorts first among the bit patterns. Weights before \
       depths: edges times depths would leave the range of float in large and tiny scenes. */      \
    inline TriangleHit##SUFFIX finish_hit##SUFFIX(const RayFrame##SUFFIX *r, I inside,             \
                                                  const F *edges, const F *depths)                 \
    {                                                                                              \
        TriangleHit##SUFFIX h;                                                                     \
        const F det = edges[0] + edges[1] + edges[2];                                              \
        h.u = edges[1] / det;                                                                      \
        h.v = edges[2] / det;                                                                      \
        h.t = edges[0] / det * depths[0] + h.u * depths[1] + h.v * depths[2] + 0.0f;               \
        h.hit = inside & (det != 0.0f) & (h.t >= r->tnear) & (h.t <= r->tfar);                     \
        return h;                                                                                  \
    }

DEFINE_TRIANGLE_TEST(, float, int)
DEFINE_TRIANGLE_TEST(16, float16, int16)

// A ray is two float4: origin with tnear, direction with tfar.
inline RayFrame ray_frame(float4 org_tnear, float4 dir_tfar)
{
    const float4 d = dir_tfar;
    const float ax = d.x < 0.0f ? -d.x : d.x;
    const float ay = d.y < 0.0f ? -d.y : d.y;
    const float az = d.z < 0.0f ? -d.z : d.z;
    // A distance that leaves the range of float is no hit: infinity stays above tfar.
    const float tfar = MIN(d.w, MAXFLOAT);
    RayFrame r = {org_tnear.x, org_tnear.y, org_tnear.z, 0, 0, 0, 0, 0, 0, 0, 0, 0, org_tnear.w, tfar};
    // The major axis is the largest component, so the shears are at most one in size.
    if (ax >= ay && ax >= az) {
        r.y0 = 1.0f, r.x0 = -(d.y / d.x);
        r.z1 = 1.0f, r.x1 = -(d.z / d.x);
        r.x2 = 1.0f / d.x;
    } else if (ay >= az) {
        r.z0 = 1.0f, r.y0 = -(d.z / d.y);
        r.x1 = 1.0f, r.y1 = -(d.x / d.y);
        r.y2 = 1.0f / d.y;
    } else {
        r.x0 = 1.0f, r.z0 = -(d.x / d.z);
        r.y1 = 1.0f, r.z1 = -(d.y / d.z);
        r.z2 = 1.0f / d.z;
    }
    return r;
}

inline TriangleHit intersect_triangle(const RayFrame *r, global const float4 *triangle)
{
    float edges[3], depths[3];
    const int inside = inside_edges(r, triangle[0], triangle[1], triangle[2], edges, depths);
    if (!inside) {
        const TriangleHit miss = {0.0f, 0.0f, 0.0f, 0};
        return miss;
    }
    return finish_hit(r, inside, edges, depths);
}

// The closest hit of a ray is the 64-bit minimum over (bits of t, triangle): t >= 0, so its bits sort
// like its value, and equal distances go to the smaller triangle, whatever the order of work.
#define MISS 0xffffffffffffffffUL

inline ulong hit_key(float t, uint triangle) { return ((ulong)as_uint(t) << 32) | triangle; }
