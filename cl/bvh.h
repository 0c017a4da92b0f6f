// Nodes of the bounding volume hierarchy, as cl/bvh.cl makes and cl/packet.cl reads them.

#include "common.h"

// low.w and high.w hold integers: of a leaf its first triangle and their number, of an inner node its
// left child (the right one is next to it) and -1 - axis of the split.
typedef struct {
    float4 low, high;
} Node;

#define SET_LEAF(node, first, count) ((node).low.w = as_float(first), (node).high.w = as_float(count))
#define SET_LEFT(node, left) ((node).low.w = as_float(left))
#define SET_AXIS(node, axis) ((node).high.w = as_float(-1 - (int)(axis)))

#define IS_LEAF(node) (as_int((node).high.w) >= 0)
#define LEAF_FIRST(node) as_uint((node).low.w)
#define LEAF_COUNT(node) as_uint((node).high.w)
#define LEFT_CHILD(node) as_uint((node).low.w)
#define SPLIT_AXIS(node) (-1 - as_int((node).high.w))
