// Triangles, gathered from the mesh once per frame, and their bounds, for the methods that need them.
//
// Output layout:
//   triangles  three float4 a triangle: v0, v1, v2, w unused
//   bounds       cl/bounds.h, for tests of scattered triangles
//   bound_rows   the same per block of 16 triangles, a float16 each; for runs
//   middles      boxes around parts of the scene, low and high corner, for cells to divide
// All are padded to whole blocks; padding has radius -inf, which no test of cl/node.h keeps.
//
// Spheres are minimal (design, section 5): the circumcircle's, or that of the longest edge where the
// triangle is obtuse. The centre is rounded, so the radius is measured from the rounded centre to the
// three vertices and enlarged by RADIUS_SLACK, more than the rounding of that distance.
//
// Build-time constant: GATHERED, triangles to a work-item.

#include "bounds.h"
#include "triangle.h"

#define SLAB_SLACK 0x1p-20f // the three dot products: below 8 u times the radius

inline float largest(float4 v)
{
    return largest3(fabs(v));
}

// Centre from the first vertex, for edges ab and ac of a size near one.
inline float4 relative_centre(float4 ab, float4 ac)
{
    const float4 bc = ac - ab;
    const float ab2 = dot3(ab, ab), ac2 = dot3(ac, ac), bc2 = dot3(bc, bc);
    if (ab2 >= ac2 + bc2)
        return 0.5f * ab;
    if (ac2 >= ab2 + bc2)
        return 0.5f * ac;
    if (bc2 >= ab2 + ac2)
        return ab + 0.5f * bc;
    // Acute, so the denominator is well away from zero.
    const float4 n = cross3(ab, ac);
    return (ac2 * cross3(n, ab) + ab2 * cross3(ac, n)) / (2.0f * dot3(n, n));
}

// Everything is divided by the largest component before it is multiplied: the fifth power of an edge
// leaves the range of float from lengths of 1e-8 and 5e7 on.
inline float4 bounding_sphere(float4 a, float4 b, float4 c)
{
    const float size = MAX(largest(b - a), largest(c - a));
    float4 sphere = a;
    if (size > 0.0f)
        sphere += size * relative_centre((b - a) / size, (c - a) / size);
    const float4 da = a - sphere, db = b - sphere, dc = c - sphere;
    const float far = MAX(largest(da), MAX(largest(db), largest(dc)));
    sphere.w = 0.0f;
    if (far > 0.0f) {
        const float4 ea = da / far, eb = db / far, ec = dc / far;
        const float2 squares = (float2)(MAX(dot3(ea, ea), dot3(eb, eb)), dot3(ec, ec));
        sphere.w = far * sqrt(MAX(squares.x, squares.y)) * RADIUS_SLACK;
    }
    return sphere;
}

// The slab around the sphere's centre, which lies in the plane but for its rounding. A triangle without
// a normal has a slab without an end.
inline float4 slab(float4 a, float4 b, float4 c, float4 sphere)
{
    const float size = MAX(largest(b - a), largest(c - a));
    const float4 n = size > 0.0f ? cross3((b - a) / size, (c - a) / size) : (float4)0.0f;
    const float length = sqrt(dot3(n, n));
    if (!(length > 0x1p-20f && sphere.w < INFINITY)) // below, the normal is rounding
        return (float4)(0.0f, 0.0f, 0.0f, INFINITY);
    float4 result = n / length;
    const float high = MAX(fabs(dot3(result, a - sphere)), fabs(dot3(result, b - sphere)));
    result.w = MAX(high, fabs(dot3(result, c - sphere))) + SLAB_SLACK * sphere.w;
    return result;
}

// Half extents around the sphere's centre; differences are rounded once.
inline float4 half_extents(float4 a, float4 b, float4 c, float4 sphere)
{
    const float4 da = fabs(a - sphere), db = fabs(b - sphere), dc = fabs(c - sphere);
    const float4 ab = da > db ? da : db;
    float4 result = (ab > dc ? ab : dc) * RADIUS_SLACK;
    result.w = 0.0f;
    return result;
}

inline float4 vertex(global const float *vertices, uint number)
{
    global const float *p = vertices + 3 * (ulong)number;
    return (float4)(p[0], p[1], p[2], 0.0f);
}

// One work-item gathers GATHERED triangles; padding is zero. middles[2 * item]: the box around twice the
// middles of these triangles' boxes; inf, -inf where there are none.
kernel void gather_triangles(const uint num_triangles, const uint padded,
                             global const float *restrict vertices,
                             global const uint *restrict faces, global float4 *restrict triangles,
                             global float4 *restrict middles)
{
    const uint begin = GATHERED * get_global_id(0), end = MIN(begin + GATHERED, padded);
    float4 lowest = INFINITY, highest = -INFINITY;
    for (uint i = begin; i < MIN(end, num_triangles); i++) {
        global const uint *face = faces + 3 * (ulong)i;
        const float4 a = vertex(vertices, face[0]), b = vertex(vertices, face[1]),
                     c = vertex(vertices, face[2]);
        global float4 *triangle = triangles + TRIANGLE_FLOAT4S * (ulong)i;
        triangle[0] = a, triangle[1] = b, triangle[2] = c;
        float4 low, high;
        bound_corners(a, b, c, &low, &high);
        const float4 middle = low + high;
        lowest = middle < lowest ? middle : lowest;
        highest = middle > highest ? middle : highest;
    }
    for (uint i = MAX(begin, num_triangles); i < end; i++)
        for (uint corner = 0; corner < 3; corner++)
            triangles[TRIANGLE_FLOAT4S * (ulong)i + corner] = 0.0f;
    middles[2 * get_global_id(0)] = lowest;
    middles[2 * get_global_id(0) + 1] = highest;
}

// One work-item bounds one block of 16 triangles.
kernel void bound_triangles(const uint num_triangles, global const float4 *restrict triangles,
                            global float4 *restrict bounds, global float *restrict bound_rows)
{
    const uint block = get_global_id(0);
    for (uint lane = 0; lane < 16; lane++) {
        const uint i = block * 16 + lane;
        float4 bound[BOUND_FLOAT4S] = {(float4)(0.0f, 0.0f, 0.0f, -INFINITY), 0.0f, 0.0f};
        if (i < num_triangles) {
            global const float4 *v = triangles + TRIANGLE_FLOAT4S * (ulong)i;
            bound[0] = bounding_sphere(v[0], v[1], v[2]);
            bound[1] = slab(v[0], v[1], v[2], bound[0]);
            bound[2] = half_extents(v[0], v[1], v[2], bound[0]);
        }
        for (uint part = 0; part < BOUND_FLOAT4S; part++) {
            bounds[BOUND_FLOAT4S * (ulong)i + part] = bound[part];
            global float *rows = bound_rows + 16 * (BOUND_ROWS * (ulong)block + 4 * part) + lane;
            rows[0] = bound[part].x;
            rows[16] = bound[part].y;
            rows[32] = bound[part].z;
            rows[48] = bound[part].w;
        }
    }
}
