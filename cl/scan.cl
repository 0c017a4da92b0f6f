// Sum scans, for CPU devices: every work-item takes one chunk of the stream, no barriers.
//
// Reduce, then scan: the chunks' sums (read), their scan (one work-item), the scan of each chunk from
// its offset (read and write). The scan begins with the chunks that were summed last: the cache still
// holds them.
//
// A segmented scan restarts where a head flag is set: its operator takes (flag, sum) pairs, and a
// chunk's flag says whether it holds a head at all (Schwartz 1980; Sengupta et al. 2007).
//
// Build-time constants: TYPE, CHUNKS; VECTOR for 32-bit integers, whose addition is exact in any order;
// STREAMING where the stream is larger than the cache, so that stores go past it.

#include "common.h"

#ifdef STREAMING
#define STORE_ALIGNED(T, p, v) STORE_STREAMING(T, p, v)
#else
#define STORE_ALIGNED(T, p, v) (*(global T *)(p) = (v))
#endif

kernel void sum_chunks(const ulong n, global const TYPE *restrict values,
                       global TYPE *restrict sums)
{
    TYPE sum = 0;
    ulong i = chunk_begin(n);
    const ulong end = chunk_end(n);
#ifdef VECTOR
    uint16 several = 0;
    for (; i + 16 <= end; i += 16)
        several += LOAD_UNALIGNED(uint16, (global const uint *)(values + i));
    const uint8 a = several.lo + several.hi;
    const uint4 b = a.lo + a.hi;
    sum += b.x + b.y + b.z + b.w;
#endif
    for (; i < end; i++)
        sum += values[i];
    sums[get_global_id(0)] = sum;
}

// One work-item: sums become what lies before each chunk.
kernel void scan_sums(global TYPE *restrict sums)
{
    TYPE before = 0;
    for (uint c = 0; c < CHUNKS; c++) {
        const TYPE sum = sums[c];
        sums[c] = before;
        before += sum;
    }
}

// Writes the sum at i and returns the sum with it.
inline TYPE scan_one(global const TYPE *values, ulong i, TYPE sum, uint inclusive, global TYPE *out)
{
    const TYPE value = values[i];
    out[i] = inclusive ? sum + value : sum;
    return sum + value;
}

#ifdef VECTOR
// Inclusive sums within sixteen lanes, in four steps.
inline uint16 prefix16(uint16 v)
{
    v += (uint16)(0, v.s01234567, v.s89ab, v.scd, v.se);
    v += (uint16)(0, 0, v.s01234567, v.s89ab, v.scd);
    v += (uint16)((uint4)0, v.s01234567, v.s89ab);
    v += (uint16)((uint8)0, v.lo);
    return v;
}
#endif

// `inclusive`: out[i] holds values[i], too. `out` may be `values`.
kernel void scan_chunks(const ulong n, global const TYPE *values, global const TYPE *restrict sums,
                        const uint inclusive, global TYPE *out)
{
    const uint chunk = CHUNKS - 1 - get_global_id(0);
    ulong i = chunk_first(chunk, n);
    const ulong end = chunk_first(chunk + 1, n);
    TYPE sum = sums[chunk];
#ifdef VECTOR
    for (; i < end && (ulong)(out + i) % sizeof(uint16) != 0; i++)
        sum = scan_one(values, i, sum, inclusive, out);
    uint16 before = (uint16)(uint)sum; // a vector, so that vectors wait for one addition only
    for (; i + 16 <= end; i += 16) {
        const uint16 v = LOAD_UNALIGNED(uint16, (global const uint *)(values + i));
        const uint16 upto = prefix16(v);
        STORE_ALIGNED(uint16, out + i, before + (inclusive ? upto : upto - v));
        before += (uint16)(upto.sf);
    }
    sum = before.s0;
#endif
    for (; i < end; i++)
        sum = scan_one(values, i, sum, inclusive, out);
}

// --- segmented -----------------------------------------------------------------------------------

// has_head[c] and the sum since the chunk's last head.
kernel void sum_segments(const ulong n, global const TYPE *restrict values,
                         global const uchar *restrict heads, global TYPE *restrict sums,
                         global uchar *restrict has_head)
{
    TYPE sum = 0;
    uchar any = 0;
    for (ulong i = chunk_begin(n), end = chunk_end(n); i < end; i++) {
        sum = heads[i] ? values[i] : sum + values[i];
        any |= heads[i] != 0;
    }
    sums[get_global_id(0)] = sum;
    has_head[get_global_id(0)] = any;
}

kernel void scan_segment_sums(global TYPE *restrict sums, global const uchar *restrict has_head)
{
    TYPE before = 0;
    for (uint c = 0; c < CHUNKS; c++) {
        const TYPE sum = sums[c];
        sums[c] = before;
        before = has_head[c] ? sum : before + sum;
    }
}

kernel void scan_segments(const ulong n, global const TYPE *values,
                          global const uchar *restrict heads, global const TYPE *restrict sums,
                          const uint inclusive, global TYPE *out)
{
    TYPE sum = sums[get_global_id(0)];
    for (ulong i = chunk_begin(n), end = chunk_end(n); i < end; i++) {
        const TYPE value = values[i], before = heads[i] ? 0 : sum;
        out[i] = inclusive ? before + value : before;
        sum = before + value;
    }
}
