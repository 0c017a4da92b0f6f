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
typedef Corner16 VCorner;
#define LANES (uint16)(0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15)
#define TRANSPOSE(s, x, y, z, w) TRANSPOSE16(s, x, y, z, w)
#define STORE_ROW(to, from) STORE_UNALIGNED_QUAD(to, *(const uint4 *)(from))
#define SIDE 4 // of the square of pixels that a SIMD ray covers
#define AS_VF as_float16
#define AS_VI as_int16
#define AS_VU as_uint16
#define FMA_V(a, b, c) FMA16(a, b, c)
#define MASK_V(m) MASK16(m)
#define SET_FRAME set_frame16
#define TURN turn16
#define INSIDE_EDGES inside_edges_rays16
#define INSIDE_EDGES_LANES inside_edges_lanes16
#define FINISH_HIT finish_hit16
#define HALVES(OP, v)                                                                              \
    const float8 v8 = OP((v).lo, (v).hi);                                                          \
    const float4 v4 = OP(v8.lo, v8.hi);
#else
DEFINE_CORNER(Corner4, float4)
DEFINE_TRIANGLE_HIT(TriangleHit4, float4, int4)
DEFINE_DIFFERENCE_OF_PRODUCTS(4, float4, FMA4)
DEFINE_RAYS_TEST(4, float4, int4, FMA4, MASK4)
typedef float4 VF;
typedef int4 VI;
typedef uint4 VU;
typedef RayFrame4 VFrame;
typedef TriangleHit4 VHit;
typedef Corner4 VCorner;
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
#define SET_FRAME set_frame4
#define TURN turn4
#define INSIDE_EDGES inside_edges_rays4
#define INSIDE_EDGES_LANES inside_edges_lanes4
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
    VFrame frame;
    VF largest; // m
    VF t;       // closest hit
    VU triangle;
    VF unit[3]; // q
    VU ray;
    uint live; // lanes that hold a ray
} SimdRay;

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

// Keeps the nearer of two hits, of equal ones the smaller triangle.
inline void keep_nearer(SimdRay *r, VI inside, const VF *edges, const VF *depths, uint triangle)
{
    const VHit h = FINISH_HIT(&r->frame, inside, edges, depths);
    const VI nearer
        = h.hit & ((h.t < r->t) | ((h.t == r->t) & ((VU)triangle < r->triangle)));
    r->t = nearer ? h.t : r->t;
    r->triangle = nearer ? (VU)triangle : r->triangle;
}

// Tests a SIMD ray against the triangles in `slots`.
inline void intersect_triangles(SimdRay *r, const uint *slots, uint count,
                                global const float4 *triangles)
{
    for (uint k = 0; k < count; k++) {
        global const float4 *v = triangles + TRIANGLE_FLOAT4S * (ulong)slots[k];
        VF edges[3], depths[3];
        const VI inside = INSIDE_EDGES(&r->frame, (global const float *)v, 4, 1, edges, depths);
        if (MASK_V(inside))
            keep_nearer(r, inside, edges, depths, as_uint(v[0].w));
    }
}

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
        VF x, y, z, unused;
        TRANSPOSE(s, x, y, z, unused)
        corners[k] = TURN(x, y, z, r->frame.major);
    }
    VF edges[3], depths[3];
    const VI inside
        = INSIDE_EDGES_LANES(&r->frame, corners[0], corners[1], corners[2], edges, depths);
    return FINISH_HIT(&r->frame, inside, edges, depths);
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
    r->largest = x > y ? x : y;
    r->largest = z > r->largest ? z : r->largest;
    SET_FRAME(&r->frame, r->org, d, CHOOSE(live, tnear, 0.0f), CHOOSE(live, tfar, -1.0f), live);
    for (uint axis = 0; axis < 3; axis++) {
        r->above[axis] = r->org[axis] + pad, r->below[axis] = r->org[axis] - pad;
        r->unit[axis] = d[axis] / r->largest;
        const VF inverse = 1.0f / r->unit[axis];
        const VF limited = CHOOSE(inverse > LARGEST_INVERSE, LARGEST_INVERSE, inverse);
        r->inverse[axis] = CHOOSE(limited < -LARGEST_INVERSE, -LARGEST_INVERSE, limited);
    }
    r->enter = r->frame.tnear * r->largest;
    r->leave = CHOOSE(live, tfar * r->largest, -INFINITY);
    r->t = INFINITY;
}
