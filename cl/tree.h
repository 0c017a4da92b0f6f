// The scene hierarchy of `dual`: layout shared by its builder and its traversals.
//
// A node holds the boxes of up to eight children as rows of eight lanes, so that one ray meets all of
// them at once: low x, y, z, high x, y, z, the children's numbers, and a row that keeps nodes on
// cache lines. A child is a node, or, with LEAF set, a leaf; an unused lane has an empty box
// (low > high: +inf, -inf) and NO_CHILD, and no ray may enter it.
//
// A leaf holds up to eight triangles as rows of eight lanes: v0 x, y, z, v1 x, y, z, v2 x, y, z, and the flat
// triangle number; an unused lane has NaN vertices and triangle NO_CHILD (all comparisons with it are false).
//
// Boxes contain their triangles exactly (minima and maxima of float32 vertices round nothing); whoever
// tests a ray against a box pads the interval for the rounding of that test.
//
// Node 0 is the root, there always is one, also of a single triangle. No path from the root is longer than
// TREE_DEPTH nodes whatever the scene (the builders prove it), hence a depth-first stack never holds more than
// TREE_STACK entries.

#include "common.h"

#define TREE_WIDTH 8
#define TREE_ROWS 8
#define TREE_CHILD_ROW 6
#define LEAF_ROWS 10
#define LEAF_TRIANGLE_ROW 9
#define LEAF 0x80000000u
#define NO_CHILD 0xffffffffu
#define TREE_DEPTH 24
#define TREE_STACK ((TREE_WIDTH - 1) * TREE_DEPTH + 1)

typedef struct {
    float4 low, high;
} Box;

// The box around a node's children; those of unused lanes are empty.
inline Box box_of_node(global const float8 *rows)
{
    const Box b = {(float4)(lowest8(rows[0]), lowest8(rows[1]), lowest8(rows[2]), 0.0f),
                   (float4)(highest8(rows[3]), highest8(rows[4]), highest8(rows[5]), 0.0f)};
    return b;
}

// The boxes of a leaf's triangles along an axis; NaN in lanes without one.
INLINE void bound_leaf(global const float8 *leaf, uint axis, float8 *low, float8 *high)
{
    const float8 v0 = leaf[axis], v1 = leaf[3 + axis], v2 = leaf[6 + axis];
    const float8 lower = v0 < v1 ? v0 : v1, higher = v0 > v1 ? v0 : v1;
    *low = lower < v2 ? lower : v2;
    *high = higher > v2 ? higher : v2;
}
