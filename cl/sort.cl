// Stable radix sort, least significant digit first, for CPU devices: no barriers.
//
// A pass counts the digits of every chunk, scans the counts (digit by digit, within a digit chunk by
// chunk, which is what keeps the sort stable), and moves each element to its place. Few chunks, one or
// two per core, keep the tables small enough for the caches. Between passes a key and its 32-bit value
// travel as one 64-bit word: one store instead of two.
//
// Build-time constants: KEY (uint, ulong), CHUNKS, DIGITS (2^bits of a digit); VALUE (uint, ulong), not
// defined for keys alone; FROM_PACKED, TO_PACKED where the pass reads or writes packed words.

#include "common.h"

#ifdef FROM_PACKED
#define LOAD_KEY(i) packed_in[i].x
#else
#define LOAD_KEY(i) keys_in[i]
#endif

// counts[digit * CHUNKS + chunk]
kernel void count_digits(const ulong n, const uint shift, global const KEY *restrict keys_in,
                         global const uint2 *restrict packed_in, global uint *restrict counts)
{
    // Two tables: equal digits in a row would wait for each other's increments.
    uint even[DIGITS] = {0}, odd[DIGITS] = {0};
    ulong i = chunk_begin(n);
    const ulong end = chunk_end(n);
    for (; i + 2 <= end; i += 2) {
        even[(LOAD_KEY(i) >> shift) & (DIGITS - 1)]++;
        odd[(LOAD_KEY(i + 1) >> shift) & (DIGITS - 1)]++;
    }
    if (i < end)
        even[(LOAD_KEY(i) >> shift) & (DIGITS - 1)]++;
    for (uint d = 0; d < DIGITS; d++)
        counts[d * CHUNKS + get_global_id(0)] = even[d] + odd[d];
}

// One work-item: counts become the places of each chunk's first element of each digit.
kernel void scan_digits(global uint *restrict counts)
{
    uint before = 0;
    for (uint k = 0; k < DIGITS * CHUNKS; k++) {
        const uint count = counts[k];
        counts[k] = before;
        before += count;
    }
}

kernel void scatter_digits(const ulong n, const uint shift, global const KEY *restrict keys_in,
#ifdef VALUE
                           global const VALUE *restrict values_in,
#endif
                           global const uint2 *restrict packed_in,
                           global const uint *restrict counts, global KEY *restrict keys_out,
#ifdef VALUE
                           global VALUE *restrict values_out,
#endif
                           global uint2 *restrict packed_out)
{
    uint places[DIGITS];
    for (uint d = 0; d < DIGITS; d++)
        places[d] = counts[d * CHUNKS + get_global_id(0)];
    for (ulong i = chunk_begin(n), end = chunk_end(n); i < end; i++) {
        const KEY key = LOAD_KEY(i);
        const uint place = places[(key >> shift) & (DIGITS - 1)]++;
#ifdef VALUE
#ifdef FROM_PACKED
        const VALUE value = packed_in[i].y;
#else
        const VALUE value = values_in[i];
#endif
#endif
#ifdef TO_PACKED
        packed_out[place] = (uint2)(key, value);
#else
        keys_out[place] = key;
#ifdef VALUE
        values_out[place] = value;
#endif
#endif
    }
}
