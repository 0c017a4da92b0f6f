// Layered depth cube (Buerger, Hertel, Krueger, Westermann 2007): construction of three layered
// depth images along the axes, and of their coarse blocks.
//
// Section 1.2: each triangle is rasterised into one image only (cube.h). A-buffer: the samples of
// each texel are counted, scanned, written and sorted by depth, then triangle. Depth peeling, as
// published: layer after layer, in each texel the nearest sample behind the last. Both leave the
// same arrays: samples first[texel] .. first[texel + 1] - 1 ascend.
// Section 1.3, the coarse level: blocks[d][column][row] = smallest and largest depth of a block of
// texels. Beyond the paper: slabs[d][column][row], a bit for each of SLABS slabs of the cube's
// depth that is occupied; it also knows the empty space between the layers, and is what rays are
// tested against.
//
// Build-time constants: CHUNKS, shares of the triangles and texels; those of cube.h.

#pragma OPENCL EXTENSION cl_khr_int64_base_atomics : enable
#pragma OPENCL EXTENSION cl_khr_int64_extended_atomics : enable

#include "cube.h"

#define SMALLEST_BOX 1e-30f
#define MARGIN 0x1p-18f // texels from the cube's far sides: above the rounding of to_grid

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

// One work-item: the grid (cube.h) over the chunks' boxes.
kernel void make_grid(const uint resolution, global const float4 *restrict boxes,
                      global float4 *restrict grid)
{
    float4 low, high;
    join_boxes(boxes, CHUNKS, &low, &high);
    const float4 extent = high - low;
    float edge = largest3(extent);
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
    const Sink sink = {counts};
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
                            global const uint *restrict first, global Fragment *restrict fragments)
{
    const Sink sink = {counts, first, fragments};
    FOR_TRIANGLES(i) rasterise(SCATTER, &sink, &g, resolution, triangles, i);
}

// Layer after layer; see Sink in cube.h. The pass after the last layer writes that.
kernel void peel_layer(const uint num_triangles, const int resolution, const uint layer,
                       global const float4 *restrict grid, global const float4 *restrict triangles,
                       global const uint *restrict first, global const ulong *restrict last,
                       global ulong *restrict next, global Depth *restrict near,
                       global Depth *restrict far, global uint *restrict triangle)
{
    const Sink sink = {0, first, 0, {near, far, triangle}, last, next, layer};
    FOR_TRIANGLES(i) rasterise(PEEL, &sink, &g, resolution, triangles, i);
}

inline ulong fragment_key(const Fragment *f) { return hit_key(f->near, f->triangle); }

// Sift down: s[root] of a heap of n, the largest on top.
inline void sift(global Fragment *s, uint root, uint n)
{
    const Fragment moving = s[root];
    for (uint child = 2 * root + 1; child < n; child = 2 * root + 1) {
        Fragment larger = s[child];
        if (child + 1 < n) {
            const Fragment other = s[child + 1];
            if (fragment_key(&other) > fragment_key(&larger)) {
                larger = other;
                child++;
            }
        }
        if (fragment_key(&moving) >= fragment_key(&larger))
            break;
        s[root] = larger;
        root = child;
    }
    s[root] = moving;
}

#define FEW 24 // fragments up to which insertion is the fastest sort

inline void sort_fragments(global Fragment *s, uint n)
{
    if (n <= FEW) {
        for (uint i = 1; i < n; i++) {
            const Fragment moving = s[i];
            uint j = i;
            for (; j > 0; j--) {
                const Fragment before = s[j - 1];
                if (fragment_key(&before) <= fragment_key(&moving))
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
        const Fragment largest = s[0];
        s[0] = s[last];
        s[last] = largest;
        sift(s, 0, last);
    }
}

// Sorts the fragments of each texel, and leaves them as samples.
kernel void sort_texels(const uint texels, global const uint *restrict first,
                        global Fragment *restrict fragments, global Depth *restrict near,
                        global Depth *restrict far, global uint *restrict triangle)
{
    const Samples samples = {near, far, triangle};
    for (ulong i = chunk_begin(texels), end = chunk_end(texels); i < end; i++) {
        if (first[i + 1] - first[i] > 1)
            sort_fragments(fragments + first[i], first[i + 1] - first[i]);
        for (uint k = first[i]; k < first[i + 1]; k++) {
            const Fragment f = fragments[k];
            write_sample(&samples, k, f.triangle, f.near, f.far);
        }
    }
}

// One work-item per direction and column of blocks, n columns by m rows of texels each.
kernel void build_blocks(const uint resolution, const uint n, const uint m, const uint across,
                         const uint along, global const uint *restrict first,
                         global Depth *restrict near, global Depth *restrict far,
                         global float2 *restrict blocks, global ulong *restrict slabs)
{
    const Samples samples = {near, far, 0};
    const float per_slab = (float)SLABS / (float)resolution;
    const uint line = get_global_id(0);
    if (line >= 3 * across)
        return;
    const uint direction = line / across, left = line % across * n;
    const uint right = MIN(left + n, resolution);
    for (uint row = 0; row < along; row++) {
        const uint bottom = row * m, top = MIN(bottom + m, resolution);
        float2 depths = (float2)(INFINITY, -INFINITY);
        ulong occupied = 0;
        for (uint column = left; column < right; column++) {
            const ulong texel = ((ulong)direction * resolution + column) * resolution;
            const uint end = first[texel + top];
            for (uint k = first[texel + bottom]; k < end; k++) {
                const float low = depth_of(samples.near[k]), high = depth_of(FAR(&samples)[k]);
                depths.x = low < depths.x ? low : depths.x;
                depths.y = high > depths.y ? high : depths.y;
                occupied |= slabs_between(low, high, per_slab);
            }
        }
        blocks[line * along + row] = depths;
        slabs[line * along + row] = occupied;
    }
}

// Of every sample: its depth in the scene's unit, the weights u, v of the middle of its texel on its
// triangle, and the direction it is seen along. A work-item takes a chunk of the texels.
kernel void place_samples(const int resolution, global const float4 *restrict grid,
                          global const float4 *restrict triangles,
                          global const uint *restrict first, global const Depth *restrict near,
                          global const uint *restrict triangle, global float *restrict depth,
                          global float *restrict u, global float *restrict v,
                          global float4 *restrict view)
{
    const Grid g = load_grid(grid);
    const uint plane = (uint)resolution * resolution;
    for (ulong i = chunk_begin(3 * plane), end = chunk_end(3 * plane); i < end; i++) {
        const uint axis = i / plane;
        const int row = i % resolution, column = i / resolution % resolution;
        for (uint k = first[i]; k < first[i + 1]; k++) {
            global const float4 *corners = triangles + TRIANGLE_FLOAT4S * (ulong)triangle[k];
            const float2 weights = weights_at(&g, corners, column + 0.5f, row + 0.5f);
            depth[k] = depth_of(near[k]) * g.edge;
            u[k] = weights.x;
            v[k] = weights.y;
            view[k] = (float4)(axis == 0, axis == 1, axis == 2, 0.0f);
        }
    }
}
