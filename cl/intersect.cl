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

// The triangles of up to WIDTH pairs, component k of corner c in rows[3 * c + k]; the last pair fills up.
inline void gather_corners(global const Pair *pairs, uint count, global const float4 *triangles,
                           float16 *rows)
{
    for (uint corner = 0; corner < 3; corner++) {
        float4 s[WIDTH] __attribute__((aligned(64)));
        for (uint k = 0; k < WIDTH; k++)
            s[k] = triangles[TRIANGLE_FLOAT4S * (ulong)pairs[k < count ? k : count - 1].y + corner];
        float16 unused;
        TRANSPOSE16(s, rows[3 * corner], rows[3 * corner + 1], rows[3 * corner + 2], unused);
    }
}

// One ray and up to WIDTH triangles: bit k of the result says whether triangle k is hit at t[k].
inline uint intersect_run(const RayFrame *frame, const float16 *rows, uint count, float16 *t)
{
    Corner16 corners[3];
    for (uint c = 0; c < 3; c++, rows += 3)
        corners[c].x = rows[frame->x], corners[c].y = rows[frame->y], corners[c].z = rows[frame->z];
    float16 edges[3], depths[3];
    const int16 inside
        = inside_edges_run(frame, corners[0], corners[1], corners[2], edges, depths);
    const uint lanes = (1u << count) - 1;
    if ((MASK16(inside) & lanes) == 0)
        return 0;
    const TriangleHit16 h = finish_hit_run(frame, inside, edges, depths);
    *t = h.t;
    return MASK16(h.hit) & lanes;
}

// Smallest key of the triangles whose bit is set.
inline ulong nearest_key(global const Pair *pairs, uint mask, float16 distances)
{
    float t[WIDTH] __attribute__((aligned(64)));
    *(float16 *)t = distances;
    ulong nearest = MISS;
    for (; mask != 0; mask &= mask - 1) {
        const uint k = LOWEST(mask);
        const ulong key = hit_key(t[k], pairs[k].y);
        nearest = MIN(nearest, key);
    }
    return nearest;
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
            const uint first_slot = pairs[i].x * rays_per_node;                                    \
            const uint count = run_length(pairs, i, MIN(i + WIDTH, end));                          \
            float16 rows[9];                                                                       \
            gather_corners(pairs + i, count, triangles, rows);                                     \
            for (uint k = 0; k < rays_per_node; k++) {                                             \
                const uint ray = ray_of(first_slot + k, num_slots, slots);                         \
                if (ray == INVALID || dir_tfar[ray].w < org_tnear[ray].w)                          \
                    continue;                                                                      \
                const RayFrame frame = ray_frame(org_tnear[ray], dir_tfar[ray]);                   \
                float16 t;                                                                         \
                const uint mask = intersect_run(&frame, rows, count, &t);                          \
                tests += count;                                                                    \
                if (mask) {                                                                        \
                    hits += COUNT16(mask);                                                         \
                    ON_HITS;                                                                       \
                }                                                                                  \
            }                                                                                      \
            i += count;                                                                            \
        }                                                                                          \
        chunk_tests[get_global_id(0)] = tests;                                                     \
        chunk_hits[get_global_id(0)] = hits;                                                       \
    }

DEFINE_INTERSECT_PAIRS(intersect_pairs, ulong,
                       atom_min(result + ray, nearest_key(pairs + i, mask, t)))
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

// Records of t, u, v and the triangle (single.h) as hits.
kernel void unpack_hits(const uint num_rays, global const float4 *restrict records,
                        global float *restrict t, global uint *restrict triangle,
                        global float *restrict u, global float *restrict v)
{
    const ulong runs = num_rays / 16, stop = 16 * chunk_end(runs);
    for (ulong i = 16 * chunk_begin(runs); i < stop; i += 16) {
        global const float4 *s = records + i;
        float16 ts, us, vs, triangles;
        TRANSPOSE16(s, ts, us, vs, triangles);
        STORE_UNALIGNED(float16, t + i, ts);
        STORE_UNALIGNED(uint16, triangle + i, as_uint16(triangles));
        STORE_UNALIGNED(float16, u + i, us);
        STORE_UNALIGNED(float16, v + i, vs);
    }
    if (get_global_id(0) == CHUNKS - 1)
        for (ulong i = 16 * runs; i < num_rays; i++) {
            t[i] = records[i].x, u[i] = records[i].y, v[i] = records[i].z;
            triangle[i] = as_uint(records[i].w);
        }
}

// Flat triangle numbers into (geometry, face within it); -1 where missed.
kernel void split_ids(const uint num_rays, const uint num_meshes,
                      global const uint *restrict triangle, global const uint *restrict geom_ids,
                      global const uint *restrict first_prims, global int *restrict geom_id,
                      global int *restrict prim_id)
{
    for (ulong i = chunk_begin(num_rays), end = chunk_end(num_rays); i < end; i++) {
        const uint id = triangle[i];
        uint mesh = id == INVALID ? INVALID : 0, first = 0;
        if (num_meshes > 1 && id != INVALID) {
            mesh = geom_ids[id];
            first = first_prims[mesh];
        }
        geom_id[i] = (int)mesh;
        prim_id[i] = (int)(id - first);
    }
}

// One work-item: sums of the columns of rows of counts.
kernel void sum_counts(const uint rows, const uint columns, global const ulong *restrict counts,
                       global ulong *restrict sums)
{
    for (uint k = 0; k < columns; k++) {
        ulong sum = 0;
        for (uint row = 0; row < rows; row++)
            sum += counts[row * columns + k];
        sums[k] = sum;
    }
}
