// One ray's walk down a tree: see single.cl.

#include "dual.h"
#include "rays.h"

typedef struct {
    global const float8 *nodes, *leaves;
} Tree;

// A node or leaf will be visited: most are not in the cache.
inline void prefetch_child(const Tree *tree, uint child)
{
    global const float8 *rows = child & LEAF ? tree->leaves + (ulong)(child & ~LEAF) * LEAF_ROWS
                                             : tree->nodes + (ulong)child * TREE_ROWS;
    for (uint k = 0; k < LEAF_ROWS; k += 2)
        PREFETCH(rows + k);
}

// Of a work-item: rays traced; visits of nodes, tests of their boxes, boxes entered; visits of leaves,
// tests of their triangles' boxes, boxes entered; ray-triangle tests, hits within the segment as far
// as it then reached. Of bundles that are a sample: pairs of rays side by side, and those of close directions.
typedef struct {
    uint rays, nodes, box_tests, boxes, leaves, leaf_tests, leaf_boxes, tests, hits, pairs, close_pairs;
} Counts;

#define NUM_COUNTS 11

inline void store_counts(const Counts *c, global ulong *counts)
{
    counts += NUM_COUNTS * get_global_id(0);
    counts[0] = c->rays;
    counts[1] = c->nodes;
    counts[2] = c->box_tests;
    counts[3] = c->boxes;
    counts[4] = c->leaves;
    counts[5] = c->leaf_tests;
    counts[6] = c->leaf_boxes;
    counts[7] = c->tests;
    counts[8] = c->hits;
    counts[9] = c->pairs;
    counts[10] = c->close_pairs;
}

// What every traversal takes, before its results.
#define TRAVERSAL_ARGUMENTS                                                                        \
    const uint num_slots, const uint stride, global const uint *restrict slots,                    \
        global const float4 *restrict org_tnear, global const float4 *restrict dir_tfar,           \
        global const float8 *restrict nodes, global const float8 *restrict leaves,                 \
        global ulong *restrict counts

// How every traversal begins: with its slots from `first` to `stop`.
#define BEGIN_TRAVERSAL                                                                            \
    const uint first = get_global_id(0) * stride * RAYS;                                           \
    const uint stop = MIN(first + RAYS, num_slots);                                                \
    const Tree tree = {nodes, leaves};                                                             \
    const Box scene = box_of_node(nodes);                                                            \
    Counts c = {0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0};

// The ray in a slot, INVALID where there is none.
inline uint ray_in_slot(global const uint *slots, uint num_slots, uint i,
                        global const float4 *org_tnear, global const float4 *dir_tfar)
{
    prefetch_ray(slots[MIN(i + AHEAD, num_slots - 1)], org_tnear, dir_tfar);
    return slots[i];
}

// The result of either query for a ray; `triangle` is INVALID where it hits nothing. Hits are records of
// t, u, v and the triangle: sorted rays lie all over memory, and each touches one cache line.
#define HIT_RECORDS global float4 *restrict hits
#define STORE_RECORD(ray, t, u, v, triangle)                                                       \
    hits[ray] = (triangle) == INVALID ? (float4)(INFINITY, 0.0f, 0.0f, as_float(INVALID))          \
                                      : (float4)(t, u, v, as_float(triangle))
#define BLOCKED_FLAGS global uchar *restrict blocked
#define STORE_FLAG(ray, t, u, v, triangle) blocked[ray] = (triangle) != INVALID

// The closest hit so far: its key, and weights of its triangle's vertices.
typedef struct {
    ulong key;
    float u, v;
} Closest;

// A ray as leaves see it; nodes see its BoxRay. A cache line each.
typedef struct {
    RayFrame frame;
    Closest hit;
} __attribute__((aligned(64))) LeafRay;

inline void set_leaf_ray(LeafRay *r, float4 org_tnear, float4 dir_tfar)
{
    r->frame = ray_frame(org_tnear, dir_tfar);
    r->hit.key = MISS;
    r->hit.u = r->hit.v = 0.0f;
}

inline bool is_active(const LeafRay *r) { return r->frame.tfar >= r->frame.tnear; }

// A ray's edges and depths of a leaf's triangles.
typedef struct {
    float8 edges[3], depths[3];
    int8 inside;
} LeafTest;

// Whether the ray's line is inside a triangle.
INLINE bool test_edges(const RayFrame *frame, global const float8 *leaf, LeafTest *test)
{
    const uint x = frame->x, y = frame->y, z = frame->z;
    const Corner8 v0 = {leaf[x], leaf[y], leaf[z]};
    const Corner8 v1 = {leaf[3 + x], leaf[3 + y], leaf[3 + z]};
    const Corner8 v2 = {leaf[6 + x], leaf[6 + y], leaf[6 + z]};
    test->inside = inside_edges8(frame, v0, v1, v2, test->edges, test->depths);
    return MASK8(test->inside) != 0;
}

// Whether there is a hit nearer than `hit`, which becomes that hit.
INLINE bool finish_leaf(const RayFrame *frame, const LeafTest *test, Closest *hit,
                        global const float8 *leaf, Counts *c)
{
    const TriangleHit8 h = finish_hit8(frame, test->inside, test->edges, test->depths);
    uint mask = MASK8(h.hit);
    if (mask == 0)
        return false;
    c->hits += COUNT16(mask);
    float t[8] __attribute__((aligned(32))), u[8] __attribute__((aligned(32))),
        v[8] __attribute__((aligned(32)));
    *(float8 *)t = h.t;
    *(float8 *)u = h.u;
    *(float8 *)v = h.v;
    const ulong before = hit->key;
    for (; mask != 0; mask &= mask - 1) {
        const uint k = LOWEST(mask);
        const ulong key = hit_key(t[k], ((global const uint *)(leaf + LEAF_TRIANGLE_ROW))[k]);
        if (key < hit->key) {
            hit->key = key;
            hit->u = u[k];
            hit->v = v[k];
        }
    }
    return hit->key != before;
}

// Both; test_list in ray_stream.cl does them apart.
INLINE bool test_leaf(const RayFrame *frame, Closest *hit, global const float8 *leaf, Counts *c)
{
    LeafTest test;
    c->leaves++;
    c->tests += TREE_WIDTH;
    return test_edges(frame, leaf, &test) && finish_leaf(frame, &test, hit, leaf, c);
}

inline float distance_of(const Closest *hit) { return as_float((uint)(hit->key >> 32)); }

// The ray goes no farther than its hit; equal distances still hit, and are still entered.
inline void shorten_ray(BoxRay *box, LeafRay *r)
{
    r->frame.tfar = distance_of(&r->hit);
    box->end = r->frame.tfar * box->per_t * OUTWARDS;
}

inline void visit_leaf(BoxRay *box, LeafRay *r, global const float8 *leaf, Counts *c)
{
    if (test_leaf(&r->frame, &r->hit, leaf, c))
        shorten_ray(box, r);
}

// A child and where it is entered, ordered by the latter: s >= 0, so its bits sort like its value.
inline ulong entry(float enter, uint child) { return ((ulong)as_uint(enter) << 32) | child; }

// Walk the tree from `node`; where `any`, up to the first hit.
inline void walk(BoxRay *box, LeafRay *r, const Tree *tree, uint node, bool any, Counts *c)
{
    ulong stack[TREE_STACK];
    uint top = 0;
    for (;;) {
        if (node & LEAF) {
            visit_leaf(box, r, tree->leaves + (ulong)(node & ~LEAF) * LEAF_ROWS, c);
            if (any && r->hit.key != MISS)
                return;
        } else {
            global const float8 *rows = tree->nodes + (ulong)node * TREE_ROWS;
            global const uint *children = (global const uint *)(rows + TREE_CHILD_ROW);
            float8 enter;
            uint mask = MASK8(enter_children(box, rows, &enter));
            c->nodes++;
            c->box_tests += TREE_WIDTH;
            c->boxes += COUNT16(mask);
            if (mask != 0) {
                const uint first = LOWEST(mask);
                mask &= mask - 1;
                if (mask == 0) {
                    node = children[first];
                    continue;
                }
                float distance[8] __attribute__((aligned(32)));
                *(float8 *)distance = enter;
                ulong nearest = entry(distance[first], children[first]);
                const uint base = top;
                for (; mask != 0; mask &= mask - 1) {
                    const uint k = LOWEST(mask);
                    const ulong child = entry(distance[k], children[k]);
                    const ulong farther = MAX(child, nearest);
                    nearest = MIN(child, nearest);
                    uint place = top++;
                    for (; place > base && stack[place - 1] < farther; place--)
                        stack[place] = stack[place - 1];
                    stack[place] = farther;
                }
                node = (uint)nearest;
                continue;
            }
        }
        do {
            if (top == 0)
                return;
            top--;
        } while (as_float((uint)(stack[top] >> 32)) > box->end);
        node = (uint)stack[top];
    }
}
