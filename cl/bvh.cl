// A bounding volume hierarchy with binned SAH splits, built level by level from the root.
//
// Section 5.1 of Overbeck, Ramamoorthi and Mark (2008) names a "binned SAH build"; the rules are those
// of Wald, "On fast Construction of SAH-based Bounding Volume Hierarchies" (2007), all three axes binned.
// baselines/bvh.py builds the same tree in numpy: prices are in double, in the same order of operations.
//
// One work-item splits one node after another; a level's nodes are numbered in the order of their parents.
// A node's triangles are order[first .. first + count), and stay in their order within both halves.
//
// Build-time constants: NUM_BINS, LEAF_SIZE.

#pragma OPENCL EXTENSION cl_khr_fp64 : enable

#include "bvh.h"
#include "triangle.h"

#define TRAVERSAL_COST 1.0 // price of one box test in triangle tests

inline float4 least(float4 a, float4 b) { return b < a ? b : a; }
inline float4 most(float4 a, float4 b) { return b > a ? b : a; }

// The boxes of triangles as low and high; their order to start with.
kernel void bound_triangles(const uint num_triangles, global const float4 *restrict triangles,
                            global float4 *restrict boxes, global uint *restrict order)
{
    const uint i = get_global_id(0);
    if (i >= num_triangles)
        return;
    global const float4 *v = triangles + TRIANGLE_FLOAT4S * (ulong)i;
    boxes[2 * i] = least(least(v[0], v[1]), v[2]);
    boxes[2 * i + 1] = most(most(v[0], v[1]), v[2]);
    order[i] = i;
}

// The triangles of a node in their order, and the boxes of all triangles.
typedef struct {
    global const float4 *boxes;
    global uint *order;
    uint count;
} Triangles;

typedef struct {
    float4 low[NUM_BINS], high[NUM_BINS];
    uint count[NUM_BINS];
} Bins;

// Twice the centre of a box: exact enough, and finite for all of float.
inline double centre(float low, float high) { return (double)low + (double)high; }

inline double half_area(float4 low, float4 high)
{
    const double x = (double)high.x - (double)low.x, y = (double)high.y - (double)low.y,
                 z = (double)high.z - (double)low.z;
    return x * y + y * z + z * x;
}

// Bins of a centre along the axes.
typedef struct {
    double low[3], scale[3];
} Binning;

inline uint bin_of(const Binning *b, uint axis, float low, float high)
{
    const double place = (centre(low, high) - b->low[axis]) * b->scale[axis];
    return (uint)MIN(place, (double)(NUM_BINS - 1));
}

inline void fill_bins(Bins *bins, const Binning *binning, Triangles own)
{
    for (uint axis = 0; axis < 3; axis++)
        for (uint k = 0; k < NUM_BINS; k++) {
            bins[axis].low[k] = INFINITY, bins[axis].high[k] = -INFINITY;
            bins[axis].count[k] = 0;
        }
    for (uint i = 0; i < own.count; i++) {
        const float4 low = own.boxes[2 * (ulong)own.order[i]];
        const float4 high = own.boxes[2 * (ulong)own.order[i] + 1];
        const uint place[3] = {bin_of(binning, 0, low.x, high.x), bin_of(binning, 1, low.y, high.y),
                               bin_of(binning, 2, low.z, high.z)};
        for (uint axis = 0; axis < 3; axis++) {
            Bins *b = bins + axis;
            const uint k = place[axis];
            b->low[k] = least(b->low[k], low), b->high[k] = most(b->high[k], high);
            b->count[k]++;
        }
    }
}

typedef struct {
    double cost; // area times triangles of both halves; infinite where there is no split
    uint axis, last_bin;
} Split;

// The cheapest split; of equal ones the smaller axis, then bin.
inline Split cheapest(const Bins *bins)
{
    Split best = {INFINITY, 0, 0};
    for (uint axis = 0; axis < 3; axis++) {
        double right_cost[NUM_BINS]; // of the bins from k on; negative without triangles
        float4 low = INFINITY, high = -INFINITY;
        uint count = 0;
        for (uint k = NUM_BINS; k-- > 0;) {
            low = least(low, bins[axis].low[k]), high = most(high, bins[axis].high[k]);
            count += bins[axis].count[k];
            right_cost[k] = count ? count * half_area(low, high) : -1.0;
        }
        low = INFINITY, high = -INFINITY, count = 0;
        for (uint k = 0; k + 1 < NUM_BINS; k++) {
            low = least(low, bins[axis].low[k]), high = most(high, bins[axis].high[k]);
            count += bins[axis].count[k];
            if (count == 0 || right_cost[k + 1] < 0.0)
                continue;
            const double cost = count * half_area(low, high) + right_cost[k + 1];
            if (cost < best.cost)
                best.cost = cost, best.axis = axis, best.last_bin = k;
        }
    }
    return best;
}

// The box of a node, and the bins of its triangles' centres.
inline void measure(Triangles own, float4 *low, float4 *high, Binning *binning)
{
    *low = INFINITY, *high = -INFINITY;
    double first[3] = {INFINITY, INFINITY, INFINITY}, last[3] = {-INFINITY, -INFINITY, -INFINITY};
    for (uint i = 0; i < own.count; i++) {
        const float4 l = own.boxes[2 * (ulong)own.order[i]];
        const float4 h = own.boxes[2 * (ulong)own.order[i] + 1];
        *low = least(*low, l), *high = most(*high, h);
        const double c[3] = {centre(l.x, h.x), centre(l.y, h.y), centre(l.z, h.z)};
        for (uint axis = 0; axis < 3; axis++)
            first[axis] = MIN(first[axis], c[axis]), last[axis] = MAX(last[axis], c[axis]);
    }
    for (uint axis = 0; axis < 3; axis++) {
        const double extent = last[axis] - first[axis];
        binning->low[axis] = first[axis];
        binning->scale[axis] = extent > 0.0 ? NUM_BINS / extent : 0.0;
    }
}

// Sorts the triangles of a node into halves; returns the length of the first, 0 for a leaf.
inline uint split_node(Triangles own, global uint *scratch, global Node *node)
{
    Binning binning;
    float4 low, high;
    measure(own, &low, &high, &binning);
    node->low = low, node->high = high;
    if (own.count == 1)
        return 0;
    Bins bins[3];
    fill_bins(bins, &binning, own);
    const Split split = cheapest(bins);
    const double area = half_area(low, high);
    if (!(TRAVERSAL_COST * area + split.cost < own.count * area) && own.count <= LEAF_SIZE)
        return 0;
    uint left = 0, right = 0;
    for (uint i = 0; i < own.count; i++) {
        const uint triangle = own.order[i];
        const float4 l = own.boxes[2 * (ulong)triangle], h = own.boxes[2 * (ulong)triangle + 1];
        const float2 span = split.axis == 0 ? (float2)(l.x, h.x)
                            : split.axis == 1 ? (float2)(l.y, h.y) : (float2)(l.z, h.z);
        // Centres that share all their bins are halved in their order, so that it ends.
        const bool goes_right = split.cost < INFINITY
                                    ? bin_of(&binning, split.axis, span.x, span.y) > split.last_bin
                                    : i >= own.count / 2;
        if (goes_right)
            scratch[right++] = triangle;
        else
            own.order[left++] = triangle;
    }
    for (uint i = 0; i < right; i++)
        own.order[left + i] = scratch[i];
    SET_AXIS(*node, split.axis);
    return left;
}

// Splits the nodes begin .. end of a level; spans holds first and count of each, and gets the length of
// the first half.
kernel void split_nodes(global const uint *restrict level, global const float4 *restrict boxes,
                        global uint *order, global uint *scratch, global uint4 *restrict spans,
                        global Node *restrict nodes)
{
    for (uint n = level[0] + get_global_id(0); n < level[1]; n += get_global_size(0)) {
        const Triangles own = {boxes, order + spans[n].x, spans[n].y};
        spans[n].z = split_node(own, scratch + spans[n].x, nodes + n);
    }
}

// One work-item: numbers the children of a level's nodes, which are the next level.
kernel void number_children(global uint *restrict level, global uint4 *restrict spans,
                            global Node *restrict nodes)
{
    const uint begin = level[0], end = level[1];
    uint next = end;
    for (uint n = begin; n < end; n++) {
        const uint first = spans[n].x, count = spans[n].y, left = spans[n].z;
        if (left == 0) {
            SET_LEAF(nodes[n], first, count);
            continue;
        }
        SET_LEFT(nodes[n], next);
        spans[next++] = (uint4)(first, left, 0, 0);
        spans[next++] = (uint4)(first + left, count - left, 0, 0);
    }
    level[0] = end, level[1] = next;
}

// The triangles in the order of the leaves, their numbers in the w of their first corner.
kernel void order_triangles(const uint num_triangles, global const uint *restrict order,
                            global const float4 *restrict triangles, global float4 *restrict sorted)
{
    const uint i = get_global_id(0);
    if (i >= num_triangles)
        return;
    global const float4 *from = triangles + TRIANGLE_FLOAT4S * (ulong)order[i];
    global float4 *to = sorted + TRIANGLE_FLOAT4S * (ulong)i;
    to[0] = (float4)(from[0].xyz, as_float(order[i]));
    to[1] = from[1];
    to[2] = from[2];
}
