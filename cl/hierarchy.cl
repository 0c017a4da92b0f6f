// Building the ray-space hierarchy bottom-up (Roger et al. 2007, section 3.2).
//
// Leaves are the rays (sphere radius and cone angle zero); every ARITY consecutive nodes have one
// parent, the union of their cone-spheres. Layout of a node block: cl/node.h.
//
// Unions: the sphere around the middle of the children's box; the cone around the middle of the box
// of the children's axes, each grown by its sine, with the largest angle to any child's far side. Both
// are tighter than merging the children two by two with the paper's theta/2 + max(phi) (the middle,
// too, than the mean axis: 12 to 20 % fewer tests of mirror rays), and need no trigonometric function:
// sin(theta + phi) is formed by addition, and an angle of pi/2 or more is all that is asked of wide
// cones. Sines, not cosines, are compared: near zero a cosine does not tell angles apart.
// Boxes: of the origins around the sphere's centre, and of the ends, or of the directions where a ray
// has no end.
// Rounding: sines are enlarged by SINE_SLACK, radii and extents by RADIUS_SLACK, ends by END_SLACK of
// their coordinates, all well above the handful of roundings (u = 2^-24 each) that made them.
//
// Build-time constants: ARITY; PAPER_BOUNDS for the unions of Reis et al. 2017 (cl/paper_bounds.h).

#include "node.h"

#define SINE_SLACK 0x1p-21f
#define RADIUS_SLACK (1.0f + 0x1p-20f)
#define REACH_SLACK (1.0f + 0x1p-21f)
#define END_SLACK 0x1p-22f

typedef struct {
    float4 centre, axis;
    float radius, cosine, sine, reach;
    float4 origin_half;            // of the origins' box around the centre
    float4 end_middle, end_half;   // of the ends' box, where `finite` is 1, else of the directions'
    float finite;
} Node;

inline void store_node(global float *blocks, ulong i, const Node n)
{
    global float *rows = blocks + (i / ARITY) * (NODE_ROWS * ARITY) + i % ARITY;
    const float fields[NODE_ROWS] = {
        n.centre.x,      n.centre.y,      n.centre.z,     n.radius,       n.axis.x,
        n.axis.y,        n.axis.z,        n.cosine,       n.sine,         n.reach,
        n.origin_half.x, n.origin_half.y, n.origin_half.z, n.end_middle.x, n.end_middle.y,
        n.end_middle.z,  n.end_half.x,    n.end_half.y,   n.end_half.z,   n.finite};
    for (uint row = 0; row < NODE_ROWS; row++)
        rows[row * ARITY] = fields[row];
}

inline Node null_node(void)
{
    const Node n = {0.0f, 0.0f, 0.0f, 1.0f, 0.0f, NULL_REACH, 0.0f, 0.0f, 0.0f, 0.0f};
    return n;
}

inline float largest(float4 v)
{
    const float4 m = fabs(v);
    return MAX(m.x, MAX(m.y, m.z));
}

// The ray as a node; null where there is none or it is inactive (tfar < tnear).
inline Node ray_node(uint ray, global const float4 *org_tnear, global const float4 *dir_tfar)
{
    Node n = null_node();
    if (ray == INVALID)
        return n;
    const float4 o = org_tnear[ray], d = dir_tfar[ray];
    if (!(d.w >= o.w))
        return n;
    // Scaled by its largest component first: squares of tiny or huge ones leave the range.
    const float scale = largest(d);
    const float4 e = d / scale;
    const float length = sqrt(dot3(e, e));
    n.centre = o;
    n.axis = e / length;
    n.reach = d.w * scale * length * REACH_SLACK; // 0 * inf must not arise
    const float4 step = d * d.w;
    n.finite = largest(o + step) < INFINITY ? 1.0f : 0.0f;
    n.end_middle = n.finite > 0.0f ? o + step : n.axis;
    n.end_half = END_SLACK * (n.finite > 0.0f ? fabs(o) + fabs(step) : (float4)1.0f);
    return n;
}

// Leaf `i` is ray `slots[i]`, or null where that is INVALID.
kernel void build_leaves(const uint num_leaves, const uint num_slots,
                         global const uint *restrict slots, global const float4 *restrict org_tnear,
                         global const float4 *restrict dir_tfar, global float *restrict blocks)
{
    const ulong first = (ulong)get_global_id(0) * 16;
    for (ulong i = first; i < first + 16 && i < num_leaves; i++)
        store_node(blocks, i,
                   ray_node(i < num_slots ? slots[i] : INVALID, org_tnear, dir_tfar));
}

inline Node load_child(global const float *block, uint lane)
{
    global const float *rows = block + lane;
    float f[NODE_ROWS];
    for (uint row = 0; row < NODE_ROWS; row++)
        f[row] = rows[row * ARITY];
    const Node n = {(float4)(f[0], f[1], f[2], 0.0f),
                    (float4)(f[4], f[5], f[6], 0.0f),
                    f[3],
                    f[7],
                    f[8],
                    f[9],
                    (float4)(f[10], f[11], f[12], 0.0f),
                    (float4)(f[13], f[14], f[15], 0.0f),
                    (float4)(f[16], f[17], f[18], 0.0f),
                    f[19]};
    return n;
}

#ifdef PAPER_BOUNDS

#include "paper_bounds.h"

#else

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

// Boxes of the origins, and of the ends or the directions.
inline void enclose_boxes(Node *n, const Node *children, uint count)
{
    float4 low = INFINITY, high = -INFINITY;
    n->finite = 1.0f;
    for (uint k = 0; k < count; k++)
        n->finite = MIN(n->finite, children[k].finite);
    for (uint k = 0; k < count; k++) {
        const Node *c = children + k;
        const float4 origin = fabs(c->centre - n->centre) + c->origin_half;
        n->origin_half = origin > n->origin_half ? origin : n->origin_half;
        float4 middle = c->end_middle, extent = c->end_half + END_SLACK * fabs(c->end_middle);
        if (n->finite < c->finite) { // ends among directions: what the cone says of these
            middle = c->cosine > 0.0f ? c->axis : (float4)0.0f;
            extent = c->cosine > 0.0f ? c->sine + SINE_SLACK : 1.0f;
        }
        low = middle - extent < low ? middle - extent : low;
        high = middle + extent > high ? middle + extent : high;
    }
    n->origin_half *= RADIUS_SLACK;
    n->end_middle = low + 0.5f * (high - low);
    const float4 up = high - n->end_middle, down = n->end_middle - low;
    n->end_half = (up > down ? up : down) * RADIUS_SLACK;
}

inline Node enclose(const Node *children, uint count)
{
    Node n = null_node();
    if (count == 0)
        return n;
    float4 low = INFINITY, high = -INFINITY, first = INFINITY, last = -INFINITY;
    for (uint k = 0; k < count; k++) {
        const float4 l = children[k].centre - children[k].radius;
        const float4 h = children[k].centre + children[k].radius;
        low = l < low ? l : low;
        high = h > high ? h : high;
        const float4 before = children[k].axis - children[k].sine;
        const float4 after = children[k].axis + children[k].sine;
        first = before < first ? before : first;
        last = after > last ? after : last;
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
    enclose_boxes(&n, children, count);
    const float4 sum = first + last;
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

#endif

// One work-item makes 16 parents, padded to whole blocks. `valid[b]` counts the children of parent b
// that are not null.
#define DEFINE_BUILD(NAME, CHILD, ...)                                                             \
    kernel void NAME(const uint num_children, const uint num_parents, __VA_ARGS__,                 \
                     global float *restrict parent_blocks, global uint *restrict valid)            \
    {                                                                                              \
        const ulong first = (ulong)get_global_id(0) * 16;                                          \
        for (ulong i = first; i < first + 16 && i < num_parents; i++) {                            \
            Node children[ARITY];                                                                  \
            uint count = 0;                                                                        \
            for (uint lane = 0; lane < ARITY && i * ARITY + lane < num_children; lane++) {         \
                const Node child = CHILD;                                                          \
                if (child.reach >= 0.0f)                                                           \
                    children[count++] = child;                                                     \
            }                                                                                      \
            valid[i] = count;                                                                      \
            store_node(parent_blocks, i, enclose(children, count));                                \
        }                                                                                          \
    }

DEFINE_BUILD(build_parents, load_child(child_blocks + i * (NODE_ROWS * ARITY), lane),
             global const float *restrict child_blocks)

// Level 1 without its leaves: where no leaf is ever tested none is stored.
DEFINE_BUILD(build_parents_of_rays, ray_node(slots[i * ARITY + lane], org_tnear, dir_tfar),
             global const uint *restrict slots, global const float4 *restrict org_tnear,
             global const float4 *restrict dir_tfar)
