// Bundles of 64 coherent rays against the scene hierarchy (tree.h): the Partition traversal of
// Overbeck, Ramamoorthi and Mark 2008 (section 3), with masks of rays in the place of its list.
//
// A bundle is four groups of sixteen rays. Intervals of the rays' origins and inverse directions
// enclose all of them: one interval test tells which of a node's eight children any ray may enter,
// and where the first one enters. Children wait on a stack, nearest on top, with the rays that
// entered their parent. When a child is popped each of these rays is tested against its box alone, up
// to the ray's hit so far, unless the intervals say that all enter. Where few rays are left they finish
// that child as single rays. In a leaf, triangles whose box the intervals miss are dropped, the others
// are tested with sixteen rays at once, or the few rays of a group one by one.
//
// Work-item g takes bundle g * stride; with a stride above 1 bundles are a sample to know the others by,
// and their rays are compared with their neighbours, too.

#include "single.h"

#define GROUPS 4 // of sixteen rays
#define RAYS (16 * GROUPS)
#define FEW 6 // rays that are better off alone
#define CLOSE 0.9924f // directions: the square of the cosine of 5 degrees
#define CLOSE_END(per_t, t) ((t) * (per_t) * OUTWARDS)

typedef struct {
    float16 inverse[3], near[3], far[3]; // as in BoxRay
    int16 falls[3];                      // whether the direction falls along the axis
    float16 begin, end, per_t;
    RayFrame16 frame;
    uint16 nearest; // triangle of the hit at frame.tfar, INVALID where there is none
    float16 u, v;
} Group;

// Bounds of all rays of a bundle: where they enter and leave planes lies between plane * inverse +
// near (far) of the two ends of `inverse`. An axis along which not all go the same way says nothing.
typedef struct {
    float inverse[3][2], near[3][2], far[3][2];
    bool falls[3], says[3], agrees;
    uint low_row[3]; // as in BoxRay
    float begin, end;
} Interval;

typedef struct {
    Group groups[GROUPS];
    Interval interval;
    ulong open; // rays that look for a hit: all, or those that have none
    bool any;   // one hit is enough
} Bundle;

// Sixteen rays, and bounds of the active ones.
typedef struct {
    float low_org[3], high_org[3], low_inverse[3], high_inverse[3];
    float slack, begin, end;
} Bounds;

inline void widen(float *low, float *high, float16 v, int16 active)
{
    const float l = lowest(active ? v : (float16)INFINITY);
    const float h = highest(active ? v : (float16)-INFINITY);
    *low = MIN(*low, l);
    *high = MAX(*high, h);
}

// cl/dual.h: set_box_ray, lane by lane.
inline void set_group(Group *g, const Rays16 *r, const Box *scene, Bounds *bounds)
{
    const int16 active = r->tfar >= r->tnear;
    const float16 o[3] = {r->ox, r->oy, r->oz}, d[3] = {r->dx, r->dy, r->dz};
    const float low[3] = {scene->low.x, scene->low.y, scene->low.z};
    const float high[3] = {scene->high.x, scene->high.y, scene->high.z};
    float16 per_t = 0.0f, offset = 0.0f, reach = 0.0f;
    for (uint k = 0; k < 3; k++) {
        per_t = larger(per_t, magnitude(d[k]));
        offset = larger(offset, magnitude(o[k]));
        reach = larger(reach, larger(magnitude(low[k] - o[k]), magnitude(high[k] - o[k])));
    }
    const float16 slack = 0x1p-18f * reach + 0x1p-22f * offset;
    for (uint k = 0; k < 3; k++) {
        const float16 slope = d[k] / per_t;
        const float16 steep = larger(magnitude(slope), STILL), inverse = 1.0f / steep;
        g->falls[k] = slope < 0.0f;
        g->inverse[k] = g->falls[k] ? -inverse : inverse;
        g->near[k] = -o[k] * g->inverse[k] - slack * inverse;
        g->far[k] = -o[k] * g->inverse[k] + slack * inverse;
        widen(&bounds->low_org[k], &bounds->high_org[k], o[k], active);
        widen(&bounds->low_inverse[k], &bounds->high_inverse[k], g->inverse[k], active);
    }
    set_frame16(&g->frame, o, d, r->tnear, r->tfar, active);
    g->per_t = per_t;
    g->begin = r->tnear * per_t / OUTWARDS + 0.0f;
    g->end = CLOSE_END(g->per_t, g->frame.tfar);
    g->nearest = INVALID;
    float unused = 0.0f;
    widen(&unused, &bounds->slack, slack, active);
    widen(&bounds->begin, &unused, g->begin, active);
    widen(&unused, &bounds->end, g->end, active);
}

inline Interval interval_of(const Bounds *b)
{
    Interval v;
    for (uint k = 0; k < 3; k++) {
        const bool falls = v.falls[k] = b->high_inverse[k] < 0.0f;
        const float low = b->low_org[k] - b->slack, high = b->high_org[k] + b->slack;
        v.says[k] = falls || b->low_inverse[k] > 0.0f;
        v.low_row[k] = falls ? 3 + k : k;
        v.inverse[k][0] = b->low_inverse[k];
        v.inverse[k][1] = b->high_inverse[k];
        for (uint end = 0; end < 2; end++) {
            v.near[k][end] = -(falls ? low : high) * v.inverse[k][end];
            v.far[k][end] = -(falls ? high : low) * v.inverse[k][end];
        }
    }
    v.agrees = v.says[0] && v.says[1] && v.says[2];
    v.begin = b->begin;
    v.end = b->end;
    return v;
}

// Eight boxes.
typedef struct {
    float8 low[3], high[3];
} Boxes;

// Bit k: some ray may enter box k; at (*enter)[k] at the earliest. In `all`, bit k: every ray enters, as
// far as its hits leave it whole. No bound hangs on that: a ray that is taken for one that enters costs
// its tests.
INLINE uint enter_boxes(const Interval *v, const Boxes *boxes, float8 *enter, uint *all)
{
    float8 a = v->begin, b = v->end, last_in = v->begin, first_out = v->end;
    for (uint k = 0; k < 3; k++) {
        if (!v->says[k])
            continue;
        const float8 first = v->falls[k] ? boxes->high[k] : boxes->low[k];
        const float8 last = v->falls[k] ? boxes->low[k] : boxes->high[k];
        const float8 i0 = v->inverse[k][0], i1 = v->inverse[k][1];
        const float8 near0 = v->near[k][0], near1 = v->near[k][1];
        const float8 far0 = v->far[k][0], far1 = v->far[k][1];
        a = larger8(a, smaller8(FMA8(first, i0, near0), FMA8(first, i1, near1)));
        b = smaller8(b, larger8(FMA8(last, i0, far0), FMA8(last, i1, far1)));
        last_in = larger8(last_in, larger8(FMA8(first, i0, far0), FMA8(first, i1, far1)));
        first_out = smaller8(first_out, smaller8(FMA8(last, i0, near0), FMA8(last, i1, near1)));
    }
    *enter = a;
    *all = v->agrees ? MASK8(last_in <= first_out) : 0;
    return MASK8(a <= b);
}

// Rays of a group that enter a box, where all of the bundle go the same way along every axis: the planes
// at which they enter and leave. All axes and groups straight on: with choices in between bundles took
// 1.07 times as long.
INLINE uint rays_entering(const Group *g, const float *first, const float *last)
{
    float16 a = g->begin, b = g->end;
#pragma unroll
    for (uint k = 0; k < 3; k++) {
        const float16 near = FMA16((float16)first[k], g->inverse[k], g->near[k]);
        const float16 far = FMA16((float16)last[k], g->inverse[k], g->far[k]);
        a = near > a ? near : a;
        b = far < b ? far : b;
    }
    return MASK16(a <= b);
}

// The same, where they do not: six rows of eight boxes, the box in the first lane.
INLINE uint mixed_entering(const Group *g, global const float *box)
{
    float16 a = g->begin, b = g->end;
#pragma unroll
    for (uint k = 0; k < 3; k++) {
        const float16 low = box[8 * k], high = box[8 * (3 + k)];
        const float16 near = FMA16(g->falls[k] ? high : low, g->inverse[k], g->near[k]);
        const float16 far = FMA16(g->falls[k] ? low : high, g->inverse[k], g->far[k]);
        a = near > a ? near : a;
        b = far < b ? far : b;
    }
    return MASK16(a <= b);
}

#define LANE(T, field) (((T *)&g->field)[lane])

INLINE RayFrame frame_of_lane(const Group *g, uint lane)
{
    const uint z = LANE(uint, frame.major);
    const RayFrame f = {LANE(float, frame.ox),      LANE(float, frame.oy),      LANE(float, frame.oz),
                        LANE(float, frame.shear_x), LANE(float, frame.shear_y), LANE(float, frame.scale),
                        LANE(float, frame.tnear),   LANE(float, frame.tfar),
                        TURNED_X(z),                TURNED_Y(z),                z};
    return f;
}

INLINE Closest hit_of_lane(const Group *g, uint lane)
{
    const uint triangle = LANE(uint, nearest);
    const Closest h = {triangle == INVALID ? MISS : hit_key(LANE(float, frame.tfar), triangle),
                       LANE(float, u), LANE(float, v)};
    return h;
}

// The ray's closest hit is `hit`, unless that is a miss.
INLINE void store_lane(Group *g, uint lane, const Closest *hit)
{
    if (hit->key == MISS)
        return;
    LANE(float, frame.tfar) = distance_of(hit);
    LANE(float, end) = CLOSE_END(LANE(float, per_t), distance_of(hit));
    LANE(uint, nearest) = (uint)hit->key;
    LANE(float, u) = hit->u;
    LANE(float, v) = hit->v;
}

inline BoxRay box_ray_of_lane(const Group *g, uint lane)
{
    BoxRay r;
    for (uint k = 0; k < 3; k++) {
        r.inverse[k] = LANE(float, inverse[k]);
        r.near[k] = LANE(float, near[k]);
        r.far[k] = LANE(float, far[k]);
        r.low_row[k] = r.inverse[k] < 0.0f ? 3 + k : k;
    }
    r.begin = LANE(float, begin);
    r.end = LANE(float, end);
    r.per_t = LANE(float, per_t);
    return r;
}

// Rays of `mask` of one group finish `node` alone; returns those that have a hit.
inline uint finish_alone(Group *g, uint mask, const Tree *tree, uint node, bool any, Counts *c)
{
    uint hit = 0;
    for (; mask != 0; mask &= mask - 1) {
        const uint lane = LOWEST(mask);
        BoxRay box = box_ray_of_lane(g, lane);
        LeafRay r = {frame_of_lane(g, lane), hit_of_lane(g, lane)};
        walk(&box, &r, tree, node, any, c);
        store_lane(g, lane, &r.hit);
        hit |= (uint)(r.hit.key != MISS) << lane;
    }
    return hit;
}

// The same in a leaf.
inline uint test_alone(Group *g, uint mask, global const float8 *leaf, Counts *c)
{
    uint hit = 0;
    for (; mask != 0; mask &= mask - 1) {
        const uint lane = LOWEST(mask);
        const RayFrame frame = frame_of_lane(g, lane);
        Closest closest = hit_of_lane(g, lane);
        if (test_leaf(&frame, &closest, leaf, c)) {
            store_lane(g, lane, &closest);
            hit |= 1u << lane;
        }
    }
    return hit;
}

// Sixteen rays, those in `mask`, and triangle k of a leaf; returns those that have a new hit.
inline uint test_triangle(Group *g, uint mask, global const float *leaf, uint k, Counts *c)
{
    float16 edges[3], depths[3];
    const int16 inside = inside_edges_rays16(&g->frame, leaf + k, 24, 8, edges, depths);
    c->tests += COUNT16(mask);
    if ((MASK16(inside) & mask) == 0)
        return 0;
    const TriangleHit16 h = finish_hit16(&g->frame, inside, edges, depths);
    const uint triangle = ((global const uint *)leaf)[8 * LEAF_TRIANGLE_ROW + k];
    // Equal distances go to the smaller triangle.
    const int16 nearer = h.hit & ((h.t < g->frame.tfar) | (triangle < g->nearest));
    g->frame.tfar = nearer ? h.t : g->frame.tfar;
    g->nearest = nearer ? (uint16)triangle : g->nearest;
    g->end = nearer ? CLOSE_END(g->per_t, h.t) : g->end;
    g->u = nearer ? h.u : g->u;
    g->v = nearer ? h.v : g->v;
    const uint hit = MASK16(h.hit);
    c->hits += COUNT16(hit & mask);
    return hit;
}

inline uint rays_of(ulong mask, uint group) { return (uint)(mask >> 16 * group) & 0xffff; }

inline void close(Bundle *b, uint hit, uint group)
{
    if (b->any)
        b->open &= ~((ulong)hit << 16 * group);
}

// The least end of the bundle that encloses those of its rays.
inline void shorten(Bundle *b)
{
    float16 end = b->groups[0].end;
    for (uint g = 1; g < GROUPS; g++)
        end = larger(end, b->groups[g].end);
    b->interval.end = highest(end);
}

inline void test_leaf_bundle(Bundle *b, ulong mask, const Tree *tree, uint node, Counts *c)
{
    global const float8 *leaf = tree->leaves + (ulong)(node & ~LEAF) * LEAF_ROWS;
    Boxes boxes;
    for (uint k = 0; k < 3; k++)
        bound_leaf(leaf, k, &boxes.low[k], &boxes.high[k]);
    float8 enter;
    uint all;
    const uint triangles
        = enter_boxes(&b->interval, &boxes, &enter, &all) & MASK8(leaf[0] == leaf[0]);
    const uint count = COUNT16(triangles);
    c->leaves++;
    c->leaf_tests += TREE_WIDTH;
    c->leaf_boxes += count;
    if (triangles == 0)
        return;
    for (uint g = 0; g < GROUPS; g++) {
        const uint rays = rays_of(mask, g);
        if (rays == 0)
            continue;
        uint hit = 0;
        if (COUNT16(rays) < count)
            hit = test_alone(b->groups + g, rays, leaf, c);
        else
            for (uint left = triangles; left != 0; left &= left - 1)
                hit |= test_triangle(b->groups + g, rays, (global const float *)leaf, LOWEST(left),
                                     c);
        close(b, hit, g);
    }
    shorten(b);
}

// Rays of `mask` that enter a child's box and stay in the bundle. Where few enter they have finished the
// child alone.
inline ulong enter_child(Bundle *b, ulong mask, const Tree *tree, global const float *box, uint child,
                         Counts *c)
{
    ulong entered = 0;
    if (b->interval.agrees) {
        const uint *rows = b->interval.low_row;
        const float first[3] = {box[8 * rows[0]], box[8 * rows[1]], box[8 * rows[2]]};
        const float last[3] = {box[8 * (3 - rows[0])], box[8 * (5 - rows[1])], box[8 * (7 - rows[2])]};
#pragma unroll
        for (uint g = 0; g < GROUPS; g++)
            if (rays_of(mask, g))
                entered |= (ulong)rays_entering(b->groups + g, first, last) << 16 * g;
    } else {
        for (uint g = 0; g < GROUPS; g++)
            if (rays_of(mask, g))
                entered |= (ulong)mixed_entering(b->groups + g, box) << 16 * g;
    }
    entered &= mask;
    const uint count = COUNT64(entered);
    c->box_tests += COUNT64(mask);
    c->boxes += count;
    if (count > FEW || count == 0 || (child & LEAF))
        return entered;
    for (uint g = 0; g < GROUPS; g++) {
        const uint rays = rays_of(entered, g);
        close(b, finish_alone(b->groups + g, rays, tree, child, b->any, c), g);
    }
    shorten(b);
    return 0;
}

// Box k of a node, and whether all rays enter it.
#define BOX(node, k, all) ((node) * (2 * TREE_WIDTH) + 2 * (k) + (all))
#define NODE_OF(box) ((box) / (2 * TREE_WIDTH))
#define CHILD_OF(box) ((box) / 2 % TREE_WIDTH)

inline void walk_bundle(Bundle *b, const Tree *tree, Counts *c)
{
    ulong stack[TREE_STACK], waiting[TREE_STACK];
    uint top = 0, node = 0;
    ulong rays = b->open;
    for (;;) {
        global const float8 *rows = tree->nodes + (ulong)node * TREE_ROWS;
        const Boxes boxes = {{rows[0], rows[1], rows[2]}, {rows[3], rows[4], rows[5]}};
        float distance[8] __attribute__((aligned(32)));
        uint all;
        const uint mask = enter_boxes(&b->interval, &boxes, (float8 *)distance, &all);
        c->nodes++;
        c->box_tests += TREE_WIDTH;
        c->boxes += COUNT16(mask);
        const uint base = top;
        for (uint left = mask; left != 0; left &= left - 1) {
            const uint k = LOWEST(left);
            const ulong box = entry(distance[k], BOX(node, k, all >> k & 1));
            prefetch_child(tree, ((global const uint *)(rows + TREE_CHILD_ROW))[k]);
            uint place = top;
            for (; place > base && stack[place - 1] < box; place--)
                stack[place] = stack[place - 1];
            stack[place] = box;
            waiting[top++] = rays;
        }
        rays = 0;
        while (rays == 0) {
            if (top == 0)
                return;
            const ulong box = stack[--top];
            rays = waiting[top] & b->open;
            if (rays == 0)
                continue;
            if (as_float((uint)(box >> 32)) > b->interval.end) {
                rays = 0;
                continue;
            }
            const uint k = CHILD_OF((uint)box);
            rows = tree->nodes + (ulong)NODE_OF((uint)box) * TREE_ROWS;
            node = ((global const uint *)(rows + TREE_CHILD_ROW))[k];
            if ((box & 1) && !(node & LEAF))
                break;
            rays = enter_child(b, rays, tree, (global const float *)rows + k, node, c);
            if (rays != 0 && (node & LEAF)) {
                test_leaf_bundle(b, rays, tree, node, c);
                rays = 0;
            }
        }
    }
}

#define NEXT(v) ((v).s123456789abcdeff)

// Whether neighbours go nearly the same way says whether sorting will bring such rays together.
inline void compare_neighbours(const Rays16 *r, Counts *c)
{
    const float16 x = NEXT(r->dx), y = NEXT(r->dy), z = NEXT(r->dz);
    const float16 product = r->dx * x + r->dy * y + r->dz * z;
    const float16 length2 = r->dx * r->dx + r->dy * r->dy + r->dz * r->dz;
    const int16 close = (product > 0.0f) & (product * product >= CLOSE * length2 * NEXT(length2));
    const uint active = MASK16(r->tfar >= r->tnear), pairs = active & active >> 1;
    c->pairs += COUNT16(pairs);
    c->close_pairs += COUNT16(pairs & MASK16(close));
}

inline void start_bundle(Bundle *b, ulong first, ulong stop, const Box *scene, bool any,
                         global const uint *slots, global const float4 *org_tnear,
                         global const float4 *dir_tfar, bool sample, Counts *c)
{
    Bounds bounds = {{INFINITY, INFINITY, INFINITY},
                     {-INFINITY, -INFINITY, -INFINITY},
                     {INFINITY, INFINITY, INFINITY},
                     {-INFINITY, -INFINITY, -INFINITY},
                     0.0f,
                     INFINITY,
                     -INFINITY};
    b->open = 0;
    b->any = any;
    for (uint g = 0; g < GROUPS; g++) {
        const Rays16 r = gather_rays(first + 16 * g, 1, stop, slots, org_tnear, dir_tfar);
        set_group(b->groups + g, &r, scene, &bounds);
        if (sample)
            compare_neighbours(&r, c);
        b->open |= (ulong)MASK16(r.tfar >= r.tnear) << 16 * g;
    }
    b->interval = interval_of(&bounds);
}

#define DEFINE_BUNDLE(NAME, ANY, RESULT, STORE)                                                    \
    kernel void NAME(TRAVERSAL_ARGUMENTS, RESULT)                                                  \
    {                                                                                              \
        BEGIN_TRAVERSAL                                                                            \
        Bundle b;                                                                                  \
        start_bundle(&b, first, num_slots, &scene, ANY, slots, org_tnear, dir_tfar, stride > 1,    \
                     &c);                                                                          \
        c.rays = COUNT64(b.open);                                                                  \
        if (b.open != 0)                                                                           \
            walk_bundle(&b, &tree, &c);                                                            \
        for (uint i = 0; first + i < stop; i++) {                                                  \
            const Group *g = b.groups + i / 16;                                                    \
            const uint lane = i % 16, ray = slots[first + i];                                      \
            if (ray != INVALID)                                                                    \
                STORE(ray, LANE(float, frame.tfar), LANE(float, u), LANE(float, v),                \
                      LANE(uint, nearest));                                                        \
        }                                                                                          \
        store_counts(&c, counts);                                                                  \
    }

DEFINE_BUNDLE(intersect_bundle, false, HIT_RECORDS, STORE_RECORD)
DEFINE_BUNDLE(occlude_bundle, true, BLOCKED_FLAGS, STORE_FLAG)
