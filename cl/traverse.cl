// Traversal of the ray-space hierarchy, level by level (Roger et al. 2007, section 3.3).
//
// The top level's nodes are tested against every triangle in a loop: its pairs are never written
// out. Below, each pair (node, triangle) of the stream is tested against all children of the node at
// once. Tests only mark survivors (a mask per pair, a count per chunk); cl/pairs.cl makes the next
// level's stream of them.
//
// Layouts: nodes in cl/node.h, triangle bounds in cl/geometry.cl, streams in cl/pairs.h.
// Build-time constants: ARITY, CHUNKS; OBJECTS where objects are tested before their triangles;
// SPHERES_ALONE (cl/node.h).

#pragma OPENCL EXTENSION cl_khr_int64_base_atomics : enable

#include "node.h"
#include "pairs.h"

// --- top level: tasks are (node, one of its parts of the scene), in this order -------------------
//
// Without OBJECTS a part is RUN triangles. With OBJECTS (whole-mesh culling, Reis et al. 2017, section
// 3.3.7) it is a block of 16 objects, runs of an order of the triangles, and only those whose bounding
// sphere meets the node are gone through.

#define RUN 256

typedef struct {
    global const float *blocks;
    global const float16 *bound_rows; // of the triangles, by position in the order
    uint first, last;                  // positions of this batch
#ifdef OBJECTS
    global const float16 *object_rows;
    global const uint *ranges, *order;
    uint num_objects;
#endif
} Top;

inline global const float *node_rows(global const float *blocks, uint node)
{
    return blocks + (ulong)(node / ARITY) * (NODE_ROWS * ARITY) + node % ARITY;
}

// Tests the triangles at begin .. end; returns how many survive, and where `out` is not null writes
// their pairs.
inline uint test_run(const Top *top, uint node, uint begin, uint end, global Pair *out)
{
    global const float *rows = node_rows(top->blocks, node);
    uint hits = 0;
    for (uint block = begin / 16; block * 16 < end; block++) {
        float16 bounds[BOUND_ROWS];
        for (uint row = 0; row < BOUND_ROWS; row++)
            bounds[row] = top->bound_rows[(ulong)block * BOUND_ROWS + row];
        const uint from_begin = begin > block * 16 ? 0xffffu << (begin - block * 16) : 0xffffu;
        const uint to_end = end < block * 16 + 16 ? (1u << (end - block * 16)) - 1 : 0xffffu;
        uint mask = MASK16(NODE_MEETS(rows, bounds)) & from_begin & to_end;
        if (out == 0) {
            hits += COUNT16(mask);
            continue;
        }
        for (; mask != 0; mask &= mask - 1) {
            const uint position = block * 16 + LOWEST(mask);
#ifdef OBJECTS
            out[hits++] = (Pair)(node, top->order[position]);
#else
            out[hits++] = (Pair)(node, position);
#endif
        }
    }
    return hits;
}

#ifdef OBJECTS

inline uint num_parts(const Top *top) { return (top->num_objects + 15) / 16; }

// An object that two batches share is tested in both, and counted where it begins.
inline uint test_part(const Top *top, uint node, uint part, global Pair *out, ulong *tests,
                      ulong *object_tests)
{
    const uint first = part * 16, stop = MIN(first + 16, top->num_objects);
    float16 spheres[4];
    for (uint row = 0; row < 4; row++)
        spheres[row] = top->object_rows[(ulong)part * 4 + row];
    const uint mask = MASK16(node_meets_spheres(node_rows(top->blocks, node), spheres));
    uint hits = 0;
    for (uint o = first; o < stop; o++) {
        const uint whole = top->ranges[o], next = top->ranges[o + 1];
        const uint begin = MAX(whole, top->first), end = MIN(next, top->last);
        *object_tests += whole >= top->first && whole < top->last && whole < next;
        if (begin >= end || !(mask >> (o - first) & 1))
            continue;
        *tests += end - begin;
        hits += test_run(top, node, begin, end, out == 0 ? 0 : out + hits);
    }
    return hits;
}

#else

inline uint num_parts(const Top *top) { return (top->last - top->first + RUN - 1) / RUN; }

inline uint test_part(const Top *top, uint node, uint part, global Pair *out, ulong *tests,
                      ulong *object_tests)
{
    const uint begin = top->first + part * RUN, end = MIN(begin + RUN, top->last);
    *tests += end - begin;
    return test_run(top, node, begin, end, out);
}

#endif

// All tasks of this work-item; returns the number of survivors. A null node is never tested.
inline ulong test_tasks(const Top *top, uint num_nodes, global Pair *out, ulong *tests,
                        ulong *object_tests)
{
    const uint parts = num_parts(top);
    const ulong tasks = (ulong)num_nodes * parts;
    ulong hits = 0;
    for (ulong task = chunk_begin(tasks), end = chunk_end(tasks); task < end; task++) {
        const uint node = task / parts;
        if (node_rows(top->blocks, node)[9 * ARITY] >= 0.0f)
            hits += test_part(top, node, task % parts, out == 0 ? 0 : out + hits, tests,
                              object_tests);
    }
    return hits;
}

#ifdef OBJECTS
#define OBJECT_ARGUMENTS                                                                           \
    , const uint num_objects, global const float16 *restrict object_rows,                          \
        global const uint *restrict ranges, global const uint *restrict order
#define MAKE_TOP {blocks, bound_rows, first, last, object_rows, ranges, order, num_objects}
#else
#define OBJECT_ARGUMENTS
#define MAKE_TOP {blocks, bound_rows, first, last}
#endif

// Positions first .. last of the triangles' order are this batch; *object_tests is added to.
kernel void count_top(const uint num_nodes, const uint first, const uint last,
                      global const float *restrict blocks,
                      global const float16 *restrict bound_rows,
                      global ulong *restrict chunk_tests, global ulong *restrict chunk_hits,
                      global ulong *restrict object_tests OBJECT_ARGUMENTS)
{
    const Top top = MAKE_TOP;
    ulong tests = 0, objects = 0;
    chunk_hits[get_global_id(0)] = test_tasks(&top, num_nodes, 0, &tests, &objects);
    chunk_tests[get_global_id(0)] = tests;
    if (objects != 0)
        atom_add(object_tests, objects);
}

kernel void write_top(const uint num_nodes, const uint first, const uint last,
                      global const float *restrict blocks,
                      global const float16 *restrict bound_rows,
                      global const uint *restrict offsets, global const uint *restrict out_length,
                      global Pair *restrict out OBJECT_ARGUMENTS)
{
    if (*out_length == 0)
        return;
    const Top top = MAKE_TOP;
    ulong tests = 0, objects = 0;
    test_tasks(&top, num_nodes, out + offsets[get_global_id(0)], &tests, &objects);
}

// --- every level below ---------------------------------------------------------------------------

#ifdef SPHERES_ALONE
#define NUM_BOUNDS 1 // float4 of a triangle that are needed
#else
#define NUM_BOUNDS BOUND_FLOAT4S
#endif

// The bounds of the triangles of up to sixteen pairs as rows; the last pair fills up.
inline void gather_bounds(global const Pair *pairs, uint count, global const float4 *bounds,
                          float16 *rows)
{
    for (uint part = 0; part < NUM_BOUNDS; part++, rows += 4) {
        float4 s[WIDTH] __attribute__((aligned(64)));
        for (uint k = 0; k < WIDTH; k++)
            s[k] = bounds[BOUND_FLOAT4S * (ulong)pairs[k < count ? k : count - 1].y + part];
        TRANSPOSE16(s, rows[0], rows[1], rows[2], rows[3]);
    }
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
                          global const float4 *restrict bounds, global Mask *restrict masks,
                          global ulong *restrict chunk_tests, global ulong *restrict chunk_hits)
{
    const uint n = *length;
    ulong tests = 0, hits = 0;
    for (uint i = chunk_begin(n), end = chunk_end(n); i < end;) {
        const uint node = pairs[i].x;
        const uint count = run_length(pairs, i, MIN(i + WIDTH, end));
        const uint lanes = (1u << count) - 1;
        float16 rows[BOUND_ROWS];
        gather_bounds(pairs + i, count, bounds, rows);
        global const float *block = blocks + (ulong)node * (NODE_ROWS * ARITY);
        int16 mask = 0;
        for (uint child = 0; child < ARITY; child++) {
            const int16 hit = NODE_MEETS(block + child, rows);
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
