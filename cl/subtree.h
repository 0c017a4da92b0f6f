// A task of the better builder (sah.cl): the nodes and leaves over ranges of things, made by one work-item.

#include "cut.h"

#define FEW BINS // things that are sorted
#define MANY 256 // things of which SAMPLE choose the axis
#define SAMPLE 64
#define TASK_LEVELS 14
#define NEED(triangles) ((triangles) <= TREE_WIDTH ? 1 : (triangles) / 5 + 1)

// ---- ranges within a task ----

// `middles` are bounds, no tighter than need be. `swapped`: the things are in the second array. `packed`:
// parts end where packed leaves do.
typedef struct {
    float8 box, middles;
    uint begin, end, weight;
    uint swapped;
    bool packed;
} Range;

// Where a subtree goes, and how many leaves it may have more than its parts need.
typedef struct {
    global float8 *things[2], *nodes, *leaves;
    global const float4 *triangles;
    uint next_node, next_leaf, spare;
    float area; // of its nodes' children
} Subtree;

inline void measure(const Subtree *t, Range *r)
{
    global const float8 *things = t->things[r->swapped];
    r->box = r->middles = -INFINITY;
    r->weight = 0;
    for (uint i = r->begin; i < r->end; i++) {
        const float8 thing = things[i];
        r->box = larger8(r->box, thing);
        r->middles = larger8(r->middles, middle(thing));
        r->weight += weight_of(thing);
    }
}

// Things before the cut from the front, the others from the back, to the other array.
inline void partition(const Subtree *t, const Range *r, Line line, uint last)
{
    global const float8 *from = t->things[r->swapped];
    global float8 *to = t->things[r->swapped ^ 1];
    const float plane = last + 1;
    uint next = r->begin, behind = r->end - 1;
    for (uint i = r->begin, end = r->end; i < end; i++) {
        const bool before = place_along(line, from, i) < plane;
        to[before ? next : behind] = from[i];
        next += before;
        behind -= !before;
    }
}

inline uint longest(float8 middles)
{
    const float4 extent = middles.lo + middles.hi;
    return extent.x >= extent.y && extent.x >= extent.z ? 0 : extent.y >= extent.z ? 1 : 2;
}

// The axis of the cheapest cut of some of the things, if they are many, else the longest.
inline uint choose_axis(const Subtree *t, const Range *r)
{
    const uint count = r->end - r->begin;
    Cut cut = {INFINITY, longest(r->middles), 0, 0};
    if (count < MANY)
        return cut.axis;
    Bins tables[6];
    clear_bins(tables, 6);
    bin_things(tables, binning_of(r->middles), t->things[r->swapped], r->begin, r->end, count / SAMPLE);
    join_tables(tables);
    for (uint axis = 0; axis < 3; axis++)
        improve_cut(&cut, axis, tables + axis);
    return cut.axis;
}

// The cheapest cut between bins along a line, and its parts.
inline Cut cut_many(const Subtree *t, const Range *r, Line line, Parts *parts)
{
    global const float8 *things = t->things[r->swapped];
    Bins tables[2]; // as those of bin_things
    clear_bins(tables, 2);
    for (uint i = r->begin, end = r->end; i < end; i++)
        add_thing(tables + (i & 1), bin_at(place_along(line, things, i)), things[i]);
    join_bins(tables, tables + 1);
    Cut cut = {INFINITY, 0, 0, 0};
    improve_cut(&cut, line.axis, tables);
    if (cut.cost < INFINITY)
        *parts = cut_parts(&cut, line, tables, r->middles);
    return cut;
}

// Places of up to FEW things along an axis, as if sorted. Distances from the low end of the box have bits
// that sort like them; the last four give way to the number, so that none are equal.
inline void rank_few(const float8 *things, uint count, float minus_low, uint axis, uint *ranks)
{
    uint keys[FEW] __attribute__((aligned(64)));
    for (uint i = 0; i < FEW; i++) {
        const float *p = (const float *)(things + i);
        const float offset = p[4 + axis] - p[axis] + 2.0f * minus_low;
        keys[i] = i < count ? (as_uint(offset) & ~(FEW - 1u)) | i : INVALID;
    }
    const uint16 mine = *(const uint16 *)keys;
    int16 rank = 0;
    for (uint i = 0; i < count; i++)
        rank -= keys[i] < mine; // truth is -1
    *(int16 *)ranks = rank;
}

// The cheapest cut of up to FEW things, which are put in the order along its axis.
inline Cut cut_few(const Subtree *t, const Range *r)
{
    global float8 *things = t->things[r->swapped] + r->begin;
    const uint count = r->end - r->begin;
    const float8 box = r->box;
    float8 few[FEW];
    Bins sorted; // one thing each
    uint ranks[3][FEW] __attribute__((aligned(64)));
    for (uint i = 0; i < FEW; i++)
        few[i] = i < count ? things[i] : (float8)-INFINITY;
    clear_bins(&sorted, 1);
    Cut cut = {INFINITY, 0, 0, 0};
    for (uint axis = 0; axis < 3; axis++) {
        rank_few(few, count, AT(box, axis), axis, ranks[axis]);
        for (uint i = 0; i < count; i++) {
            const uint place = ranks[axis][i];
            sorted.boxes[place] = few[i];
            sorted.amounts[place] = THING(weight_of(few[i]));
            PREFETCH(t->triangles + TRIANGLE_FLOAT4S * (ulong)as_uint(few[i].FIRST) + axis);
        }
        improve_cut(&cut, axis, &sorted);
    }
    for (uint i = 0; i < count; i++)
        things[ranks[cut.axis][i]] = few[i];
    return cut;
}

// Leaves that things fill in their order, up to place `end` or as many as `most`; (*at): where they end.
inline uint pack(const Subtree *t, const Range *r, uint most, uint *at)
{
    global const float8 *things = t->things[r->swapped];
    uint leaves = 1, weight = 0;
    for (*at = r->begin; *at < r->end; (*at)++) {
        weight += weight_of(things[*at]);
        if (weight <= TREE_WIDTH)
            continue;
        if (leaves == most)
            break;
        leaves++;
        weight = weight_of(things[*at]);
    }
    return leaves;
}

// `r` becomes the part in front, the part behind is returned.
inline Range halve(const Subtree *t, Range *r)
{
    uint at;
    pack(t, r, pack(t, r, INVALID, &at) / 2, &at);
    Range back = *r;
    r->end = back.begin = at;
    r->packed = back.packed = true;
    measure(t, r);
    measure(t, &back);
    return back;
}

// The same, where the surface area heuristic says, or where it says nothing or would need too many leaves.
inline Range split(Subtree *t, Range *r, bool halves)
{
    if (halves || r->packed)
        return halve(t, r);
    const bool many = r->end - r->begin > FEW;
    Line line = {0, 0.0f, 0.0f};
    Parts parts;
    if (many)
        line = line_of(r->middles, choose_axis(t, r));
    const Cut cut = many ? cut_many(t, r, line, &parts) : cut_few(t, r);
    if (!(cut.cost < INFINITY))
        return halve(t, r);
    const uint weight = TRIANGLES(cut.before), rest = r->weight - weight;
    const uint needed = NEED(weight) + NEED(rest);
    if (needed > NEED(r->weight) + t->spare)
        return halve(t, r);
    t->spare += NEED(r->weight) - needed;
    Range front = *r, back = *r;
    front.end = back.begin = r->begin + THINGS(cut.before);
    if (many) {
        partition(t, r, line, cut.last);
        front.swapped = back.swapped = r->swapped ^ 1;
        front.box = parts.boxes[0], back.box = parts.boxes[1];
        front.middles = parts.middles[0], back.middles = parts.middles[1];
        front.weight = weight, back.weight = rest;
    } else {
        measure(t, &front);
        measure(t, &back);
    }
    *r = front;
    return back;
}

// ---- nodes ----

// Whether a node of one level less could not hold so many packed leaves.
inline bool needs_all(uint leaves, uint budget)
{
    ulong most = 1;
    for (uint k = 1; k < budget && most < leaves; k++)
        most *= TREE_WIDTH / 2;
    return most < leaves;
}

// The leaf over a range of up to eight triangles.
inline uint make_leaf(Subtree *t, const Range *r)
{
    global const float8 *things = t->things[r->swapped];
    uint numbers[TREE_WIDTH] __attribute__((aligned(32)));
    uint lane = 0;
    for (uint i = r->begin; i < r->end; i++) {
        const uint first = as_uint(things[i].FIRST), weight = weight_of(things[i]);
        for (uint k = 0; k < weight; k++)
            numbers[lane++] = first + k;
    }
    while (lane < TREE_WIDTH)
        numbers[lane++] = NO_CHILD;
    fill_leaf(t->leaves + LEAF_ROWS * (ulong)t->next_leaf, numbers, t->triangles);
    return LEAF | t->next_leaf++;
}

inline void set_child(Children *c, uint k, float8 box, uint child)
{
    for (uint axis = 0; axis < 3; axis++) {
        c->low[axis][k] = -AT(box, axis);
        c->high[axis][k] = AT(box, 4 + axis);
    }
    c->child[k] = child;
}

// Splits the largest of `count` parts until a node has no room for more, or all are leaves; returns how
// many they are then.
inline uint open_parts(Subtree *t, Range *parts, uint count, uint budget)
{
    uint all = 0;
    for (uint k = 0; k < count; k++)
        all += parts[k].weight;
    const bool halves = needs_all(NEED(all), budget);
    while (count < TREE_WIDTH) {
        float largest = -1.0f;
        uint heaviest = 0, chosen = INVALID;
        for (uint k = 0; k < count; k++) {
            const uint weight = parts[k].weight;
            const float area = half_area(parts[k].box);
            const float size = halves || !(area < INFINITY) ? (float)weight : area;
            // Of duplicates, whose boxes are equal, the heaviest: or one part of them would be cut
            // thinner and thinner.
            if (weight > TREE_WIDTH && (size > largest || (size == largest && weight > heaviest)))
                largest = size, heaviest = weight, chosen = k;
        }
        if (chosen == INVALID)
            break;
        parts[count++] = split(t, &parts[chosen], halves);
    }
    return count;
}

typedef struct {
    Range range;
    uint node, budget;
} Waiting;

// The nodes over `count` parts, the first of them number `node`.
inline void build_subtree(Subtree *t, Range *parts, uint count, uint node)
{
    Waiting stack[(TREE_WIDTH - 1) * TASK_LEVELS + 1];
    uint top = 0, budget = TASK_LEVELS;
    for (;;) {
        count = open_parts(t, parts, count, budget);
        Children c __attribute__((aligned(64)));
        for (uint k = 0; k < TREE_WIDTH; k++) {
            set_empty(&c, k);
            if (k >= count || parts[k].weight == 0)
                continue; // the range of a scene without triangles is empty
            t->area += half_area(parts[k].box);
            if (parts[k].weight <= TREE_WIDTH) {
                set_child(&c, k, parts[k].box, make_leaf(t, &parts[k]));
                continue;
            }
            const Waiting child = {parts[k], t->next_node++, budget - 1};
            stack[top++] = child;
            set_child(&c, k, parts[k].box, child.node);
        }
        store_node(t->nodes, node, &c);
        if (top == 0)
            return;
        const Waiting w = stack[--top];
        parts[0] = w.range;
        count = 1;
        node = w.node;
        budget = w.budget;
    }
}
