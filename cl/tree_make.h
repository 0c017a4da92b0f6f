// What builders of the scene hierarchy share: nodes and leaves on their way into memory.

#include "tree.h"
#include "triangle.h"

inline float half_area_of(float4 extent)
{
    return extent.x * extent.y + extent.y * extent.z + extent.z * extent.x;
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

// A leaf of triangles `numbers`, aligned to eight of them, some NO_CHILD at the end.
inline void fill_leaf(global float8 *leaf, const uint *numbers, global const float4 *triangles)
{
    float4 s[2][16] __attribute__((aligned(64)));
    for (uint k = 0; k < TREE_WIDTH; k++) {
        const bool meant = numbers[k] != NO_CHILD;
        global const float4 *v = triangles + TRIANGLE_FLOAT4S * (ulong)(meant ? numbers[k] : numbers[0]);
        s[0][k] = meant ? v[0] : (float4)NAN;
        s[0][k + 8] = meant ? v[1] : (float4)NAN;
        s[1][k] = s[1][k + 8] = meant ? v[2] : (float4)NAN;
    }
    float16 rows[2][3], unused;
    TRANSPOSE16(s[0], rows[0][0], rows[0][1], rows[0][2], unused);
    TRANSPOSE16(s[1], rows[1][0], rows[1][1], rows[1][2], unused);
    for (uint axis = 0; axis < 3; axis++) {
        leaf[axis] = rows[0][axis].lo;
        leaf[3 + axis] = rows[0][axis].hi;
        leaf[6 + axis] = rows[1][axis].lo;
    }
    leaf[LEAF_TRIANGLE_ROW] = as_float8(*(const uint8 *)numbers);
}
