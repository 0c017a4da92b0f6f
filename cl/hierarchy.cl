// Building the ray-space hierarchy bottom-up (Roger et al. 2007, section 3.2).
//
// Leaves are the rays (sphere radius and cone angle zero); every ARITY consecutive nodes have one
// parent, the union of their cone-spheres. Layout of a node block: cl/node.h.
//
// Unions: the sphere around the middle of the children's box; the cone around the mean of the
// children's axes, with the largest angle to any child's far side. Both are tighter than merging the
// children two by two with the paper's theta/2 + max(phi), and need no trigonometric function:
// sin(theta + phi) is formed by addition, and an angle of pi/2 or more is all that is asked of wide
// cones. Sines, not cosines, are compared: near zero a cosine does not tell angles apart.
// Rounding: sines are enlarged by SINE_SLACK, radii by RADIUS_SLACK, both well above the handful of
// roundings (u = 2^-24 each) that made them.
//
// Build-time constant: ARITY.

#include "node.h"

#define SINE_SLACK 0x1p-21f
#define RADIUS_SLACK (1.0f + 0x1p-20f)
#define REACH_SLACK (1.0f + 0x1p-21f)

typedef struct {
    float4 centre, axis;
    float radius, cosine, sine, reach;
} Node;

inline void store_node(global float *blocks, ulong i, const Node n)
{
    global float *rows = blocks + (i / ARITY) * (NODE_ROWS * ARITY) + i % ARITY;
    const float fields[NODE_ROWS] = {n.centre.x, n.centre.y, n.centre.z, n.radius,  n.axis.x,
                                     n.axis.y,   n.axis.z,   n.cosine,   n.sine,    n.reach};
    for (uint row = 0; row < NODE_ROWS; row++)
        rows[row * ARITY] = fields[row];
}

inline Node null_node(void)
{
    const Node n = {0.0f, 0.0f, 0.0f, 1.0f, 0.0f, NULL_REACH};
    return n;
}

// Leaf `i` is ray `slots[i]`, or null where that is INVALID or the ray is inactive (tfar < tnear).
kernel void build_leaves(const uint num_leaves, const uint num_slots,
                         global const uint *restrict slots, global const float4 *restrict org_tnear,
                         global const float4 *restrict dir_tfar, global float *restrict blocks)
{
    const ulong first = (ulong)get_global_id(0) * 16;
    for (ulong i = first; i < first + 16 && i < num_leaves; i++) {
        Node n = null_node();
        const uint ray = i < num_slots ? slots[i] : INVALID;
        if (ray != INVALID) {
            const float4 o = org_tnear[ray], d = dir_tfar[ray];
            if (d.w >= o.w) {
                // Scaled by its largest component first: squares of tiny or huge ones leave the range.
                const float4 m = fabs(d);
                const float scale = MAX(m.x, MAX(m.y, m.z));
                const float4 e = d / scale;
                const float length = sqrt(dot3(e, e));
                n.centre = o;
                n.axis = e / length;
                n.reach = d.w * scale * length * REACH_SLACK; // 0 * inf must not arise
            }
        }
        store_node(blocks, i, n);
    }
}

inline Node load_child(global const float *block, uint lane)
{
    global const float *rows = block + lane;
    Node n;
    n.centre = (float4)(rows[0], rows[ARITY], rows[2 * ARITY], 0.0f);
    n.radius = rows[3 * ARITY];
    n.axis = (float4)(rows[4 * ARITY], rows[5 * ARITY], rows[6 * ARITY], 0.0f);
    n.cosine = rows[7 * ARITY];
    n.sine = rows[8 * ARITY];
    n.reach = rows[9 * ARITY];
    return n;
}

// Largest sine of an angle between `axis` and a ray of any child; 2 where that is pi/2 or more.
inline float cone_sine(const Node *children, uint count, float4 axis)
{
    float widest = 0.0f;
    for (uint k = 0; k < count; k++) {
        const float4 perpendicular = cross3(axis, children[k].axis);
        const float across = sqrt(dot3(perpendicular, perpendicular));
        const float along = dot3(axis, children[k].axis);
        const float sine = across * children[k].cosine + along * children[k].sine;
        const float cosine = along * children[k].cosine - across * children[k].sine;
        // The cosine must be positive beyond its own rounding.
        const float sine_or_wide = children[k].cosine > 0.0f && cosine > SINE_SLACK ? sine : 2.0f;
        widest = MAX(widest, sine_or_wide);
    }
    return widest;
}

inline Node enclose(const Node *children, uint count)
{
    Node n = null_node();
    if (count == 0)
        return n;
    float4 low = INFINITY, high = -INFINITY, sum = 0.0f;
    for (uint k = 0; k < count; k++) {
        const float4 l = children[k].centre - children[k].radius;
        const float4 h = children[k].centre + children[k].radius;
        low = l < low ? l : low;
        high = h > high ? h : high;
        sum += children[k].axis;
        n.reach = MAX(n.reach, children[k].reach);
    }
    n.centre = low + 0.5f * (high - low);
    for (uint k = 0; k < count; k++) {
        const float4 offset = children[k].centre - n.centre;
        const float radius = sqrt(dot3(offset, offset)) + children[k].radius;
        n.radius = MAX(n.radius, radius);
    }
    n.radius *= RADIUS_SLACK;
    if (!(n.radius < INFINITY)) { // origins so far apart bound nothing, but lose nothing either
        n.centre = 0.0f;
        n.radius = INFINITY;
    }
    const float length = sqrt(dot3(sum, sum));
    n.axis = sum / length;
    // Opposite axes cancel: any direction then. NaN compares false, too.
    float sine = length > 0x1p-10f ? cone_sine(children, count, n.axis) : 2.0f;
    if (sine > 0.0f)
        sine += SINE_SLACK;
    if (sine < 1.0f) {
        n.sine = sine;
        n.cosine = sqrt((1.0f - sine) * (1.0f + sine));
    } else {
        n.axis = (float4)(1.0f, 0.0f, 0.0f, 0.0f);
        n.sine = 1.0f;
        n.cosine = 0.0f;
    }
    return n;
}

// One work-item makes 16 parents; `num_children` nodes below, `num_parents` padded to whole blocks.
// `valid[b]` counts the children of parent b that are not null.
kernel void build_parents(const uint num_children, const uint num_parents,
                          global const float *restrict child_blocks,
                          global float *restrict parent_blocks, global uint *restrict valid)
{
    const ulong first = (ulong)get_global_id(0) * 16;
    for (ulong i = first; i < first + 16 && i < num_parents; i++) {
        Node children[ARITY];
        uint count = 0;
        for (uint lane = 0; lane < ARITY && i * ARITY + lane < num_children; lane++) {
            const Node child = load_child(child_blocks + i * (NODE_ROWS * ARITY), lane);
            if (child.reach >= 0.0f)
                children[count++] = child;
        }
        valid[i] = count;
        store_node(parent_blocks, i, enclose(children, count));
    }
}
