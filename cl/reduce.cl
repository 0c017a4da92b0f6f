// Stream reduction, for CPU devices: every work-item takes one chunk, no barriers.
//
//   scan       the chunks' numbers of survivors (only the flags are read), their scan, and one pass that
//              writes survivors straight to their place
//   segmented  Roger et al. 2007, section 4.1: segments reduced alone, each at its own begin; then
//              concatenated. The first step alone is what a consumer needs that can read segments.
//   horn       Horn 2005: running sums of the rejected by log2 n passes over the whole stream, then each
//              place of the result finds its element by a search of log2 n steps
//   append     blocks reserve room by an atomic counter: their order is lost (the stand-in for the
//              geometry shader of section 4.2)
//
// `keep` is a byte per element, kept where it is not 0. Order is kept by all but `append`.
//
// Build-time constants: ELEMENT (uint, uint2, uint4), BYTES (4, 8, 16), CHUNKS.

#include "common.h"

#define PER_VECTOR (64 / BYTES)

inline ulong count_range(global const uchar *keep, ulong begin, ulong end)
{
    ulong count = 0;
#ifdef COMPRESS16
    for (; begin + 64 <= end; begin += 64)
        count += COUNT64(NONZERO64(keep + begin));
#else
    for (; begin < end && ((ulong)(keep + begin) & 7) != 0; begin++)
        count += keep[begin] != 0;
    for (; begin + 8 <= end; begin += 8) {
        const ulong low = 0x7f7f7f7f7f7f7f7ful, bytes = *(global const ulong *)(keep + begin);
        // The top bit of each byte says whether the byte is not 0; the product sums the bytes.
        const ulong nonzero = (((bytes & low) + low) | bytes) & ~low;
        count += ((nonzero >> 7) * 0x0101010101010101ul) >> 56;
    }
#endif
    for (; begin < end; begin++)
        count += keep[begin] != 0;
    return count;
}

#ifdef COMPRESS16

// Sixty-four elements by `mask` to out[0 ..]; up to a vector of other places behind is overwritten.
inline void compress64(global const ELEMENT *values, ulong mask, global ELEMENT *out)
{
    for (uint k = 0; k < 64; k += PER_VECTOR) {
        const uint part = (uint)(mask >> k) & ((1u << PER_VECTOR) - 1);
        const uint16 v = LOAD_UNALIGNED(uint16, (global const uint *)(values + k));
        STORE_UNALIGNED(uint16, (global uint *)out, CONCAT(COMPRESS_BYTES, BYTES)(v, part));
        out += COUNT16(part);
    }
}

#endif

// The survivors among begin .. end to out[0 ..]; there are `room` of them.
inline void compact_range(global const ELEMENT *values, global const uchar *keep, ulong begin,
                          ulong end, global ELEMENT *out, ulong room)
{
    const global ELEMENT *stop = out + room;
#ifdef COMPRESS16
    // As long as whole vectors fit: whoever has the places behind `stop` may have written already.
    for (; begin + 64 <= end && out + 64 <= stop; begin += 64) {
        const ulong mask = NONZERO64(keep + begin);
        compress64(values + begin, mask, out);
        out += COUNT64(mask);
    }
#endif
    // Without a branch: what is not kept is overwritten by the next one that is.
    for (; begin < end && out < stop; begin++) {
        *out = values[begin];
        out += keep[begin] != 0;
    }
}

// --- scan ----------------------------------------------------------------------------------------

kernel void count_kept(const ulong n, global const uchar *restrict keep, global ulong *restrict counts)
{
    counts[get_global_id(0)] = count_range(keep, chunk_begin(n), chunk_end(n));
}

// One work-item: counts become what lies before each chunk, *total their sum. CHUNKS + 1 entries.
kernel void scan_counts(global ulong *restrict counts, global uint *restrict total)
{
    ulong before = 0;
    for (uint c = 0; c < CHUNKS; c++) {
        const ulong count = counts[c];
        counts[c] = before;
        before += count;
    }
    counts[CHUNKS] = before;
    *total = (uint)before;
}

kernel void write_kept(const ulong n, global const ELEMENT *restrict values,
                       global const uchar *restrict keep, global const ulong *restrict offsets,
                       global ELEMENT *restrict out)
{
    const uint c = get_global_id(0);
    compact_range(values, keep, chunk_begin(n), chunk_end(n), out + offsets[c],
                  offsets[c + 1] - offsets[c]);
}

// --- segmented -----------------------------------------------------------------------------------

inline ulong segments_begin(ulong n, ulong size) { return chunk_begin((n + size - 1) / size); }
inline ulong segments_end(ulong n, ulong size) { return chunk_end((n + size - 1) / size); }

// Segment s's survivors to segments[s * size ..], their number to lengths[s]; counts per chunk.
kernel void reduce_segments(const ulong n, const ulong size, global const ELEMENT *restrict values,
                            global const uchar *restrict keep, global ELEMENT *restrict segments,
                            global uint *restrict lengths, global ulong *restrict counts)
{
    ulong sum = 0;
    for (ulong s = segments_begin(n, size), stop = segments_end(n, size); s < stop; s++) {
        const ulong begin = s * size, end = MIN(begin + size, n);
        const ulong length = count_range(keep, begin, end);
        // A segment owns all its places, so whole vectors may be written up to its end.
        compact_range(values, keep, begin, end, segments + begin, end - begin);
        lengths[s] = (uint)length;
        sum += length;
    }
    counts[get_global_id(0)] = sum;
}

kernel void concatenate(const ulong n, const ulong size, global const ELEMENT *restrict segments,
                        global const uint *restrict lengths, global const ulong *restrict offsets,
                        global ELEMENT *restrict out)
{
    out += offsets[get_global_id(0)];
    for (ulong s = segments_begin(n, size), stop = segments_end(n, size); s < stop; s++) {
        global const ELEMENT *from = segments + s * size;
        const uint length = lengths[s];
        uint i = 0;
        for (; i + PER_VECTOR <= length; i += PER_VECTOR) {
            const uint16 v = LOAD_UNALIGNED(uint16, (global const uint *)(from + i));
            STORE_UNALIGNED(uint16, (global uint *)(out + i), v);
        }
        for (; i < length; i++)
            out[i] = from[i];
        out += length;
    }
}

// --- horn ----------------------------------------------------------------------------------------

kernel void count_rejected(const ulong n, global const uchar *restrict keep,
                           global uint *restrict sums)
{
    for (ulong i = chunk_begin(n), end = chunk_end(n); i < end; i++)
        sums[i] = keep[i] == 0;
}

// One of log2 n passes: out[i] = sums[i] + sums[i - distance].
kernel void add_distant(const ulong n, const ulong distance, global const uint *restrict sums,
                        global uint *restrict out)
{
    for (ulong i = chunk_begin(n), end = chunk_end(n); i < end; i++)
        out[i] = i >= distance ? sums[i] + sums[i - distance] : sums[i];
}

// Place j takes the element i that is kept and has i - j rejected ones before it.
kernel void gather_kept(const ulong n, global const ELEMENT *restrict values,
                        global const uint *restrict sums, global ELEMENT *restrict out,
                        global uint *restrict total)
{
    const ulong kept = n - sums[n - 1];
    for (ulong j = chunk_begin(kept), end = chunk_end(kept); j < end; j++) {
        ulong low = j, high = n - 1; // the smallest i with i + 1 - sums[i] > j
        while (low < high) {
            const ulong middle = (low + high) / 2;
            if (middle + 1 - sums[middle] > j)
                high = middle;
            else
                low = middle + 1;
        }
        out[j] = values[low];
    }
    if (get_global_id(0) == 0)
        *total = (uint)kept;
}

// --- append --------------------------------------------------------------------------------------

#define APPEND_BLOCK 16384

// *total, 0 before, counts the places that blocks have reserved.
kernel void append_kept(const ulong n, global const ELEMENT *restrict values,
                        global const uchar *restrict keep, global ELEMENT *restrict out,
                        global uint *restrict total)
{
    const ulong begin = (ulong)get_global_id(0) * APPEND_BLOCK;
    const ulong end = MIN(begin + APPEND_BLOCK, n);
    const uint count = (uint)count_range(keep, begin, end);
    const uint place = count ? atomic_add(total, count) : 0;
    compact_range(values, keep, begin, end, out + place, count);
}
