// The better builder of the scene hierarchy of `dual` (layout in tree.h): splits by the surface area
// heuristic (Goldsmith, Salmon 1987; binned: Wald 2007), top down.
//
// The order of the fast builder (tree.cl) comes first: cells of an octree are runs of it. Cells of few
// enough triangles are tasks (cut_tasks), whose subtrees are built side by side (build_tasks); the
// tree above them treats each as one thing (build_top).
//
// A range of things becomes a node by up to seven splits in two, each of the largest part. Parts
// within a task end at multiples of eight triangles, so that all leaves but a task's last are full
// and a leaf's number follows from its place. Sums along a plane choose the place; the few triangles
// that rounding moves to the other side are those nearest the plane. Up to 32 triangles are sorted
// along each axis, and every split of the leaves-to-be is compared.
//
// Bounds, for whatever scene:
// - Tasks: two in a row have more than a quarter of `target` triangles together, target being at
//   least a 64th of all: at most 513.
// - Nodes: one with A of its kind whose children all are leaves has at least two of them each, the
//   others have eight children each: over L leaves there are at most (L + 6 A) / 7 <= 4 L / 7.
// - Depth: a node `budget` levels above the lowest holds at most 8^budget leaves. Where it could hold
//   no more, parts are halves, the largest first: seven splits leave no part above an eighth, rounded
//   up. Anything else leaves fewer leaves to a node of one level less than it may hold.
//
// Deterministic: which work-item takes a task decides nothing.
//
// Build-time constants: CHUNKS; CELL_BITS, of a place along an axis: keys have as many digits of three bits, an
// octree level each.

#include "tree_make.h"

#define BINS 16
#define FEW 32 // triangles that are sorted
#define MOST_MOVED TREE_WIDTH // by rounding to whole leaves
#define TASK_LEVELS 14
#define TOP_LEVELS (TREE_DEPTH - TASK_LEVELS)

// A thing: -low x, y, z, its number; high x, y, z. Boxes are joined by `larger8`.
#define NUMBER s3

// What is between the first two, of things or of doubled middles of their boxes.
typedef struct {
    float8 box, middles;
    uint begin, end;
} Range;

inline float8 middle(float8 thing)
{
    const float4 m = thing.hi - thing.lo;
    return (float8)(-m, m);
}

inline Range measure(global const float8 *things, uint begin, uint end)
{
    Range r = {-INFINITY, -INFINITY, begin, end};
    for (uint i = begin; i < end; i++) {
        const float8 thing = things[i];
        r.box = larger8(r.box, thing);
        r.middles = larger8(r.middles, middle(thing));
    }
    return r;
}

inline float half_area(float8 box)
{
    const float4 e = box.lo + box.hi;
    return e.x * e.y + e.y * e.z + e.z * e.x;
}

// Lane k of a float8 in memory.
#define AT(v, k) (((const float *)&(v))[k])

inline float middle_along(global const float8 *things, uint i, uint axis)
{
    global const float *p = (global const float *)(things + i);
    return p[4 + axis] - p[axis];
}

// ---- many things ----

typedef struct {
    uint axis;
    float low, scale;
} Binning;

inline uint bin_of(const Binning *b, global const float8 *things, uint i)
{
    const uint bin = (uint)((middle_along(things, i, b->axis) - b->low) * b->scale);
    return MIN(bin, BINS - 1);
}

// The plane with the least cost, as the first bin behind it; 0 where there is none. `before`: things
// before the plane.
inline uint best_plane(const Binning *b, global const float8 *things, const Range *r, uint grain,
                       uint *before)
{
    // Two tables: equal bins in a row would wait for each other.
    float8 boxes[2][BINS];
    uint counts[2][BINS];
    for (uint k = 0; k < BINS; k++) {
        boxes[0][k] = boxes[1][k] = -INFINITY;
        counts[0][k] = counts[1][k] = 0;
    }
    for (uint i = r->begin; i < r->end; i++) {
        const uint bin = bin_of(b, things, i);
        boxes[i & 1][bin] = larger8(boxes[i & 1][bin], things[i]);
        counts[i & 1][bin]++;
    }
    float behind[BINS];
    float8 box = -INFINITY;
    uint count = 0;
    for (uint k = BINS - 1; k > 0; k--) {
        box = larger8(box, larger8(boxes[0][k], boxes[1][k]));
        count += counts[0][k] + counts[1][k];
        behind[k] = count == 0 ? INFINITY : half_area(box) * ((count + grain - 1) / grain);
    }
    const uint all = count + counts[0][0] + counts[1][0];
    float best = INFINITY;
    uint plane = 0;
    box = -INFINITY, count = 0;
    for (uint k = 1; k < BINS; k++) {
        box = larger8(box, larger8(boxes[0][k - 1], boxes[1][k - 1]));
        count += counts[0][k - 1] + counts[1][k - 1];
        const float cost = half_area(box) * ((count + grain - 1) / grain) + behind[k];
        if (count > 0 && count < all && cost < best)
            best = cost, plane = k, *before = count;
    }
    return plane;
}

// Those before the plane in front; both sides keep their order.
inline void partition(const Binning *b, uint plane, global float8 *things, global float8 *scratch,
                      const Range *r)
{
    uint front = r->begin, back = r->begin;
    for (uint i = r->begin; i < r->end; i++) {
        const bool before = bin_of(b, things, i) < plane;
        const float8 thing = things[i];
        things[front] = thing;
        scratch[back] = thing;
        front += before;
        back += !before;
    }
    for (uint i = r->begin; i < back; i++)
        things[front++] = scratch[i];
}

// The `count` things begin .. end that are farthest along an axis (sign -1: nearest) to the end (the
// beginning). One pass finds them: few are farther than the last one kept.
inline void move_farthest(global float8 *things, uint begin, uint end, uint axis, float sign,
                          uint count)
{
    float far[MOST_MOVED];
    uint place[MOST_MOVED];
    for (uint k = 0; k < count; k++)
        far[k] = -INFINITY, place[k] = begin + k;
    for (uint i = begin; i < end; i++) {
        const float m = sign * middle_along(things, i, axis);
        if (!(m > far[count - 1]))
            continue;
        uint k = count - 1;
        for (; k > 0 && m > far[k - 1]; k--)
            far[k] = far[k - 1], place[k] = place[k - 1];
        far[k] = m, place[k] = i;
    }
    // From the end inwards, so that none is traded for another.
    for (uint k = 0; k < count; k++) {
        uint next = k;
        for (uint j = k + 1; j < count; j++)
            next = (place[j] > place[next]) == (sign > 0.0f) ? j : next;
        const uint from = place[next], to = sign > 0.0f ? end - 1 - k : begin + k;
        place[next] = place[k];
        const float8 thing = things[from];
        things[from] = things[to];
        things[to] = thing;
    }
}

// The end of the part in front. In halves where that is all that is left, or no plane parts them.
inline uint split_many(global float8 *things, global float8 *scratch, const Range *r, uint grain,
                       bool halves)
{
    const uint units = (r->end - r->begin + grain - 1) / grain;
    const uint centre = r->begin + units / 2 * grain;
    const float8 m = r->middles;
    const float4 extent = m.lo + m.hi;
    Binning b = {extent.x >= extent.y && extent.x >= extent.z ? 0 : extent.y >= extent.z ? 1 : 2};
    const float length = AT(extent, b.axis);
    b.low = -AT(m, b.axis);
    b.scale = BINS / length;
    if (halves || !(length < INFINITY && b.scale < INFINITY))
        return centre;
    uint before = 0;
    const uint plane = best_plane(&b, things, r, grain, &before);
    if (plane == 0)
        return centre;
    partition(&b, plane, things, scratch, r);
    const uint whole = (before + grain / 2) / grain;
    const uint kept = (whole < 1 ? 1 : whole >= units ? units - 1 : whole) * grain;
    const uint at = r->begin + before;
    if (kept < before)
        move_farthest(things, r->begin, at, b.axis, 1.0f, before - kept);
    if (kept > before)
        move_farthest(things, at, r->end, b.axis, -1.0f, kept - before);
    return r->begin + kept;
}

// ---- few triangles ----

// Places along an axis, as if sorted. Distances from the low end of the box have bits that sort like
// them; the last six give way to the number, so that none are equal.
inline void rank_few(const float8 *things, uint count, float minus_low, uint axis, uint *ranks)
{
    uint keys[FEW] __attribute__((aligned(64)));
    for (uint i = 0; i < FEW; i++) {
        const float *p = (const float *)(things + i);
        const float offset = p[4 + axis] - p[axis] + 2.0f * minus_low;
        keys[i] = i < count ? (as_uint(offset) & ~(FEW - 1)) | i : INVALID;
    }
    for (uint v = 0; v < count; v += 16) {
        const uint16 mine = *(const uint16 *)(keys + v);
        int16 rank = 0;
        for (uint i = 0; i < count; i++)
            rank -= keys[i] < mine; // truth is -1
        *(int16 *)(ranks + v) = rank;
    }
}

// The end of the part in front, of up to FEW triangles; the boxes of both parts.
inline uint split_few(global float8 *things, const Range *r, float8 *front, float8 *back)
{
    const uint count = r->end - r->begin, leaves = (count + TREE_WIDTH - 1) / TREE_WIDTH;
    float8 few[FEW];
    uint ranks[3][FEW] __attribute__((aligned(64)));
    for (uint i = 0; i < count; i++)
        few[i] = things[r->begin + i];
    float best = INFINITY;
    uint best_axis = 0, best_leaves = leaves / 2;
    for (uint axis = 0; axis < 3; axis++) {
        const float8 box = r->box;
        rank_few(few, count, AT(box, axis), axis, ranks[axis]);
        float8 boxes[TREE_WIDTH], behind[TREE_WIDTH];
        for (uint k = 0; k < leaves; k++)
            boxes[k] = -INFINITY;
        for (uint i = 0; i < count; i++) {
            const uint k = ranks[axis][i] / TREE_WIDTH;
            boxes[k] = larger8(boxes[k], few[i]);
        }
        behind[leaves - 1] = boxes[leaves - 1];
        for (uint k = leaves - 1; k > 0; k--)
            behind[k - 1] = larger8(behind[k], boxes[k - 1]);
        float8 before = boxes[0];
        for (uint k = 1; k < leaves; k++) {
            const float cost = half_area(before) * k + half_area(behind[k]) * (leaves - k);
            if (cost < best || (axis == 0 && k == best_leaves && best == INFINITY)) {
                best = cost, best_axis = axis, best_leaves = k;
                *front = before, *back = behind[k];
            }
            before = larger8(before, boxes[k]);
        }
    }
    for (uint i = 0; i < count; i++)
        things[r->begin + ranks[best_axis][i]] = few[i];
    return r->begin + best_leaves * TREE_WIDTH;
}

// ---- nodes ----

// Where a subtree goes. Its leaves are numbered by place from `first_leaf` at `begin` on.
typedef struct {
    global float8 *things, *scratch, *nodes;
    global uint *order;
    uint begin, first_leaf, next_node;
} Subtree;

// `r` becomes the part in front, the part behind is returned.
inline Range split(const Subtree *t, Range *r, uint grain, bool halves)
{
    const uint begin = r->begin, end = r->end;
    if (grain > 1 && end - begin <= FEW) {
        float8 front, back;
        const uint at = split_few(t->things, r, &front, &back);
        const Range a = {front, 0.0f, begin, at}, b = {back, 0.0f, at, end}; // middles of few are
        *r = a;                                                             // not asked for
        return b;
    }
    const uint at = split_many(t->things, t->scratch, r, grain, halves);
    *r = measure(t->things, begin, at);
    return measure(t->things, at, end);
}

// Whether a node of one level less could not hold `units` leaves.
inline bool needs_all(uint units, uint budget)
{
    ulong most = 1;
    for (uint k = 1; k < budget && most < units; k++)
        most *= TREE_WIDTH;
    return most < units;
}

// The leaf over a range of up to eight triangles, as a place in the order that fill_leaves reads.
inline uint make_leaf(const Subtree *t, const Range *r)
{
    const uint leaf = t->first_leaf + (r->begin - t->begin) / TREE_WIDTH;
    for (uint k = 0; k < TREE_WIDTH; k++) {
        const uint i = r->begin + k;
        t->order[leaf * TREE_WIDTH + k] = i < r->end ? as_uint(t->things[i].NUMBER) : INVALID;
    }
    return LEAF | leaf;
}

typedef struct {
    Range range;
    uint node, budget;
} Waiting;

// The parts of a range that become a node's children.
inline uint part_range(const Subtree *t, Range r, uint grain, uint budget, Range *parts)
{
    const bool halves = needs_all((r.end - r.begin + grain - 1) / grain, budget);
    uint count = 1;
    parts[0] = r;
    while (count < TREE_WIDTH) {
        float largest = -1.0f;
        uint most = 0, chosen = INVALID;
        for (uint k = 0; k < count; k++) {
            const uint things = parts[k].end - parts[k].begin;
            const float area = half_area(parts[k].box);
            const float size = halves || !(area < INFINITY) ? (float)things : area;
            // Of duplicates, whose boxes are equal, the most: or one part of them would be cut thinner
            // and thinner.
            if (things > grain && (size > largest || (size == largest && things > most)))
                largest = size, most = things, chosen = k;
        }
        if (chosen == INVALID)
            break;
        parts[count++] = split(t, &parts[chosen], grain, halves);
    }
    return count;
}

// The nodes over `whole`, the first of them number `root`. `grain`: things to a leaf; where 1, a thing
// is a child as it is.
inline void build_subtree(Subtree *t, Range whole, uint grain, uint root, uint levels)
{
    Waiting stack[(TREE_WIDTH - 1) * TASK_LEVELS + 1];
    const Waiting first = {whole, root, levels};
    uint top = 0;
    stack[top++] = first;
    while (top > 0) {
        const Waiting w = stack[--top];
        Range parts[TREE_WIDTH];
        const uint count = part_range(t, w.range, grain, w.budget, parts);
        Children c __attribute__((aligned(64)));
        for (uint k = 0; k < TREE_WIDTH; k++) {
            set_empty(&c, k);
            if (k >= count || parts[k].begin == parts[k].end)
                continue; // the range of a scene without triangles is empty
            for (uint axis = 0; axis < 3; axis++) {
                c.low[axis][k] = -AT(parts[k].box, axis);
                c.high[axis][k] = AT(parts[k].box, 4 + axis);
            }
            if (parts[k].end - parts[k].begin > grain) {
                const Waiting child = {parts[k], t->next_node++, w.budget - 1};
                stack[top++] = child;
                c.child[k] = child.node;
            } else if (grain == 1) {
                c.child[k] = as_uint(t->things[parts[k].begin].NUMBER);
            } else {
                c.child[k] = make_leaf(t, &parts[k]);
            }
        }
        store_node(t->nodes, w.node, &c);
    }
}

// ---- tasks ----

// A task: its first triangle in the order, leaf and node. The one behind the last holds the ends.
typedef struct {
    uint begin, leaf, node;
} Task;

// Of all tasks: how many, the next that no one has taken, their leaves.
typedef struct {
    uint count, next, leaves;
} Tasks;

// The first place from `begin` on whose digit is at least `digit`.
inline uint first_with(global const uint *keys, uint begin, uint end, uint shift, uint digit)
{
    while (begin < end) {
        const uint at = begin + (end - begin) / 2;
        if ((keys[at] >> shift & 7) < digit)
            begin = at + 1;
        else
            end = at;
    }
    return begin;
}

// One work-item: cells of at most `target` triangles, or as small as keys tell apart; small ones in
// a row are one task.
kernel void cut_tasks(const uint num_triangles, const uint target, const uint first_node,
                      global const uint *restrict keys, global Task *restrict tasks,
                      global Tasks *restrict all)
{
    uint3 stack[7 * CELL_BITS + 1]; // begin, end, level
    uint top = 0, count = 0;
    stack[top++] = (uint3)(0, num_triangles, 0);
    while (top > 0) {
        const uint3 cell = stack[--top];
        if (cell.x == cell.y)
            continue;
        if (cell.y - cell.x <= target || cell.z == CELL_BITS) {
            if (count == 0 || cell.y - tasks[count - 1].begin > target / 4)
                tasks[count++].begin = cell.x;
            continue;
        }
        const uint shift = 3 * (CELL_BITS - 1 - cell.z);
        uint end = cell.y;
        for (uint digit = 8; digit-- > 0;) { // the first on top
            const uint begin = first_with(keys, cell.x, end, shift, digit);
            stack[top++] = (uint3)(begin, end, cell.z + 1);
            end = begin;
        }
    }
    uint leaf = 0, node = first_node;
    tasks[count].begin = num_triangles;
    for (uint k = 0; k <= count; k++) {
        tasks[k].leaf = leaf;
        tasks[k].node = node;
        if (k < count) {
            const uint leaves = (tasks[k + 1].begin - tasks[k].begin + TREE_WIDTH - 1) / TREE_WIDTH;
            leaf += leaves;
            node += NODES_OVER(leaves);
        }
    }
    all->count = count;
    all->next = 0;
    all->leaves = leaf;
}

inline float8 thing_of(global const float4 *triangles, uint number)
{
    global const float4 *v = triangles + TRIANGLE_FLOAT4S * (ulong)number;
    const float4 a = v[0], b = v[1], c = v[2];
    const float4 low = a < b ? a : b, high = a > b ? a : b;
    float8 thing = (float8)(-(low < c ? low : c), high > c ? high : c);
    thing.NUMBER = as_float(number);
    return thing;
}

// `roots`: each task as a thing, whose number is that of its root.
kernel void build_tasks(global const uint *restrict sorted, global const float4 *restrict triangles,
                        global const Task *restrict tasks, global Tasks *restrict all,
                        global float8 *restrict things, global float8 *restrict scratch,
                        global uint *restrict order, global float8 *restrict nodes,
                        global float8 *restrict roots)
{
    for (uint k = atomic_inc(&all->next); k < all->count; k = atomic_inc(&all->next)) {
        const uint begin = tasks[k].begin, end = tasks[k + 1].begin;
        for (uint i = begin; i < end; i++) {
            PREFETCH(triangles + TRIANGLE_FLOAT4S * (ulong)sorted[MIN(i + 16 * AHEAD, end - 1)]);
            things[i] = thing_of(triangles, sorted[i]);
        }
        Subtree t = {things, scratch, nodes, order, begin, tasks[k].leaf, tasks[k].node};
        const Range whole = measure(things, begin, end);
        float8 root = whole.box;
        if (end - begin <= TREE_WIDTH) {
            root.NUMBER = as_float(make_leaf(&t, &whole));
        } else {
            root.NUMBER = as_float(t.next_node++);
            build_subtree(&t, whole, TREE_WIDTH, tasks[k].node, TASK_LEVELS);
        }
        roots[k] = root;
    }
}

// One work-item: the nodes above the tasks, from the root, number 0, on.
kernel void build_top(global const Tasks *restrict all, global float8 *restrict roots,
                      global float8 *restrict scratch, global float8 *restrict nodes)
{
    Subtree t = {roots, scratch, nodes, 0, 0, 0, 1};
    build_subtree(&t, measure(roots, 0, all->count), 1, 0, TOP_LEVELS);
}

// The triangles of the leaves, two leaves at a time.
kernel void fill_leaves(global const Tasks *restrict all, global const uint *restrict order,
                        global const float4 *restrict triangles, global float8 *restrict leaves)
{
    const uint count = all->leaves, pairs = (count + 1) / 2;
    for (uint pair = chunk_begin(pairs), end = chunk_end(pairs); pair < end; pair++) {
        const uint ahead = MIN(pair + AHEAD, pairs - 1);
        uint numbers[16] __attribute__((aligned(64)));
        const bool second = 2 * pair + 1 < count;
        for (uint lane = 0; lane < 16; lane++) {
            const uint number = lane < 8 || second ? order[16 * pair + lane] : INVALID;
            const uint later = order[16 * ahead + lane % 8];
            PREFETCH(triangles + TRIANGLE_FLOAT4S * (ulong)(later == INVALID ? 0 : later));
            numbers[lane] = number;
        }
        const int16 meant = *(uint16 *)numbers != INVALID;
        for (uint lane = 0; lane < 16; lane++)
            numbers[lane] = numbers[lane] == INVALID ? 0 : numbers[lane];
        float16 corners[3][3];
        gather_corners(triangles, numbers, corners);
        store_two_leaves(leaves + LEAF_ROWS * 2 * (ulong)pair, numbers, meant, second, corners);
    }
}
