// What both builders of the scene hierarchy share: boxes, leaves and nodes on their way into memory.

#include "tree.h"
#include "triangle.h"

#define AHEAD 4 // groups of sixteen that gathers look ahead: sorted triangles lie all over memory
#define NODES_OVER(leaves) (4 * (leaves) / 7 + 1) // at most: sah.cl
#define LANES ((int16)(0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15))

typedef struct {
    float16 low[3], high[3];
} Boxes;

// Boxes of sixteen triangles; INFINITY and -INFINITY in lanes that are not meant.
inline Boxes bound_corners(const float16 corners[3][3], int16 meant)
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

// A node while it is made: rows of TREE_ROWS, a lane each child.
typedef struct {
    float low[3][TREE_WIDTH], high[3][TREE_WIDTH];
    uint child[TREE_WIDTH];
} Children;

inline void set_empty(Children *c, uint k)
{
    for (uint axis = 0; axis < 3; axis++)
        c->low[axis][k] = INFINITY, c->high[axis][k] = -INFINITY;
    c->child[k] = NO_CHILD;
}

inline void store_node(global float8 *nodes, uint node, Children *c)
{
    global float8 *rows = nodes + TREE_ROWS * (ulong)node;
    for (uint axis = 0; axis < 3; axis++) {
        rows[axis] = *(float8 *)c->low[axis];
        rows[3 + axis] = *(float8 *)c->high[axis];
    }
    rows[TREE_CHILD_ROW] = as_float8(*(uint8 *)c->child);
    rows[TREE_CHILD_ROW + 1] = 0.0f;
}

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
