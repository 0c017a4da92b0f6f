// Streams of incoherent rays against the scene hierarchy (tree.h): many rays walk the tree together,
// depth first, each list of rays meeting a node while it is in the cache and without the jumps that
// single rays mispredict.
//
// A stack entry is a child with the list of the rays that entered it. At a node every ray of its list is
// tested against the eight boxes; the ids of those that enter a child are compressed into that child's
// list. Children are pushed by the mean distance at which their rays enter, nearest on top. Where few
// rays are left, or no room for the lists of all children, they finish the node as single rays.
//
// Build-time constant: RAYS, to a work-item.

#include "single.h"

#define SOON 8 // rays ahead in a list: all rays of a stream are more than the first cache holds
#define FEW 4 // rays that are better off alone
#define ROOM (16 * RAYS) // for the ids of all lists on the stack; of 40 cases two asked for more

typedef struct {
    uint node, begin, count;
} List;

typedef struct {
    BoxRay boxes[RAYS];
    LeafRay rays[RAYS];
    uint ids[ROOM + 16];
    uchar entered[RAYS + 16];
    bool any;
} Stream;

// The ids of `list` whose ray entered child k, to `out`; returns how many they are.
inline uint compress_list(const Stream *s, List list, uint k, uint *out)
{
    const uint *ids = s->ids + list.begin;
    uint count = 0;
#ifdef COMPRESS16
    for (uint i = 0; i < list.count; i += 16) {
        const uchar16 bits = LOAD_PRIVATE(uchar16, s->entered + i) & (uchar16)(1 << k);
        const uint lanes = list.count - i < 16 ? (1u << (list.count - i)) - 1 : 0xffff;
        const uint mask = MASK16(CONVERT(int16, bits) != 0) & lanes;
        STORE_PRIVATE(uint16, out + count, COMPRESS16(LOAD_PRIVATE(uint16, ids + i), mask));
        count += COUNT16(mask);
    }
#else
    for (uint i = 0; i < list.count; i++) {
        out[count] = ids[i];
        count += s->entered[i] >> k & 1;
    }
#endif
    return count;
}

inline bool is_closed(const Stream *s, uint id) { return s->any && s->rays[id].hit.key != MISS; }

// Where one hit is enough, a ray that has one enters no box from here on.
inline void close_ray(Stream *s, uint id)
{
    if (is_closed(s, id))
        s->boxes[id].end = -INFINITY;
}

inline void finish_list(Stream *s, const Tree *tree, List list, Counts *c)
{
    for (uint i = 0; i < list.count; i++) {
        const uint id = s->ids[list.begin + i];
        if (is_closed(s, id))
            continue;
        walk(s->boxes + id, s->rays + id, tree, list.node, s->any, c);
        close_ray(s, id);
    }
}

// Push the children of a node that rays of `list` enter; returns the new height of the stack.
inline uint push_children(Stream *s, const Tree *tree, List list, List *stack, uint top, Counts *c)
{
    global const float8 *rows = tree->nodes + (ulong)list.node * TREE_ROWS;
    global const uint *children = (global const uint *)(rows + TREE_CHILD_ROW);
    float8 sum = 0.0f;
    int8 count = 0;
    for (uint i = 0; i < list.count; i++) {
        const BoxRay *r = s->boxes + s->ids[list.begin + i];
        PREFETCH_PRIVATE(s->boxes + s->ids[list.begin + MIN(i + SOON, list.count - 1)]);
        float8 enter;
        const int8 enters = enter_children(r, rows, &enter);
        s->entered[i] = (uchar)MASK8(enters);
        sum += enters ? enter : 0.0f;
        count -= enters;
    }
    float distance[8] __attribute__((aligned(32)));
    uint counts[8] __attribute__((aligned(32)));
    *(float8 *)distance = sum / CONVERT(float8, count);
    *(uint8 *)counts = as_uint8(count);
    ulong order[8];
    uint num = 0, total = 0;
    for (uint k = 0; k < 8; k++) {
        if (counts[k] == 0)
            continue;
        total += counts[k];
        const ulong child = entry(distance[k], k);
        uint place = num++;
        for (; place > 0 && order[place - 1] < child; place--)
            order[place] = order[place - 1];
        order[place] = child;
    }
    uint begin = list.begin + list.count;
    if (begin + total > ROOM) {
        finish_list(s, tree, list, c);
        return top;
    }
    for (uint i = 0; i < num; i++) {
        const uint k = (uint)order[i];
        const List child = {children[k], begin, counts[k]};
        prefetch_child(tree, child.node);
        compress_list(s, list, k, s->ids + begin);
        stack[top++] = child;
        begin += counts[k];
    }
    c->nodes++;
    c->box_tests += TREE_WIDTH * list.count;
    c->boxes += total;
    return top;
}

// Tests first, without a branch, then what the few go on with that have a triangle around them.
inline void test_list(Stream *s, List list, global const float8 *leaf, Counts *c)
{
    const uint *ids = s->ids + list.begin;
    LeafTest tests[16];
    for (uint i = 0; i < list.count; i += 16) {
        const uint count = MIN(list.count - i, 16u);
        uint inside = 0;
        for (uint k = 0; k < count; k++)
            PREFETCH_PRIVATE(s->rays + ids[i + k]);
        for (uint k = 0; k < count; k++)
            inside |= (uint)test_edges(&s->rays[ids[i + k]].frame, leaf, tests + k) << k;
        for (; inside != 0; inside &= inside - 1) {
            const uint k = LOWEST(inside);
            const uint id = ids[i + k];
            LeafRay *r = s->rays + id;
            if (!is_closed(s, id) && finish_leaf(&r->frame, tests + k, &r->hit, leaf, c)) {
                shorten_ray(s->boxes + id, r);
                close_ray(s, id);
            }
        }
    }
    c->leaves += list.count;
    c->tests += TREE_WIDTH * list.count;
}

inline void walk_stream(Stream *s, uint num_rays, const Tree *tree, Counts *c)
{
    List stack[TREE_STACK];
    const List all = {0, 0, num_rays};
    for (uint i = 0; i < num_rays; i++)
        s->ids[i] = i;
    stack[0] = all;
    for (uint top = 1; top > 0;) {
        const List list = stack[--top];
        if (list.node & LEAF) {
            global const float8 *leaf = tree->leaves + (ulong)(list.node & ~LEAF) * LEAF_ROWS;
            test_list(s, list, leaf, c);
        } else if (list.count <= FEW) {
            finish_list(s, tree, list, c);
        } else {
            top = push_children(s, tree, list, stack, top, c);
        }
    }
}

#define DEFINE_STREAM(NAME, ANY, RESULT, STORE)                                                    \
    kernel void NAME(TRAVERSAL_ARGUMENTS, RESULT)                                                  \
    {                                                                                              \
        BEGIN_TRAVERSAL                                                                            \
        Stream s;                                                                                  \
        uint number[RAYS];                                                                         \
        s.any = ANY;                                                                               \
        for (uint i = first; i < stop; i++) {                                                      \
            const uint ray = ray_in_slot(slots, num_slots, i, org_tnear, dir_tfar);                \
            if (ray == INVALID)                                                                    \
                continue;                                                                          \
            LeafRay *r = s.rays + c.rays;                                                          \
            set_box_ray(s.boxes + c.rays, &scene, org_tnear[ray], dir_tfar[ray]);                  \
            set_leaf_ray(r, org_tnear[ray], dir_tfar[ray]);                                        \
            if (is_active(r))                                                                      \
                number[c.rays++] = ray;                                                            \
            else                                                                                   \
                STORE(ray, 0.0f, 0.0f, 0.0f, INVALID);                                             \
        }                                                                                          \
        if (c.rays != 0)                                                                           \
            walk_stream(&s, c.rays, &tree, &c);                                                    \
        for (uint i = 0; i < c.rays; i++) {                                                        \
            const LeafRay *r = s.rays + i;                                                         \
            STORE(number[i], r->frame.tfar, r->hit.u, r->hit.v, (uint)r->hit.key);                 \
        }                                                                                          \
        store_counts(&c, counts);                                                                  \
    }

DEFINE_STREAM(intersect_stream, false, HIT_RECORDS, STORE_RECORD)
DEFINE_STREAM(occlude_stream, true, BLOCKED_FLAGS, STORE_FLAG)
