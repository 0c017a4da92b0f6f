// Sum scans, for CPU devices: every work-item takes one chunk of the stream, no barriers.
//
// Reduce, then scan: the chunks' sums (read), their scan (one work-item), the scan of each chunk from
// its offset (read and write). The host launches this block by block, each block a part of the device's
// cache, so that the second read comes from there; `carry` takes the sum from block to block.
//
// A segmented scan restarts where a head flag is set: its operator takes (flag, sum) pairs, and a
// chunk's flag says whether it holds a head at all (Schwartz 1980; Sengupta et al. 2007).
//
// Build-time constants: TYPE, CHUNKS; VECTOR for 32-bit integers, whose addition is exact in any order.

#include "common.h"

kernel void sum_chunks(const ulong first, const ulong n, global const TYPE *restrict values,
                       global TYPE *restrict sums)
{
    values += first;
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

// One work-item: sums become what lies before each chunk; *carry grows by the block's sum.
kernel void scan_sums(global TYPE *restrict sums, global TYPE *restrict carry)
{
    TYPE before = *carry;
    for (uint c = 0; c < CHUNKS; c++) {
        const TYPE sum = sums[c];
        sums[c] = before;
        before += sum;
    }
    *carry = before;
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
kernel void scan_chunks(const ulong first, const ulong n, global const TYPE *values,
                        global const TYPE *restrict sums, const uint inclusive, global TYPE *out)
{
    values += first;
    out += first;
    TYPE sum = sums[get_global_id(0)];
    ulong i = chunk_begin(n);
    const ulong end = chunk_end(n);
#ifdef VECTOR
    uint16 before = (uint16)(uint)sum; // a vector, so that vectors wait for one addition only
    for (; i + 16 <= end; i += 16) {
        const uint16 v = LOAD_UNALIGNED(uint16, (global const uint *)(values + i));
        const uint16 upto = prefix16(v);
        STORE_UNALIGNED(uint16, (global uint *)(out + i),
                        before + (inclusive ? upto : upto - v));
        before += (uint16)(upto.sf);
    }
    sum = before.s0;
#endif
    for (; i < end; i++) {
        const TYPE value = values[i];
        out[i] = inclusive ? sum + value : sum;
        sum += value;
    }
}

// --- segmented -----------------------------------------------------------------------------------

// has_head[c] and the sum since the chunk's last head.
kernel void sum_segments(const ulong first, const ulong n, global const TYPE *restrict values,
                         global const uchar *restrict heads, global TYPE *restrict sums,
                         global uchar *restrict has_head)
{
    values += first;
    heads += first;
    TYPE sum = 0;
    uchar any = 0;
    for (ulong i = chunk_begin(n), end = chunk_end(n); i < end; i++) {
        sum = heads[i] ? values[i] : sum + values[i];
        any |= heads[i] != 0;
    }
    sums[get_global_id(0)] = sum;
    has_head[get_global_id(0)] = any;
}

kernel void scan_segment_sums(global TYPE *restrict sums, global const uchar *restrict has_head,
                              global TYPE *restrict carry)
{
    TYPE before = *carry;
    for (uint c = 0; c < CHUNKS; c++) {
        const TYPE sum = sums[c];
        sums[c] = before;
        before = has_head[c] ? sum : before + sum;
    }
    *carry = before;
}

kernel void scan_segments(const ulong first, const ulong n, global const TYPE *values,
                          global const uchar *restrict heads, global const TYPE *restrict sums,
                          const uint inclusive, global TYPE *out)
{
    values += first;
    heads += first;
    out += first;
    TYPE sum = sums[get_global_id(0)];
    for (ulong i = chunk_begin(n), end = chunk_end(n); i < end; i++) {
        const TYPE value = values[i], before = heads[i] ? 0 : sum;
        out[i] = inclusive ? before + value : before;
        sum = before + value;
    }
}
