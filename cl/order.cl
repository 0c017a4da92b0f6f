// The order of rays from one point to what a picture shows, row by row, where some pixels have no ray: a light's
// shadow rays. Their rows are neither even nor known, but each is near the one before. Bands of ROWS of them
// are taken in tiles.
//
// Each work-item orders a chunk of the rays, whose first ray is the start of its first row: the result is a
// permutation whatever the rays are, and the order given from where they do not look like rows.

#include "common.h"

#define ROWS 8      // of a band
#define TILE 64     // rays
#define SHORTEST 16 // row
#define STEP 4      // neighbours along a row are near, too: the first search may pass over some
#define REACH 16    // a row is at most so much longer or shorter than the one before; at most SHORTEST
#define PROBES 4    // rays of a row that are compared, four apart
#define MARGIN 32   // behind the start of a row: the last probe, and what it is compared with
#define STRAY 2     // rows of a band that may be far from the next
#define NEAR 0.2f   // squared: how far apart rows are, beside rays SHORTEST places apart along one

// Where a ray ends, seen from the origin of all; where it has no end, its direction.
inline float4 end_of(float4 dir_tfar)
{
    return dir_tfar.w < MAXFLOAT ? dir_tfar * dir_tfar.w : dir_tfar;
}

inline float gap(global const float4 *dir_tfar, uint i, uint j)
{
    const float4 d = end_of(dir_tfar[j]) - end_of(dir_tfar[i]);
    return dot3(d, d);
}

// Sum over some rays from i on and from i + offset on.
inline float gaps(global const float4 *dir_tfar, uint i, uint offset)
{
    float sum = 0.0f;
    for (uint k = 0; k < PROBES; k++)
        sum += gap(dir_tfar, i + 4 * k, i + 4 * k + offset);
    return sum;
}

// The length of the row that starts at `begin`: where the ray nearest to it is that does not follow it.
inline uint first_length(global const float4 *dir_tfar, uint begin, uint end)
{
    float least = INFINITY;
    uint length = SHORTEST;
    for (uint k = SHORTEST; begin + ROWS * k + MARGIN < end; k += STEP) {
        const float d = gap(dir_tfar, begin, begin + k);
        if (d < least)
            least = d, length = k;
    }
    return length;
}

// The start of the row behind that at `row`, whose length becomes the last one's. (*near): it is near.
inline uint next_row(global const float4 *dir_tfar, uint row, uint end, uint *length, bool *near)
{
    const uint longest = *length + REACH;
    *near = false;
    if (row + longest + MARGIN > end)
        return end;
    float least = INFINITY;
    for (uint k = MAX(*length - REACH, SHORTEST); k <= longest; k++) {
        const float d = gaps(dir_tfar, row, k);
        if (d < least)
            least = d, *length = k;
    }
    *near = least < INFINITY && least <= NEAR * gaps(dir_tfar, row, SHORTEST);
    return row + *length;
}

// The rays of rows starts[0], starts[1], ..., up to starts[count], in tiles that end at slots divisible by
// TILE: of every row the same part.
inline void store_band(const uint *starts, uint count, global uint *slots)
{
    const uint begin = starts[0], end = starts[count];
    uint from[ROWS];
    for (uint k = 0; k < count; k++)
        from[k] = starts[k];
    slots += begin;
    for (uint at = begin; at < end;) {
        at = MIN((at / TILE + 1) * TILE, end);
        const float part = (float)(at - begin) / (float)(end - begin);
        float due = 0.5f; // parts of rays are carried from row to row
        for (uint k = 0; k < count; k++) {
            due += part * (float)(starts[k + 1] - starts[k]);
            const uint whole = (uint)due;
            const uint stop = at == end ? starts[k + 1] : MIN(starts[k] + whole, starts[k + 1]);
            due -= (float)whole;
            while (from[k] < stop)
                *slots++ = from[k]++;
        }
    }
}

kernel void tile_rows(const uint num_rays, global const float4 *restrict dir_tfar,
                      global uint *restrict slots)
{
    const uint item = get_global_id(0), items = get_global_size(0);
    const ulong tiles = (num_rays + TILE - 1) / TILE;
    const uint begin = tiles * item / items * TILE;
    const uint end = item + 1 < items ? tiles * (item + 1) / items * TILE : num_rays;
    uint length = first_length(dir_tfar, begin, end), row = begin;
    while (row < end) {
        uint starts[ROWS + 1] = {row}, count = 0, near_rows = 0;
        while (count < ROWS && row < end) {
            bool near;
            const uint next = next_row(dir_tfar, row, end, &length, &near);
            if (next == end && count > 0)
                break; // what is left of a row is a band of its own
            starts[++count] = row = next;
            near_rows += near;
        }
        if (near_rows + STRAY < count) { // these are no rows
            starts[1] = row;
            count = 1;
        }
        store_band(starts, count, slots);
    }
}
