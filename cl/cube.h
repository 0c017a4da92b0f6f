// Layered depth cube: its grid, its samples, and the rasterisation of one triangle into it.
//
// Grid space: g = (x - low) * per_unit, in texels, so that the cube over the scene's bounding box
// is [0, resolution)^3. Its edge is the box's longest, so a triangle's depth changes by at most one
// texel a texel along either axis of the image of its direction (its normal is most parallel to
// that). Direction d looks along axis d; its image's columns are axis (d + 1) % 3, its rows (d + 2)
// % 3: texel [d][column][row].
//
// How exact it is, with u = 2^-24 and coordinates up to `resolution`: a vertex in grid space is
// within 2 u resolution of its place; each clip against a line of the grid adds 5 u resolution
// along the rows and in depth (a ratio within 3 u, a product, a sum; the column is exact). There
// are at most three, so: every point of a triangle is within 17 u resolution of a texel, and of a
// depth, that conservative rasterisation gives it. The ray's slack (ldc.cl) pays for that.
//
// A sample is a depth and a triangle, in arrays of their own: `near`, `triangle`, and `far` where
// CONSERVATIVE. Everything else that it holds, the point, normal, colour, geom_id and prim_id, follows
// from its texel, depth and triangle (a visibility buffer: Burns, Hunt 2013), and is computed for
// the few that are asked for. Depths are read sixteen at a time: both arrays have DEPTH_PADDING
// more elements.
//
// Build-time constants: CONSERVATIVE, where defined, samples hold the interval of depths in the
// texel, of all triangles that touch it; otherwise the depth at the texel's centre, of those that
// cover that. HALF_DEPTH, where defined: depths of 16 bits, 11 of them significant, rounded
// outwards where CONSERVATIVE.

#include "triangle.h"

#ifdef HALF_DEPTH

// The bits of a half are those of the float 2^-112 times as large, without the last 13. Depths are
// neither negative nor above MAX_RESOLUTION of cube.py. (Half arithmetic and its built-ins are
// optional in OpenCL 1.2.)
typedef ushort Depth;
typedef ushort16 Depth16;
#define BITS_LESS 13
#define HALF_SCALE 0x1p-112f
inline Depth depth_below(float z) { return (ushort)(as_uint(z * HALF_SCALE) >> BITS_LESS); }
inline Depth depth_above(float z)
{
    return (ushort)((as_uint(z * HALF_SCALE) + (1u << BITS_LESS) - 1) >> BITS_LESS);
}
inline Depth depth_nearest(float z)
{
    return (ushort)((as_uint(z * HALF_SCALE) + (1u << (BITS_LESS - 1))) >> BITS_LESS);
}
inline float depth_of(Depth d) { return as_float((uint)d << BITS_LESS) * (1.0f / HALF_SCALE); }
inline float16 depths_of(Depth16 d)
{
    return as_float16(CONVERT(uint16, d) << BITS_LESS) * (1.0f / HALF_SCALE);
}

#else

typedef float Depth;
typedef float16 Depth16;
inline Depth depth_below(float z) { return z; }
inline Depth depth_above(float z) { return z; }
inline Depth depth_nearest(float z) { return z; }
inline float depth_of(Depth d) { return d; }
inline float16 depths_of(Depth16 d) { return d; }

#endif

// Of the published mode `far` is not read: a sample's depths are the one it has.
typedef struct {
    global Depth *near, *far;
    global uint *triangle;
} Samples;

inline void write_sample(const Samples *s, ulong place, uint triangle, float near, float far)
{
#ifdef CONSERVATIVE
    s->near[place] = depth_below(near);
    s->far[place] = depth_above(far);
#else
    s->near[place] = depth_nearest(near);
#endif
    s->triangle[place] = triangle;
}

#ifdef CONSERVATIVE
#define FAR(samples) ((samples)->far)
#else
#define FAR(samples) ((samples)->near)
#endif

// A sample on its way into its place.
typedef struct {
    float near, far;
    uint triangle;
} Fragment;

// grid[0]: low corner, texels per unit; grid[1]: the box's diagonal and a texel's edge.
typedef struct {
    float4 low;
    float per_unit, diagonal, edge;
} Grid;

inline Grid load_grid(global const float4 *grid)
{
    const float4 a = grid[0], b = grid[1];
    const Grid g = {(float4)(a.x, a.y, a.z, 0.0f), a.w, b.x, b.y};
    return g;
}

inline float4 to_grid(const Grid *grid, float4 p) { return (p - grid->low) * grid->per_unit; }

// (x, y, z) as column, row and depth of direction `axis`.
inline float4 seen_along(uint axis, float4 v)
{
    return axis == 0 ? v.yzxw : axis == 1 ? v.zxyw : v;
}

inline int floor_of(float v)
{
    const int whole = (int)v;
    return whole - (v < (float)whole);
}

inline int cell_of(float v, int cells)
{
    const int cell = floor_of(v);
    return cell < 0 ? 0 : cell >= cells ? cells - 1 : cell;
}

// ---- what becomes of a triangle's samples ----

enum { COUNT, SCATTER, PEEL };

// COUNT: `counts` grows. SCATTER: a fragment is written to any free place of its texel, and
// `counts` shrinks. PEEL: the nearest fragment of a texel behind that of the layer before goes into
// `next`, and the one in `last`, which is that layer's, becomes sample `layer` of its texel.
typedef struct {
    global uint *counts;
    global const uint *first;
    global Fragment *fragments;
    Samples samples;
    global const ulong *last;
    global ulong *next;
    uint layer;
} Sink;

// Rounding may leave the cube by less than the slack: depths are not negative, so that their bits
// sort like them.
inline void emit(const uint mode, const Sink *sink, uint texel, uint triangle, float near,
                 float far)
{
    near = near > 0.0f ? near : 0.0f;
    far = far > near ? far : near;
    if (mode == COUNT) {
        atomic_inc(sink->counts + texel);
    } else if (mode == SCATTER) {
        const uint place = atomic_dec(sink->counts + texel) - 1;
        const Fragment fragment = {near, far, triangle};
        sink->fragments[sink->first[texel] + place] = fragment;
    } else {
        const ulong key = hit_key(near, triangle);
        const bool beyond = sink->layer == 0 || key > sink->last[texel];
        if (beyond)
            atom_min(sink->next + texel, key);
        else if (key == sink->last[texel])
            write_sample(&sink->samples, sink->first[texel] + sink->layer - 1, triangle, near, far);
    }
}

// ---- one triangle ----

#define CORNERS 5 // of a triangle cut by two lines

#ifdef CONSERVATIVE

typedef struct {
    float low, high;
} Interval;

inline Interval include(Interval i, float v)
{
    i.low = v < i.low ? v : i.low;
    i.high = v > i.high ? v : i.high;
    return i;
}

// Around two intervals; empty ones, with low > high, count for nothing.
inline Interval both(Interval a, Interval b)
{
    const Interval i = {MIN(a.low, b.low), MAX(a.high, b.high)};
    return i;
}

// The part of a polygon where `side` * (x - at) >= 0; returns its number of corners.
inline uint cut(const float4 *in, uint n, float at, float side, float4 *out)
{
    uint m = 0;
    for (uint k = 0; k < n; k++) {
        const float4 p = in[k], q = in[k + 1 == n ? 0 : k + 1];
        const float dp = side * (p.x - at), dq = side * (q.x - at);
        if (dp >= 0.0f)
            out[m++] = p;
        if ((dp > 0.0f && dq < 0.0f) || (dp < 0.0f && dq > 0.0f)) {
            out[m] = p + dp / (dp - dq) * (q - p);
            out[m++].x = at;
        }
    }
    return m;
}

// Depths of a convex polygon where it crosses y = at; empty where it does not.
inline Interval cross_depths(const float4 *p, uint n, float at)
{
    Interval z = {INFINITY, -INFINITY};
    for (uint k = 0; k < n; k++) {
        const float4 a = p[k], b = p[k + 1 == n ? 0 : k + 1];
        if ((a.y <= at) != (b.y <= at))
            z = include(z, a.z + (at - a.y) / (b.y - a.y) * (b.z - a.z));
    }
    return z;
}

// The texels of one column that a polygon within it touches. The depths over a texel are those
// where the polygon crosses its two ends, and at the corners between.
inline void fill_column(const uint mode, const Sink *sink, uint texel, int resolution,
                        uint triangle, const float4 *p, uint n)
{
    Interval rows = {INFINITY, -INFINITY};
    for (uint k = 0; k < n; k++)
        rows = include(rows, p[k].y);
    const int first = cell_of(rows.low, resolution), last = cell_of(rows.high, resolution);
    Interval end = {INFINITY, -INFINITY};
    for (int row = first; row <= last; row++) {
        Interval z = end;
        if (row < last) {
            end = cross_depths(p, n, (float)(row + 1));
            z = both(z, end);
        }
        for (uint k = 0; k < n; k++)
            if (p[k].y >= (float)row && p[k].y <= (float)(row + 1))
                z = include(z, p[k].z);
        if (z.low <= z.high)
            emit(mode, sink, texel + row, triangle, z.low, z.high);
    }
}

inline void fill(const uint mode, const Sink *sink, uint plane, int resolution, uint triangle,
                 const float4 *p)
{
    const float low = MIN(p[0].x, MIN(p[1].x, p[2].x)), high = MAX(p[0].x, MAX(p[1].x, p[2].x));
    const int first = cell_of(low, resolution), last = cell_of(high, resolution);
    for (int column = first; column <= last; column++) {
        float4 left[CORNERS], part[CORNERS];
        uint n = 3;
        const float4 *polygon = p;
        if (first < last) {
            n = cut(p, n, (float)column, 1.0f, left);
            n = cut(left, n, (float)(column + 1), -1.0f, part);
            polygon = part;
        }
        const uint texel = plane + (uint)column * resolution;
        fill_column(mode, sink, texel, resolution, triangle, polygon, n);
    }
}

#else

// Where the edge between p and q crosses the column's middle: its row and depth. From the same end
// whichever way it is walked, so two triangles at an edge leave no gap and no overlap.
inline float2 cross_edge(float4 p, float4 q, float at)
{
    const bool turn = p.x > q.x || (p.x == q.x && p.y > q.y);
    const float4 a = turn ? q : p, b = turn ? p : q;
    const float4 c = a + (at - a.x) / (b.x - a.x) * (b - a);
    return (float2)(c.y, c.z);
}

inline int centre_from(float v, int resolution)
{
    const int cell = -floor_of(0.5f - v); // ceil(v - 0.5)
    return cell < 0 ? 0 : cell > resolution ? resolution : cell;
}

inline void fill(const uint mode, const Sink *sink, uint plane, int resolution, uint triangle,
                 const float4 *p)
{
    const float low = MIN(p[0].x, MIN(p[1].x, p[2].x)), high = MAX(p[0].x, MAX(p[1].x, p[2].x));
    const int first = centre_from(low, resolution), end = centre_from(high, resolution);
    for (int column = first; column < end; column++) {
        const float at = (float)column + 0.5f;
        float2 ends[3];
        uint n = 0;
        for (uint k = 0; k < 3; k++) {
            const float4 a = p[k], b = p[k == 2 ? 0 : k + 1];
            if ((a.x <= at) != (b.x <= at))
                ends[n++] = cross_edge(a, b, at);
        }
        if (n != 2)
            continue;
        const bool turn = ends[0].x > ends[1].x;
        const float2 a = turn ? ends[1] : ends[0], b = turn ? ends[0] : ends[1];
        const int last = centre_from(b.x, resolution);
        for (int row = centre_from(a.x, resolution); row < last; row++) {
            const float z = a.y + ((float)row + 0.5f - a.x) / (b.x - a.x) * (b.y - a.y);
            const uint texel = plane + (uint)column * resolution + row;
            emit(mode, sink, texel, triangle, z, z);
        }
    }
}

#endif

// The axis that the normal is most parallel to. Zero area: any of them.
inline uint axis_of(float4 normal)
{
    const float x = size_of(normal.x), y = size_of(normal.y), z = size_of(normal.z);
    return x >= y && x >= z ? 0 : y >= z ? 1 : 2;
}

inline float4 grid_normal(const Grid *grid, global const float4 *corners)
{
    const float4 a = to_grid(grid, corners[0]);
    return cross3(to_grid(grid, corners[1]) - a, to_grid(grid, corners[2]) - a);
}

// Into the image of that axis.
inline void rasterise(const uint mode, const Sink *sink, const Grid *grid, int resolution,
                      global const float4 *triangles, uint triangle)
{
    global const float4 *v = triangles + TRIANGLE_FLOAT4S * (ulong)triangle;
    float4 p[3] = {to_grid(grid, v[0]), to_grid(grid, v[1]), to_grid(grid, v[2])};
    const uint axis = axis_of(cross3(p[1] - p[0], p[2] - p[0]));
    for (uint k = 0; k < 3; k++)
        p[k] = seen_along(axis, p[k]);
    fill(mode, sink, axis * (uint)resolution * resolution, resolution, triangle, p);
}

// Weights u, v of the point of a triangle seen at a place in the image of its direction; of a point on
// its outline where that is beside it.
inline float2 weights_at(const Grid *grid, global const float4 *corners, float column, float row)
{
    const float4 a = to_grid(grid, corners[0]);
    const float4 b = to_grid(grid, corners[1]) - a, c = to_grid(grid, corners[2]) - a;
    const uint axis = axis_of(cross3(b, c));
    const float4 o = seen_along(axis, a), e = seen_along(axis, b), f = seen_along(axis, c);
    const float x = column - o.x, y = row - o.y;
    const float area = e.x * f.y - e.y * f.x;
    float2 weights = (float2)(x * f.y - y * f.x, e.x * y - e.y * x) / area;
    weights = weights > 0.0f ? weights : 0.0f; // NaN of a zero area becomes 0
    weights = weights < 0x1p60f ? weights : 0x1p60f; // infinity would become NaN
    const float sum = weights.x + weights.y;
    return sum > 1.0f ? weights / sum : weights;
}

// ---- the coarse level ----

#define SLABS 64 // that the cube's depth is cut into

inline ulong slabs_between(float near, float far, float per_slab)
{
    const int first = cell_of(near * per_slab, SLABS), last = cell_of(far * per_slab, SLABS);
    return (2ul << last) - (1ul << first);
}
