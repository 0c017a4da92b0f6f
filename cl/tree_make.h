// What both builders of the scene hierarchy share: nodes on their way into memory.

#include "tree.h"
#include "triangle.h"

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
