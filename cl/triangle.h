// Watertight ray-triangle intersection (Woop, Benthin, Wald 2013): one ray and one triangle or eight or
// sixteen, and rays in lanes with one triangle for all or one each.
//
// A ray's frame is an affine map that takes the ray to the z axis: the components of a vertex are turned so
// that z is the major axis of the direction, x and y are sheared along z, and z is scaled to the ray
// parameter t. A vertex maps to the same point whichever triangle it is seen from, and the 2-D edge
// functions below have the exact sign for these points; so a ray through a shared edge or vertex
// always hits one of the triangles there.
// The paper falls back to double precision where an edge function is zero; a difference of products
// by Kahan's method (Jeannerod, Louvet, Muller 2013) is within 1.5 ulp of the exact value of its float
// inputs, hence never zero or of the wrong sign by rounding, and needs no second precision (products of
// coordinates below 1e-19 underflow).
//
// The vector forms do the same operations in the same order: hits are equal bit for bit.

#include "common.h"

// A triangle is three float4 (v0, v1, v2, each with an unused w) in a row.
#define TRIANGLE_FLOAT4S 3

// Corners are turned: x, y, z as a ray's frame sees them.
#define DEFINE_CORNER(NAME, F)                                                                     \
    typedef struct {                                                                               \
        F x, y, z;                                                                                 \
    } NAME;

DEFINE_CORNER(Corner, float)
DEFINE_CORNER(Corner8, float8)
DEFINE_CORNER(Corner16, float16)

inline void bound_corners(float4 a, float4 b, float4 c, float4 *low, float4 *high)
{
    const float4 lower = a < b ? a : b, higher = a > b ? a : b;
    *low = lower < c ? lower : c;
    *high = higher > c ? higher : c;
}

// The components that are turned to x and y, where z is.
#define TURNED_X(z) ((z) == 2 ? 0 : (z) + 1)
#define TURNED_Y(z) ((z) == 0 ? 2 : (z) - 1)

// The origin is turned, too.
typedef struct {
    float ox, oy, oz;
    float shear_x, shear_y, scale;
    float tnear, tfar;
    uint x, y, z; // the components of a vertex that are turned to x, y, z
} RayFrame;

// Rays in lanes, each with its major axis; x, y, z as in RayFrame where one is that of all, not `mixed`.
#define DEFINE_RAY_FRAME(NAME, F, I)                                                               \
    typedef struct {                                                                               \
        F ox, oy, oz;                                                                              \
        F shear_x, shear_y, scale;                                                                 \
        F tnear, tfar;                                                                             \
        I major;                                                                                   \
        uint x, y, z;                                                                              \
        bool mixed;                                                                                \
    } NAME;

// `hit` is SIMD truth: -1 in vectors, 1 in the scalar form, 0 where missed.
#define DEFINE_TRIANGLE_HIT(NAME, F, I)                                                            \
    typedef struct {                                                                               \
        F t, u, v;                                                                                 \
        I hit;                                                                                     \
    } NAME;

DEFINE_TRIANGLE_HIT(TriangleHit, float, int)
DEFINE_TRIANGLE_HIT(TriangleHit8, float8, int8)
DEFINE_TRIANGLE_HIT(TriangleHit16, float16, int16)

#define DEFINE_DIFFERENCE_OF_PRODUCTS(SUFFIX, F, FMA)                                              \
    inline F difference_of_products##SUFFIX(F a, F b, F c, F d)                                    \
    {                                                                                              \
        const F w = c * d;                                                                         \
        const F error = FMA(-c, d, w);                                                             \
        return FMA(a, b, -w) + error;                                                              \
    }

// Edges only: whether a hit of the triangle's plane would lie inside. FRAME and CORNER in lanes of F; what is
// not a vector yet is the same in all lanes.
#define DEFINE_INSIDE_EDGES(NAME, SUFFIX, F, I, FMA, FRAME, CORNER)                                \
    INLINE I NAME(const FRAME *r, CORNER v0, CORNER v1, CORNER v2, F *edges, F *depths)            \
    {                                                                                              \
        const F ox = (F)(r->ox), oy = (F)(r->oy), oz = (F)(r->oz);                                 \
        const F shear_x = (F)(r->shear_x), shear_y = (F)(r->shear_y), scale = (F)(r->scale);       \
        const F az = (F)(v0.z) - oz, bz = (F)(v1.z) - oz, cz = (F)(v2.z) - oz;                     \
        const F ax = FMA(shear_x, az, (F)(v0.x) - ox), ay = FMA(shear_y, az, (F)(v0.y) - oy);      \
        const F bx = FMA(shear_x, bz, (F)(v1.x) - ox), by = FMA(shear_y, bz, (F)(v1.y) - oy);      \
        const F cx = FMA(shear_x, cz, (F)(v2.x) - ox), cy = FMA(shear_y, cz, (F)(v2.y) - oy);      \
        edges[0] = difference_of_products##SUFFIX(cx, by, cy, bx);                                 \
        edges[1] = difference_of_products##SUFFIX(ax, cy, ay, cx);                                 \
        edges[2] = difference_of_products##SUFFIX(bx, ay, by, ax);                                 \
        depths[0] = scale * az, depths[1] = scale * bz, depths[2] = scale * cz;                    \
        return ((edges[0] >= 0.0f) & (edges[1] >= 0.0f) & (edges[2] >= 0.0f))                      \
               | ((edges[0] <= 0.0f) & (edges[1] <= 0.0f) & (edges[2] <= 0.0f));                   \
    }

// The rest. A zero determinant (edge-on or zero-area) is a miss; comparisons with its NaN are false. So is
// one that left the range of float, whose t would be 0. + 0.0f turns -0.0 into 0.0, which sorts
// first among the bit patterns. Weights before depths: edges times depths would leave the range of
// float in large and tiny scenes.
#define DEFINE_FINISH_HIT(NAME, F, I, FRAME, HIT)                                                  \
    INLINE HIT NAME(const FRAME *r, I inside, const F *edges, const F *depths)                     \
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

DEFINE_DIFFERENCE_OF_PRODUCTS(, float, FMA)
DEFINE_DIFFERENCE_OF_PRODUCTS(8, float8, FMA8)
DEFINE_DIFFERENCE_OF_PRODUCTS(16, float16, FMA16)
DEFINE_INSIDE_EDGES(inside_edges, , float, int, FMA, RayFrame, Corner)
DEFINE_INSIDE_EDGES(inside_edges8, 8, float8, int8, FMA8, RayFrame, Corner8)          // 8 triangles
DEFINE_INSIDE_EDGES(inside_edges_run, 16, float16, int16, FMA16, RayFrame, Corner16) // 16 triangles
DEFINE_FINISH_HIT(finish_hit, float, int, RayFrame, TriangleHit)
DEFINE_FINISH_HIT(finish_hit8, float8, int8, RayFrame, TriangleHit8)
DEFINE_FINISH_HIT(finish_hit_run, float16, int16, RayFrame, TriangleHit16)

// W rays in lanes.
#define DEFINE_RAYS_TEST(W, F, I, FMA, MASK)                                                       \
    DEFINE_RAY_FRAME(RayFrame##W, F, I)                                                            \
    DEFINE_INSIDE_EDGES(inside_edges##W, W, F, I, FMA, RayFrame##W, Corner)                        \
    DEFINE_INSIDE_EDGES(inside_edges_lanes##W, W, F, I, FMA, RayFrame##W, Corner##W)               \
    DEFINE_FINISH_HIT(finish_hit##W, F, I, RayFrame##W, TriangleHit##W)                            \
                                                                                                   \
    inline Corner##W turn##W(F x, F y, F z, I major)                                               \
    {                                                                                              \
        const I along_x = major == 0, along_y = major == 1;                                        \
        const Corner##W v = {along_x ? y : along_y ? z : x, along_x ? z : along_y ? x : y,         \
                             along_x ? x : along_y ? y : z};                                       \
        return v;                                                                                  \
    }                                                                                              \
                                                                                                   \
    /* As ray_frame; lanes that are not live do not count for the common axis. */                  \
    inline void set_frame##W(RayFrame##W *r, const F *o, const F *d, F tnear, F tfar, I live)      \
    {                                                                                              \
        const F x = d[0] < 0.0f ? -d[0] : d[0], y = d[1] < 0.0f ? -d[1] : d[1];                    \
        const F z = d[2] < 0.0f ? -d[2] : d[2];                                                    \
        const I along_x = (x >= y) & (x >= z), along_y = ~along_x & (y >= z);                      \
        r->major = along_x ? (I)0 : along_y ? (I)1 : (I)2;                                         \
        r->z = MASK(live & along_x) ? 0 : MASK(live & along_y) ? 1 : 2;                            \
        r->x = TURNED_X(r->z);                                                                     \
        r->y = TURNED_Y(r->z);                                                                     \
        r->mixed = MASK(live & (r->major != (int)r->z)) != 0;                                      \
        const Corner##W org = turn##W(o[0], o[1], o[2], r->major);                                 \
        const Corner##W dir = turn##W(d[0], d[1], d[2], r->major);                                 \
        r->ox = org.x, r->oy = org.y, r->oz = org.z;                                               \
        r->shear_x = -(dir.x / dir.z);                                                             \
        r->shear_y = -(dir.y / dir.z);                                                             \
        r->scale = 1.0f / dir.z;                                                                   \
        r->tnear = tnear;                                                                          \
        r->tfar = tfar < MAXFLOAT ? tfar : (F)MAXFLOAT;                                            \
    }                                                                                              \
                                                                                                   \
    /* One triangle for all: component k of corner c at v[c * corner + k * component]. */          \
    INLINE I inside_edges_rays##W(const RayFrame##W *r, global const float *v, uint corner,        \
                                  uint component, F *edges, F *depths)                             \
    {                                                                                              \
        global const float *v1 = v + corner, *v2 = v + 2 * corner;                                 \
        if (r->mixed) {                                                                            \
            const uint y = component, z = 2 * component;                                           \
            return inside_edges_lanes##W(                                                          \
                r, turn##W((F)(v[0]), (F)(v[y]), (F)(v[z]), r->major),                             \
                turn##W((F)(v1[0]), (F)(v1[y]), (F)(v1[z]), r->major),                             \
                turn##W((F)(v2[0]), (F)(v2[y]), (F)(v2[z]), r->major), edges, depths);             \
        }                                                                                          \
        const uint x = r->x * component, y = r->y * component, z = r->z * component;               \
        const Corner a = {v[x], v[y], v[z]}, b = {v1[x], v1[y], v1[z]}, c = {v2[x], v2[y], v2[z]}; \
        return inside_edges##W(r, a, b, c, edges, depths);                                         \
    }

DEFINE_RAYS_TEST(16, float16, int16, FMA16, MASK16)

// A ray is two float4: origin with tnear, direction with tfar.
inline RayFrame ray_frame(float4 org_tnear, float4 dir_tfar)
{
    float o[4] __attribute__((aligned(16))), d[4] __attribute__((aligned(16)));
    *(float4 *)o = org_tnear;
    *(float4 *)d = dir_tfar;
    const float ax = size_of(d[0]), ay = size_of(d[1]), az = size_of(d[2]);
    // The major axis is the largest component, so the shears are at most one in size.
    const uint z = ax >= ay && ax >= az ? 0 : ay >= az ? 1 : 2;
    const uint x = TURNED_X(z), y = TURNED_Y(z);
    // A distance that leaves the range of float is no hit: infinity stays above tfar.
    const RayFrame r = {o[x],  o[y],  o[z],  -(d[x] / d[z]), -(d[y] / d[z]), 1.0f / d[z],
                        o[3], MIN(d[3], MAXFLOAT), x, y, z};
    return r;
}

// Component k of the corner at v[k * component].
inline Corner turned(const RayFrame *r, global const float *v, uint component)
{
    const Corner c = {v[r->x * component], v[r->y * component], v[r->z * component]};
    return c;
}

inline TriangleHit intersect_triangle(const RayFrame *r, global const float4 *triangle)
{
    global const float *v = (global const float *)triangle;
    float edges[3], depths[3];
    const int inside = inside_edges(r, turned(r, v, 1), turned(r, v + 4, 1), turned(r, v + 8, 1),
                                    edges, depths);
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
