// Two-level layered depth cube (Buerger, Hertel, Krueger, Westermann 2007): three layered depth
// images along the axes, their coarse blocks, and rays through them.
//
// Construction (section 1.2): each triangle is rasterised into one image only (ldc.h). A-buffer:
// the samples of each texel are counted, scanned, written and sorted by depth, then triangle. Depth
// peeling, as published: layer after layer, in each texel the nearest sample behind the last. Both
// leave the same arrays: samples[first[texel]] .. samples[first[texel + 1] - 1] ascend.
// Coarse level (1.3): blocks[d][column][row] = smallest and largest depth of block^2 texels. Beyond
// the paper: slabs[d][column][row], a bit for each of SLABS slabs of the cube's depth that is
// occupied; it also knows the empty space between the layers, and is what rays are tested against.
//
// Traversal (1.4): the blocks in the ray's columns, nearest first; where the ray's depths over a
// block meet the block's, its texels likewise; the ray ends at the nearest hit so far. The paper
// takes one direction after another; here they take turns, stretch by stretch of the ray, so that a
// hit in one shortens the ray for all. Nothing is stepped: each column's piece of the ray is
// computed from the ray itself, sixteen columns at a time, so errors do not add up; cells are
// widened by the ray's slack.
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
// Build-time constants: CHUNKS, shares of the triangles and texels; RAYS, rays to a work-item;
// CONSERVATIVE (ldc.h): exact mode.

#pragma OPENCL EXTENSION cl_khr_int64_base_atomics : enable
#pragma OPENCL EXTENSION cl_khr_int64_extended_atomics : enable

#include "ldc.h"

#define SMALLEST_BOX 1e-30f
#define MARGIN 0x1p-18f // texels from the cube's far sides: above the rounding of to_grid
#define SLACK 0x1p-16f
#define STILL 0x1p-25f // a slope below this moves a ray by less than u R within the cube
#define STRETCH 14     // blocks: their columns fill a vector, with one more at either end
#define MAILBOX 8      // triangles that a ray remembers to have been tested against

// ---- construction ----

// The box of a chunk of triangles: boxes[2c] low corner, boxes[2c + 1] high corner.
kernel void measure_box(const uint num_triangles, global const float4 *restrict triangles,
                        global float4 *restrict boxes)
{
    float4 low = INFINITY, high = -INFINITY;
    const ulong end = TRIANGLE_FLOAT4S * chunk_end(num_triangles);
    for (ulong i = TRIANGLE_FLOAT4S * chunk_begin(num_triangles); i < end; i++) {
        const float4 v = triangles[i];
        low = v < low ? v : low;
        high = v > high ? v : high;
    }
    boxes[2 * get_global_id(0)] = low;
    boxes[2 * get_global_id(0) + 1] = high;
}

// One work-item: the grid (ldc.h) over the chunks' boxes.
kernel void make_grid(const uint resolution, global const float4 *restrict boxes,
                      global float4 *restrict grid)
{
    float4 low = INFINITY, high = -INFINITY;
    for (uint c = 0; c < CHUNKS; c++) {
        const float4 a = boxes[2 * c], b = boxes[2 * c + 1];
        low = a < low ? a : low;
        high = b > high ? b : high;
    }
    const float4 extent = high - low;
    float edge = MAX(extent.x, MAX(extent.y, extent.z));
    edge = edge > SMALLEST_BOX ? edge : SMALLEST_BOX;
    const float4 part = extent / edge;
    const float per_unit = (float)resolution / edge * (1.0f - MARGIN);
    grid[0] = (float4)(low.x, low.y, low.z, per_unit);
    grid[1] = (float4)(edge * sqrt(dot3(part, part)), 1.0f / per_unit, 0.0f, 0.0f);
}

// Each work-item takes TRIANGLES triangles.
#define TRIANGLES 64
#define FOR_TRIANGLES(i)                                                                           \
    const Grid g = load_grid(grid);                                                                \
    const uint begin = get_global_id(0) * TRIANGLES;                                               \
    const uint end = MIN(begin + TRIANGLES, num_triangles);                                        \
    for (uint i = begin; i < end; i++)

// counts[texel] grows by the samples of the texel.
kernel void count_samples(const uint num_triangles, const int resolution,
                          global const float4 *restrict grid,
                          global const float4 *restrict triangles, global uint *restrict counts)
{
    const Sink sink = {counts, 0, 0, 0, 0, 0};
    FOR_TRIANGLES(i) rasterise(COUNT, &sink, &g, resolution, triangles, i);
}

// Of a chunk of texels: their samples, and in each direction the most of a texel.
kernel void measure_counts(const uint texels, global const uint *restrict counts,
                           global ulong4 *restrict measures)
{
    ulong sum = 0;
    uint most[3] = {0, 0, 0};
    for (uint d = 0; d < 3; d++) {
        const ulong start = (ulong)d * texels;
        for (ulong i = start + chunk_begin(texels); i < start + chunk_end(texels); i++) {
            sum += counts[i];
            most[d] = MAX(most[d], counts[i]);
        }
    }
    measures[get_global_id(0)] = (ulong4)(sum, most[0], most[1], most[2]);
}

// One work-item: the same of all chunks, in measures[CHUNKS].
kernel void sum_measures(global ulong4 *restrict measures)
{
    ulong4 all = 0;
    for (uint c = 0; c < CHUNKS; c++) {
        const ulong4 m = measures[c];
        const ulong4 most = m > all ? m : all;
        all = (ulong4)(all.x + m.x, most.y, most.z, most.w);
    }
    measures[CHUNKS] = all;
}

kernel void scatter_samples(const uint num_triangles, const int resolution,
                            global const float4 *restrict grid,
                            global const float4 *restrict triangles, global uint *restrict counts,
                            global const uint *restrict first, global Sample *restrict samples)
{
    const Sink sink = {counts, first, samples, 0, 0, 0};
    FOR_TRIANGLES(i) rasterise(SCATTER, &sink, &g, resolution, triangles, i);
}

// Layer after layer; see Sink in ldc.h. The pass after the last layer writes that.
kernel void peel_layer(const uint num_triangles, const int resolution, const uint layer,
                       global const float4 *restrict grid, global const float4 *restrict triangles,
                       global const uint *restrict first, global const ulong *restrict last,
                       global ulong *restrict next, global Sample *restrict samples)
{
    const Sink sink = {0, first, samples, last, next, layer};
    FOR_TRIANGLES(i) rasterise(PEEL, &sink, &g, resolution, triangles, i);
}

inline ulong sample_key(const Sample *s) { return hit_key(s->near, s->triangle); }

// Sift down: s[root] of a heap of n, the largest on top.
inline void sift(global Sample *s, uint root, uint n)
{
    const Sample moving = s[root];
    for (uint child = 2 * root + 1; child < n; child = 2 * root + 1) {
        Sample larger = s[child];
        if (child + 1 < n) {
            const Sample other = s[child + 1];
            if (sample_key(&other) > sample_key(&larger)) {
                larger = other;
                child++;
            }
        }
        if (sample_key(&moving) >= sample_key(&larger))
            break;
        s[root] = larger;
        root = child;
    }
    s[root] = moving;
}

#define FEW 24 // samples up to which insertion is the fastest sort

inline void sort_samples(global Sample *s, uint n)
{
    if (n <= FEW) {
        for (uint i = 1; i < n; i++) {
            const Sample moving = s[i];
            uint j = i;
            for (; j > 0; j--) {
                const Sample before = s[j - 1];
                if (sample_key(&before) <= sample_key(&moving))
                    break;
                s[j] = before;
            }
            s[j] = moving;
        }
        return;
    }
    for (uint root = n / 2; root-- > 0;)
        sift(s, root, n);
    for (uint last = n - 1; last > 0; last--) {
        const Sample largest = s[0];
        s[0] = s[last];
        s[last] = largest;
        sift(s, 0, last);
    }
}

kernel void sort_texels(const uint texels, global const uint *restrict first,
                        global Sample *restrict samples)
{
    for (ulong i = chunk_begin(texels), end = chunk_end(texels); i < end; i++)
        if (first[i + 1] - first[i] > 1)
            sort_samples(samples + first[i], first[i + 1] - first[i]);
}

#define SLABS 64 // that the cube's depth is cut into

inline ulong slabs_between(float near, float far, float per_slab)
{
    const int first = cell_of(near * per_slab, SLABS), last = cell_of(far * per_slab, SLABS);
    return (2ul << last) - (1ul << first);
}

// One work-item per direction and column of blocks.
kernel void build_blocks(const uint resolution, const uint block, const uint across,
                         global const uint *restrict first, global const Sample *restrict samples,
                         global float2 *restrict blocks, global ulong *restrict slabs)
{
    const float per_slab = (float)SLABS / (float)resolution;
    const uint line = get_global_id(0);
    if (line >= 3 * across)
        return;
    const uint direction = line / across, left = line % across * block;
    const uint right = MIN(left + block, resolution);
    for (uint row = 0; row < across; row++) {
        const uint bottom = row * block, top = MIN(bottom + block, resolution);
        float2 depths = (float2)(INFINITY, -INFINITY);
        ulong occupied = 0;
        for (uint column = left; column < right; column++) {
            const ulong texel = ((ulong)direction * resolution + column) * resolution;
            const uint end = first[texel + top];
            for (uint k = first[texel + bottom]; k < end; k++) {
                const Sample s = samples[k];
                depths.x = s.near < depths.x ? s.near : depths.x;
                depths.y = FAR(s) > depths.y ? FAR(s) : depths.y;
                occupied |= slabs_between(s.near, FAR(s), per_slab);
            }
        }
        blocks[line * across + row] = depths;
        slabs[line * across + row] = occupied;
    }
}

// ---- rays ----

typedef struct {
    float low, high;
} Span;

// A ray in grid space, o + s d with the largest component of d 1 in size, as one direction sees it:
// the faster coordinate of its image (main), the slower one (side), and depth. `inverse` is 0 where
// the ray stands still. Texel (main, side) is number plane + main * main_stride + side *
// side_stride.
typedef struct {
    float main_o, main_d, main_inverse;
    float side_o, side_d, side_inverse;
    float depth_o, depth_d, depth_inverse;
    uint plane, main_stride, side_stride;
    uint block_plane, main_block_stride, side_block_stride;
} GridRay;

// The cube, and what is known of one ray.
typedef struct {
    int resolution, block, across;
    float slack, tolerance, per_slab; // the tolerance includes the slack
    global const uint *first;
    global const Sample *samples;
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

// The samples of one texel; `s` is the ray's piece over it.
inline void visit_texel(Trace *t, const GridRay *r, uint begin, uint end, Span s)
{
    const Span z = values(s, r->depth_o, r->depth_d, t->tolerance);
    for (uint k = begin; k < end; k++) {
        const Sample sample = t->samples[k];
        if (sample.near > z.high)
            break;
        if (FAR(sample) < z.low)
            continue;
#ifdef CONSERVATIVE
        if (!was_tested(t, sample.triangle))
            test_triangle(t, sample.triangle);
        if (done(t))
            return;
#else
        // Where the ray has the sample's depth, within the texel.
        float at = s.low;
        if (r->depth_d != 0.0f)
            at = (sample.near - r->depth_o) * r->depth_inverse;
        at = at < s.low ? s.low : at > s.high ? s.high : at;
        float distance = at / t->per_t;
        distance = MAX(distance, t->frame.tnear);
        distance = MIN(distance, t->frame.tfar);
        t->tests++;
        const ulong key = hit_key(distance, sample.triangle);
        if (key >= t->nearest || touches(t, sample.triangle))
            continue;
        t->hits++;
        t->nearest = key;
#endif
    }
#ifndef CONSERVATIVE
    if (t->nearest != MISS)
        shorten(t, as_float((uint)(t->nearest >> 32)));
#endif
}

// Cells, `size` texels wide, along the main coordinate: `count` from `first` on, in the order in
// which the ray meets them.
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

// Of sixteen columns of cells in a row: the ray's piece over each, the depths and the first and
// last row of cells there.
typedef struct {
    float enter[16], leave[16], near[16], far[16];
    int low[16], high[16];
} __attribute__((aligned(64))) Columns;

inline int16 floor_of16(float16 v)
{
    const int16 whole = CONVERT(int16, v);
    return whole + (v < CONVERT(float16, whole)); // truth is -1
}

// Fills `c`; returns the columns, a bit each, that the ray passes within the span.
inline uint cut_columns(const Trace *t, const GridRay *r, Span s, Cells cells, int done_before,
                        float size, float per_cell, int bottom, int top, Columns *c)
{
    const float16 lanes = (float16)(0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15);
    const float16 column
        = (float)(cells.first + cells.step * done_before) + (float)cells.step * lanes;
    float16 enter = s.low, leave = s.high;
    if (r->main_d != 0.0f) {
        const float16 low = column * size - t->slack, high = column * size + (size + t->slack);
        const float16 a = (low - r->main_o) * r->main_inverse;
        const float16 b = (high - r->main_o) * r->main_inverse;
        const float16 in = a < b ? a : b, out = a < b ? b : a;
        enter = in > enter ? in : enter;
        leave = out < leave ? out : leave;
    }
    const float16 ya = r->side_o + enter * r->side_d, yb = r->side_o + leave * r->side_d;
    const float16 za = r->depth_o + enter * r->depth_d, zb = r->depth_o + leave * r->depth_d;
    const int16 low = floor_of16(((ya < yb ? ya : yb) - t->slack) * per_cell);
    const int16 high = floor_of16(((ya < yb ? yb : ya) + t->slack) * per_cell);
    const int16 least = low < bottom ? (int16)bottom : low, most = high > top ? (int16)top : high;
    *(float16 *)c->enter = enter;
    *(float16 *)c->leave = leave;
    *(float16 *)c->near = (za < zb ? za : zb) - t->tolerance;
    *(float16 *)c->far = (za < zb ? zb : za) + t->tolerance;
    *(int16 *)c->low = least;
    *(int16 *)c->high = most;
    const int left = cells.count - done_before;
    const uint meant = left < 16 ? (1u << left) - 1 : 0xffffu;
    return MASK16((enter <= leave) & (least <= most)) & meant;
}

// Runs the last argument for the cells of `size` texels that the ray passes over the span `s`,
// among the columns left .. right and rows bottom .. top, until the ray ends: `column` and `row`,
// and `p`, the ray's piece over the whole column. A column has one or two rows, more only where the
// slack is large.
#define WALK(s, size, left, right, bottom, top, ...)                                               \
    {                                                                                              \
        const float per_cell = 1.0f / (float)(size);                                               \
        const Span over = values(s, r->main_o, r->main_d, t->slack);                               \
        const Cells cells = cells_over(over, r->main_d, per_cell, left, right);                    \
        for (int before = 0; before < cells.count; before += 16) {                                 \
            Columns c;                                                                             \
            const Span rest = {s.low, MIN(s.high, t->end)};                                        \
            uint mask = cut_columns(t, r, rest, cells, before, (float)(size), per_cell, bottom,    \
                                    top, &c);                                                      \
            for (; mask != 0; mask &= mask - 1) {                                                  \
                const uint k = LOWEST(mask);                                                       \
                const int column = cells.first + cells.step * (before + (int)k);                   \
                for (int row = c.low[k]; row <= c.high[k]; row++) {                                \
                    const Span p = {c.enter[k], MIN(c.leave[k], t->end)};                          \
                    __VA_ARGS__                                                                    \
                }                                                                                  \
            }                                                                                      \
        }                                                                                          \
    }

// The piece of a column's piece over one row.
inline Span row_piece(const Trace *t, const GridRay *r, Span s, int row, int size)
{
    return piece(s, r->side_o, r->side_d, r->side_inverse, (float)(row * size) - t->slack,
                 (float)((row + 1) * size) + t->slack);
}

// The texels of a block that starts at texel (left, bottom).
inline void walk_block(Trace *t, const GridRay *r, Span s, int left, int bottom)
{
    const int right = MIN(left + t->block, t->resolution) - 1;
    const int top = MIN(bottom + t->block, t->resolution) - 1;
    WALK(s, 1, left, right, bottom, top, {
        const uint texel = r->plane + column * r->main_stride + row * r->side_stride;
        const uint begin = t->first[texel], end = t->first[texel + 1];
        if (begin == end)
            continue;
        const Span q = row_piece(t, r, p, row, 1);
        if (q.low <= q.high)
            visit_texel(t, r, begin, end, q);
        if (done(t))
            return;
    })
}

inline void walk(Trace *t, const GridRay *r, Span s)
{
    const int size = t->block, last = t->across - 1;
    WALK(s, size, 0, last, 0, last, {
        const ulong occupied = t->slabs[r->block_plane + column * r->main_block_stride
                                        + row * r->side_block_stride];
        if (occupied == 0)
            continue;
        const Span q = row_piece(t, r, p, row, size);
        const Span z = values(q, r->depth_o, r->depth_d, t->tolerance);
        if (q.low <= q.high && (occupied & slabs_between(z.low, z.high, t->per_slab)) != 0)
            walk_block(t, r, q, column * size, row * size);
        if (done(t))
            return;
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

// The ray as direction `axis` sees it.
inline GridRay seen_ray(uint axis, const float *o, const float *d, const float *inverse,
                        uint resolution, uint across)
{
    const uint column = axis == 2 ? 0 : axis + 1, row = axis == 0 ? 2 : axis - 1;
    const bool turn = size_of(d[row]) > size_of(d[column]);
    const uint main = turn ? row : column, side = turn ? column : row;
    const GridRay r = {o[main], d[main], inverse[main], o[side], d[side], inverse[side],
                       o[axis], d[axis], inverse[axis],
                       axis * resolution * resolution, turn ? 1 : resolution, turn ? resolution : 1,
                       axis * across * across, turn ? 1 : across, turn ? across : 1};
    return r;
}

inline void trace(Trace *t, const Grid *grid, uint num_triangles, float4 org_tnear, float4 dir_tfar)
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
    GridRay rays[3];
    for (uint plane = 0; plane < 3; plane++)
        rays[plane] = seen_ray(plane, o, d, inverse, t->resolution, t->across);
    // A near hit in one direction saves the others their way. Each stretch starts with the very
    // number at which the one before ended.
    const float stretch = (float)(STRETCH * t->block);
    float from = s.low;
    for (uint i = 1; from <= MIN(s.high, t->end) && !done(t); i++) {
        const float to = s.low + (float)i * stretch;
        for (uint plane = 0; plane < 3; plane++) {
            const Span left = {from, MIN(MIN(s.high, t->end), to)};
            if (left.low <= left.high && !done(t))
                walk(t, &rays[plane], left);
        }
        from = to;
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
                     const int block, const int across, const float tolerance,                     \
                     global const float4 *restrict grid, global const uint *restrict first,        \
                     global const Sample *restrict samples, global const ulong *restrict slabs,    \
                     global const float4 *restrict org_tnear,                                      \
                     global const float4 *restrict dir_tfar,                                       \
                     global const float4 *restrict triangles, global RESULT *restrict result,      \
                     global ulong *restrict counts)                                                \
    {                                                                                              \
        const Grid g = load_grid(grid);                                                            \
        const uint begin = get_global_id(0) * RAYS, end = MIN(begin + RAYS, num_rays);             \
        ulong active = 0, tests = 0, hits = 0;                                                     \
        for (uint i = begin; i < end; i++) {                                                       \
            Trace t = {resolution, block, across, 0.0f, tolerance * g.diagonal * g.per_unit,       \
                       (float)SLABS / (float)resolution, first, samples, slabs, triangles};        \
            t.frame = ray_frame(org_tnear[i], dir_tfar[i]);                                        \
            t.nearest = MISS;                                                                      \
            t.tests = t.hits = 0;                                                                  \
            t.any = ANY;                                                                           \
            for (uint k = 0; k < MAILBOX; k++)                                                     \
                t.tested[k] = INVALID;                                                             \
            SET_ENDS(t, org_tnear[i], dir_tfar[i])                                                 \
            if (t.frame.tfar >= t.frame.tnear) {                                                   \
                trace(&t, &g, num_triangles, org_tnear[i], dir_tfar[i]);                           \
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

// Hits from keys in the published mode: u and v of the ray's point, projected onto the sample's
// triangle and kept within it.
kernel void resolve_samples(const uint num_rays, global const ulong *restrict closest,
                            global const float4 *restrict org_tnear,
                            global const float4 *restrict dir_tfar,
                            global const float4 *restrict triangles, global float *restrict t,
                            global uint *restrict triangle, global float *restrict u,
                            global float *restrict v)
{
    const uint i = get_global_id(0);
    if (i >= num_rays)
        return;
    const bool hit = closest[i] != MISS;
    const uint id = hit ? (uint)closest[i] : INVALID;
    float2 weights = 0.0f;
    t[i] = hit ? as_float((uint)(closest[i] >> 32)) : INFINITY;
    if (hit) {
        global const float4 *corners = triangles + TRIANGLE_FLOAT4S * (ulong)id;
        const float4 ab = corners[1] - corners[0], ac = corners[2] - corners[0];
        const float4 p = org_tnear[i] + t[i] * dir_tfar[i] - corners[0];
        // Edges of about one in size: the fourth power of a length leaves the range of float.
        const float4 m = MAX(size_of4(ab), size_of4(ac));
        const float scale = MAX(m.x, MAX(m.y, m.z));
        const float4 e = ab / scale, f = ac / scale, q = p / scale;
        const float4 n = cross3(e, f);
        const float area = dot3(n, n);
        weights = (float2)(dot3(cross3(q, f), n) / area, dot3(cross3(e, q), n) / area);
        weights = weights > 0.0f ? weights : 0.0f; // NaN becomes 0
        const float sum = weights.x + weights.y;
        weights = sum > 1.0f ? weights / sum : weights;
    }
    triangle[i] = id;
    u[i] = weights.x;
    v[i] = weights.y;
}
