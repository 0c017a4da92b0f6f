// Traversal of the ray-space hierarchy, level by level (Roger et al. 2007, section 3.3).
//
// The top level's nodes are tested against every triangle in a loop: its pairs are never written
// out. Below, each pair (node, triangle) of the stream is tested against all children of the node at
// once. Tests only mark survivors (a mask per pair, a count per chunk); cl/stream.cl makes the next
// level's stream of them.
//
// Layouts: nodes in cl/node.h, triangle spheres in cl/geometry.cl, streams in cl/stream.h.
// Build-time constants: ARITY, CHUNKS.

#include "node.h"
#include "stream.h"

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
                      global uint *restrict chunk_tests, global uint *restrict chunk_hits)
{
    const uint runs = (last_triangle - first_triangle + RUN - 1) / RUN;
    const ulong tasks = (ulong)num_nodes * runs;
    uint tests = 0, hits = 0;
    for (ulong task = chunk_begin(tasks, 1), end = chunk_end(tasks, 1); task < end; task++) {
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
    for (ulong task = chunk_begin(tasks, 1), end = chunk_end(tasks, 1); task < end; task++) {
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

// A group's children side by side: field `row` of the nodes' blocks, and the triangles' spheres, each
// component spread over its member's lanes.
#if ARITY == 4
#define GROUP_ROW(row) ((float16)(c[0][row], c[1][row], c[2][row], c[3][row]))
#define GROUP_SPHERES (float16)(d[0], d[1], d[2], d[3])
#define SPHERES_TYPE float16
#define SPREAD(s, x, y, z, w) s.s##x##x##x##x##y##y##y##y##z##z##z##z##w##w##w##w
#define SPREAD_X(s) SPREAD(s, 0, 4, 8, c)
#define SPREAD_Y(s) SPREAD(s, 1, 5, 9, d)
#define SPREAD_Z(s) SPREAD(s, 2, 6, a, e)
#define SPREAD_R(s) SPREAD(s, 3, 7, b, f)
#elif ARITY == 8
#define GROUP_ROW(row) ((float16)(c[0][row], c[1][row]))
#define GROUP_SPHERES (float8)(d[0], d[1])
#define SPHERES_TYPE float8
#define SPREAD_X(s) ((float16)(s.s00000000, s.s44444444))
#define SPREAD_Y(s) ((float16)(s.s11111111, s.s55555555))
#define SPREAD_Z(s) ((float16)(s.s22222222, s.s66666666))
#define SPREAD_R(s) ((float16)(s.s33333333, s.s77777777))
#else
#define GROUP_ROW(row) (c[0][row])
#define GROUP_SPHERES d[0]
#define SPHERES_TYPE float4
#define SPREAD_X(s) (float16)(s.x)
#define SPREAD_Y(s) (float16)(s.y)
#define SPREAD_Z(s) (float16)(s.z)
#define SPREAD_R(s) (float16)(s.w)
#endif

// `valid[node]`: children of the node that are not null, the tests that a pair costs.
kernel void test_children(global const uint *restrict length, global const Pair *restrict pairs,
                          global const float *restrict blocks, global const uint *restrict valid,
                          global const float4 *restrict spheres, global ushort *restrict masks,
                          global uint *restrict chunk_tests, global uint *restrict chunk_hits)
{
    const uint n = *length;
    uint tests = 0, hits = 0;
    for (uint i = chunk_begin(n, GROUP), end = chunk_end(n, GROUP); i < end; i += GROUP) {
        global const FLOATN *c[GROUP];
        float4 d[GROUP];
        for (uint k = 0; k < GROUP; k++) {
            const Pair pair = pairs[MIN(i + k, n - 1)];
            c[k] = (global const FLOATN *)(blocks + (ulong)pair.x * (NODE_ROWS * ARITY));
            d[k] = spheres[pair.y];
            tests += i + k < n ? valid[pair.x] : 0;
        }
        const SPHERES_TYPE s = GROUP_SPHERES;
        uint mask = MASK16(node_meets_sphere(
            GROUP_ROW(0), GROUP_ROW(1), GROUP_ROW(2), GROUP_ROW(3), GROUP_ROW(4), GROUP_ROW(5),
            GROUP_ROW(6), GROUP_ROW(7), GROUP_ROW(8), GROUP_ROW(9), SPREAD_X(s), SPREAD_Y(s), SPREAD_Z(s),
            SPREAD_R(s)));
        if (n - i < GROUP)
            mask &= (1u << (n - i) * ARITY) - 1;
        masks[i / GROUP] = (ushort)mask;
        hits += COUNT16(mask);
    }
    chunk_tests[get_global_id(0)] = tests;
    chunk_hits[get_global_id(0)] = hits;
}
