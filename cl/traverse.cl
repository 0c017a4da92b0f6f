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

#if ARITY > 8
typedef ushort Mask;
#else
typedef uchar Mask;
#endif

inline uint mask4(int4 m)
{
    const int4 bits = m & (int4)(1, 2, 4, 8);
    const int2 half_bits = bits.lo | bits.hi;
    return (uint)(half_bits.x | half_bits.y);
}

inline uint mask8(int8 m) { return mask4(m.lo) | (mask4(m.hi) << 4); }
inline uint mask16(int16 m) { return mask8(m.lo) | (mask8(m.hi) << 8); }
#define MASK CONCAT(mask, ARITY)

inline uint count_bits(uint x)
{
    x = x - ((x >> 1) & 0x5555u);
    x = (x & 0x3333u) + ((x >> 2) & 0x3333u);
    x = (x + (x >> 4)) & 0x0f0fu;
    return (x + (x >> 8)) & 0x1fu;
}

// --- top level: tasks are (node, run of RUN triangles), in this order ---------------------------

#define RUN 256

inline float top_field(global const float *blocks, uint node, uint row)
{
    return blocks[(ulong)(node / ARITY) * (NODE_ROWS * ARITY) + row * ARITY + node % ARITY];
}

// Survivors among the 16 triangles of sphere block `block` that lie in begin .. end.
inline uint test_block(global const float *blocks, uint node, global const float16 *spheres,
                       uint block, uint begin, uint end)
{
    global const float16 *rows = spheres + 4 * (ulong)block;
    const uint mask = mask16(node_meets_sphere16(
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
                      global const float *restrict blocks, global const float16 *restrict spheres,
                      global uint *restrict chunk_tests, global uint *restrict chunk_hits)
{
    const uint runs = (last_triangle - first_triangle + RUN - 1) / RUN;
    const ulong tasks = (ulong)num_nodes * runs;
    uint tests = 0, hits = 0;
    for (ulong task = chunk_begin(tasks), end = chunk_end(tasks); task < end; task++) {
        const uint node = task / runs;
        const uint begin = first_triangle + (task % runs) * RUN;
        const uint stop = MIN(begin + RUN, last_triangle);
        if (top_field(blocks, node, 9) < 0.0f)
            continue; // a null node is never tested
        tests += stop - begin;
        for (uint block = begin / 16; block * 16 < stop; block++)
            hits += count_bits(test_block(blocks, node, spheres, block, begin, stop));
    }
    chunk_tests[get_global_id(0)] = tests;
    chunk_hits[get_global_id(0)] = hits;
}

kernel void write_top(const uint num_nodes, const uint first_triangle, const uint last_triangle,
                      global const float *restrict blocks, global const float16 *restrict spheres,
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
            uint mask = test_block(blocks, node, spheres, block, begin, stop);
            for (uint triangle = block * 16; mask != 0; triangle++, mask >>= 1) {
                if (mask & 1u)
                    out[next++] = (Pair)(node, triangle);
            }
        }
    }
}

// --- every level below ---------------------------------------------------------------------------

// `valid[node]`: children of the node that are not null, the tests that a pair costs.
kernel void test_children(global const uint *restrict length, global const Pair *restrict pairs,
                          global const float *restrict blocks, global const uint *restrict valid,
                          global const float *restrict spheres, global Mask *restrict masks,
                          global uint *restrict chunk_tests, global uint *restrict chunk_hits)
{
    const uint n = *length;
    uint tests = 0, hits = 0;
    for (uint i = chunk_begin(n), end = chunk_end(n); i < end; i++) {
        const Pair pair = pairs[i];
        global const FLOATN *c
            = (global const FLOATN *)(blocks + (ulong)pair.x * (NODE_ROWS * ARITY));
        global const float *p = spheres + (ulong)(pair.y / 16) * 64 + pair.y % 16;
        const uint mask = MASK(NODES_MEET_SPHERE(c[0], c[1], c[2], c[3], c[4], c[5], c[6], c[7],
                                                 c[8], c[9], p[0], p[16], p[32], p[48]));
        masks[i] = (Mask)mask;
        tests += valid[pair.x];
        hits += count_bits(mask);
    }
    chunk_tests[get_global_id(0)] = tests;
    chunk_hits[get_global_id(0)] = hits;
}
