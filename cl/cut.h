// What the surface area heuristic cuts: things, their places in bins, and the best cut between these (sah.cl).

#include "tree_make.h"

#define BINS 16
#define LEAVES_OF(triangles) (((triangles) + TREE_WIDTH - 1) / TREE_WIDTH) // at least

// -low x, y, z, the first triangle; high x, y, z, how many. Boxes are joined by `larger8`, and doubled
// middles are kept like boxes: minus the middle, the middle.
#define FIRST s3
#define WEIGHT s7

inline uint weight_of(float8 thing) { return as_uint(thing.WEIGHT); }

// Numbers as floats are denormal, and slow in sums.
inline float4 without_number(float4 v) { return (float4)(v.xyz, 0.0f); }

inline float4 doubled_middle(float8 thing)
{
    return without_number(thing.hi) - without_number(thing.lo);
}

inline float8 middle(float8 thing)
{
    const float4 m = doubled_middle(thing);
    return (float8)(-m, m);
}

inline float half_area(float8 box)
{
    return half_area_of(without_number(box.lo) + without_number(box.hi));
}

// Lane k of a float8 in memory.
#define AT(v, k) (((const float *)&(v))[k])

inline float8 thing_of(global const float4 *triangles, uint number)
{
    global const float4 *v = triangles + TRIANGLE_FLOAT4S * (ulong)number;
    float4 low, high;
    bound_corners(v[0], v[1], v[2], &low, &high);
    float8 thing = (float8)(-low, high);
    thing.FIRST = as_float(number);
    thing.WEIGHT = as_float(1);
    return thing;
}

// Sixteen cells between bounds of the middles along each axis; what rounding moves out of them is in the
// first and the last. Where the bounds are one, or nearly so, or farther apart than floats go, all are in one.
typedef struct {
    float4 low, scale;
} Binning;

inline Binning binning_of(float8 middles)
{
    const float4 scale = BINS / (middles.lo + middles.hi);
    const Binning b = {-middles.lo, scale > 0.0f && scale < INFINITY ? scale : (float4)0.0f};
    return b;
}

// The same along one axis.
typedef struct {
    uint axis;
    float low, scale;
} Line;

inline Line line_of(float8 middles, uint axis)
{
    const Binning b = binning_of(middles);
    const Line line = {axis, AT(b.low, axis), AT(b.scale, axis)};
    return line;
}

// Where a middle is, in cells.
INLINE float place_along(Line line, global const float8 *things, uint i)
{
    global const float *p = (global const float *)(things + i) + line.axis;
    return (p[4] - p[0] - line.low) * line.scale;
}

inline uint bin_at(float place)
{
    const float most = place < BINS - 1 ? place : BINS - 1;
    return (uint)(most > 0.0f ? most : 0.0f);
}

// ---- the best place to cut ----

// Things in the upper half, triangles in the lower.
typedef ulong Amount;
#define THING(weight) ((Amount)1 << 32 | (weight))
#define THINGS(amount) ((uint)((amount) >> 32))
#define TRIANGLES(amount) ((uint)(amount))

// Things between cells along an axis.
typedef struct {
    float8 boxes[BINS];
    Amount amounts[BINS];
} Bins;

inline void clear_bins(Bins *bins, uint count)
{
    for (uint i = 0; i < count; i++)
        for (uint k = 0; k < BINS; k++)
            bins[i].boxes[k] = -INFINITY, bins[i].amounts[k] = 0;
}

INLINE void add_thing(Bins *bins, uint bin, float8 thing)
{
    bins->boxes[bin] = larger8(bins->boxes[bin], thing);
    bins->amounts[bin] += THING(weight_of(thing));
}

inline void join_bins(Bins *bins, const Bins *more)
{
    for (uint k = 0; k < BINS; k++) {
        bins->boxes[k] = larger8(bins->boxes[k], more->boxes[k]);
        bins->amounts[k] += more->amounts[k];
    }
}

// Every `step`-th thing, along each axis. Two tables of three: equal bins in a row would wait for each other.
inline void bin_things(Bins *tables, Binning b, global const float8 *things, uint begin, uint end,
                       uint step)
{
    for (uint i = begin; i < end; i += step) {
        const float8 thing = things[i];
        const float4 place = (doubled_middle(thing) - b.low) * b.scale;
        Bins *table = tables + 3 * (i / step & 1);
        add_thing(table, bin_at(place.x), thing);
        add_thing(table + 1, bin_at(place.y), thing);
        add_thing(table + 2, bin_at(place.z), thing);
    }
}

// The second table into the first.
inline void join_tables(Bins *tables)
{
    for (uint axis = 0; axis < 3; axis++)
        join_bins(tables + axis, tables + 3 + axis);
}

// A cut of sixteen boxes in a row behind number `last`; so much before it.
typedef struct {
    float cost;
    uint axis, last;
    Amount before;
} Cut;

#define UP1(v, f) (float16)(f, (v).s0, (v).s12, (v).s3456, (v).s789abcde)
#define UP2(v, f) (float16)((float2)(f), (v).s01, (v).s2345, (v).s6789abcd)
#define UP4(v, f) (float16)((float4)(f), (v).s0123, (v).s456789ab)
#define UP8(v, f) (float16)((float8)(f), (v).lo)
#define DOWN1(v, f) (float16)((v).s12345678, (v).s9abc, (v).sde, (v).sf, f)
#define DOWN2(v, f) (float16)((v).s23456789, (v).sabcd, (v).sef, (float2)(f))
#define DOWN4(v, f) (float16)((v).s456789ab, (v).scdef, (float4)(f))
#define DOWN8(v, f) (float16)((v).hi, (float8)(f))

// Lane k: the largest of lanes up to k.
INLINE float16 largest_before(float16 v)
{
    v = larger(v, UP1(v, -INFINITY));
    v = larger(v, UP2(v, -INFINITY));
    v = larger(v, UP4(v, -INFINITY));
    return larger(v, UP8(v, -INFINITY));
}

// Lane k: the largest of lanes above k.
INLINE float16 largest_behind(float16 v)
{
    v = DOWN1(v, -INFINITY);
    v = larger(v, DOWN1(v, -INFINITY));
    v = larger(v, DOWN2(v, -INFINITY));
    v = larger(v, DOWN4(v, -INFINITY));
    return larger(v, DOWN8(v, -INFINITY));
}

INLINE float16 half_areas(const float16 *rows)
{
    const float16 x = rows[0] + rows[3], y = rows[1] + rows[4], z = rows[2] + rows[5];
    return x * y + y * z + z * x;
}

// The cheapest cut of boxes along an axis, if it is cheaper than `best`. Among equals the middle one: of
// boxes without an area each would leave but one thing before it.
inline void improve_cut(Cut *best, uint axis, const Bins *bins)
{
    float4 s[2][BINS] __attribute__((aligned(64)));
    Amount sums[BINS], all = 0;
    uint weights[BINS] __attribute__((aligned(64)));
    for (uint k = 0; k < BINS; k++) {
        s[0][k] = bins->boxes[k].lo;
        s[1][k] = bins->boxes[k].hi;
        sums[k] = all += bins->amounts[k];
        weights[k] = TRIANGLES(all);
    }
    float16 rows[6], before[6], behind[6], unused;
    TRANSPOSE16(s[0], rows[0], rows[1], rows[2], unused);
    TRANSPOSE16(s[1], rows[3], rows[4], rows[5], unused);
    for (uint k = 0; k < 6; k++) {
        before[k] = largest_before(rows[k]);
        behind[k] = largest_behind(rows[k]);
    }
    const uint16 front = *(const uint16 *)weights, back = TRIANGLES(all) - front;
    const float16 cost = half_areas(before) * CONVERT(float16, LEAVES_OF(front))
                         + half_areas(behind) * CONVERT(float16, LEAVES_OF(back));
    const int16 better = (front > 0) & (back > 0) & (cost < best->cost);
    const float least = lowest(better ? cost : (float16)INFINITY);
    uint mask = MASK16(better & (cost == least));
    if (mask == 0)
        return;
    for (uint k = COUNT16(mask) / 2; k > 0; k--)
        mask &= mask - 1;
    best->cost = least;
    best->axis = axis;
    best->last = LOWEST(mask);
    best->before = sums[best->last];
}

// Of the parts before and behind a cut.
typedef struct {
    float8 boxes[2], middles[2];
} Parts;

inline Parts cut_parts(const Cut *cut, Line line, const Bins *bins, float8 middles)
{
    Parts p;
    float8 before = -INFINITY, behind = -INFINITY;
    for (uint k = 0; k < BINS; k++) {
        const int8 front = k <= cut->last ? -1 : 0;
        before = larger8(before, front ? bins->boxes[k] : (float8)-INFINITY);
        behind = larger8(behind, front ? (float8)-INFINITY : bins->boxes[k]);
    }
    p.boxes[0] = before;
    p.boxes[1] = behind;
    p.middles[0] = smaller8(middles, 2.0f * before);
    p.middles[1] = smaller8(middles, 2.0f * behind);
    const float plane = line.low + (cut->last + 1) / line.scale;
    float *high = (float *)&p.middles[0] + 4 + line.axis, *low = (float *)&p.middles[1] + line.axis;
    *high = MIN(*high, plane);
    *low = MIN(*low, -plane);
    return p;
}
