// Rays through a layered depth cube (Buerger, Hertel, Krueger, Westermann 2007), which cube.cl made.
//
// Traversal (section 1.4): one direction after another, that of the ray's largest component first;
// in each, the blocks in the ray's columns, nearest first; where the slabs of depth that the ray
// passes over a block are occupied, its texels likewise; the ray ends at the nearest hit so far.
// Nothing is stepped: each column's piece of the ray is computed from the ray itself, so errors do
// not add up; cells are widened by the ray's slack. Sixteen at a time (the paper's section 4 names
// four): rays over the blocks, each over a column of its own; columns of texels in a block, of one
// ray; the layers of a texel.
//
// Published mode (POINTS): a hit is a sample within the tolerance of the ray's depths over its texel.
// By default a sample is a piece of its triangle's plane, as large as its texel: the depth and normal
// that the paper stores say where. The samples of the surface that a ray starts or ends on are no
// hits (`touches`).
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
// Build-time constants: RAYS, rays to a work-item, a multiple of 16; POINTS, where defined; those of
// cube.h.

#pragma OPENCL EXTENSION cl_khr_int64_base_atomics : enable
#pragma OPENCL EXTENSION cl_khr_int64_extended_atomics : enable

#include "cube.h"

#define SLACK 0x1p-16f
#define STILL 0x1p-25f // a slope below this moves a ray by less than u R within the cube
#define MAILBOX 8 // triangles that a ray remembers to have been tested against

typedef struct {
    float low, high;
} Span;

// A ray in grid space, o + s d with the largest component of d 1 in size, as one direction sees it:
// the faster coordinate of its image (main), the slower one (side), and depth. And the cells there,
// of main by side texels: cell (i, j) is number first + i * main_stride + j * side_stride. `inverse`
// is 0 where the ray stands still. Of one ray, or of sixteen.
#define DEFINE_GRID_RAY(NAME, F, I)                                                                \
    typedef struct {                                                                               \
        F main_o, main_d, main_inverse, side_o, side_d, side_inverse, depth_o, depth_d,            \
            depth_inverse, slack, tolerance;                                                       \
        I first, main_stride, side_stride, main, side;                                             \
    } NAME;

DEFINE_GRID_RAY(GridRay, float, int)
DEFINE_GRID_RAY(GridRay16, float16, int16)

// The cube.
typedef struct {
    int resolution;
    int2 block;
    float per_slab;
    global const uint *first;
    Samples samples;
    global const ulong *slabs;
    global const float4 *triangles;
    uint num_triangles;
} Cube;

// What is known of one ray.
typedef struct {
    const Cube *cube;
    float slack, tolerance; // the tolerance includes the slack
    float o[3], d[3], inverse[3]; // in grid space
    uint order[3]; // of the directions
    float begin, end; // in s
    float per_t; // s = per_t * t
    RayFrame frame;
    ulong nearest;
    uint tested[MAILBOX];
    uint tests, hits;
    bool any; // one hit is enough
#ifndef CONSERVATIVE
    float4 org, dir, start, stop; // in space; the last two are the same where the ray has no end
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
        = intersect_triangle(&t->frame, t->cube->triangles + TRIANGLE_FLOAT4S * (ulong)triangle);
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

// Not of unit length, but never out of the range of float; NaN for a triangle in one point.
inline float4 normal_of(global const float4 *v)
{
    const float4 ab = v[1] - v[0], ac = v[2] - v[0];
    const float4 m = MAX(size_of4(ab), size_of4(ac));
    const float scale = largest3(m);
    return cross3(ab / scale, ac / scale);
}

// Whether the ray starts or ends on the triangle's plane, as far as samples tell: a tolerance and a
// texel. All rays from a surface, and from a light to it, would be caught by its own samples.
inline bool touches(const Trace *t, uint triangle)
{
    global const float4 *v = t->cube->triangles + TRIANGLE_FLOAT4S * (ulong)triangle;
    const float4 a = v[0], n = normal_of(v);
    const float reach = t->margin * sqrt(dot3(n, n));
    return size_of(dot3(t->start - a, n)) <= reach || size_of(dot3(t->stop - a, n)) <= reach;
}
#endif

#ifdef CONSERVATIVE

inline void visit_sample(Trace *t, const GridRay *r, uint k, Span s)
{
    const uint triangle = t->cube->samples.triangle[k];
    if (!was_tested(t, triangle))
        test_triangle(t, triangle);
}

#else

#ifdef POINTS

// Where the ray has the sample's depth, within the texel.
inline float meet_sample(const Trace *t, const GridRay *r, uint k, uint triangle, Span s)
{
    float at = s.low;
    if (r->depth_d != 0.0f)
        at = (depth_of(t->cube->samples.near[k]) - r->depth_o) * r->depth_inverse;
    at = at < s.low ? s.low : at > s.high ? s.high : at;
    float distance = at / t->per_t;
    distance = MAX(distance, t->frame.tnear);
    return MIN(distance, t->frame.tfar);
}

#else

// Where the ray meets the triangle's plane, within the texel and the ray's segment; else NaN.
inline float meet_sample(const Trace *t, const GridRay *r, uint k, uint triangle, Span s)
{
    global const float4 *v = t->cube->triangles + TRIANGLE_FLOAT4S * (ulong)triangle;
    const float4 n = normal_of(v);
    const float distance = dot3(v[0] - t->org, n) / dot3(t->dir, n), at = distance * t->per_t;
    const bool meets = at >= s.low && at <= s.high && distance >= t->frame.tnear
                       && distance <= t->frame.tfar;
    return meets ? distance : NAN;
}

#endif

inline void visit_sample(Trace *t, const GridRay *r, uint k, Span s)
{
    const uint triangle = t->cube->samples.triangle[k];
    t->tests++;
    const float distance = meet_sample(t, r, k, triangle, s);
    if (!(distance >= 0.0f))
        return;
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
    const float16 near = depths_of(LOAD_UNALIGNED(Depth16, t->cube->samples.near + begin));
    const float16 far = depths_of(LOAD_UNALIGNED(Depth16, FAR(&t->cube->samples) + begin));
    const uint left = end - begin, meant = left < 16 ? (1u << left) - 1 : 0xffffu;
    return MASK16((near <= z.high) & (far >= z.low)) & meant;
}

// Cells along the main coordinate: `count` from `first` on, in the order in which the ray meets
// them.
typedef struct {
    int first, step, count;
} Cells;

inline Cells cells_over(const GridRay *r, Span s, int least, int most)
{
    const Span v = values(s, r->main_o, r->main_d, r->slack);
    const float per_cell = 1.0f / (float)r->main;
    int a = floor_of(v.low * per_cell), b = floor_of(v.high * per_cell);
    a = a < least ? least : a;
    b = b > most ? most : b;
    const Cells up = {a, 1, b - a + 1}, down = {b, -1, b - a + 1};
    return r->main_d < 0.0f ? down : up;
}

// Of sixteen columns of cells: the ray's piece over it, the depths and the first and last row of
// cells there, and whether the ray passes it, as a bit of `mask`.
typedef struct {
    float16 enter, leave, near, far;
    int16 column, low, high;
    uint mask;
} Columns;

#define LANE(v, k) (((float *)&(v))[k])
#define WHOLE_LANE(v, k) (((int *)&(v))[k])

inline int16 floor_of16(float16 v)
{
    const int16 whole = CONVERT(int16, v);
    return whole + (v < CONVERT(float16, whole)); // truth is -1
}

// Columns of one ray, or one of each of sixteen, over the span begin .. end; rows bottom .. top.
#define DEFINE_CUT_COLUMNS(SUFFIX, RAY)                                                            \
    inline Columns cut_columns##SUFFIX(const RAY *r, int16 column, float16 begin, float16 end,     \
                                       int16 bottom, int16 top)                                    \
    {                                                                                              \
        Columns c;                                                                                 \
        const float16 size = CONVERT(float16, (int16)(r->main)), slack = (float16)(r->slack);      \
        const float16 from = CONVERT(float16, column) * size - slack;                              \
        const float16 to = CONVERT(float16, column) * size + (size + slack);                       \
        const float16 a = (from - (float16)(r->main_o)) * (float16)(r->main_inverse);              \
        const float16 b = (to - (float16)(r->main_o)) * (float16)(r->main_inverse);                \
        const float16 in = a < b ? a : b, out = a < b ? b : a;                                     \
        const int16 moves = (float16)(r->main_d) != 0.0f;                                          \
        c.enter = (moves & (in > begin)) ? in : begin;                                             \
        c.leave = (moves & (out < end)) ? out : end;                                               \
        const float16 side_o = (float16)(r->side_o), side_d = (float16)(r->side_d);                \
        const float16 ya = side_o + c.enter * side_d, yb = side_o + c.leave * side_d;              \
        const float16 depth_o = (float16)(r->depth_o), depth_d = (float16)(r->depth_d);            \
        const float16 za = depth_o + c.enter * depth_d, zb = depth_o + c.leave * depth_d;          \
        const float16 per_row = 1.0f / CONVERT(float16, (int16)(r->side));                         \
        const int16 low = floor_of16(((ya < yb ? ya : yb) - slack) * per_row);                     \
        const int16 high = floor_of16(((ya < yb ? yb : ya) + slack) * per_row);                    \
        c.column = column;                                                                         \
        c.low = low < bottom ? bottom : low;                                                       \
        c.high = high > top ? top : high;                                                          \
        c.near = (za < zb ? za : zb) - (float16)(r->tolerance);                                    \
        c.far = (za < zb ? zb : za) + (float16)(r->tolerance);                                     \
        c.mask = MASK16((c.enter <= c.leave) & (c.low <= c.high));                                 \
        return c;                                                                                  \
    }

DEFINE_CUT_COLUMNS(, GridRay)
DEFINE_CUT_COLUMNS(16, GridRay16)

// ---- one ray over the texels of a block ----

// The piece of a column's piece over one row of cells.
inline Span row_piece(const GridRay *r, Span s, int row, int size)
{
    return piece(s, r->side_o, r->side_d, r->side_inverse, (float)(row * size) - r->slack,
                 (float)((row + 1) * size) + r->slack);
}

// The samples of a texel: those that the column's depths meet are few, and looked at again over the
// texel alone.
inline void visit_texel(Trace *t, const GridRay *r, uint texel, int row, Span column, Span p)
{
    const uint end = t->cube->first[texel + 1];
    for (uint begin = t->cube->first[texel]; begin < end; begin += 16) {
        if (meeting_samples(t, begin, end, column) == 0)
            continue;
        const Span q = row_piece(r, p, row, 1);
        if (q.low > q.high)
            return;
        const Span z = values(q, r->depth_o, r->depth_d, r->tolerance);
        for (uint m = meeting_samples(t, begin, end, z); m != 0 && !done(t); m &= m - 1)
            visit_sample(t, r, begin + LOWEST(m), q);
    }
}

// Of the block that starts at texel (left, bottom), `size` texels each way.
inline void walk_texels(Trace *t, const GridRay *r, Span s, int left, int bottom, int2 size)
{
    const int16 lanes = (int16)(0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15);
    const int right = MIN(left + size.x, t->cube->resolution) - 1;
    const int top = MIN(bottom + size.y, t->cube->resolution) - 1;
    const Cells cells = cells_over(r, s, left, right);
    for (int before = 0; before < cells.count; before += 16) {
        Columns c = cut_columns(r, cells.first + cells.step * (before + lanes), s.low,
                                MIN(s.high, t->end), bottom, top);
        const int rest = cells.count - before;
        c.mask &= rest < 16 ? (1u << rest) - 1 : 0xffffu;
        for (; c.mask != 0; c.mask &= c.mask - 1) {
            const uint k = LOWEST(c.mask);
            const Span p = {LANE(c.enter, k), MIN(LANE(c.leave, k), t->end)};
            if (p.low > p.high)
                continue;
            const Span depths = {LANE(c.near, k), LANE(c.far, k)};
            const uint line = r->first + WHOLE_LANE(c.column, k) * r->main_stride;
            for (int row = WHOLE_LANE(c.low, k); row <= WHOLE_LANE(c.high, k); row++)
                visit_texel(t, r, line + row * r->side_stride, row, depths, p);
            if (done(t))
                return;
        }
    }
}

// ---- sixteen rays over the blocks of a direction ----

// The ray as direction `axis` sees it, over cells of n columns by m rows of texels.
inline GridRay seen_ray(const Trace *t, uint axis, int n, int m)
{
    const uint column = axis == 2 ? 0 : axis + 1, row = axis == 0 ? 2 : axis - 1;
    const bool turn = size_of(t->d[row]) > size_of(t->d[column]);
    const uint main = turn ? row : column, side = turn ? column : row;
    const int last = t->cube->resolution - 1, across = last / n + 1, along = last / m + 1;
    const GridRay r = {t->o[main], t->d[main], t->inverse[main],
                       t->o[side], t->d[side], t->inverse[side],
                       t->o[axis], t->d[axis], t->inverse[axis], t->slack, t->tolerance,
                       axis * across * along, turn ? 1 : along, turn ? along : 1,
                       turn ? m : n, turn ? n : m};
    return r;
}

inline void set_lane(GridRay16 *rays, uint k, const GridRay *r)
{
    LANE(rays->main_o, k) = r->main_o;
    LANE(rays->main_d, k) = r->main_d;
    LANE(rays->main_inverse, k) = r->main_inverse;
    LANE(rays->side_o, k) = r->side_o;
    LANE(rays->side_d, k) = r->side_d;
    LANE(rays->depth_o, k) = r->depth_o;
    LANE(rays->depth_d, k) = r->depth_d;
    LANE(rays->slack, k) = r->slack;
    LANE(rays->tolerance, k) = r->tolerance;
    WHOLE_LANE(rays->first, k) = r->first;
    WHOLE_LANE(rays->main_stride, k) = r->main_stride;
    WHOLE_LANE(rays->side_stride, k) = r->side_stride;
    WHOLE_LANE(rays->main, k) = r->main;
    WHOLE_LANE(rays->side, k) = r->side;
}

// The slabs of depth over each column.
inline ulong16 slabs_over(const Cube *cube, const Columns *c)
{
    const int16 last = SLABS - 1;
    int16 a = CONVERT(int16, c->near * cube->per_slab), b = CONVERT(int16, c->far * cube->per_slab);
    a = a < 0 ? 0 : a > last ? last : a;
    b = b < 0 ? 0 : b > last ? last : b;
    const ulong16 one = 1ul;
    return ((one + one) << CONVERT(ulong16, b)) - (one << CONVERT(ulong16, a));
}

// The columns in which these slabs are occupied. Most have one or two rows, which are looked up
// without a branch; more, where blocks are narrow or the slack is large, are left to the visit.
inline uint occupied_columns(const Cube *cube, const GridRay16 *r, Columns *c, const ulong *slabs)
{
    const int16 line = r->first + c->column * r->main_stride;
    int16 lows = line + c->low * r->side_stride, highs = line + c->high * r->side_stride;
    const uint many = MASK16(c->high > c->low + 1);
    uint mask = 0;
    for (uint rest = c->mask; rest != 0; rest &= rest - 1) {
        const uint k = LOWEST(rest);
        const ulong occupied = cube->slabs[WHOLE_LANE(lows, k)] | cube->slabs[WHOLE_LANE(highs, k)];
        mask |= (uint)((occupied & slabs[k]) != 0) << k;
    }
    return mask | (many & c->mask);
}

// The blocks of lane `k`'s column, by its ray.
inline void visit_column(Trace *t, const GridRay *r, const GridRay16 *rays, Columns *c, uint k,
                         ulong slabs)
{
    const int column = WHOLE_LANE(c->column, k), stride = WHOLE_LANE(rays->side_stride, k);
    const uint line = WHOLE_LANE(rays->first, k) + column * WHOLE_LANE(rays->main_stride, k);
    const int2 size = (int2)(WHOLE_LANE(rays->main, k), WHOLE_LANE(rays->side, k));
    for (int row = WHOLE_LANE(c->low, k); row <= WHOLE_LANE(c->high, k) && !done(t); row++) {
        const ulong occupied = t->cube->slabs[line + row * stride] & slabs;
        if (occupied == 0)
            continue;
        const Span p = {LANE(c->enter, k), MIN(LANE(c->leave, k), t->end)};
        const Span q = row_piece(r, p, row, size.y);
        const Span z = values(q, r->depth_o, r->depth_d, r->tolerance);
        if (q.low <= q.high && (occupied & slabs_between(z.low, z.high, t->cube->per_slab)) != 0)
            walk_texels(t, r, q, column * size.x, row * size.y, size);
    }
}

// In the direction that is each ray's `turn`-th.
inline void walk_blocks(Trace *t, uint num_rays, uint turn)
{
    const Cube *cube = t->cube;
    GridRay texels[16];
    GridRay16 blocks = {0.0f};
    int16 first = 0, step = 0, count = 0;
    float16 begin = 0.0f, end = -1.0f;
    int most = 0;
    for (uint k = 0; k < num_rays; k++) {
        const Span s = {t[k].begin, t[k].end};
        if (!(s.low <= s.high) || done(&t[k]))
            continue;
        texels[k] = seen_ray(&t[k], t[k].order[turn], 1, 1);
        const GridRay r = seen_ray(&t[k], t[k].order[turn], cube->block.x, cube->block.y);
        const Cells cells = cells_over(&r, s, 0, (cube->resolution - 1) / r.main);
        set_lane(&blocks, k, &r);
        WHOLE_LANE(first, k) = cells.first;
        WHOLE_LANE(step, k) = cells.step;
        WHOLE_LANE(count, k) = cells.count;
        LANE(begin, k) = s.low;
        LANE(end, k) = s.high;
        most = MAX(most, cells.count);
    }
    const int16 top = (cube->resolution - 1) / (blocks.side > 1 ? blocks.side : 1);
    for (int n = 0; n < most; n++) {
        Columns c = cut_columns16(&blocks, first + n * step, begin, end, 0, top);
        const uint left = MASK16((n < count) & (c.enter <= end));
        if (left == 0) // nor later: the rays have ended
            return;
        c.mask &= left;
        const ulong16 slabs = slabs_over(cube, &c);
        for (uint mask = occupied_columns(cube, &blocks, &c, (const ulong *)&slabs); mask != 0;
             mask &= mask - 1) {
            const uint k = LOWEST(mask);
            visit_column(&t[k], &texels[k], &blocks, &c, k, ((const ulong *)&slabs)[k]);
            LANE(end, k) = done(&t[k]) ? -INFINITY : t[k].end;
        }
    }
}

// ---- rays ----

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

// The ray `t` in grid space; without a span where none of its t is within the cube.
inline void aim(Trace *t, const Grid *grid, float4 org_tnear, float4 dir_tfar)
{
    const float x = size_of(dir_tfar.x), y = size_of(dir_tfar.y), z = size_of(dir_tfar.z);
    const float length = MAX(x, MAX(y, z)), resolution = (float)t->cube->resolution;
    const float4 origin = to_grid(grid, org_tnear), direction = still(dir_tfar / length);
    const float4 far = MAX(size_of4(origin), size_of4(origin - resolution));
    t->o[0] = origin.x, t->o[1] = origin.y, t->o[2] = origin.z;
    t->d[0] = direction.x, t->d[1] = direction.y, t->d[2] = direction.z;
    for (uint k = 0; k < 3; k++)
        t->inverse[k] = t->d[k] == 0.0f ? 0.0f : 1.0f / t->d[k];
    sort_axes(t->d, t->order);
    t->slack = SLACK * largest3(far);
    t->tolerance += t->slack;
    t->per_t = length * grid->per_unit;
    Span s = {org_tnear.w * t->per_t, t->frame.tfar * t->per_t};
    s.low -= s.low * 0x1p-20f + t->slack;
    s.high += s.high * 0x1p-20f + t->slack;
    s = enter_cube(t->o, t->d, t->inverse, s, t->slack, resolution);
    t->begin = s.low;
    t->end = s.high;
}

inline bool is_far(const Trace *t) { return !(t->slack <= 0.25f * (float)t->cube->resolution); }

// A ray from too far away to be led through the cube.
inline void trace_far(Trace *t)
{
#ifdef CONSERVATIVE
    for (uint i = 0; i < t->cube->num_triangles && !done(t); i++)
        test_triangle(t, i);
#endif
    t->end = -INFINITY;
}

inline Trace start_ray(const Cube *cube, const Grid *grid, float4 org_tnear, float4 dir_tfar,
                       float2 tolerance, bool any)
{
    Trace t = {cube};
    t.tolerance = tolerance.x * grid->diagonal * grid->per_unit + tolerance.y;
    t.frame = ray_frame(org_tnear, dir_tfar);
    t.nearest = MISS;
    t.any = any;
    for (uint k = 0; k < MAILBOX; k++)
        t.tested[k] = INVALID;
#ifndef CONSERVATIVE
    t.org = org_tnear;
    t.dir = dir_tfar;
    t.start = org_tnear + t.frame.tnear * dir_tfar;
    t.stop = t.frame.tfar < MAXFLOAT ? org_tnear + t.frame.tfar * dir_tfar : t.start;
#ifdef POINTS
    t.margin = t.tolerance / grid->per_unit + grid->edge;
#else
    t.margin = grid->edge;
#endif
#endif
    aim(&t, grid, org_tnear, dir_tfar);
    return t;
}

inline bool is_active(const Trace *t) { return t->frame.tfar >= t->frame.tnear; }

inline void trace(Trace *t, uint num_rays)
{
    for (uint k = 0; k < num_rays; k++)
        if (!is_active(&t[k]))
            t[k].end = -INFINITY;
        else if (is_far(&t[k]))
            trace_far(&t[k]);
    for (uint turn = 0; turn < 3; turn++)
        walk_blocks(t, num_rays, turn);
}

// Work-item g takes RAYS consecutive rays. tolerance: in diagonals and in texels, to be added up.
// counts[3g]: active rays, triangles or samples tested, hits.
#define DEFINE_TRACE(NAME, RESULT, ANY, STORE)                                                     \
    kernel void NAME(const uint num_rays, const uint num_triangles, const int resolution,          \
                     const int2 block, const float2 tolerance, global const float4 *restrict grid, \
                     global const uint *restrict first, global Depth *restrict near,               \
                     global Depth *restrict far, global uint *restrict triangle,                   \
                     global const ulong *restrict slabs, global const float4 *restrict org_tnear,  \
                     global const float4 *restrict dir_tfar,                                       \
                     global const float4 *restrict triangles, global RESULT *restrict result,      \
                     global ulong *restrict counts)                                                \
    {                                                                                              \
        const Grid g = load_grid(grid);                                                            \
        const Cube cube = {resolution, block, (float)SLABS / (float)resolution, first,             \
                           {near, far, triangle}, slabs, triangles, num_triangles};                \
        const uint begin = get_global_id(0) * RAYS, end = MIN(begin + RAYS, num_rays);             \
        ulong active = 0, tests = 0, hits = 0;                                                     \
        Trace t[16];                                                                               \
        for (uint i = begin; i < end; i += 16) {                                                   \
            const uint n = MIN(end - i, 16u);                                                      \
            for (uint k = 0; k < n; k++)                                                           \
                t[k] = start_ray(&cube, &g, org_tnear[i + k], dir_tfar[i + k], tolerance, ANY);    \
            trace(t, n);                                                                           \
            for (uint k = 0; k < n; k++) {                                                         \
                result[i + k] = STORE(t[k].nearest);                                               \
                active += is_active(&t[k]);                                                        \
                tests += t[k].tests;                                                               \
                hits += t[k].hits;                                                                 \
            }                                                                                      \
        }                                                                                          \
        counts[3 * get_global_id(0)] = active;                                                     \
        counts[3 * get_global_id(0) + 1] = tests;                                                  \
        counts[3 * get_global_id(0) + 2] = hits;                                                   \
    }

#define KEY(nearest) (nearest)
#define BLOCKED(nearest) ((nearest) != MISS)
DEFINE_TRACE(intersect_ldc, ulong, false, KEY)
DEFINE_TRACE(occlude_ldc, uchar, true, BLOCKED)

// Hits from keys of samples: POINTS, t is the ray's, u and v are the stored sample's (section 1.4), that
// of the texel in which the ray then is; else u and v are those of the ray's point.
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
#ifdef POINTS
        weights = weights_at(&g, corners, cell_of(p.x, resolution) + 0.5f,
                             cell_of(p.y, resolution) + 0.5f);
#else
        weights = weights_at(&g, corners, p.x, p.y);
#endif
    }
    triangle[i] = id;
    u[i] = weights.x;
    v[i] = weights.y;
}
