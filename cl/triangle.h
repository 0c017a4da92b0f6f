// Watertight ray-triangle intersection (Woop, Benthin, Wald 2013): one ray and one triangle, sixteen
// rays, or eight or sixteen triangles.
//
// A ray's frame is an affine map that takes the ray to the z axis: rows 0 and 1 shear the two minor
// axes, row 2 scales the major one, so that z is the ray parameter t. A vertex maps to the same
// point whichever triangle it is seen from, and the 2-D edge functions below have the exact sign for
// these points; so a ray through a shared edge or vertex always hits one of the triangles there.
// The paper falls back to double precision where an edge function is zero; a difference of products
// by Kahan's method (Jeannerod, Louvet, Muller 2013) is within 1.5 ulp of the exact value of its float
// inputs, hence never zero or of the wrong sign by rounding, and needs no second precision (products of
// coordinates below 1e-19 underflow).
//
// The vector forms do the same operations in the same order: hits are equal bit for bit.

#include "common.h"

// A triangle is three float4 (v0, v1, v2, each with an unused w) in a row.
#define TRIANGLE_FLOAT4S 3

// Rows 0, 1, 2 of the map, of one ray or of sixteen.
#define DEFINE_RAY_FRAME(NAME, F)                                                                  \
    typedef struct {                                                                               \
        F ox, oy, oz;                                                                              \
        F x0, y0, z0, x1, y1, z1, x2, y2, z2;                                                      \
        F tnear, tfar;                                                                             \
    } NAME;

DEFINE_RAY_FRAME(RayFrame, float)
DEFINE_RAY_FRAME(RayFrame16, float16)

typedef struct {
    float8 x, y, z;
} Corner8;

typedef struct {
    float16 x, y, z;
} Corner16;

// `hit` is SIMD truth: -1 in vectors, 1 in the scalar form, 0 where missed.
typedef struct {
    float t, u, v;
    int hit;
} TriangleHit;

typedef struct {
    float8 t, u, v;
    int8 hit;
} TriangleHit8;

typedef struct {
    float16 t, u, v;
    int16 hit;
} TriangleHit16;

// FRAME and CORNER in lanes of F; what is not a vector yet is the same in all lanes.
#define DEFINE_TRIANGLE_TEST(SUFFIX, F, I, FMA, FRAME, CORNER, HIT)                                \
    inline F difference_of_products##SUFFIX(F a, F b, F c, F d)                                    \
    {                                                                                              \
        const F w = c * d;                                                                         \
        const F error = FMA(-c, d, w);                                                             \
        return FMA(a, b, -w) + error;                                                              \
    }                                                                                              \
                                                                                                   \
    /* Edges only: whether a hit of the triangle's plane would lie inside. */                      \
    inline I inside_edges##SUFFIX(const FRAME *r, CORNER v0, CORNER v1, CORNER v2, F *edges,       \
                                  F *depths)                                                       \
    {                                                                                              \
        const F ox = (F)(r->ox), oy = (F)(r->oy), oz = (F)(r->oz);                                 \
        const F x0 = (F)(r->x0), y0 = (F)(r->y0), z0 = (F)(r->z0);                                 \
        const F x1 = (F)(r->x1), y1 = (F)(r->y1), z1 = (F)(r->z1);                                 \
        const F x2 = (F)(r->x2), y2 = (F)(r->y2), z2 = (F)(r->z2);                                 \
        const F ax = (F)(v0.x) - ox, ay = (F)(v0.y) - oy, az = (F)(v0.z) - oz;                     \
        const F bx = (F)(v1.x) - ox, by = (F)(v1.y) - oy, bz = (F)(v1.z) - oz;                     \
        const F cx = (F)(v2.x) - ox, cy = (F)(v2.y) - oy, cz = (F)(v2.z) - oz;                     \
        const F px = FMA(x0, ax, FMA(y0, ay, z0 * az)), py = FMA(x1, ax, FMA(y1, ay, z1 * az));    \
        const F qx = FMA(x0, bx, FMA(y0, by, z0 * bz)), qy = FMA(x1, bx, FMA(y1, by, z1 * bz));    \
        const F sx = FMA(x0, cx, FMA(y0, cy, z0 * cz)), sy = FMA(x1, cx, FMA(y1, cy, z1 * cz));    \
        edges[0] = difference_of_products##SUFFIX(sx, qy, sy, qx);                                 \
        edges[1] = difference_of_products##SUFFIX(px, sy, py, sx);                                 \
        edges[2] = difference_of_products##SUFFIX(qx, py, qy, px);                                 \
        depths[0] = FMA(x2, ax, FMA(y2, ay, z2 * az));                                             \
        depths[1] = FMA(x2, bx, FMA(y2, by, z2 * bz));                                             \
        depths[2] = FMA(x2, cx, FMA(y2, cy, z2 * cz));                                             \
        return ((edges[0] >= 0.0f) & (edges[1] >= 0.0f) & (edges[2] >= 0.0f))                      \
               | ((edges[0] <= 0.0f) & (edges[1] <= 0.0f) & (edges[2] <= 0.0f));                   \
    }                                                                                              \
                                                                                                   \
    /* The rest. A zero determinant (edge-on or zero-area) is a miss; comparisons with its NaN are \
       false. So is one that left the range of float, whose t would be 0. + 0.0f turns -0.0 into 0.0, which sorts first among the bit patterns. Weights before \
       depths: edges times depths would leave the range of float in large and tiny scenes. */      \
    inline HIT finish_hit##SUFFIX(const FRAME *r, I inside, const F *edges, const F *depths)       \
    {                                                                                              \
        HIT h;                                                                                     \
        const F det = edges[0] + edges[1] + edges[2];                                              \
        h.u = edges[1] / det;                                                                      \
        h.v = edges[2] / det;                                                                      \
        h.t = edges[0] / det * depths[0] + h.u * depths[1] + h.v * depths[2] + 0.0f;               \
        h.hit = inside & (det != 0.0f) & (det - det == 0.0f) & (h.t >= (F)(r->tnear))              \
                & (h.t <= (F)(r->tfar));                                                           \
        return h;                                                                                  \
    }

DEFINE_TRIANGLE_TEST(, float, int, FMA, RayFrame, float4, TriangleHit)
DEFINE_TRIANGLE_TEST(8, float8, int8, FMA8, RayFrame, Corner8, TriangleHit8)          // 8 triangles
DEFINE_TRIANGLE_TEST(16, float16, int16, FMA16, RayFrame16, float4, TriangleHit16)    // 16 rays
DEFINE_TRIANGLE_TEST(_run, float16, int16, FMA16, RayFrame, Corner16, TriangleHit16) // 16 triangles

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
