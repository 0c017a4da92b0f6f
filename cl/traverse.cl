// Traversal of the ray-space hierarchy, level by level (Roger et al. 2007, section 3.3).
//
// The top level's nodes are tested against every triangle in a loop: its pairs are never written
// out. Below, each pair (node, triangle) of the stream is tested against all children of the node at
// once. Tests only mark survivors (a mask per pair, a count per chunk); cl/pairs.cl makes the next
// level's stream of them.
//
// Layouts: nodes in cl/node.h, triangle spheres in cl/geometry.cl, streams in cl/pairs.h.
// Build-time constants: ARITY, CHUNKS.

#include "node.h"
#include "pairs.h"

// --- top level: tasks are (node, run of RUN triangles), in this order ---------------------------

#define RUN 256

inline float top_field(global const float *blocks, uint node, uint row)
{
    return blocks[(ulong)(node / ARITY) * (NODE_ROWS * ARITY) + row * ARITY + node % ARITY];
}

// Survivors among the 16 triangles of sphere block `block` that lie in begin .. end.
inline uint test_block(global const float *blocks, uint node, global const float16 *sphere_rows,
                       uint block, uint begin, uint end)
{
    global const float16 *rows = sphere_rows + 4 * (ulong)block;
    const uint mask = MASK16(node_meets_sphere(
        top_field(blocks, node, 0), top_field(blocks, node, 1), top_field(blocks, node, 2),
        top_field(blocks, node, 3), top_field(blocks, node, 4), top_field(blocks, node, 5),
        top_field(blocks, node, 6), top_field(blocks, node, 7), top_field(blocks, node, 8),
        top_field(blocks, node, 9), rows[0], rows[1], rows[2], rows[3]));
    const uint from_begin = begin > block * 16 ? 0xffffu << (begin - block * 16) : 0xffffu;
    const uint to_end = end < block * 16 + 16 ? (1u << (end - block * 16)) - 1 : 0xffffu;
    return mask & from_begin & to_end;
}

// Triangles first_triangle .. last_triangle are this batch.
kernel void count_top(const uint num_nodes, const uint first_triangle, const uint last_triangle,
                      global const float *restrict blocks, global const float16 *restrict sphere_rows,
                      global ulong *restrict chunk_tests, global ulong *restrict chunk_hits)
{
    const uint runs = (last_triangle - first_triangle + RUN - 1) / RUN;
    const ulong tasks = (ulong)num_nodes * runs;
    ulong tests = 0, hits = 0;
    for (ulong task = chunk_begin(tasks), end = chunk_end(tasks); task < end; task++) {
        const uint node = task / runs;
        const uint begin = first_triangle + (task % runs) * RUN;
        const uint stop = MIN(begin + RUN, last_triangle);
        if (top_field(blocks, node, 9) < 0.0f)
            continue; // a null node is never tested
        tests += stop - begin;
        for (uint block = begin / 16; block * 16 < stop; block++)
            hits += COUNT16(test_block(blocks, node, sphere_rows, block, begin, stop));
    }
    chunk_tests[get_global_id(0)] = tests;
    chunk_hits[get_global_id(0)] = hits;
}

kernel void write_top(const uint num_nodes, const uint first_triangle, const uint last_triangle,
                      global const float *restrict blocks, global const float16 *restrict sphere_rows,
                      global const uint *restrict offsets, global const uint *restrict out_length,
                      global Pair *restrict out)
{
    if (*out_length == 0)
        return;
    const uint runs = (last_triangle - first_triangle + RUN - 1) / RUN;
    const ulong tasks = (ulong)num_nodes * runs;
    uint next = offsets[get_global_id(0)];
    for (ulong task = chunk_begin(tasks), end = chunk_end(tasks); task < end; task++) {
        const uint node = task / runs;
        const uint begin = first_triangle + (task % runs) * RUN;
        const uint stop = MIN(begin + RUN, last_triangle);
        if (top_field(blocks, node, 9) < 0.0f)
            continue;
        for (uint block = begin / 16; block * 16 < stop; block++) {
            uint mask = test_block(blocks, node, sphere_rows, block, begin, stop);
            for (uint triangle = block * 16; mask != 0; triangle++, mask >>= 1) {
                if (mask & 1u)
                    out[next++] = (Pair)(node, triangle);
            }
        }
    }
}

// --- every level below ---------------------------------------------------------------------------

// The spheres of the triangles of up to sixteen pairs as rows; the last pair fills up.
typedef struct {
    float16 x, y, z, d;
} SphereRows;

inline SphereRows gather_spheres(global const Pair *pairs, uint count,
                                 global const float4 *spheres)
{
    float4 s[WIDTH] __attribute__((aligned(64)));
    for (uint k = 0; k < WIDTH; k++)
        s[k] = spheres[pairs[k < count ? k : count - 1].y];
    SphereRows rows;
    TRANSPOSE16(s, rows.x, rows.y, rows.z, rows.d);
    return rows;
}

inline int16 test_child(global const float *block, uint child, const SphereRows *p)
{
    global const float *f = block + child;
    return node_meets_sphere(f[0], f[ARITY], f[2 * ARITY], f[3 * ARITY], f[4 * ARITY], f[5 * ARITY],
                             f[6 * ARITY], f[7 * ARITY], f[8 * ARITY], f[9 * ARITY], p->x, p->y,
                             p->z, p->d);
}

inline void store_masks(global Mask *masks, uchar16 values, uint count)
{
    if (count == WIDTH) {
        STORE_UNALIGNED(uchar16, masks, values);
        return;
    }
    Mask lanes[WIDTH] __attribute__((aligned(64)));
    *(uchar16 *)lanes = values;
    for (uint k = 0; k < count; k++) // not more: the next chunk's masks follow
        masks[k] = lanes[k];
}

// `valid[node]`: children of the node that are not null, the tests that a pair costs.
kernel void test_children(global const uint *restrict length, global const Pair *restrict pairs,
                          global const float *restrict blocks, global const uint *restrict valid,
                          global const float4 *restrict spheres, global Mask *restrict masks,
                          global ulong *restrict chunk_tests, global ulong *restrict chunk_hits)
{
    const uint n = *length;
    ulong tests = 0, hits = 0;
    for (uint i = chunk_begin(n), end = chunk_end(n); i < end;) {
        const uint node = pairs[i].x;
        const uint count = run_length(pairs, i, MIN(i + WIDTH, end));
        const uint lanes = (1u << count) - 1;
        const SphereRows rows = gather_spheres(pairs + i, count, spheres);
        global const float *block = blocks + (ulong)node * (NODE_ROWS * ARITY);
        int16 mask = 0;
        for (uint child = 0; child < ARITY; child++) {
            const int16 hit = test_child(block, child, &rows);
            mask |= hit & (1 << child);
            hits += COUNT16(MASK16(hit) & lanes);
        }
        store_masks(masks + i, CONVERT(uchar16, mask), count);
        tests += count * valid[node];
        i += count;
    }
    chunk_tests[get_global_id(0)] = tests;
    chunk_hits[get_global_id(0)] = hits;
}
