// The better builder of the scene hierarchy of `dual` (layout in tree.h): splits by the surface area
// heuristic (Goldsmith, Salmon 1987; binned: Wald 2007), top down, and leaves as full as that leaves them.
//
// A thing is the box of up to MOST triangles in a row of the scene, one where the next would make it
// larger than both apart: the two halves of a quad, or neighbours of a strip, would share a leaf anyway.
// Ranges of things are split in two, level by level, each of them by PIECES work-items (start_build, then
// choose_planes and split_ranges once a level), until they are small enough or LEVELS splits deep. The nodes
// above are made first (plan_tasks), then the subtrees of the others side by side (build_tasks): each is
// a task, or all the ends below a node together. A split of many things moves them from one array to the other.
// When triangles have moved a little the same tasks are refitted (refit_tasks); finish_tree says how good
// the tree is.
//
// A range becomes a node by up to seven splits in two, each of the largest part. Sixteen bins along each axis
// choose the place in the top levels, along one axis in tasks: the best for a sample of many things, the
// longest of fewer. Up to 16 things are cut in their order along each axis. The cost of a part is its area
// times the leaves it takes, of eight triangles each.
//
// Bounds, for whatever scene:
// - Leaves: things in a row fill leaves with at least five triangles each but the last (`packed`), so over
//   w triangles NEED(w) leaves are enough. A task has some more. A split whose parts need more than is left
//   is not made; from there on parts end where leaves do that things fill in their order.
// - Nodes: A of a task's have leaves alone for children, at least two of them each but for the root over up to
//   eight triangles, the others have eight children: over L leaves there are at most (L + 6 A) / 7 <= 4 L / 7.
// - Depth: a node `budget` levels above the lowest holds at most 4^budget packed leaves, hence less than
//   4 T triangles, T being 5 * 4^(budget - 1). Where it could hold no more, parts are halves by packed leaves,
//   the heaviest first. Three halvings leave a part with less than T. Parts of T or more are at most one, two
//   and three after no, one and two halvings: six splits, of seven that are made, leave none.
//
// Deterministic: which work-item takes a task decides nothing.
//
// Build-time constants: PIECES, LEVELS.

#include "refit.h"
#include "subtree.h"

#define MOST 4 // triangles to a thing
#define BLOCK 128 // things that stay in the first cache

// Ranges of the top are numbered like a heap: 1 is all, 2 h and 2 h + 1 are the parts of h. Those that
// are l splits deep have their things in array l % 2, in PIECES, from the first place of each to the last + 1.
enum State { NONE, OPEN, SPLIT, END };
typedef struct {
    float8 box, middles; // bounds of the latter
    uint begin, before, weight; // its place; triangles before it and its own
    enum State state;
    uint axis, last; // of its cut
} Top;

inline enum State state_of(uint weight, uint target, uint level)
{
    return weight <= target || level == LEVELS ? END : OPEN;
}

// The things of triangles begin .. end, from place `at` on; returns the place behind the last.
inline uint gather_things(global const float4 *triangles, uint begin, uint end, global float8 *things,
                          uint at)
{
    float8 thing = thing_of(triangles, begin);
    float area = half_area(thing);
    uint weight = 1;
    for (uint i = begin + 1; i < end; i++) {
        const float8 next = thing_of(triangles, i);
        float8 both = larger8(thing, next);
        const float next_area = half_area(next), both_area = half_area(both);
        const bool joins = weight < MOST && both_area <= area + next_area;
        thing.WEIGHT = as_float(weight);
        things[at] = thing;
        at += !joins;
        both.FIRST = thing.FIRST;
        thing = joins ? both : next;
        area = joins ? both_area : next_area;
        weight = joins ? weight + 1 : 1;
    }
    thing.WEIGHT = as_float(weight);
    things[at] = thing;
    return at + 1;
}

// Bins are kept by range, piece and axis.
inline void store_bins(const Bins *table, global Bins *bins)
{
    for (uint axis = 0; axis < 3; axis++)
        bins[axis] = table[axis];
}

// The things, in PIECES, and the bins of range 1.
kernel void start_build(const uint num_triangles, const uint target,
                        global const float4 *restrict triangles, const uint num_boxes,
                        global const float4 *restrict middles, global float8 *restrict things,
                        global Top *restrict tops, global uint2 *restrict pieces,
                        global Bins *restrict bins)
{
    const uint k = get_global_id(0);
    const uint begin = (ulong)num_triangles * k / PIECES, end = (ulong)num_triangles * (k + 1) / PIECES;
    float4 low, high;
    join_boxes(middles, num_boxes, &low, &high);
    const float8 around = (float8)(-low, high);
    const Binning b = binning_of(around);
    Bins tables[6];
    clear_bins(tables, 6);
    uint at = begin;
    for (uint i = begin; i < end; i += BLOCK) {
        const uint first = at;
        at = gather_things(triangles, i, MIN(i + BLOCK, end), things, at);
        bin_things(tables, b, things, first, at, 1);
    }
    join_tables(tables);
    store_bins(tables, bins + 3 * k);
    pieces[PIECES + k] = (uint2)(begin, at);
    if (k > 0)
        return;
    const Top all = {0.0f, around, 0, 0, num_triangles, state_of(num_triangles, target, 0), 0, 0};
    tops[1] = all;
}

// A work-item for each range of a level: where it is to be cut, and what its parts are. Without a place to
// cut it is an end.
kernel void choose_planes(const uint level, const uint target, global Top *restrict tops,
                          global uint2 *restrict pieces, global const Bins *restrict bins)
{
    const uint h = (1 << level) + get_global_id(0);
    Top whole = tops[h];
    tops[2 * h].state = tops[2 * h + 1].state = NONE;
    if (whole.state != OPEN)
        return;
    bins += 3 * (ulong)PIECES * get_global_id(0);
    Bins all[3];
    clear_bins(all, 3);
    Cut cut = {INFINITY, 0, 0, 0};
    for (uint axis = 0; axis < 3; axis++) {
        for (uint piece = 0; piece < PIECES; piece++) {
            const Bins some = bins[3 * piece + axis];
            join_bins(all + axis, &some);
        }
        improve_cut(&cut, axis, all + axis);
    }
    if (!(cut.cost < INFINITY)) {
        tops[h].state = END;
        return;
    }
    const Line line = line_of(whole.middles, cut.axis);
    const Parts parts = cut_parts(&cut, line, all + cut.axis, whole.middles);
    const uint weight = TRIANGLES(cut.before), rest = whole.weight - weight;
    const uint at = whole.begin + THINGS(cut.before);
    const Top front = {parts.boxes[0], parts.middles[0], whole.begin, whole.before, weight,
                       state_of(weight, target, level + 1), 0, 0};
    const Top back = {parts.boxes[1], parts.middles[1], at, whole.before + weight, rest,
                      state_of(rest, target, level + 1), 0, 0};
    tops[2 * h] = front;
    tops[2 * h + 1] = back;
    whole.state = SPLIT;
    whole.axis = cut.axis;
    whole.last = cut.last;
    tops[h] = whole;
    global uint2 *of_front = pieces + 2 * h * PIECES, *of_back = of_front + PIECES;
    uint next = whole.begin, behind = at;
    for (uint piece = 0; piece < PIECES; piece++) {
        of_front[piece].x = next;
        of_back[piece].x = behind;
        for (uint k = 0; k < BINS; k++) {
            const uint count = THINGS(bins[3 * piece + cut.axis].amounts[k]);
            next += k <= cut.last ? count : 0;
            behind += k <= cut.last ? 0 : count;
        }
        of_front[piece].y = next;
        of_back[piece].y = behind;
    }
}

// A work-item for each piece of each range of a level: its things to the range's parts, and into the
// bins of those that will be cut.
kernel void split_ranges(const uint level, global const Top *restrict tops,
                         global const uint2 *restrict pieces, global const float8 *restrict from,
                         global float8 *restrict to, global Bins *restrict bins)
{
    const uint range = get_global_id(0) / PIECES, piece = get_global_id(0) % PIECES;
    const uint h = (1 << level) + range;
    const Top whole = tops[h];
    if (whole.state != SPLIT)
        return;
    const Line line = line_of(whole.middles, whole.axis);
    const float plane = whole.last + 1;
    const bool open[2] = {tops[2 * h].state == OPEN, tops[2 * h + 1].state == OPEN};
    const Binning inner[2] = {binning_of(tops[2 * h].middles), binning_of(tops[2 * h + 1].middles)};
    Bins tables[2][6];
    clear_bins(tables[0], 6);
    clear_bins(tables[1], 6);
    const uint2 mine = pieces[h * PIECES + piece];
    uint front = pieces[2 * h * PIECES + piece].x, back = pieces[(2 * h + 1) * PIECES + piece].x;
    for (uint i = mine.x; i < mine.y; i += BLOCK) {
        const uint first_front = front, first_back = back;
        for (uint j = i, stop = MIN(i + BLOCK, mine.y); j < stop; j++) {
            const bool before = place_along(line, from, j) < plane;
            to[before ? front : back] = from[j];
            front += before;
            back += !before;
        }
        if (open[0])
            bin_things(tables[0], inner[0], to, first_front, front, 1);
        if (open[1])
            bin_things(tables[1], inner[1], to, first_back, back, 1);
    }
    bins += 3 * (2 * range * PIECES + piece);
    for (uint side = 0; side < 2; side++) {
        if (!open[side])
            continue;
        join_tables(tables[side]);
        store_bins(tables[side], bins + 3 * side * PIECES);
    }
}

// Ends whose parts, `count` of them, are built below one node; INVALID where all are one leaf. `range` holds
// them, and no others.
// What it has made are leaves and nodes in a row, beside `node`, and `area` is that of the nodes' children.
typedef struct {
    uint range, node, count, ends[TREE_WIDTH];
    uint leaf, leaf_end, first, first_end;
    float area;
} Task;

// `next`: that no one has taken. Nodes above the tasks have numbers below `top`; the area of their children.
typedef struct {
    uint count, next, top;
    float area;
    Task tasks[1 << LEVELS];
} Tasks;

// Leaves and nodes of what comes before a range of the top have numbers below these.
inline uint first_leaf(const global Top *tops, uint h)
{
    const uint level = 31 - clz(h);
    return tops[h].before / 4 + (h << (LEVELS - level)); // one more for each end that may be
}

inline uint first_node(uint leaf) { return (1 << LEVELS) + 4 * leaf / 7; }

inline void add_task(global Tasks *all, uint range, uint node, const uint *ends, uint count)
{
    global Task *task = all->tasks + all->count++;
    task->range = range;
    task->node = node;
    task->count = count;
    for (uint k = 0; k < count; k++)
        task->ends[k] = ends[k];
}

// One work-item: the nodes above the tasks, from the root, number 0, on.
kernel void plan_tasks(global const Top *restrict tops, global Tasks *restrict all,
                       global float8 *restrict nodes)
{
    uint2 stack[(TREE_WIDTH - 1) * LEVELS + 1]; // a range and its node
    uint top = 0, next_node = 1;
    float area = 0.0f;
    all->count = all->next = 0;
    stack[top++] = (uint2)(1, 0);
    while (top > 0) {
        const uint2 w = stack[--top];
        uint parts[TREE_WIDTH] = {w.x}, count = 1, splits = tops[w.x].state == SPLIT;
        while (count < TREE_WIDTH && splits > 0) {
            float largest = -1.0f;
            uint chosen = INVALID;
            for (uint k = 0; k < count; k++) {
                const float size = half_area(tops[parts[k]].box);
                if (tops[parts[k]].state == SPLIT && (chosen == INVALID || size > largest))
                    largest = size, chosen = k;
            }
            const uint front = 2 * parts[chosen];
            parts[chosen] = front;
            parts[count++] = front + 1;
            splits += (tops[front].state == SPLIT) + (tops[front + 1].state == SPLIT) - 1;
        }
        if (splits == 0) {
            add_task(all, w.x, w.y, parts, count);
            continue;
        }
        Children c __attribute__((aligned(64)));
        for (uint k = 0; k < TREE_WIDTH; k++) {
            const uint h = parts[k], leaf = first_leaf(tops, h);
            uint child;
            if (tops[h].state == SPLIT) {
                child = next_node++;
                stack[top++] = (uint2)(h, child);
            } else {
                const bool is_leaf = tops[h].weight <= TREE_WIDTH;
                child = is_leaf ? LEAF | leaf : first_node(leaf);
                add_task(all, h, is_leaf ? INVALID : child, &h, 1);
            }
            set_child(&c, k, tops[h].box, child);
            area += half_area(tops[h].box);
        }
        store_node(nodes, w.y, &c);
    }
    all->top = next_node;
    all->area = area;
}

// The things of range 1 side by side, which have gaps between pieces; returns the place behind the last.
inline uint close_gaps(global float8 *things, global const uint2 *pieces)
{
    uint at = 0;
    for (uint piece = 0; piece < PIECES; piece++)
        for (uint i = pieces[piece].x; i < pieces[piece].y; i++, at++)
            things[at] = things[i];
    return at;
}

kernel void build_tasks(global const Top *restrict tops, global const uint2 *restrict pieces,
                        global Tasks *restrict all, global const float4 *restrict triangles,
                        global float8 *restrict even, global float8 *restrict odd,
                        global float8 *restrict nodes, global float8 *restrict leaves)
{
    for (uint k = atomic_inc(&all->next); k < all->count; k = atomic_inc(&all->next)) {
        Task task = all->tasks[k];
        const uint h = task.range, level = 31 - clz(h), leaf = first_leaf(tops, h);
        const uint first = first_node(leaf) + 1; // behind the root's
        Subtree t = {{even, odd}, nodes, leaves, triangles, first, leaf, 0, 0.0f};
        const uint heirs = 1 << (LEVELS - level);
        t.spare = (tops[h].before + tops[h].weight) / 4 - tops[h].before / 4 + heirs;
        Range parts[TREE_WIDTH];
        for (uint i = 0; i < task.count; i++) {
            const uint end = task.ends[i];
            const Top e = tops[end];
            const uint behind
                = end > 1 ? pieces[(end + 1) * PIECES - 1].y : close_gaps(even, pieces + PIECES);
            const Range part = {e.box, e.middles, e.begin, behind, e.weight, (31 - clz(end)) % 2, false};
            parts[i] = part;
            t.spare -= NEED(e.weight);
        }
        if (h == 1 && task.count == 1)
            measure(&t, parts);
        if (task.node == INVALID)
            make_leaf(&t, parts);
        else
            build_subtree(&t, parts, task.count, task.node);
        task.leaf = leaf;
        task.leaf_end = t.next_leaf;
        task.first = first;
        task.first_end = t.next_node;
        task.area = t.area;
        all->tasks[k] = task;
    }
}

// Whether a node of the top is none that a task makes.
inline bool is_above(global const Tasks *all, uint node)
{
    for (uint k = 0; k < all->count; k++)
        if (all->tasks[k].node == node)
            return false;
    return true;
}

// One work-item, after build_tasks or refit_tasks: the nodes above the tasks, where they are to be refitted. Of
// half the areas the sum over all nodes' children to areas[0], the root's to areas[1]: a line through the
// root is expected to meet as many nodes and leaves as one goes into the other.
kernel void finish_tree(const uint refit, global Tasks *restrict all, global float8 *restrict nodes,
                        global const float8 *restrict leaves, global float *restrict areas)
{
    float area = refit ? 0.0f : all->area;
    for (uint k = 0; k < all->count; k++)
        area += all->tasks[k].area;
    for (uint node = all->top; refit && node-- > 0;)
        if (is_above(all, node))
            area += refit_node(nodes, leaves, node);
    const Box root = box_of_node(nodes);
    areas[0] = area;
    areas[1] = half_area_of(root.high - root.low);
    all->next = 0;
}

// A task's leaves and nodes around triangles that have moved.
kernel void refit_tasks(global Tasks *restrict all, global const float4 *restrict triangles,
                        global float8 *restrict nodes, global float8 *restrict leaves)
{
    for (uint k = atomic_inc(&all->next); k < all->count; k = atomic_inc(&all->next)) {
        const Task task = all->tasks[k];
        for (uint leaf = task.leaf; leaf < task.leaf_end; leaf++) {
            prefetch_triangles(leaves + LEAF_ROWS * (ulong)MIN(leaf + REFIT_AHEAD, task.leaf_end - 1),
                               triangles);
            refit_leaf(leaves + LEAF_ROWS * (ulong)leaf, triangles);
        }
        float area = 0.0f;
        for (uint node = task.first_end; node-- > task.first;)
            area += refit_node(nodes, leaves, node);
        if (task.node != INVALID)
            area += refit_node(nodes, leaves, task.node);
        all->tasks[k].area = area;
    }
}
