// Rays through a layered depth cube (Buerger, Hertel, Krueger, Westermann 2007), which cube.cl made.
//
// Traversal (section 1.4): one direction after another, that of the ray's largest component first;
// in each, the blocks in the ray's columns, nearest first; where the slabs of depth that the ray
// passes over a block are occupied, its texels likewise; the ray ends at the nearest hit so far.
// Nothing is stepped: each column's piece of the ray is computed from the ray itself, sixteen
// columns at a time, so errors do not add up; cells are widened by the ray's slack. The layers of a
// texel are compared sixteen at a time.
//
// Published mode: a hit is a sample within the tolerance of the ray's depths over its texel; the
// samples of the surface that a ray starts or ends on are no hits (`touches`).
//
// Why no hit of the watertight test is lost (CONSERVATIVE), with u = 2^-24 and R the largest
// coordinate of a corner of the cube seen from the ray's origin. The test's edge functions have the
// sign, and 1.5 ulp, of the sheared vertices as rounded, so for a hit (t, u, v) the point P of the
// triangle with these weights is near o + t d: the sheared vertices are within 6 u R of their
// place, the weights move P by 12 u R, and t is within 10 u R of P's depth along the major axis
// (slopes are at most 1): |o + t d - P| < 32 u R along each axis. P is within 17 u resolution, that
// is 34 u R, of a texel and a depth interval of its triangle. What is computed here of the ray (its
// origin and direction in grid space, the parameter where it crosses a line, coordinates there) is
// within 16 u R each, of which a texel's test uses three. The sum is below 128 u R; the slack is
// 256 u R.
// Coordinates should lie between about 1e-15 and 1e15, as the test itself needs it. Rays whose
// slack exceeds a quarter of the cube, from 16,000 cubes away, are tested against all triangles.
//
// Build-time constants: RAYS, rays to a work-item; those of cube.h.

#pragma OPENCL EXTENSION cl_khr_int64_base_atomics : enable
#pragma OPENCL EXTENSION cl_khr_int64_extended_atomics : enable

#include "cube.h"

#define SLACK 0x1p-16f
#define STILL 0x1p-25f // a slope below this moves a ray by less than u R within the cube
#define MAILBOX 8 // triangles that a ray remembers to have been tested against

typedef struct {
    float low, high;
} Span;

// Cells of texels in an image, main by side texels each: cell (i, j) is number first + i *
// main_stride + j * side_stride.
typedef struct {
    uint first, main_stride, side_stride;
    int main, side;
} Image;

// A ray in grid space, o + s d with the largest component of d 1 in size, as one direction sees it:
// the faster coordinate of its image (main), the slower one (side), and depth. `inverse` is 0 where
// the ray stands still.
typedef struct {
    float main_o, main_d, main_inverse;
    float side_o, side_d, side_inverse;
    float depth_o, depth_d, depth_inverse;
    Image texels, blocks;
} GridRay;

// The cube, and what is known of one ray.
typedef struct {
    int resolution;
    float slack, tolerance, per_slab; // the tolerance includes the slack
    global const uint *first;
    Samples samples;
    global const ulong *slabs;
    global const float4 *triangles;
    RayFrame frame;
    float per_t; // s = per_t * t
    float end;   // of the ray, in s
    ulong nearest;
    uint tested[MAILBOX];
    uint tests, hits;
    bool any; // one hit is enough
#ifndef CONSERVATIVE
    float4 start, stop; // of the ray, in space; the same where it has no end
    float margin;
#endif
} Trace;

// The piece of a span over [low, high] of one coordinate.
inline Span piece(Span s, float o, float d, float inverse, float low, float high)
{
    if (d == 0.0f)
        return s;
    const float a = (low - o) * inverse, b = (high - o) * inverse;
    const float enter = a < b ? a : b, leave = a < b ? b : a;
    const Span p = {enter > s.low ? enter : s.low, leave < s.high ? leave : s.high};
    return p;
}

// Values of one coordinate over a span, widened.
inline Span values(Span s, float o, float d, float slack)
{
    const float a = o + s.low * d, b = o + s.high * d;
    const Span v = {(a < b ? a : b) - slack, (a < b ? b : a) + slack};
    return v;
}

inline bool was_tested(Trace *t, uint triangle)
{
    for (uint k = 0; k < MAILBOX; k++)
        if (t->tested[k] == triangle)
            return true;
    t->tested[t->tests % MAILBOX] = triangle;
    return false;
}

// A hit of the ray ends it there.
inline void shorten(Trace *t, float distance)
{
    const float s = distance * t->per_t;
    const float end = s + s * 0x1p-20f + t->slack;
    t->end = end < t->end ? end : t->end;
}

inline void test_triangle(Trace *t, uint triangle)
{
    t->tests++;
    const TriangleHit h
        = intersect_triangle(&t->frame, t->triangles + TRIANGLE_FLOAT4S * (ulong)triangle);
    if (!h.hit)
        return;
    t->hits++;
    const ulong key = hit_key(h.t, triangle);
    t->nearest = MIN(t->nearest, key);
    t->frame.tfar = h.t; // equal distances still hit
    shorten(t, h.t);
}

inline bool done(const Trace *t) { return t->any && t->nearest != MISS; }

#ifndef CONSERVATIVE
// Whether the ray starts or ends on the triangle's plane, as far as samples tell: a tolerance and a
// texel. All rays from a surface, and from a light to it, would be caught by its own samples.
inline bool touches(const Trace *t, uint triangle)
{
    global const float4 *v = t->triangles + TRIANGLE_FLOAT4S * (ulong)triangle;
    const float4 a = v[0], ab = v[1] - a, ac = v[2] - a;
    const float4 m = MAX(size_of4(ab), size_of4(ac));
    const float scale = MAX(m.x, MAX(m.y, m.z));
    const float4 n = cross3(ab / scale, ac / scale);
    const float reach = t->margin * sqrt(dot3(n, n));
    return size_of(dot3(t->start - a, n)) <= reach || size_of(dot3(t->stop - a, n)) <= reach;
}
#endif

#ifdef CONSERVATIVE

inline void visit_sample(Trace *t, const GridRay *r, uint k, Span s)
{
    const uint triangle = t->samples.triangle[k];
    if (!was_tested(t, triangle))
        test_triangle(t, triangle);
}

#else

// Where the ray has the sample's depth, within the texel.
inline void visit_sample(Trace *t, const GridRay *r, uint k, Span s)
{
    const uint triangle = t->samples.triangle[k];
    float at = s.low;
    if (r->depth_d != 0.0f)
        at = (depth_of(t->samples.near[k]) - r->depth_o) * r->depth_inverse;
    at = at < s.low ? s.low : at > s.high ? s.high : at;
    float distance = at / t->per_t;
    distance = MAX(distance, t->frame.tnear);
    distance = MIN(distance, t->frame.tfar);
    t->tests++;
    const ulong key = hit_key(distance, triangle);
    if (key >= t->nearest || touches(t, triangle))
        return;
    t->hits++;
    t->nearest = key;
    shorten(t, distance);
}

#endif

// The samples from `begin` on whose depths meet `z`, a bit each, of sixteen.
inline uint meeting_samples(const Trace *t, uint begin, uint end, Span z)
{
    const float16 near = depths_of(LOAD_UNALIGNED(Depth16, t->samples.near + begin));
    const float16 far = depths_of(LOAD_UNALIGNED(Depth16, FAR(&t->samples) + begin));
    const uint left = end - begin, meant = left < 16 ? (1u << left) - 1 : 0xffffu;
    return MASK16((near <= z.high) & (far >= z.low)) & meant;
}

// Cells along the main coordinate: `count` from `first` on, in the order in which the ray meets
// them.
typedef struct {
    int first, step, count;
} Cells;

inline Cells cells_over(Span v, float d, float per_cell, int least, int most)
{
    int a = floor_of(v.low * per_cell), b = floor_of(v.high * per_cell);
    a = a < least ? least : a;
    b = b > most ? most : b;
    const Cells up = {a, 1, b - a + 1}, down = {b, -1, b - a + 1};
    return d < 0.0f ? down : up;
}

// Of sixteen columns of cells in a row: the column, the ray's piece over it, the depths and the
// first and last row of cells there, and whether the ray passes it, as a bit of `mask`.
typedef struct {
    float16 enter, leave, near, far;
    int16 column, low, high;
    uint mask;
} Columns;

inline int16 floor_of16(float16 v)
{
    const int16 whole = CONVERT(int16, v);
    return whole + (v < CONVERT(float16, whole)); // truth is -1
}

// The cells' columns from number `before` on, over the span `s`; rows bottom .. top.
inline Columns cut_columns(const Trace *t, const GridRay *r, const Image *image, Span s,
                           Cells cells, int before, int bottom, int top)
{
    const int16 lanes = (int16)(0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15);
    const float size = (float)image->main, per_row = 1.0f / (float)image->side;
    Columns c;
    c.column = cells.first + cells.step * (before + lanes);
    float16 enter = s.low, leave = s.high;
    if (r->main_d != 0.0f) {
        const float16 column = CONVERT(float16, c.column);
        const float16 low = column * size - t->slack, high = column * size + (size + t->slack);
        const float16 a = (low - r->main_o) * r->main_inverse;
        const float16 b = (high - r->main_o) * r->main_inverse;
        const float16 in = a < b ? a : b, out = a < b ? b : a;
        enter = in > enter ? in : enter;
        leave = out < leave ? out : leave;
    }
    const float16 ya = r->side_o + enter * r->side_d, yb = r->side_o + leave * r->side_d;
    const float16 za = r->depth_o + enter * r->depth_d, zb = r->depth_o + leave * r->depth_d;
    const int16 low = floor_of16(((ya < yb ? ya : yb) - t->slack) * per_row);
    const int16 high = floor_of16(((ya < yb ? yb : ya) + t->slack) * per_row);
    c.low = low < bottom ? (int16)bottom : low;
    c.high = high > top ? (int16)top : high;
    c.enter = enter;
    c.leave = leave;
    c.near = (za < zb ? za : zb) - t->tolerance;
    c.far = (za < zb ? zb : za) + t->tolerance;
    const int left = cells.count - before;
    const uint meant = left < 16 ? (1u << left) - 1 : 0xffffu;
    c.mask = MASK16((enter <= leave) & (c.low <= c.high)) & meant;
    return c;
}

// Runs the last argument for the columns of the image's cells that the ray passes over the span
// `s`, nearest first, among the columns left .. right and rows bottom .. top, until the ray ends:
// lane `k` of `c`, whose mask FILTER may have thinned out, and `p`, the ray's piece over the column.
#define WALK(IMAGE, S, LEFT, RIGHT, BOTTOM, TOP, FILTER, ...)                                      \
    {                                                                                              \
        const float per_cell = 1.0f / (float)(IMAGE)->main;                                        \
        const Span over = values(S, r->main_o, r->main_d, t->slack);                               \
        const Cells cells = cells_over(over, r->main_d, per_cell, LEFT, RIGHT);                    \
        for (int before = 0; before < cells.count; before += 16) {                                 \
            const Span rest = {(S).low, MIN((S).high, t->end)};                                    \
            Columns c = cut_columns(t, r, IMAGE, rest, cells, before, BOTTOM, TOP);                \
            FILTER for (uint mask = c.mask; mask != 0; mask &= mask - 1)                           \
            {                                                                                      \
                const uint k = LOWEST(mask);                                                       \
                const Span p = {LANE(c.enter, k), MIN(LANE(c.leave, k), t->end)};                  \
                if (p.low > p.high)                                                                \
                    continue;                                                                      \
                __VA_ARGS__                                                                        \
                if (done(t))                                                                       \
                    return;                                                                        \
            }                                                                                      \
        }                                                                                          \
    }

#define LANE(v, k) (((const float *)&(v))[k])
#define WHOLE_LANE(v, k) (((const int *)&(v))[k])

// The piece of a column's piece over one row.
inline Span row_piece(const Trace *t, const GridRay *r, Span s, int row, int size)
{
    return piece(s, r->side_o, r->side_d, r->side_inverse, (float)(row * size) - t->slack,
                 (float)((row + 1) * size) + t->slack);
}

// The samples of a texel: those that the column's depths meet are few, and looked at again over the
// texel alone.
inline void visit_texel(Trace *t, const GridRay *r, uint texel, int row, Span column, Span p)
{
    const uint end = t->first[texel + 1];
    for (uint begin = t->first[texel]; begin < end; begin += 16) {
        if (meeting_samples(t, begin, end, column) == 0)
            continue;
        const Span q = row_piece(t, r, p, row, 1);
        if (q.low > q.high)
            return;
        const Span z = values(q, r->depth_o, r->depth_d, t->tolerance);
        for (uint m = meeting_samples(t, begin, end, z); m != 0 && !done(t); m &= m - 1)
            visit_sample(t, r, begin + LOWEST(m), q);
    }
}

// The texels of a block that starts at texel (left, bottom).
inline void walk_block(Trace *t, const GridRay *r, Span s, int left, int bottom)
{
    const int right = MIN(left + r->blocks.main, t->resolution) - 1;
    const int top = MIN(bottom + r->blocks.side, t->resolution) - 1;
    WALK(&r->texels, s, left, right, bottom, top, , {
        const Span column = {LANE(c.near, k), LANE(c.far, k)};
        const uint line = r->texels.first + WHOLE_LANE(c.column, k) * r->texels.main_stride;
        for (int row = WHOLE_LANE(c.low, k); row <= WHOLE_LANE(c.high, k); row++)
            visit_texel(t, r, line + row * r->texels.side_stride, row, column, p);
    })
}

// The slabs of depth over each column, and the columns in which they are occupied. Most columns
// have one or two rows, which are looked up without a branch; more, where blocks are narrow or the
// slack is large, are left to the walk.
inline uint occupied_columns(const Trace *t, const Image *image, const Columns *c, ulong *slabs)
{
    const int16 last_slab = SLABS - 1;
    int16 a = CONVERT(int16, c->near * t->per_slab), b = CONVERT(int16, c->far * t->per_slab);
    a = a < 0 ? 0 : a > last_slab ? last_slab : a;
    b = b < 0 ? 0 : b > last_slab ? last_slab : b;
    const ulong16 one = 1ul;
    *(ulong16 *)slabs = ((one + one) << CONVERT(ulong16, b)) - (one << CONVERT(ulong16, a));
    uint mask = 0;
    for (uint rest = c->mask; rest != 0; rest &= rest - 1) {
        const uint k = LOWEST(rest);
        const int low = WHOLE_LANE(c->low, k), high = WHOLE_LANE(c->high, k);
        const uint line = image->first + WHOLE_LANE(c->column, k) * image->main_stride;
        const ulong occupied = t->slabs[line + low * image->side_stride]
                               | t->slabs[line + high * image->side_stride];
        const bool meets = (occupied & slabs[k]) != 0 || high > low + 1;
        mask |= (uint)meets << k;
    }
    return mask;
}

inline void walk(Trace *t, const GridRay *r, Span s)
{
    const Image *image = &r->blocks;
    const int right = (t->resolution - 1) / image->main, top = (t->resolution - 1) / image->side;
    ulong slabs[16] __attribute__((aligned(128)));
    WALK(image, s, 0, right, 0, top, c.mask = occupied_columns(t, image, &c, slabs);, {
        const int column = WHOLE_LANE(c.column, k);
        const uint line = image->first + column * image->main_stride;
        for (int row = WHOLE_LANE(c.low, k); row <= WHOLE_LANE(c.high, k); row++) {
            const ulong occupied = t->slabs[line + row * image->side_stride] & slabs[k];
            if (occupied == 0)
                continue;
            const Span q = row_piece(t, r, p, row, image->side);
            const Span z = values(q, r->depth_o, r->depth_d, t->tolerance);
            if (q.low <= q.high && (occupied & slabs_between(z.low, z.high, t->per_slab)) != 0)
                walk_block(t, r, q, column * image->main, row * image->side);
        }
    })
}

inline float4 still(float4 d)
{
    const float4 size = d < 0.0f ? -d : d;
    return size < STILL ? 0.0f : d;
}

// The ray's span within the widened cube; empty where it misses it.
inline Span enter_cube(const float *o, const float *d, const float *inverse, Span s, float slack,
                       float resolution)
{
    for (uint k = 0; k < 3; k++) {
        s = piece(s, o[k], d[k], inverse[k], -slack, resolution + slack);
        if (d[k] == 0.0f && !(o[k] >= -slack && o[k] <= resolution + slack))
            s.high = -INFINITY;
    }
    return s;
}

// An image of direction `axis`, whose cells are n columns by m rows of texels; `turn`: its main
// coordinate is that of the rows.
inline Image image_of(uint axis, bool turn, int resolution, int n, int m)
{
    const uint across = (resolution - 1) / n + 1, along = (resolution - 1) / m + 1;
    const uint first = axis * across * along;
    const Image by_column = {first, along, 1, n, m}, by_row = {first, 1, along, m, n};
    return turn ? by_row : by_column;
}

// The ray as direction `axis` sees it.
inline GridRay seen_ray(uint axis, const float *o, const float *d, const float *inverse,
                        int resolution, int2 block)
{
    const uint column = axis == 2 ? 0 : axis + 1, row = axis == 0 ? 2 : axis - 1;
    const bool turn = size_of(d[row]) > size_of(d[column]);
    const uint main = turn ? row : column, side = turn ? column : row;
    const GridRay r = {o[main], d[main], inverse[main], o[side], d[side], inverse[side],
                       o[axis], d[axis], inverse[axis],
                       image_of(axis, turn, resolution, 1, 1),
                       image_of(axis, turn, resolution, block.x, block.y)};
    return r;
}

// The axes, along which the ray moves fastest first: it crosses the fewest texels of that image, and
// surfaces that it meets head-on are there.
inline void sort_axes(const float *d, uint *order)
{
    const float x = size_of(d[0]), y = size_of(d[1]), z = size_of(d[2]);
    order[0] = x >= y && x >= z ? 0 : y >= z ? 1 : 2;
    const uint a = order[0] == 2 ? 0 : order[0] + 1, b = order[0] == 0 ? 2 : order[0] - 1;
    const bool turn = size_of(d[b]) > size_of(d[a]);
    order[1] = turn ? b : a;
    order[2] = turn ? a : b;
}

inline void trace(Trace *t, const Grid *grid, int2 block, uint num_triangles, float4 org_tnear,
                  float4 dir_tfar)
{
    const float x = size_of(dir_tfar.x), y = size_of(dir_tfar.y), z = size_of(dir_tfar.z);
    const float length = MAX(x, MAX(y, z)), resolution = (float)t->resolution;
    const float4 origin = to_grid(grid, org_tnear), direction = still(dir_tfar / length);
    const float4 far = MAX(size_of4(origin), size_of4(origin - resolution));
    const float o[3] = {origin.x, origin.y, origin.z};
    const float d[3] = {direction.x, direction.y, direction.z};
    float inverse[3];
    for (uint k = 0; k < 3; k++)
        inverse[k] = d[k] == 0.0f ? 0.0f : 1.0f / d[k];
    t->slack = SLACK * MAX(far.x, MAX(far.y, far.z));
    if (!(t->slack <= 0.25f * resolution)) {
#ifdef CONSERVATIVE
        for (uint i = 0; i < num_triangles && !done(t); i++)
            test_triangle(t, i);
#endif
        return;
    }
    t->tolerance += t->slack;
    t->per_t = length * grid->per_unit;
    Span s = {org_tnear.w * t->per_t, t->frame.tfar * t->per_t};
    s.low -= s.low * 0x1p-20f + t->slack;
    s.high += s.high * 0x1p-20f + t->slack;
    s = enter_cube(o, d, inverse, s, t->slack, resolution);
    t->end = s.high;
    uint order[3];
    sort_axes(d, order);
    for (uint k = 0; k < 3 && !done(t); k++) {
        const GridRay r = seen_ray(order[k], o, d, inverse, t->resolution, block);
        const Span rest = {s.low, MIN(s.high, t->end)};
        if (rest.low <= rest.high)
            walk(t, &r, rest);
    }
}

#ifdef CONSERVATIVE
#define SET_ENDS(t, org, dir)
#else
#define SET_ENDS(t, org, dir)                                                                      \
    t.start = org + t.frame.tnear * dir;                                                           \
    t.stop = t.frame.tfar < MAXFLOAT ? org + t.frame.tfar * dir : t.start;                         \
    t.margin = t.tolerance / g.per_unit + g.edge;
#endif

// Work-item g takes RAYS consecutive rays. counts[3g]: active rays, triangles or samples tested,
// hits.
#define DEFINE_TRACE(NAME, RESULT, ANY, STORE)                                                     \
    kernel void NAME(const uint num_rays, const uint num_triangles, const int resolution,          \
                     const int2 block, const float tolerance, global const float4 *restrict grid,  \
                     global const uint *restrict first, global Depth *restrict near,               \
                     global Depth *restrict far, global uint *restrict triangle,                   \
                     global const ulong *restrict slabs, global const float4 *restrict org_tnear,  \
                     global const float4 *restrict dir_tfar,                                       \
                     global const float4 *restrict triangles, global RESULT *restrict result,      \
                     global ulong *restrict counts)                                                \
    {                                                                                              \
        const Grid g = load_grid(grid);                                                            \
        const uint begin = get_global_id(0) * RAYS, end = MIN(begin + RAYS, num_rays);             \
        ulong active = 0, tests = 0, hits = 0;                                                     \
        for (uint i = begin; i < end; i++) {                                                       \
            Trace t = {resolution, 0.0f, tolerance * g.diagonal * g.per_unit,                      \
                       (float)SLABS / (float)resolution, first, {near, far, triangle}, slabs,      \
                       triangles};                                                                 \
            t.frame = ray_frame(org_tnear[i], dir_tfar[i]);                                        \
            t.nearest = MISS;                                                                      \
            t.tests = t.hits = 0;                                                                  \
            t.any = ANY;                                                                           \
            for (uint k = 0; k < MAILBOX; k++)                                                     \
                t.tested[k] = INVALID;                                                             \
            SET_ENDS(t, org_tnear[i], dir_tfar[i])                                                 \
            if (t.frame.tfar >= t.frame.tnear) {                                                   \
                trace(&t, &g, block, num_triangles, org_tnear[i], dir_tfar[i]);                    \
                active++;                                                                          \
            }                                                                                      \
            result[i] = STORE;                                                                     \
            tests += t.tests;                                                                      \
            hits += t.hits;                                                                        \
        }                                                                                          \
        counts[3 * get_global_id(0)] = active;                                                     \
        counts[3 * get_global_id(0) + 1] = tests;                                                  \
        counts[3 * get_global_id(0) + 2] = hits;                                                   \
    }

DEFINE_TRACE(intersect_ldc, ulong, false, t.nearest)
DEFINE_TRACE(occlude_ldc, uchar, true, t.nearest != MISS)

// Hits from keys in the published mode: t is the ray's, u and v are the stored sample's (section
// 1.4), that of the texel in which the ray then is.
kernel void resolve_samples(const uint num_rays, const int resolution,
                            global const float4 *restrict grid,
                            global const ulong *restrict closest,
                            global const float4 *restrict org_tnear,
                            global const float4 *restrict dir_tfar,
                            global const float4 *restrict triangles, global float *restrict t,
                            global uint *restrict triangle, global float *restrict u,
                            global float *restrict v)
{
    const uint i = get_global_id(0);
    if (i >= num_rays)
        return;
    const Grid g = load_grid(grid);
    const bool hit = closest[i] != MISS;
    const uint id = hit ? (uint)closest[i] : INVALID;
    float2 weights = 0.0f;
    t[i] = hit ? as_float((uint)(closest[i] >> 32)) : INFINITY;
    if (hit) {
        global const float4 *corners = triangles + TRIANGLE_FLOAT4S * (ulong)id;
        const uint axis = axis_of(grid_normal(&g, corners));
        const float4 p = seen_along(axis, to_grid(&g, org_tnear[i] + t[i] * dir_tfar[i]));
        weights = weights_at(&g, corners, cell_of(p.x, resolution), cell_of(p.y, resolution));
    }
    triangle[i] = id;
    u[i] = weights.x;
    v[i] = weights.y;
}
