// SIMD rays: WIDTH rays in the lanes of a vector, the smallest primitive of cl/packet.cl.
//
// A ray is o + s q with q = d / m, m the largest component of |d|: s is a distance along the major axis in
// units of the scene, so that nothing here leaves the range of float, whatever the length of d.
//
// Build-time constant: WIDTH, 4 or 16.

#include "bvh.h"
#include "triangle.h"

#if WIDTH == 16
typedef float16 VF;
typedef int16 VI;
typedef uint16 VU;
typedef RayFrame16 VFrame;
typedef TriangleHit16 VHit;
#define LANES (uint16)(0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15)
#define TRANSPOSE(s, x, y, z, w) TRANSPOSE16(s, x, y, z, w)
#define STORE_ROW(to, from) STORE_UNALIGNED_QUAD(to, *(const uint4 *)(from))
#define SIDE 4 // of the square of pixels that a SIMD ray covers
#define AS_VF as_float16
#define AS_VI as_int16
#define AS_VU as_uint16
#define FMA_V(a, b, c) FMA16(a, b, c)
#define MASK_V(m) MASK16(m)
#define INSIDE_EDGES inside_edges16
#define FINISH_HIT finish_hit16
#define HALVES(OP, v)                                                                              \
    const float8 v8 = OP((v).lo, (v).hi);                                                          \
    const float4 v4 = OP(v8.lo, v8.hi);
#else
DEFINE_RAY_FRAME(RayFrame4, float4)
typedef struct {
    float4 t, u, v;
    int4 hit;
} TriangleHit4;
DEFINE_TRIANGLE_TEST(4, float4, int4, FMA4, RayFrame4, float4, TriangleHit4)
typedef float4 VF;
typedef int4 VI;
typedef uint4 VU;
typedef RayFrame4 VFrame;
typedef TriangleHit4 VHit;
#define LANES (uint4)(0, 1, 2, 3)
#define TRANSPOSE(s, to_x, to_y, to_z, to_w)                                                       \
    to_x = (float4)(s[0].x, s[1].x, s[2].x, s[3].x);                                               \
    to_y = (float4)(s[0].y, s[1].y, s[2].y, s[3].y);                                               \
    to_z = (float4)(s[0].z, s[1].z, s[2].z, s[3].z);                                               \
    to_w = (float4)(s[0].w, s[1].w, s[2].w, s[3].w);
#define STORE_ROW(to, from) (to)[0] = (from)[0], (to)[1] = (from)[1]
#define SIDE 2
#define AS_VF as_float4
#define AS_VI as_int4
#define AS_VU as_uint4
#define FMA_V(a, b, c) FMA4(a, b, c)
#define MASK_V(m) MASK4(m)
#define INSIDE_EDGES inside_edges4
#define FINISH_HIT finish_hit4
#define HALVES(OP, v) const float4 v4 = v;
#endif

#define MAX_SIMD (1024 / WIDTH) // SIMD rays of the largest packet, 32 x 32
#define ALL_LANES ((1u << WIDTH) - 1)

#define ADD(a, b) ((a) + (b))

// Over the lanes, halves onto each other: the order of the sum is part of what is counted.
inline float sum_lanes(VF v)
{
    HALVES(ADD, v)
    return (v4.x + v4.z) + (v4.y + v4.w);
}

inline float least_lane(VF v)
{
    HALVES(MIN, v)
    return MIN(MIN(v4.x, v4.y), MIN(v4.z, v4.w));
}

inline float most_lane(VF v)
{
    HALVES(MAX, v)
    return MAX(MAX(v4.x, v4.y), MAX(v4.z, v4.w));
}

inline VF magnitude_v(VF v) { return v < 0.0f ? -v : v; }

#define CHOOSE(test, a, b) ((test) ? (VF)(a) : (VF)(b))

// The triangle test finds a hit up to 20 u D beside the triangle (u = 2^-24, D the largest coordinate of a
// corner seen from the origin: shears, frame and edges round, see triangle.h), the slab test errs by 5 u D.
// Boxes are wider by BOX_PAD times more than D, so that no hit of the triangle test is outside of them.
#define BOX_PAD 0x1p-18f
#define SMALLEST_PAD 0x1p-140f // where coordinates are near the end of float's range
// Stands for 1 / 0, and for what is beyond: along such an axis a ray moves by less than the pad.
#define LARGEST_INVERSE 0x1p60f

typedef struct {
    VF below[3], above[3]; // the origin, moved by the pad
    VF inverse[3];         // 1 / q
    VF enter, leave;       // the segment, in s; `leave` is that of the closest hit so far
    VF org[3];
    VF shear[2], scale; // the triangle test's frame for a major axis
    VF tnear, tfar;
    VF largest; // m
    VF t;       // closest hit
    VU triangle;
    VF unit[3]; // q
    VI major;   // axis, by lane
    VU ray;
    uint axis; // the major axis that all lanes share, or MIXED
    uint live; // lanes that hold a ray
} SimdRay;

#define MIXED 3

// Bit mask of the lanes that overlap a box.
inline uint meet(const SimdRay *r, float4 low, float4 high)
{
    VF enter = r->enter, leave = r->leave;
    const float lows[3] = {low.x, low.y, low.z}, highs[3] = {high.x, high.y, high.z};
#pragma unroll
    for (uint axis = 0; axis < 3; axis++) {
        const VF a = (lows[axis] - r->above[axis]) * r->inverse[axis];
        const VF b = (highs[axis] - r->below[axis]) * r->inverse[axis];
        const VF first = a < b ? a : b, last = a < b ? b : a;
        enter = first > enter ? first : enter;
        leave = last < leave ? last : leave;
    }
    return MASK_V(enter <= leave);
}

// The triangle test of triangle.h for rays that share their major axis m; p and q are the next ones. Its sums
// round once or twice, as the zeros and ones in the frame make the general form round.
#define FUSED(shear, along, across) FMA_V(shear, along, across)
#define TWICE(shear, along, across) ((across) + (shear) * (along))
#define DEFINE_AXIS_TEST(NAME, M, P, Q, m, p, q, FIRST, SECOND)                                    \
    inline VI NAME(const SimdRay *r, float4 v0, float4 v1, float4 v2, VF *edges, VF *depths)       \
    {                                                                                              \
        const VF om = r->org[M], op = r->org[P], oq = r->org[Q];                                   \
        const VF a = v0.m - om, b = v1.m - om, c = v2.m - om;                                      \
        const VF px = FIRST(r->shear[0], a, v0.p - op), py = SECOND(r->shear[1], a, v0.q - oq);    \
        const VF qx = FIRST(r->shear[0], b, v1.p - op), qy = SECOND(r->shear[1], b, v1.q - oq);    \
        const VF sx = FIRST(r->shear[0], c, v2.p - op), sy = SECOND(r->shear[1], c, v2.q - oq);    \
        edges[0] = DIFFERENCE_OF_PRODUCTS(sx, qy, sy, qx);                                         \
        edges[1] = DIFFERENCE_OF_PRODUCTS(px, sy, py, sx);                                         \
        edges[2] = DIFFERENCE_OF_PRODUCTS(qx, py, qy, px);                                         \
        depths[0] = r->scale * a, depths[1] = r->scale * b, depths[2] = r->scale * c;              \
        return ((edges[0] >= 0.0f) & (edges[1] >= 0.0f) & (edges[2] >= 0.0f))                      \
               | ((edges[0] <= 0.0f) & (edges[1] <= 0.0f) & (edges[2] <= 0.0f));                   \
    }
#if WIDTH == 16
#define DIFFERENCE_OF_PRODUCTS difference_of_products16
#else
#define DIFFERENCE_OF_PRODUCTS difference_of_products4
#endif
DEFINE_AXIS_TEST(inside_edges_x, 0, 1, 2, x, y, z, FUSED, FUSED)
DEFINE_AXIS_TEST(inside_edges_y, 1, 2, 0, y, z, x, FUSED, TWICE)
DEFINE_AXIS_TEST(inside_edges_z, 2, 0, 1, z, x, y, TWICE, TWICE)

inline VFrame mixed_frame(const SimdRay *r)
{
    const VI x = r->major == 0, y = r->major == 1;
    const VF s = r->shear[0], t = r->shear[1], scale = r->scale, one = 1.0f, none = 0.0f;
    const VFrame frame = {r->org[0],
                          r->org[1],
                          r->org[2],
                          x ? s : (y ? none : one),
                          x ? one : (y ? s : none),
                          x ? none : (y ? one : s),
                          x ? t : (y ? one : none),
                          x ? none : (y ? t : one),
                          x ? one : (y ? none : t),
                          x ? scale : none,
                          y ? scale : none,
                          (x | y) ? none : scale,
                          r->tnear,
                          r->tfar};
    return frame;
}

// Keeps the nearer of two hits, of equal ones the smaller triangle.
inline void keep_nearer(SimdRay *r, const VFrame *frame, VI inside, const VF *edges,
                        const VF *depths, uint triangle)
{
    const VHit h = FINISH_HIT(frame, inside, edges, depths);
    const VI nearer
        = h.hit & ((h.t < r->t) | ((h.t == r->t) & ((VU)triangle < r->triangle)));
    r->t = nearer ? h.t : r->t;
    r->triangle = nearer ? (VU)triangle : r->triangle;
}

#define TEST_TRIANGLES(INSIDE, RAYS)                                                               \
    for (uint k = 0; k < count; k++) {                                                             \
        global const float4 *v = triangles + TRIANGLE_FLOAT4S * (ulong)slots[k];                   \
        VF edges[3], depths[3];                                                                    \
        const VI inside = INSIDE(RAYS, v[0], v[1], v[2], edges, depths);                           \
        if (MASK_V(inside))                                                                        \
            keep_nearer(r, &frame, inside, edges, depths, as_uint(v[0].w));                        \
    }

// Tests a SIMD ray against the triangles in `slots`.
inline void intersect_triangles(SimdRay *r, const uint *slots, uint count,
                                global const float4 *triangles)
{
    VFrame frame;
    frame.tnear = r->tnear, frame.tfar = r->tfar;
    if (r->axis == 0)
        TEST_TRIANGLES(inside_edges_x, r)
    else if (r->axis == 1)
        TEST_TRIANGLES(inside_edges_y, r)
    else if (r->axis == 2)
        TEST_TRIANGLES(inside_edges_z, r)
    else {
        frame = mixed_frame(r);
        TEST_TRIANGLES(INSIDE_EDGES, &frame)
    }
}

typedef struct {
    VF x, y, z;
} VCorner;
DEFINE_TRIANGLE_TEST(_lanes, VF, VI, FMA_V, VFrame, VCorner, VHit)

// The hits of all lanes, each with the triangle that is its closest.
inline VHit hit_again(const SimdRay *r, global const float4 *triangles)
{
    uint ids[WIDTH] __attribute__((aligned(64)));
    *(VU *)ids = r->triangle != INVALID ? r->triangle : (VU)0;
    VCorner corners[3];
    for (uint k = 0; k < 3; k++) {
        float4 s[WIDTH] __attribute__((aligned(64)));
        for (uint lane = 0; lane < WIDTH; lane++)
            s[lane] = triangles[TRIANGLE_FLOAT4S * (ulong)ids[lane] + k];
        VF unused;
        TRANSPOSE(s, corners[k].x, corners[k].y, corners[k].z, unused)
    }
    const VFrame frame = mixed_frame(r);
    VF edges[3], depths[3];
    const VI inside
        = inside_edges_lanes(&frame, corners[0], corners[1], corners[2], edges, depths);
    return finish_hit_lanes(&frame, inside, edges, depths);
}

// Fills the rows from the rays of the lanes; lanes that are not live never hit.
inline void set_up(SimdRay *r, const VF *origin, const VF *direction, VF tnear, VF tfar, VI live, float size)
{
    VF d[3], most = 0.0f;
    for (uint axis = 0; axis < 3; axis++) {
        r->org[axis] = CHOOSE(live, origin[axis], 0.0f);
        d[axis] = CHOOSE(live, direction[axis], 1.0f);
        const VF o = magnitude_v(r->org[axis]);
        most = o > most ? o : most;
    }
    const VF pad = BOX_PAD * (size + most) + SMALLEST_PAD;
    const VF x = magnitude_v(d[0]), y = magnitude_v(d[1]), z = magnitude_v(d[2]);
    const VI along_x = (x >= y) & (x >= z), along_y = ~along_x & (y >= z);
    const VF m = along_x ? d[0] : (along_y ? d[1] : d[2]);
    r->shear[0] = -((along_x ? d[1] : (along_y ? d[2] : d[0])) / m);
    r->shear[1] = -((along_x ? d[2] : (along_y ? d[0] : d[1])) / m);
    r->scale = 1.0f / m;
    r->major = along_x ? (VI)0 : (along_y ? (VI)1 : (VI)2);
    r->axis = MIXED;
    for (uint axis = 0; axis < 3; axis++)
        r->axis = MASK_V(live & (r->major != (int)axis)) == 0 ? axis : r->axis;
    r->largest = magnitude_v(m);
    for (uint axis = 0; axis < 3; axis++) {
        r->above[axis] = r->org[axis] + pad, r->below[axis] = r->org[axis] - pad;
        r->unit[axis] = d[axis] / r->largest;
        const VF inverse = 1.0f / r->unit[axis];
        const VF limited = CHOOSE(inverse > LARGEST_INVERSE, LARGEST_INVERSE, inverse);
        r->inverse[axis] = CHOOSE(limited < -LARGEST_INVERSE, -LARGEST_INVERSE, limited);
    }
    r->tnear = CHOOSE(live, tnear, 0.0f);
    // A distance that leaves the range of float is no hit: infinity stays above tfar.
    r->tfar = CHOOSE(live, CHOOSE(tfar < MAXFLOAT, tfar, MAXFLOAT), -1.0f);
    r->enter = r->tnear * r->largest;
    r->leave = CHOOSE(live, tfar * r->largest, -INFINITY);
    r->t = INFINITY;
}
