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

// The box of a leaf along an axis, low and high; lanes without a triangle are NaN.
inline float2 extent_of_leaf(global const float8 *leaf, uint axis)
{
    const float8 a = leaf[axis], b = leaf[3 + axis], c = leaf[6 + axis];
    const float8 low = a < b ? a : b, high = a > b ? a : b;
    const float8 lowest = low < c ? low : c, highest = high > c ? high : c;
    const int8 meant = a == a;
    return (float2)(lowest8(meant ? lowest : (float8)INFINITY), highest8(meant ? highest : (float8)-INFINITY));
}

// Half the area of the node's children.
inline float refit_node(global float8 *nodes, global const float8 *leaves, uint node)
{
    global float8 *rows = nodes + TREE_ROWS * (ulong)node;
    global const uint *children = (global const uint *)(rows + TREE_CHILD_ROW);
    float area = 0.0f;
    for (uint k = 0; k < TREE_WIDTH && children[k] != NO_CHILD; k++) {
        float size[3];
        for (uint axis = 0; axis < 3; axis++) {
            float2 extent;
            if (children[k] & LEAF) {
                extent = extent_of_leaf(leaves + LEAF_ROWS * (ulong)(children[k] & ~LEAF), axis);
            } else {
                global const float8 *child = nodes + TREE_ROWS * (ulong)children[k];
                extent = (float2)(lowest8(child[axis]), highest8(child[3 + axis]));
            }
            ((global float *)(rows + axis))[k] = extent.x;
            ((global float *)(rows + 3 + axis))[k] = extent.y;
            size[axis] = extent.y - extent.x;
        }
        area += size[0] * size[1] + size[1] * size[2] + size[2] * size[0];
    }
    return area;
}
