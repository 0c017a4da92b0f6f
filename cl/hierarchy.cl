// Building the ray-space hierarchy bottom-up (Roger et al. 2007, section 3.2).
//
// Leaves are the rays (sphere radius and cone angle zero); every ARITY consecutive nodes have one
// parent, the union of their cone-spheres. Layout of a node block: cl/node.h.
//
// Sixteen nodes are made at a time, one in each lane: lane l's child k is child k of parent first + l.
// Lanes whose child is null, or that have no parent, compute along; unions mask them out.
//
// Unions: the sphere around the middle of the children's box; the cone around the middle of the box
// of the children's axes, each grown by its sine, with the largest angle to any child's far side. Both
// are tighter than merging the children two by two with the paper's theta/2 + max(phi) (the middle,
// too, than the mean axis: 12 to 20 % fewer tests of mirror rays), and need no trigonometric function:
// sin(theta + phi) is formed by addition, and an angle of pi/2 or more is all that is asked of wide
// cones. Sines, not cosines, are compared: near zero a cosine does not tell angles apart.
// Boxes: of the origins around the sphere's centre, and of the ends, or of the directions where a ray
// has no end. An end beyond FAR counts as none: differences of two ends must not overflow.
// Rounding: sines are enlarged by SINE_SLACK, radii and extents by RADIUS_SLACK, ends by END_SLACK of
// their coordinates, all well above the handful of roundings (u = 2^-24 each) that made them. Sums of
// products may be fused, which takes roundings away; cross products not, so that they are exactly 0
// of equal vectors.
//
// Build-time constants: ARITY; PAPER_BOUNDS for the unions of Reis et al. 2017 (cl/paper_bounds.h).

#include "node.h"
#include "rays.h"

#define SINE_SLACK 0x1p-21f
#define REACH_SLACK (1.0f + 0x1p-21f)
#define END_SLACK 0x1p-22f
#define FAR 0x1p100f

#define FLOAT4N (NODE_ROWS * ARITY / 4)
#define UINTN CONCAT(uint, ARITY)

// --- sixteen vectors -----------------------------------------------------------------------------

typedef struct {
    float16 x, y, z;
} Vectors;

inline Vectors all_axes(float16 v) { return (Vectors){v, v, v}; }

inline Vectors plus(Vectors a, Vectors b) { return (Vectors){a.x + b.x, a.y + b.y, a.z + b.z}; }

inline Vectors minus(Vectors a, Vectors b) { return (Vectors){a.x - b.x, a.y - b.y, a.z - b.z}; }

inline Vectors times(Vectors a, float16 b) { return (Vectors){a.x * b, a.y * b, a.z * b}; }

inline Vectors over(Vectors a, float16 b) { return (Vectors){a.x / b, a.y / b, a.z / b}; }

inline Vectors magnitudes(Vectors a)
{
    return (Vectors){magnitude(a.x), magnitude(a.y), magnitude(a.z)};
}

// Where `a` is NaN, b.
inline Vectors larger_of_each(Vectors a, Vectors b)
{
    return (Vectors){larger(a.x, b.x), larger(a.y, b.y), larger(a.z, b.z)};
}

inline Vectors choose(int16 first, Vectors a, Vectors b)
{
    return (Vectors){first ? a.x : b.x, first ? a.y : b.y, first ? a.z : b.z};
}

inline float16 dot_of(Vectors a, Vectors b) { return dot16(a.x, a.y, a.z, b.x, b.y, b.z); }

inline float16 length_of(Vectors a) { return SQRT16(dot_of(a, a)); }

inline Vectors cross_of(Vectors a, Vectors b)
{
    return (Vectors){a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x};
}

// --- sixteen nodes -------------------------------------------------------------------------------

// The fields are the rows of a block, in their order.
typedef struct {
    Vectors centre;
    float16 radius;
    Vectors axis;
    float16 cosine, sine, reach;
    Vectors origin_half;          // of the origins' box around the centre
    Vectors end_middle, end_half; // of the ends' box, where `finite` is 1, else of the directions'
    float16 finite;
} Nodes;

inline int16 is_live(const Nodes *n) { return n->reach >= 0.0f; }

// Null nodes where not `live`, and no NaN of what was computed there.
inline void keep(Nodes *n, int16 live)
{
    float16 *rows = (float16 *)n;
    for (uint row = 0; row < NODE_ROWS; row++)
        rows[row] = as_float16(as_int16(rows[row]) & live);
    n->cosine = live ? n->cosine : 1.0f;
    n->reach = live ? n->reach : NULL_REACH;
}

// The rays of slots first, first + step, .. as nodes; null where there is no slot, no ray in it, or an
// inactive one (tfar < tnear).
inline Nodes rays_as_nodes(ulong first, uint step, uint num_slots, global const uint *slots,
                       global const float4 *org_tnear, global const float4 *dir_tfar)
{
    const Rays16 r = gather_rays(first, step, num_slots, slots, org_tnear, dir_tfar);
    const Vectors o = {r.ox, r.oy, r.oz}, d = {r.dx, r.dy, r.dz};

    // Scaled by its largest component first: squares of tiny or huge ones leave the range.
    const Vectors m = magnitudes(d);
    const float16 scale = larger(m.x, larger(m.y, m.z));
    const Vectors e = over(d, scale);
    const float16 length = length_of(e);
    Nodes n;
    n.centre = o;
    n.radius = 0.0f;
    n.axis = over(e, length);
    n.cosine = 1.0f;
    n.sine = 0.0f;
    n.reach = r.tfar * scale * length * REACH_SLACK; // 0 * inf must not arise
    n.origin_half = all_axes(0.0f);
    const Vectors way = times(d, r.tfar), sum = plus(magnitudes(o), magnitudes(way));
    const int16 finite = (sum.x < FAR) & (sum.y < FAR) & (sum.z < FAR); // NaN of 0 * inf is not
    n.end_middle = choose(finite, plus(o, way), n.axis);
    n.end_half = times(choose(finite, sum, all_axes(1.0f)), END_SLACK);
    n.finite = finite ? (float16)1.0f : (float16)0.0f;
    keep(&n, r.tfar >= r.tnear);
    return n;
}

// children[k]: child k of the sixteen parents from `first` on, null of those that have no block.
inline void load_children(ulong first, uint num_blocks, global const float *blocks, Nodes *children)
{
    float16(*fields)[NODE_ROWS] = (float16(*)[NODE_ROWS])children;
    global const float4 *block[16];
    for (uint lane = 0; lane < 16; lane++)
        block[lane] = (global const float4 *)blocks + MIN(first + lane, num_blocks - 1ul) * FLOAT4N;
    for (uint k = 0; k < ARITY; k += 4)
        for (uint row = 0; row < NODE_ROWS; row++) {
            float4 siblings[16] __attribute__((aligned(64)));
            for (uint lane = 0; lane < 16; lane++)
                siblings[lane] = block[lane][(row * ARITY + k) / 4];
            TRANSPOSE16(siblings, fields[k][row], fields[k + 1][row], fields[k + 2][row],
                        fields[k + 3][row]);
        }
    const uint16 lanes = {0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15};
    const int16 there = lanes < (uint16)MIN(num_blocks - first, 16ul);
    for (uint k = 0; k < ARITY; k++)
        children[k].reach = there ? children[k].reach : NULL_REACH;
}

// Nodes `first` .. first + 15, as far as there are so many, which are whole blocks.
inline void store_nodes(global float *blocks, ulong first, uint num_nodes, Nodes n)
{
    const float *rows = (const float *)&n;
    for (uint lane = 0; lane < 16 && first + lane < num_nodes; lane += ARITY) {
        global FLOATN *block = (global FLOATN *)(blocks + (first + lane) * NODE_ROWS);
        for (uint row = 0; row < NODE_ROWS; row++)
            block[row] = *(const FLOATN *)(rows + row * 16 + lane);
    }
}

// Leaf `i` is the ray of slot `i`. One work-item makes 16 leaves, padded to whole blocks.
kernel void build_leaves(const uint num_leaves, const uint num_slots,
                         global const uint *restrict slots, global const float4 *restrict org_tnear,
                         global const float4 *restrict dir_tfar, global float *restrict blocks)
{
    const ulong first = (ulong)get_global_id(0) * 16;
    store_nodes(blocks, first, num_leaves,
                rays_as_nodes(first, 1, num_slots, slots, org_tnear, dir_tfar));
}

#ifdef PAPER_BOUNDS

#include "paper_bounds.h"

#else

typedef struct {
    Vectors low, high;
} Boxes;

inline Boxes empty_boxes(void) { return (Boxes){all_axes(INFINITY), all_axes(-INFINITY)}; }

// Boxes where `live` take in the box of such extent around `middle`.
inline void take_in(Boxes *b, int16 live, Vectors middle, Vectors extent)
{
    const Vectors low = minus(middle, extent), high = plus(middle, extent);
    b->low.x = (live & (low.x < b->low.x)) ? low.x : b->low.x;
    b->low.y = (live & (low.y < b->low.y)) ? low.y : b->low.y;
    b->low.z = (live & (low.z < b->low.z)) ? low.z : b->low.z;
    b->high.x = (live & (high.x > b->high.x)) ? high.x : b->high.x;
    b->high.y = (live & (high.y > b->high.y)) ? high.y : b->high.y;
    b->high.z = (live & (high.z > b->high.z)) ? high.z : b->high.z;
}

inline Vectors middle_of(Boxes b) { return plus(b.low, times(minus(b.high, b.low), 0.5f)); }

inline void enclose_spheres(Nodes *n, const Nodes *children)
{
    Boxes box = empty_boxes();
    for (uint k = 0; k < ARITY; k++)
        take_in(&box, is_live(children + k), children[k].centre, all_axes(children[k].radius));
    const Vectors centre = middle_of(box);
    float16 radius = 0.0f;
    for (uint k = 0; k < ARITY; k++) {
        const float16 needed = length_of(minus(children[k].centre, centre)) + children[k].radius;
        // NaN, where the box overflows, is taken and stays: then it is that of every child.
        radius = (is_live(children + k) & ~(needed <= radius)) ? needed : radius;
    }
    radius *= RADIUS_SLACK;
    const int16 bounded = radius < INFINITY; // else nothing is bounded, but nothing lost either
    n->centre = choose(bounded, centre, all_axes(0.0f));
    n->radius = bounded ? radius : INFINITY;
}

// Largest sine of an angle between `axis` and a ray of any child; 2 where that is pi/2 or more.
inline float16 cone_sine(Vectors axis, const Nodes *children)
{
    float16 widest = 0.0f;
    for (uint k = 0; k < ARITY; k++) {
        const Nodes *c = children + k;
        const float16 across = length_of(cross_of(axis, c->axis)), along = dot_of(axis, c->axis);
        const float16 sine = FMA16(across, c->cosine, along * c->sine);
        const float16 cosine = FMA16(along, c->cosine, -(across * c->sine));
        // The cosine must be positive beyond its own rounding.
        const int16 narrow = (c->cosine > 0.0f) & (cosine > SINE_SLACK);
        const float16 sine_or_wide = narrow ? sine : 2.0f;
        widest = (is_live(c) & (sine_or_wide > widest)) ? sine_or_wide : widest;
    }
    return widest;
}

inline void enclose_cones(Nodes *n, const Nodes *children)
{
    Boxes box = empty_boxes();
    for (uint k = 0; k < ARITY; k++)
        take_in(&box, is_live(children + k), children[k].axis, all_axes(children[k].sine));
    const Vectors sum = plus(box.low, box.high);
    const float16 length = length_of(sum);
    const Vectors axis = over(sum, length);
    float16 sine = cone_sine(axis, children);
    sine = sine > 0.0f ? sine + SINE_SLACK : sine;
    // Opposite axes cancel: any direction then. NaN compares false, too.
    const int16 narrow = (length > 0x1p-10f) & (sine < 1.0f);
    const Vectors any = {1.0f, 0.0f, 0.0f};
    n->axis = choose(narrow, axis, any);
    n->sine = narrow ? sine : 1.0f;
    n->cosine = narrow ? SQRT16((1.0f - sine) * (1.0f + sine)) : 0.0f;
}

// Boxes of the origins, and of the ends or the directions.
inline void enclose_boxes(Nodes *n, const Nodes *children)
{
    n->finite = 1.0f;
    for (uint k = 0; k < ARITY; k++)
        n->finite = (is_live(children + k) & (children[k].finite == 0.0f)) ? 0.0f : n->finite;
    n->origin_half = all_axes(0.0f);
    Boxes ends = empty_boxes();
    for (uint k = 0; k < ARITY; k++) {
        const Nodes *c = children + k;
        const int16 live = is_live(c);
        const Vectors origin = plus(magnitudes(minus(c->centre, n->centre)), c->origin_half);
        n->origin_half = choose(live, larger_of_each(origin, n->origin_half), n->origin_half);
        // Ends among directions: what the cone says of these, 2 sin(alpha/2) at most from its axis.
        const int16 mixed = n->finite < c->finite, narrow = c->cosine > 0.0f;
        const float16 chord = c->sine / SQRT16(0.5f + 0.5f * c->cosine) + SINE_SLACK;
        const float16 spread = narrow ? chord : 1.0f;
        const Vectors direction = choose(narrow, c->axis, all_axes(0.0f));
        const Vectors extent = plus(c->end_half, times(magnitudes(c->end_middle), END_SLACK));
        take_in(&ends, live, choose(mixed, direction, c->end_middle),
                choose(mixed, all_axes(spread), extent));
    }
    n->origin_half = times(n->origin_half, RADIUS_SLACK);
    n->end_middle = middle_of(ends);
    n->end_half = times(larger_of_each(minus(ends.high, n->end_middle),
                                       minus(n->end_middle, ends.low)),
                        RADIUS_SLACK);
}

// The parents of sixteen times ARITY children, where any of these is not null.
inline Nodes enclose(const Nodes *children)
{
    Nodes n;
    n.reach = NULL_REACH;
    for (uint k = 0; k < ARITY; k++)
        n.reach = larger(n.reach, children[k].reach);
    enclose_spheres(&n, children);
    enclose_cones(&n, children);
    enclose_boxes(&n, children);
    return n;
}

#endif

// Stores the sixteen parents from `first` on; valid[i] counts the children of i that are not null.
inline void build(ulong first, uint num_parents, const Nodes *children, global float *parent_blocks,
                  global uint *valid)
{
    int16 count = 0;
    for (uint k = 0; k < ARITY; k++)
        count -= is_live(children + k);
    Nodes parents = enclose(children);
    keep(&parents, count > 0);
    store_nodes(parent_blocks, first, num_parents, parents);
    for (uint lane = 0; lane < 16 && first + lane < num_parents; lane += ARITY)
        *(global UINTN *)(valid + first + lane) = *(UINTN *)((uint *)&count + lane);
}

// One work-item makes 16 parents, padded to whole blocks.
kernel void build_parents(const uint num_children, const uint num_parents,
                          global const float *restrict child_blocks,
                          global float *restrict parent_blocks, global uint *restrict valid)
{
    const ulong first = (ulong)get_global_id(0) * 16;
    Nodes children[ARITY];
    load_children(first, (num_children + ARITY - 1) / ARITY, child_blocks, children);
    build(first, num_parents, children, parent_blocks, valid);
}

// Level 1 from the rays themselves: they are less to read than their leaves, which may not be stored.
kernel void build_parents_of_rays(const uint num_slots, const uint num_parents,
                                  global const uint *restrict slots,
                                  global const float4 *restrict org_tnear,
                                  global const float4 *restrict dir_tfar,
                                  global float *restrict parent_blocks, global uint *restrict valid)
{
    const ulong first = (ulong)get_global_id(0) * 16;
    Nodes children[ARITY];
    for (uint k = 0; k < ARITY; k++)
        children[k] = rays_as_nodes(first * ARITY + k, ARITY, num_slots, slots, org_tnear, dir_tfar);
    build(first, num_parents, children, parent_blocks, valid);
}
