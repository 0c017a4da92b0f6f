// Stream reduction: the hierarchical, segmented method (Roger et al. 2007, section 4.1).
//
// The stream is cut into segments (here one chunk per work-item), each is reduced alone, and the
// results are concatenated. The producer has left a mask of survivors per element and the number of
// survivors per chunk; the exclusive scan of these numbers says where each chunk's survivors go, and
// they are written straight to their place, in order. Rejected elements are never written.
//
// Build-time constants: CHUNKS, ARITY.

#include "stream.h"

// One work-item. offsets[c] = survivors before chunk c; *out_length = their total, or 0 where they
// exceed `capacity`: then nothing below runs, and *overflow keeps the total for the host.
// Row `row` of counts grows by the chunks' sums.
kernel void scan_chunks(const uint capacity, const ulong in_length,
                        global const uint *restrict in_stream_length,
                        global const uint *restrict chunk_tests,
                        global const uint *restrict chunk_hits, global uint *restrict offsets,
                        global uint *restrict out_length, global ulong *restrict overflow,
                        global ulong *restrict counts, const uint row)
{
    global ulong *level = counts + row * LEVEL_COUNTS;
    ulong hits = 0, tests = 0;
    for (uint c = 0; c < CHUNKS; c++) {
        offsets[c] = (uint)hits;
        hits += chunk_hits[c];
        tests += chunk_tests[c];
    }
    const bool fits = hits <= capacity;
    *out_length = fits ? (uint)hits : 0;
    if (!fits)
        *overflow = hits;
    level[LEVEL_TESTS] += tests;
    level[LEVEL_HITS] += hits;
    level[LEVEL_STREAM] = in_length != 0 ? in_length : *in_stream_length;
}

// Triangles of sixteen pairs whose bit is set in `mask`, with their new node, to out[0 ..].
inline void write_survivors(global const Pair *pairs, uint node, uint mask, global Pair *out)
{
#ifdef COMPRESS16
    const uint16 a = LOAD_UNALIGNED(uint16, (global const uint *)pairs);
    const uint16 b = LOAD_UNALIGNED(uint16, (global const uint *)(pairs + WIDTH / 2));
    const uint16 t = COMPRESS16(ODD_LANES(a, b), mask), n = (uint16)(node);
    // Two words a survivor: neither more nor less may be written, other survivors stand behind.
    const ulong words = (1ul << 2 * COUNT16(mask)) - 1;
    STORE_MASKED(out, LOW_PAIRS(n, t), words);
    if (words >> 16)
        STORE_MASKED(out + WIDTH / 2, HIGH_PAIRS(n, t), words >> 16);
#else
    for (uint k = 0; mask != 0; k++, mask >>= 1) {
        if (mask & 1u)
            *out++ = (Pair)(node, pairs[k].y);
    }
#endif
}

#define MASKS_PER_ULONG (sizeof(ulong) / sizeof(Mask))
#if ARITY > 8
#define FIRST_CHILDREN 0x0001000100010001ul
#else
#define FIRST_CHILDREN 0x0101010101010101ul
#endif

// Where each child's survivors of a run begin; returns where the last child's end.
inline uint place_children(global const Mask *masks, uint count, uint next, uint *places)
{
    uint sums[ARITY] = {0};
    uint k = 0;
    for (; k + MASKS_PER_ULONG <= count; k += MASKS_PER_ULONG) {
        const ulong several = LOAD_WORD(masks + k);
        for (uint child = 0; child < ARITY; child++)
            sums[child] += COUNT64((several >> child) & FIRST_CHILDREN);
    }
    for (; k < count; k++) {
        for (uint child = 0; child < ARITY; child++)
            sums[child] += (masks[k] >> child) & 1;
    }
    for (uint child = 0; child < ARITY; child++) {
        places[child] = next;
        next += sums[child];
    }
    return next;
}

// Survivors of a run, child by child: (node, triangle) with bit c becomes (node * ARITY + c, triangle).
kernel void scatter_children(global const uint *restrict in_length, global const Pair *restrict in,
                             global const Mask *restrict masks,
                             global const uint *restrict offsets,
                             global const uint *restrict out_length, global Pair *restrict out)
{
    if (*out_length == 0)
        return;
    const uint n = *in_length;
    uint next = offsets[get_global_id(0)];
    for (uint i = chunk_begin(n), end = chunk_end(n); i < end;) {
        const uint count = run_length(in, i, end), first_child = in[i].x * ARITY;
        uint places[ARITY];
        next = place_children(masks + i, count, next, places);
        for (uint k = i; k < i + count; k += WIDTH) {
            const int16 lanes = CONVERT(int16, LOAD_UNALIGNED(Mask16, masks + k));
            const uint left = i + count - k, here = left < WIDTH ? (1u << left) - 1 : 0xffffu;
            for (uint child = 0; child < ARITY; child++) {
                const uint mask = MASK16((lanes << (31 - child)) >> 31) & here;
                if (mask) {
                    write_survivors(in + k, first_child + child, mask, out + places[child]);
                    places[child] += COUNT16(mask);
                }
            }
        }
        i += count;
    }
}
