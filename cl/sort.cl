// Stable radix sort, least significant digit first, for CPU devices: no barriers.
//
// A pass counts the digits of every chunk, scans the counts (digit by digit, within a digit chunk by
// chunk, which is what keeps the sort stable), and moves each element to its place. Few chunks, one or
// two per core, keep the tables small enough for the caches. Between passes a key and its 32-bit value
// travel as one 64-bit word: one store instead of two.
//
// A stream larger than the cache goes through one line of elements per digit, which is stored whole and
// past the cache: scattered stores would fetch every line first and miss the page tables (the buffered
// scatter of Satish et al. 2010). There digits may be wider, for fewer passes.
//
// The number of elements is in device memory: *length, of arrays that may be longer.
//
// Build-time constants: KEY (uint, ulong), VALUE (uint, ulong), CHUNKS, DIGITS (2^bits of a digit);
// KEYS_ALONE where there are no values, VALUES_ALONE where the last pass keeps no keys; FROM_PACKED,
// TO_PACKED where the pass reads or writes packed words. Arrays that these rule out are not touched.

#include "common.h"

#ifdef FROM_PACKED
#define LOAD_KEY(i) packed_in[i].x
#define LOAD_VALUE(i) packed_in[i].y
#else
#define LOAD_KEY(i) keys_in[i]
#define LOAD_VALUE(i) values_in[i]
#endif

// counts[digit * CHUNKS + chunk]
kernel void count_digits(global const uint *restrict length, const uint shift,
                         global const KEY *restrict keys_in, global const uint2 *restrict packed_in,
                         global uint *restrict counts)
{
    const ulong n = *length;
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

kernel void scatter_digits(global const uint *restrict length, const uint shift,
                           global const KEY *restrict keys_in,
                           global const VALUE *restrict values_in,
                           global const uint2 *restrict packed_in,
                           global const uint *restrict counts, global KEY *restrict keys_out,
                           global VALUE *restrict values_out, global uint2 *restrict packed_out)
{
    const ulong n = *length;
    uint places[DIGITS];
    for (uint d = 0; d < DIGITS; d++)
        places[d] = counts[d * CHUNKS + get_global_id(0)];
    for (ulong i = chunk_begin(n), end = chunk_end(n); i < end; i++) {
        const KEY key = LOAD_KEY(i);
        const uint place = places[(key >> shift) & (DIGITS - 1)]++;
#ifdef TO_PACKED
        packed_out[place] = (uint2)(key, LOAD_VALUE(i));
#else
#ifndef VALUES_ALONE
        keys_out[place] = key;
#endif
#ifndef KEYS_ALONE
        values_out[place] = LOAD_VALUE(i);
#endif
#endif
    }
}

// --- buffered ------------------------------------------------------------------------------------

#define LINE 16 // elements: 64 bytes or 128

typedef struct {
    global KEY *keys;
    global VALUE *values;
} Elements;

// Elements begin .. end of the result, which wait in their digit's line.
inline void store_some(Elements out, Elements line, uint begin, uint end)
{
    for (uint p = begin; p < end; p++) {
        out.keys[p] = line.keys[p % LINE];
#ifndef KEYS_ALONE
        out.values[p] = line.values[p % LINE];
#endif
    }
}

#define STORE_BYTES(to, from, bytes)                                                               \
    for (uint k = 0; k < (bytes) / 64; k++)                                                        \
    STORE_STREAMING(uint16, (global uint16 *)(to) + k, ((global const uint16 *)(from))[k])

inline void store_whole(Elements out, Elements line, uint begin)
{
    STORE_BYTES(out.keys + begin, line.keys, LINE * sizeof(KEY));
#ifndef KEYS_ALONE
    STORE_BYTES(out.values + begin, line.values, LINE * sizeof(VALUE));
#endif
}

// As scatter_digits. Element p waits at p % LINE of its digit's line until the line is full. A digit's
// first and last line in a chunk may be shared with other chunks: these store their own elements only.
// lines: CHUNKS * DIGITS * LINE elements.
kernel void scatter_lines(global const uint *restrict length, const uint shift,
                          global const KEY *restrict keys_in,
                          global const VALUE *restrict values_in,
                          global const uint *restrict counts, global KEY *key_lines,
                          global VALUE *value_lines, global KEY *keys_out, global VALUE *values_out)
{
    const ulong n = *length;
    const Elements out = {keys_out, values_out};
    uint places[DIGITS];
    for (uint d = 0; d < DIGITS; d++)
        places[d] = counts[d * CHUNKS + get_global_id(0)];
    for (ulong i = chunk_begin(n), end = chunk_end(n); i < end; i++) {
        const KEY key = keys_in[i];
        const uint digit = (key >> shift) & (DIGITS - 1), place = places[digit]++;
        const ulong at = (get_global_id(0) * (ulong)DIGITS + digit) * LINE;
        const Elements line = {key_lines + at, value_lines + at};
        line.keys[place % LINE] = key;
#ifndef KEYS_ALONE
        line.values[place % LINE] = values_in[i];
#endif
        if (place % LINE == LINE - 1) {
            const uint begin = place - (LINE - 1), first = counts[digit * CHUNKS + get_global_id(0)];
            if (begin >= first)
                store_whole(out, line, begin);
            else
                store_some(out, line, first, place + 1);
        }
    }
    for (uint d = 0; d < DIGITS; d++) {
        const ulong at = (get_global_id(0) * (ulong)DIGITS + d) * LINE;
        const Elements line = {key_lines + at, value_lines + at};
        const uint end = places[d], begin = end - end % LINE;
        store_some(out, line, MAX(begin, counts[d * CHUNKS + get_global_id(0)]), end);
    }
}
