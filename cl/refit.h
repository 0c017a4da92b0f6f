// A tree (tree.h) over triangles that have moved: boxes and vertices anew, children as they are (Wald, Boulos,
// Shirley 2007). Children have greater numbers than their parent, so nodes are refitted from the last to the
// first.

#include "tree_make.h"

#define REFIT_AHEAD 4 // leaves: triangles lie all over memory

inline void refit_leaf(global float8 *leaf, global const float4 *triangles)
{
    uint numbers[TREE_WIDTH] __attribute__((aligned(32)));
    *(uint8 *)numbers = as_uint8(leaf[LEAF_TRIANGLE_ROW]);
    fill_leaf(leaf, numbers, triangles);
}

inline void prefetch_triangles(global const float8 *leaf, global const float4 *triangles)
{
    global const uint *numbers = (global const uint *)(leaf + LEAF_TRIANGLE_ROW);
    for (uint k = 0; k < TREE_WIDTH; k++) {
        const uint number = numbers[k] == NO_CHILD ? numbers[0] : numbers[k];
        PREFETCH(triangles + TRIANGLE_FLOAT4S * (ulong)number);
        PREFETCH(triangles + TRIANGLE_FLOAT4S * (ulong)number + 2);
    }
}

inline Box box_of_leaf(global const float8 *leaf)
{
    const int8 meant = leaf[0] == leaf[0];
    float low[3], high[3];
    for (uint axis = 0; axis < 3; axis++) {
        float8 lows, highs;
        bound_leaf(leaf, axis, &lows, &highs);
        low[axis] = lowest8(meant ? lows : (float8)INFINITY);
        high[axis] = highest8(meant ? highs : (float8)-INFINITY);
    }
    const Box b = {(float4)(low[0], low[1], low[2], 0.0f), (float4)(high[0], high[1], high[2], 0.0f)};
    return b;
}

// Half the area of the node's children.
inline float refit_node(global float8 *nodes, global const float8 *leaves, uint node)
{
    global float8 *rows = nodes + TREE_ROWS * (ulong)node;
    global const uint *children = (global const uint *)(rows + TREE_CHILD_ROW);
    float area = 0.0f;
    for (uint k = 0; k < TREE_WIDTH && children[k] != NO_CHILD; k++) {
        const uint child = children[k];
        const Box b = child & LEAF ? box_of_leaf(leaves + LEAF_ROWS * (ulong)(child & ~LEAF))
                                   : box_of_node(nodes + TREE_ROWS * (ulong)child);
        global float *lane = (global float *)rows + k;
        lane[0] = b.low.x, lane[8] = b.low.y, lane[16] = b.low.z;
        lane[24] = b.high.x, lane[32] = b.high.y, lane[40] = b.high.z;
        area += half_area_of(b.high - b.low);
    }
    return area;
}
