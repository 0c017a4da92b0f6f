// Triangles and their bounding spheres, gathered from the mesh once per frame.
//
// Output layout:
//   triangles  three float4 a triangle: v0, v1, v2, w unused
//   spheres       a float4 a triangle: centre, radius; for tests of scattered triangles
//   sphere_rows   per block of 16 triangles four float16 rows: centre x, y, z, radius; for runs
// All are padded to whole blocks; padding has radius -inf, which no test of cl/node.h keeps.
//
// Spheres are minimal (design, section 5): the circumcircle's, or that of the longest edge where the
// triangle is obtuse. The centre is rounded, so the radius is measured from the rounded centre to the
// three vertices and enlarged by RADIUS_SLACK, eight times the rounding of that distance.

#include "triangle.h"

#define RADIUS_SLACK (1.0f + 0x1p-20f)

inline float largest(float4 v)
{
    const float4 m = fabs(v);
    return MAX(m.x, MAX(m.y, m.z));
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

// One work-item gathers one block of 16 triangles.
kernel void gather_triangles(const uint num_triangles, global const float *restrict vertices,
                             global const uint *restrict faces, global float4 *restrict triangles,
                             global float4 *restrict spheres, global float *restrict sphere_rows)
{
    const uint block = get_global_id(0);
    for (uint lane = 0; lane < 16; lane++) {
        const uint i = block * 16 + lane;
        float4 v[3] = {0.0f, 0.0f, 0.0f};
        float4 sphere = (float4)(0.0f, 0.0f, 0.0f, -INFINITY);
        if (i < num_triangles) {
            for (uint corner = 0; corner < 3; corner++) {
                global const float *p = vertices + 3 * (ulong)faces[3 * i + corner];
                v[corner] = (float4)(p[0], p[1], p[2], 0.0f);
            }
            sphere = bounding_sphere(v[0], v[1], v[2]);
        }
        for (uint corner = 0; corner < 3; corner++)
            triangles[TRIANGLE_FLOAT4S * (ulong)i + corner] = v[corner];
        spheres[i] = sphere;
        global float *rows = sphere_rows + 64 * (ulong)block + lane;
        rows[0] = sphere.x;
        rows[16] = sphere.y;
        rows[32] = sphere.z;
        rows[48] = sphere.w;
    }
}
