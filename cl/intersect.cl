// Final ray-triangle intersection, and what all tracers share: resolving hits.
//
// Build-time constant: CHUNKS.

#pragma OPENCL EXTENSION cl_khr_int64_base_atomics : enable
#pragma OPENCL EXTENSION cl_khr_int64_extended_atomics : enable

#include "pairs.h"
#include "triangle.h"

inline uint ray_of(uint slot, uint num_slots, global const uint *slots)
{
    return slot < num_slots ? slots[slot] : INVALID;
}

// Pairs (node, triangle) whose nodes hold `rays_per_node` consecutive slots; a run of pairs shares its
// rays. Sets the minimum in `result`, or where any hit is asked for, the flag; counts tests and hits
// per chunk.
#define DEFINE_INTERSECT_PAIRS(NAME, RESULT, ON_HITS)                                              \
    kernel void NAME(global const uint *restrict length, global const Pair *restrict pairs,        \
                     const uint rays_per_node, const uint num_slots,                               \
                     global const uint *restrict slots, global const float4 *restrict org_tnear,   \
                     global const float4 *restrict dir_tfar,                                       \
                     global const float4 *restrict triangles, global RESULT *restrict result,      \
                     global ulong *restrict chunk_tests, global ulong *restrict chunk_hits)        \
    {                                                                                              \
        const uint n = *length;                                                                    \
        ulong tests = 0, hits = 0;                                                                 \
        for (uint i = chunk_begin(n), end = chunk_end(n); i < end;) {                              \
            const uint count = run_length(pairs, i, end);                                          \
            for (uint k = 0; k < rays_per_node; k++) {                                             \
                const uint ray = ray_of(pairs[i].x * rays_per_node + k, num_slots, slots);         \
                if (ray == INVALID || dir_tfar[ray].w < org_tnear[ray].w)                          \
                    continue;                                                                      \
                const RayFrame frame = ray_frame(org_tnear[ray], dir_tfar[ray]);                   \
                uint found = 0;                                                                    \
                const ulong nearest                                                                \
                    = intersect_run(&frame, pairs + i, count, triangles, &found);                  \
                tests += count;                                                                    \
                hits += found;                                                                     \
                if (found)                                                                         \
                    ON_HITS;                                                                       \
            }                                                                                      \
            i += count;                                                                            \
        }                                                                                          \
        chunk_tests[get_global_id(0)] = tests;                                                     \
        chunk_hits[get_global_id(0)] = hits;                                                       \
    }

inline ulong intersect_run(const RayFrame *frame, global const Pair *pairs, uint count,
                           global const float4 *triangles, uint *found)
{
    ulong nearest = MISS;
    for (uint k = 0; k < count; k++) {
        const uint triangle = pairs[k].y;
        const TriangleHit h
            = intersect_triangle(frame, triangles + TRIANGLE_FLOAT4S * (ulong)triangle);
        if (h.hit) {
            const ulong key = hit_key(h.t, triangle);
            nearest = MIN(nearest, key);
            *found += 1;
        }
    }
    return nearest;
}

DEFINE_INTERSECT_PAIRS(intersect_pairs, ulong, atom_min(result + ray, nearest))
DEFINE_INTERSECT_PAIRS(occlude_pairs, uchar, result[ray] = 1)

// One work-item: row `row` of counts grows by the chunks' counts of the final tests.
kernel void sum_final(global const uint *restrict length, global const ulong *restrict chunk_tests,
                      global const ulong *restrict chunk_hits, global ulong *restrict counts,
                      const uint row)
{
    global ulong *level = counts + row * LEVEL_COUNTS;
    for (uint c = 0; c < CHUNKS; c++) {
        level[LEVEL_TESTS] += chunk_tests[c];
        level[LEVEL_HITS] += chunk_hits[c];
    }
    level[LEVEL_STREAM] = *length;
}

// Hits from keys: t, triangle, u, v; inf, INVALID, 0, 0 where missed.
kernel void resolve_hits(const uint num_rays, global const ulong *restrict closest,
                         global const float4 *restrict org_tnear,
                         global const float4 *restrict dir_tfar,
                         global const float4 *restrict triangles, global float *restrict t,
                         global uint *restrict triangle, global float *restrict u,
                         global float *restrict v)
{
    const uint i = get_global_id(0);
    if (i >= num_rays)
        return;
    TriangleHit h = {INFINITY, 0.0f, 0.0f, 0};
    uint id = INVALID;
    if (closest[i] != MISS) {
        id = (uint)closest[i];
        const RayFrame frame = ray_frame(org_tnear[i], dir_tfar[i]);
        h = intersect_triangle(&frame, triangles + TRIANGLE_FLOAT4S * (ulong)id);
    }
    t[i] = h.t;
    triangle[i] = id;
    u[i] = h.u;
    v[i] = h.v;
}

// Flat triangle numbers into (geometry, face within it); -1 where missed.
kernel void split_ids(const uint num_rays, global const uint *restrict triangle,
                      global const uint *restrict geom_ids, global const uint *restrict first_prims,
                      global int *restrict geom_id, global int *restrict prim_id)
{
    const uint i = get_global_id(0);
    if (i >= num_rays)
        return;
    const uint id = triangle[i];
    geom_id[i] = id == INVALID ? -1 : (int)geom_ids[id];
    prim_id[i] = id == INVALID ? -1 : (int)(id - first_prims[geom_ids[id]]);
}
