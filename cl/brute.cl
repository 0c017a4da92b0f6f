// Every ray against every triangle: the device-side oracle of all other methods.
//
// One work-item takes 16 consecutive rays in the lanes of float16 and walks over all triangles in
// order, so the first of equal distances, which has the smallest number, stays.

#include "rays.h"
#include "triangle.h"

// Lanes past the last ray, and inactive rays, get tfar = -1 and so never hit.
inline RayFrame16 ray_frame16(uint first, uint num_rays, global const float4 *org_tnear,
                              global const float4 *dir_tfar)
{
    const Rays16 r = load_rays(first, num_rays, org_tnear, dir_tfar);
    const float16 o[3] = {r.ox, r.oy, r.oz}, d[3] = {r.dx, r.dy, r.dz};
    const int16 active = r.tfar >= r.tnear;
    RayFrame16 frame;
    set_frame16(&frame, o, d, r.tnear, active ? r.tfar : (float16)-1.0f, active);
    return frame;
}

// Of work-item g: counts[2g] rays that are active, counts[2g + 1] (ray, triangle) hits within the
// rays' segments, nearest or not.
#define BEGIN_BRUTE                                                                                \
    const uint first = get_global_id(0) * 16;                                                      \
    if (first >= num_rays)                                                                         \
        return;                                                                                    \
    const RayFrame16 frame = ray_frame16(first, num_rays, org_tnear, dir_tfar);                    \
    int16 count = 0;

inline uint sum16(int16 v)
{
    const int8 a = v.lo + v.hi;
    const int4 b = a.lo + a.hi;
    return (uint)(b.x + b.y + b.z + b.w);
}

kernel void intersect_brute(const uint num_rays, const uint num_triangles,
                            global const float4 *restrict org_tnear,
                            global const float4 *restrict dir_tfar,
                            global const float4 *restrict triangles, global ulong *restrict closest,
                            global uint *restrict counts)
{
    BEGIN_BRUTE
    float16 best = INFINITY;
    int16 nearest = (int)INVALID;
    for (uint i = 0; i < num_triangles; i++) {
        global const float *v = (global const float *)(triangles + TRIANGLE_FLOAT4S * (ulong)i);
        float16 edges[3], depths[3];
        const int16 inside = inside_edges_rays16(&frame, v, 4, 1, edges, depths);
        if (MASK16(inside)) {
            const TriangleHit16 h = finish_hit16(&frame, inside, edges, depths);
            count -= h.hit;
            // A later triangle replaces an earlier one only if strictly nearer.
            const int16 nearer = h.hit & ((h.t < best) | (nearest == (int)INVALID));
            best = nearer ? h.t : best;
            nearest = nearer ? (int16)(int)i : nearest;
        }
    }
    float t[16] __attribute__((aligned(64)));
    int id[16] __attribute__((aligned(64)));
    *(float16 *)t = best;
    *(int16 *)id = nearest;
    for (uint lane = 0; lane < 16 && first + lane < num_rays; lane++) {
        const bool hit = (uint)id[lane] != INVALID;
        closest[first + lane] = hit ? hit_key(t[lane], (uint)id[lane]) : MISS;
    }
    counts[2 * get_global_id(0)] = sum16(-(frame.tfar >= frame.tnear));
    counts[2 * get_global_id(0) + 1] = sum16(count);
}

kernel void occlude_brute(const uint num_rays, const uint num_triangles,
                          global const float4 *restrict org_tnear,
                          global const float4 *restrict dir_tfar,
                          global const float4 *restrict triangles, global uchar *restrict blocked,
                          global uint *restrict counts)
{
    BEGIN_BRUTE
    for (uint i = 0; i < num_triangles; i++) {
        global const float *v = (global const float *)(triangles + TRIANGLE_FLOAT4S * (ulong)i);
        float16 edges[3], depths[3];
        const int16 inside = inside_edges_rays16(&frame, v, 4, 1, edges, depths);
        if (MASK16(inside))
            count -= finish_hit16(&frame, inside, edges, depths).hit;
    }
    int lanes[16] __attribute__((aligned(64)));
    *(int16 *)lanes = count;
    for (uint lane = 0; lane < 16 && first + lane < num_rays; lane++)
        blocked[first + lane] = lanes[lane] != 0;
    counts[2 * get_global_id(0)] = sum16(-(frame.tfar >= frame.tnear));
    counts[2 * get_global_id(0) + 1] = sum16(count);
}
