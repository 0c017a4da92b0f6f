// The scene hierarchy of `dual` (layout in tree.h): from the triangles of a frame to its root.
//
// Fast: triangles along a Hilbert curve through the scene (the keys of Lauterbach et al. 2009, their
// order along the curve of Hilbert instead of Morton), eight in a row to a leaf, eight leaves in a
// row to a node, and so on upwards. The number of nodes of every level follows from that of the
// triangles: nothing is read back, and nothing depends on where the triangles are but the order.
//
// A tree over n triangles has ceil(log8(n / 8)) levels, at least one: at most 10 for 2^31, below
// TREE_DEPTH. Equal keys (all triangles in one point, duplicates) change the boxes, never the shape.
//
// Build-time constants: CHUNKS; CELL_BITS, of a place along an axis.

#include "hilbert.h"
#include "tree_make.h"

#define AHEAD 4 // groups of sixteen that gathers look ahead: sorted triangles lie all over memory
#define LANES ((int16)(0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15))

typedef struct {
    float16 low[3], high[3];
} Boxes;

// Boxes of sixteen triangles; INFINITY and -INFINITY in lanes that are not meant.
inline Boxes bound_corners16(const float16 corners[3][3], int16 meant)
{
    Boxes b;
    for (uint axis = 0; axis < 3; axis++) {
        const float16 p = corners[0][axis], q = corners[1][axis], r = corners[2][axis];
        const float16 pq_low = p < q ? p : q, pq_high = p > q ? p : q;
        const float16 low = pq_low < r ? pq_low : r, high = pq_high > r ? pq_high : r;
        b.low[axis] = meant ? low : (float16)INFINITY;
        b.high[axis] = meant ? high : (float16)-INFINITY;
    }
    return b;
}

// Corners of sixteen triangles, by corner and axis.
inline void gather_corners(global const float4 *triangles, const uint *numbers,
                           float16 corners[3][3])
{
    for (uint corner = 0; corner < 3; corner++) {
        float4 s[16] __attribute__((aligned(64)));
        for (uint lane = 0; lane < 16; lane++)
            s[lane] = triangles[TRIANGLE_FLOAT4S * (ulong)numbers[lane] + corner];
        float16 unused;
        TRANSPOSE16(s, corners[corner][0], corners[corner][1], corners[corner][2], unused);
    }
}

// ---- the order ----

// Twice the middles of the boxes of sixteen triangles in a row; the last one again beyond the end.
inline void double_middles(uint block, uint num_triangles, global const float4 *triangles,
                           float16 *middle)
{
    uint numbers[16];
    for (uint lane = 0; lane < 16; lane++)
        numbers[lane] = MIN(16 * block + lane, num_triangles - 1);
    float16 corners[3][3];
    gather_corners(triangles, numbers, corners);
    const Boxes b = bound_corners16(corners, (int16)-1);
    for (uint axis = 0; axis < 3; axis++)
        middle[axis] = b.low[axis] + b.high[axis];
}

// Cells of the cube around all middles. What is no number, where the cube has no size, is in the last.
inline uint16 cell(float16 offset, float cells)
{
    const float16 place = offset * cells, most = (1 << CELL_BITS) - 1;
    return CONVERT(uint16, place < most ? (place > 0.0f ? place : 0.0f) : most);
}

// Places along the curve. Lanes beyond the last triangle are as far along as it goes, and stay
// behind it: the sort is stable.
kernel void place_triangles(const uint num_triangles, global const float4 *restrict triangles,
                            const uint num_boxes, global const float4 *restrict middles,
                            global uint16 *restrict keys)
{
    const uint num_blocks = (num_triangles + 15) / 16;
    float4 low, high;
    join_boxes(middles, num_boxes, &low, &high);
    const float4 size = high - low;
    const float largest = largest3(size);
    const float cells = (1 << CELL_BITS) / largest;
    for (uint block = chunk_begin(num_blocks), end = chunk_end(num_blocks); block < end; block++) {
        float16 m[3];
        double_middles(block, num_triangles, triangles, m);
        const uint16 place = hilbert_place(cell(m[0] - low.x, cells), cell(m[1] - low.y, cells),
                                           cell(m[2] - low.z, cells), CELL_BITS);
        keys[block] = (int)(16 * block) + LANES < (int)num_triangles ? place : (uint16)INVALID;
    }
}

// ---- leaves and the nodes above them ----

// Two leaves from `leaf` on, of the triangles `numbers`, where `meant`; `second`: there are two.
inline void store_two_leaves(global float8 *leaf, const uint *numbers, int16 meant, bool second,
                             const float16 corners[3][3])
{
    const uint16 id = meant ? *(const uint16 *)numbers : (uint16)NO_CHILD;
    for (uint row = 0; row < LEAF_TRIANGLE_ROW; row++) {
        const float16 v = meant ? corners[row / 3][row % 3] : (float16)NAN;
        leaf[row] = v.lo;
        if (second)
            leaf[LEAF_ROWS + row] = v.hi;
    }
    leaf[LEAF_TRIANGLE_ROW] = as_float8(id.lo);
    if (second)
        leaf[LEAF_ROWS + LEAF_TRIANGLE_ROW] = as_float8(id.hi);
}

// Two leaves of sixteen places of the order from `first` on, and their boxes.
inline void make_two_leaves(uint first, uint num_triangles, global const uint *order,
                            global const float4 *triangles, global float8 *leaves, Children *c)
{
    uint numbers[16] __attribute__((aligned(64)));
    for (uint lane = 0; lane < 16; lane++)
        numbers[lane] = order[MIN(first + lane, num_triangles - 1)];
    float16 corners[3][3];
    gather_corners(triangles, numbers, corners);
    const int16 meant = (int)first + LANES < (int)num_triangles;
    const Boxes b = bound_corners16(corners, meant);
    const uint k = first / TREE_WIDTH % TREE_WIDTH;
    const bool second = first + TREE_WIDTH < num_triangles;
    store_two_leaves(leaves + LEAF_ROWS * (ulong)(first / TREE_WIDTH), numbers, meant, second,
                     corners);
    for (uint axis = 0; axis < 3; axis++) {
        c->low[axis][k] = lowest8(b.low[axis].lo);
        c->high[axis][k] = highest8(b.high[axis].lo);
        c->low[axis][k + 1] = lowest8(b.low[axis].hi);
        c->high[axis][k + 1] = highest8(b.high[axis].hi);
    }
    c->child[k] = LEAF | (first / TREE_WIDTH);
    c->child[k + 1] = second ? LEAF | (first / TREE_WIDTH + 1) : NO_CHILD;
}

// Nodes of the lowest level, number `first_node` and on, and the leaves below them.
kernel void make_leaves(const uint num_triangles, const uint num_nodes, const uint first_node,
                        global const uint *restrict order, global const float4 *restrict triangles,
                        global float8 *restrict leaves, global float8 *restrict nodes)
{
    for (uint n = chunk_begin(num_nodes), end = chunk_end(num_nodes); n < end; n++) {
        Children c __attribute__((aligned(64)));
        for (uint k = 0; k < TREE_WIDTH; k += 2) {
            const uint first = TREE_WIDTH * (TREE_WIDTH * n + k);
            const uint ahead = MIN(first + 16 * AHEAD, num_triangles);
            for (uint i = ahead; i < MIN(ahead + 16, num_triangles); i++)
                PREFETCH(triangles + TRIANGLE_FLOAT4S * (ulong)order[i]);
            if (first < num_triangles) {
                make_two_leaves(first, num_triangles, order, triangles, leaves, &c);
            } else {
                set_empty(&c, k);
                set_empty(&c, k + 1);
            }
        }
        store_node(nodes, first_node + n, &c);
    }
}

// Nodes of a level, number `first_node` and on, above `num_children` nodes from `first_child` on.
kernel void make_nodes(const uint num_nodes, const uint first_node, const uint num_children,
                       const uint first_child, global float8 *restrict nodes)
{
    for (uint n = chunk_begin(num_nodes), end = chunk_end(num_nodes); n < end; n++) {
        Children c __attribute__((aligned(64)));
        for (uint k = 0; k < TREE_WIDTH; k++) {
            const uint child = TREE_WIDTH * n + k;
            if (child >= num_children) {
                set_empty(&c, k);
                continue;
            }
            global const float8 *rows = nodes + TREE_ROWS * (ulong)(first_child + child);
            for (uint axis = 0; axis < 3; axis++) {
                c.low[axis][k] = lowest8(rows[axis]); // unused lanes are empty boxes
                c.high[axis][k] = highest8(rows[3 + axis]);
            }
            c.child[k] = first_child + child;
        }
        store_node(nodes, first_node + n, &c);
    }
}
