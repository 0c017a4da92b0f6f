// Primary visibility by rasterisation: which triangle does the ray through each pixel meet first?
//
// Sort-middle tiles: triangles are sorted into bins, one per tile of the screen (count per chunk of
// triangles and tile, scan, scatter: stable, without atomics), then each tile is drawn by one
// work-item, 16 pixels of a row at a time.
//
// Homogeneous rasterisation (Olano and Greer, "Triangle scan conversion using 2D homogeneous
// coordinates", 1997): a vertex is (X, Y, Z) with pixel position (X/Z, Y/Z), Z the depth, and the
// edge from a to b has the function (a x b) . (x, y, 1). Nothing is divided by Z or snapped to a
// grid, and triangles that cross the plane of the eye need no clipping; only the bounding box does.
// A pixel is covered when its three edge functions have one sign; both facings are drawn.
//
// No holes, no overlaps: the sign is that of Woop, Benthin and Wald ("Watertight ray/triangle
// intersection", 2013): the vertices are moved so that the pixel is the origin, rounded once, and
// the sign of x_a y_b - y_a x_b is exact for them; every triangle at it sees the same vertices.
// The vector code computes the same functions about the middle of the tile, in plain float; a bound
// says when its sign is certain, and only the few pixels where it is not take the exact path. Zero
// counts as if the pixel lay an infinitesimal (e, e*e) away (the top-left rule).
//
// Build-time constants: TILE, edge of a tile in pixels, a multiple of 16; CROWDED, triangles beyond
// which a tile is cut into BANDS (a divisor of TILE) bands of rows; TINY, pixels of a bounding box
// up to which they are tested before binning: most triangles smaller than a pixel cover none.
// Arrays: triangles[3 * i + k] is corner k of triangle i, w unused. bounds[i] holds the pixels
// (left, top, right, bottom), inclusive, whose centres triangle i can cover; left > right: none.
// counts[chunk * tiles + tile]; list[starts[tile]] .. list[starts[tile + 1] - 1] is the tile's bin.
// Invariants: a bin ascends, and a later triangle replaces an earlier one only where it is strictly
// nearer, so equal depths go to the smaller index.
// Coordinates relative to the eye should lie between about 1e-15 and 1e15: products of two must
// neither underflow nor overflow. Where they do, or are not finite, nothing is drawn.

#include "rasterize.h"

#define HALF_TILE (0.5f * TILE)

// ---- binning ----

inline bool covers_any(const Triangle *t, const View *view, int4 box)
{
    for (int y = box.y; y <= box.w; y++)
        for (int x = box.x; x <= box.z; x++)
            if (exact_coverage(t, ray_at(view, x, y)).w != 0.0f)
                return true;
    return false;
}

// Bounding boxes, and for each chunk of triangles how many fall into each tile. One work-item per
// chunk; triangles first .. last.
kernel void count_bins(const uint first, const uint last, const uint chunk_size, const int2 size,
                       const float16 axes, const float2 centre, const uint tiles,
                       global const float4 *restrict triangles, global ushort4 *restrict bounds,
                       global uint *restrict counts)
{
    const View view = make_view(axes, centre, size);
    const uint chunk = get_global_id(0), columns = (size.x + TILE - 1) / TILE;
    const uint begin = first + chunk * chunk_size, left = last - begin;
    const uint end = begin + MIN(chunk_size, left);
    global uint *count = counts + (size_t)chunk * tiles;
    for (uint tile = 0; tile < tiles; tile++)
        count[tile] = 0;
    for (uint i = begin; i < end; i++) {
        const Triangle t = load_triangle(&view, triangles, i);
        int4 box = pixel_bounds(&t, &view);
        if ((box.z - box.x + 1) * (box.w - box.y + 1) <= TINY && !covers_any(&t, &view, box))
            box = EMPTY_BOX;
        bounds[i] = (ushort4)(box.x, box.y, box.z, box.w);
        if (box.x > box.z)
            continue;
        for (int y = box.y / TILE; y <= box.w / TILE; y++)
            for (int x = box.x / TILE; x <= box.z / TILE; x++)
                count[y * columns + x]++;
    }
}

// Counts of one tile become offsets within its part of the list, in the order of the chunks.
kernel void scan_chunks(const uint chunks, const uint tiles, global uint *restrict counts,
                        global uint *restrict totals)
{
    const uint tile = get_global_id(0);
    if (tile >= tiles)
        return;
    uint sum = 0;
    for (size_t i = tile; i < (size_t)chunks * tiles; i += tiles) {
        const uint count = counts[i];
        counts[i] = sum;
        sum += count;
    }
    totals[tile] = sum;
}

// Where the tiles' parts of the list start, and the work to do: a crowded tile is cut into bands of
// rows. length[0] is the list's length (the starts are meaningless when it exceeds 32 bits),
// length[1] the number of tasks, `next` the first to do. tasks[i]: tile, first and last row. One
// work-item.
kernel void scan_tiles(const uint tiles, global const uint *restrict totals,
                       global uint *restrict starts, global uint4 *restrict tasks,
                       global ulong *restrict length, global uint *restrict next)
{
    ulong sum = 0;
    uint task = 0;
    for (uint tile = 0; tile < tiles; tile++) {
        starts[tile] = (uint)sum;
        sum += totals[tile];
        const uint rows = totals[tile] > CROWDED ? TILE / BANDS : TILE;
        for (uint row = 0; row < TILE; row += rows)
            tasks[task++] = (uint4)(tile, row, row + rows - 1, 0);
    }
    starts[tiles] = (uint)sum;
    length[0] = sum;
    length[1] = task;
    *next = 0;
}

// Write the triangles' indices into the bins. One work-item per chunk, as in count_bins.
kernel void scatter_bins(const uint first, const uint last, const uint chunk_size, const int2 size,
                         const uint tiles, global const ushort4 *restrict bounds,
                         global const uint *restrict starts, global uint *restrict offsets,
                         global uint *restrict list)
{
    const uint chunk = get_global_id(0), columns = (size.x + TILE - 1) / TILE;
    const uint begin = first + chunk * chunk_size, left = last - begin;
    const uint end = begin + MIN(chunk_size, left);
    global uint *offset = offsets + (size_t)chunk * tiles;
    for (uint i = begin; i < end; i++) {
        const ushort4 box = bounds[i];
        if (box.x > box.z)
            continue;
        for (uint y = box.y / TILE; y <= box.w / TILE; y++)
            for (uint x = box.x / TILE; x <= box.z / TILE; x++) {
                const uint tile = y * columns + x;
                list[starts[tile] + offset[tile]++] = i;
            }
    }
}

// ---- drawing ----

typedef float FloatRow __attribute__((ext_vector_type(16), aligned(4)));
typedef uint UintRow __attribute__((ext_vector_type(16), aligned(4)));

// Edge function at the pixel (x, y) from the tile's middle: a*x + b*y + c, uncertain within bound.
typedef struct {
    float a, b, c, bound;
} Edge;

// What is nearest so far at the pixels of a tile, row by row.
typedef struct {
    float t[TILE * TILE] __attribute__((aligned(64)));
    float u[TILE * TILE] __attribute__((aligned(64)));
    float v[TILE * TILE] __attribute__((aligned(64)));
    uint prim[TILE * TILE] __attribute__((aligned(64)));
} Tile;

// An entry of a bin: its pixels (left, top, right, bottom) from those of the area to draw.
typedef struct {
    uint prim;
    int4 box;
    Triangle triangle;  // not loaded where the box is empty, in another band of the tile
} Entry;

inline Entry load_entry(const View *view, int4 area, uint prim, global const float4 *triangles,
                        global const ushort4 *bounds)
{
    const int4 b = convert_int4(bounds[prim]);
    Entry entry;
    entry.prim = prim;
    entry.box = (int4)(MAX(b.x, area.x), MAX(b.y, area.y), MIN(b.z, area.z), MIN(b.w, area.w));
    entry.box -= area.xyxy;
    if (entry.box.y <= entry.box.w)
        entry.triangle = load_triangle(view, triangles, prim);
    return entry;
}

// Edge functions at 16 pixels and which of the pixels are covered (all bits set).
typedef struct {
    float16 e0, e1, e2;
    int16 covered;
} Coverage;

inline int any16(int16 mask)
{
    const ulong2 bits = as_ulong2(convert_char16(mask));
    return (bits.x | bits.y) != 0;
}

// Replace the lanes that `unsure` marks by exact values. Lane 0 is the pixel (column, row).
inline Coverage resolve(Coverage in, int16 unsure, const Triangle *t, const View *view, int column,
                        int row)
{
    union { float16 v; float s[16]; } e0, e1, e2;
    union { int16 v; int s[16]; } covered, mark;
    e0.v = in.e0;
    e1.v = in.e1;
    e2.v = in.e2;
    covered.v = in.covered;
    mark.v = unsure;
    for (int lane = 0; lane < 16; lane++) {
        if (!mark.s[lane])
            continue;
        const float4 e = exact_coverage(t, ray_at(view, column + lane, row));
        e0.s[lane] = e.x;
        e1.s[lane] = e.y;
        e2.s[lane] = e.z;
        covered.s[lane] = e.w != 0.0f ? -1 : 0;
    }
    const Coverage out = {e0.v, e1.v, e2.v, covered.v};
    return out;
}

// The edge a, b about the tile's middle: a x b = base x (b - a) with either as the base, which
// cancels less for short edges; the smaller base bounds the rounding errors by the product of the
// two corners' largest values within the tile, ga * gb: 8 roundings for the corners, 4 for each of
// the difference, the products and the sums, twice as |b - a| may be twice the larger, and 14 to
// evaluate. The pixel's position, at most `reach` from the point straight ahead, adds its own.
inline Edge make_edge(float4 a, float4 b, float reach)
{
    const float az = absolute(a.z), bz = absolute(b.z);
    const float ax = absolute(a.x), ay = absolute(a.y), bx = absolute(b.x), by = absolute(b.y);
    const float ga = MAX(ax, ay) + HALF_TILE * az, gb = MAX(bx, by) + HALF_TILE * bz;
    const float4 p = ga < gb ? a : b, d = b - a;
    const float bound = ROUNDING * (64.0f * ga * gb + 8.0f * reach * (az * gb + bz * ga));
    const Edge edge = {p.y * d.z - p.z * d.y, p.z * d.x - p.x * d.z, p.x * d.y - p.y * d.x, bound};
    return edge;
}

// +1, -1: the edge's sign is certain and the same in the whole tile; 0 otherwise.
inline int tile_sign(const Edge *e)
{
    const float spread = HALF_TILE * (absolute(e->a) + absolute(e->b)) + e->bound;
    return e->c > spread ? 1 : e->c < -spread ? -1 : 0;
}

// Keep what is nearer at 16 pixels from `at` on.
inline void keep_nearest(Tile *tile, int at, const Coverage *k, const Triangle *t, float near,
                         uint prim)
{
    float16 *const tt = (float16 *)(tile->t + at), *const uu = (float16 *)(tile->u + at);
    float16 *const vv = (float16 *)(tile->v + at);
    uint16 *const pp = (uint16 *)(tile->prim + at);
    const float16 sum = k->e0 + k->e1 + k->e2;
    const float16 u = k->e1 / sum, v = k->e2 / sum;
    const float16 depth = t->a.z + u * (t->b.z - t->a.z) + v * (t->c.z - t->a.z);
    const int16 nearer = k->covered & (depth > near) & (depth < *tt);
    *tt = nearer ? depth : *tt;
    *uu = nearer ? u : *uu;
    *vv = nearer ? v : *vv;
    *pp = nearer ? (uint16)prim : *pp;
}

// Draw an entry into the pixels `area` of the screen, by edge functions about the area's middle.
inline void draw_triangle(Tile *tile, const View *view, int4 area, const Entry *entry)
{
    const Triangle *const t = &entry->triangle;
    const int4 box = entry->box;
    const int2 middle = (area.zw - area.xy + 1) / 2;
    const float16 lanes =
        (float16)(0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15) - (float)middle.x;
    const float2 centre = ray_at(view, area.x + middle.x, area.y + middle.y);
    const float rx = absolute(centre.x), ry = absolute(centre.y);
    const float reach = MAX(rx, ry) + HALF_TILE, near = near_plane(t);
    const float4 a = around(t->a, centre), b = around(t->b, centre), c = around(t->c, centre);
    const Edge f0 = make_edge(b, c, reach), f1 = make_edge(c, a, reach);
    const Edge f2 = make_edge(a, b, reach);
    const int s0 = tile_sign(&f0), s1 = tile_sign(&f1), s2 = tile_sign(&f2);
    if ((s0 > 0 || s1 > 0 || s2 > 0) && (s0 < 0 || s1 < 0 || s2 < 0))
        return;
    for (int row = box.y; row <= box.w; row++) {
        const float y = row - middle.y;
        const float r0 = f0.b * y + f0.c, r1 = f1.b * y + f1.c, r2 = f2.b * y + f2.c;
        for (int x = box.x & ~15; x <= box.z; x += 16) {
            Coverage k;
            const float16 p = lanes + (float)x;
            k.e0 = f0.a * p + r0;
            k.e1 = f1.a * p + r1;
            k.e2 = f2.a * p + r2;
            const int16 p0 = k.e0 > f0.bound, p1 = k.e1 > f1.bound, p2 = k.e2 > f2.bound;
            const int16 n0 = k.e0 < -f0.bound, n1 = k.e1 < -f1.bound, n2 = k.e2 < -f2.bound;
            const int16 possible = ~((p0 | p1 | p2) & (n0 | n1 | n2));
            if (!any16(possible))
                continue;
            k.covered = (p0 & p1 & p2) | (n0 & n1 & n2);
            const int16 unsure = possible & ~k.covered;
            if (any16(unsure))
                k = resolve(k, unsure, t, view, area.x + x, area.y + row);
            keep_nearest(tile, row * TILE + x, &k, t, near, entry->prim);
        }
    }
}

// Draw the triangles list[begin] .. list[end - 1] into the pixels `area` of the screen. Each is
// loaded while the one before it is drawn: a bin's triangles are far apart in memory.
inline void draw_bin(Tile *tile, const View *view, int4 area, global const uint *list, uint begin,
                     uint end, global const float4 *triangles, global const ushort4 *bounds)
{
    if (begin == end)
        return;
    Entry next = load_entry(view, area, list[begin], triangles, bounds);
    for (uint i = begin; i < end; i++) {
        const Entry entry = next;
        next = load_entry(view, area, list[i + 1 < end ? i + 1 : i], triangles, bounds);
        if (entry.box.y <= entry.box.w)
            draw_triangle(tile, view, area, &entry);
    }
}

// The tile's rows as found in the image, or empty.
inline void begin_tile(Tile *tile, int4 area, int width, int merge, global const uint *prim,
                       global const float *t, global const float *u, global const float *v)
{
    for (int i = 0; i < TILE * TILE; i++) {
        tile->t[i] = INFINITY;
        tile->u[i] = tile->v[i] = 0.0f;
        tile->prim[i] = INVALID;
    }
    if (!merge)
        return;
    for (int y = area.y; y <= area.w; y++)
        for (int x = area.x; x <= area.z; x++) {
            const int i = (y - area.y) * TILE + x - area.x;
            const size_t pixel = (size_t)y * width + x;
            tile->t[i] = t[pixel];
            tile->u[i] = u[pixel];
            tile->v[i] = v[pixel];
            tile->prim[i] = prim[pixel];
        }
}

inline void end_tile(const Tile *tile, int4 area, int width, global uint *prim, global float *t,
                     global float *u, global float *v)
{
    for (int y = area.y; y <= area.w; y++) {
        int x = area.x, i = (y - area.y) * TILE;
        size_t pixel = (size_t)y * width + x;
        for (; x + 15 <= area.z; x += 16, i += 16, pixel += 16) {
            *(global FloatRow *)(t + pixel) = *(const FloatRow *)(tile->t + i);
            *(global FloatRow *)(u + pixel) = *(const FloatRow *)(tile->u + i);
            *(global FloatRow *)(v + pixel) = *(const FloatRow *)(tile->v + i);
            *(global UintRow *)(prim + pixel) = *(const UintRow *)(tile->prim + i);
        }
        for (; x <= area.z; x++, i++, pixel++) {
            t[pixel] = tile->t[i];
            u[pixel] = tile->u[i];
            v[pixel] = tile->v[i];
            prim[pixel] = tile->prim[i];
        }
    }
}

// Draw all tiles into the image; `merge`: the image holds earlier triangles. Each work-item takes
// task after task from the counter `next`, so that crowded tiles keep no other work waiting.
kernel void draw_tiles(const int2 size, const float16 axes, const float2 centre, const int merge,
                       global const float4 *restrict triangles,
                       global const ushort4 *restrict bounds, global const uint *restrict starts,
                       global const uint *restrict list, global const uint4 *restrict tasks,
                       global const ulong *restrict length, global uint *restrict next,
                       global uint *restrict prim, global float *restrict t,
                       global float *restrict u, global float *restrict v)
{
    Tile tile;
    const View view = make_view(axes, centre, size);
    const uint columns = (size.x + TILE - 1) / TILE;
    for (uint task = atomic_inc(next); task < length[1]; task = atomic_inc(next)) {
        const uint4 work = tasks[task];
        const int left = work.x % columns * TILE, top = work.x / columns * TILE;
        const int first_row = top + work.y;
        const int4 area = (int4)(left, first_row, MIN(left + TILE, size.x) - 1,
                                 MIN(top + (int)work.z + 1, size.y) - 1);
        begin_tile(&tile, area, size.x, merge, prim, t, u, v);
        draw_bin(&tile, &view, area, list, starts[work.x], starts[work.x + 1], triangles, bounds);
        end_tile(&tile, area, size.x, prim, t, u, v);
    }
}
