// Putting rays into the order of their hash keys: the ray-order stages of the coherent ray-space
// hierarchy (Reis et al. 2017, sections 3.3.2 to 3.3.5), for CPU devices, no barriers.
//
// Trimming, the compaction by head flags and the sort are stream primitives (reduce.cl, sort.cl);
// here is what stands between them. Neighbouring rays of one key make a chunk, the chunks are
// sorted, and the rays of each sorted chunk are written out again:
//
//   trimmed rays   r0 r1 r2 | r3 | r4 r5   chunk keys 7 2 7, bases 0 3 4, sizes 3 1 2
//   sorted chunks  1 0 2                   skeleton 1 3 2, starts 0 1 4, sorted bases 3 0 4
//   slots          r3 | r0 r1 r2 | r4 r5 | INVALID ...
//
// `n` is the capacity of every array, *count the number of trimmed rays, *length that of chunks;
// places beyond these numbers mean nothing unless said otherwise. Chunks lie side by side, have at
// least one ray each, and fill 0 .. *count.
//
// Build-time constant: CHUNKS, the work-items that share a stream (not the paper's chunks of rays).

#include "common.h"

// A ray is a head where its key differs from that of the ray before it; heads[*count ..] are 0.
kernel void flag_heads(const ulong n, global const uint *restrict count,
                       global const uint *restrict keys, global uchar *restrict heads,
                       global uint *restrict positions)
{
    const ulong begin = chunk_begin(n), end = chunk_end(n), kept = *count;
    uint before = begin ? keys[begin - 1] : ~keys[0];
    for (ulong i = begin; i < end; i++) {
        heads[i] = i < kept && keys[i] != before;
        positions[i] = (uint)i;
        before = keys[i];
    }
}

// A chunk ends where the next one begins.
kernel void size_chunks(global const uint *restrict length, global const uint *restrict count,
                        global const uint *restrict bases, global uint *restrict sizes)
{
    const ulong n = *length;
    for (ulong c = chunk_begin(n), end = chunk_end(n); c < end; c++)
        sizes[c] = (c + 1 < n ? bases[c + 1] : *count) - bases[c];
}

kernel void number_chunks(global const uint *restrict length, global uint *restrict chunks)
{
    const ulong n = *length;
    for (ulong c = chunk_begin(n), end = chunk_end(n); c < end; c++)
        chunks[c] = (uint)c;
}

// Sizes in sorted order, and 0 beyond them: the scan's starts there are *count. Bases are put into
// that order here, too, where gathers do not wait for each other.
kernel void write_skeleton(const ulong n, global const uint *restrict length,
                           global const uint *restrict order, global const uint *restrict sizes,
                           global const uint *restrict bases, global uint *restrict skeleton,
                           global uint *restrict sorted_bases)
{
    ulong c = chunk_begin(n);
    const ulong end = chunk_end(n), used = MIN(end, *length);
    for (; c < used; c++) {
        skeleton[c] = sizes[order[c]];
        sorted_bases[c] = bases[order[c]];
    }
    for (; c < end; c++)
        skeleton[c] = 0;
}

// The last chunk that starts at `place` or before.
inline ulong chunk_at(ulong place, ulong n, global const uint *starts)
{
    ulong low = 0, high = n - 1;
    while (low < high) {
        const ulong middle = (low + high + 1) / 2;
        if (starts[middle] <= place)
            low = middle;
        else
            high = middle - 1;
    }
    return low;
}

// Work-items share the slots, not the chunks, so that a chunk of all rays is filled by all of them.
// Whole vectors are copied as long as they stay in the work-item's own slots: what lies behind the
// chunk is written again by the next one.
kernel void fill_slots(const ulong n, global const uint *restrict count,
                       global const uint *restrict sorted_bases,
                       global const uint *restrict starts, global const uint *restrict rays,
                       global uint *restrict slots)
{
    ulong i = chunk_begin(n);
    const ulong end = chunk_end(n), filled = MIN(end, *count);
    for (ulong c = i < filled ? chunk_at(i, n, starts) : 0; i < filled; c++) {
        const ulong next = c + 1 < n ? starts[c + 1] : filled, stop = MIN(next, filled);
        ulong from = sorted_bases[c] + (i - starts[c]);
        for (; i < stop && i + 16 <= end && from + 16 <= n; i += 16, from += 16)
            STORE_UNALIGNED(uint16, slots + i, LOAD_UNALIGNED(uint16, rays + from));
        for (; i < stop; i++, from++)
            slots[i] = rays[from];
        i = stop;
    }
    for (; i < end; i++)
        slots[i] = INVALID;
}
