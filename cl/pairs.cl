// Stream reduction: the hierarchical, segmented method (Roger et al. 2007, section 4.1).
//
// The stream is cut into segments (here one chunk per work-item), each is reduced alone, and the
// results are concatenated. The producer has left a mask of survivors per element and the number of
// survivors per chunk; the exclusive scan of these numbers says where each chunk's survivors go, and
// they are written straight to their place, in order. Rejected elements are never written.
//
// Build-time constants: CHUNKS, ARITY.

#include "pairs.h"

// One work-item. offsets[c] = survivors before chunk c; *out_length = their total, or 0 where they
// exceed `capacity`: then nothing below runs, and *overflow keeps the total for the host.
// Row `row` of counts grows by the chunks' sums.
kernel void scan_chunks(const uint capacity, const ulong in_length,
                        global const uint *restrict in_stream_length,
                        global const ulong *restrict chunk_tests,
                        global const ulong *restrict chunk_hits, global uint *restrict offsets,
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

// Of sixteen pairs with triangles `t` those whose bit is set in `mask`, with their new node.
inline void write_survivors(global const Pair *pairs, uint16 t, uint node, uint mask,
                            global Pair *out)
{
#ifdef COMPRESS16
    const uint16 kept = COMPRESS16(t, mask), n = (uint16)(node);
    // Two words a survivor: neither more nor less may be written, other survivors stand behind.
    const ulong words = (1ul << 2 * COUNT16(mask)) - 1;
    STORE_MASKED(out, LOW_PAIRS(n, kept), words);
    if (words >> WIDTH)
        STORE_MASKED(out + WIDTH / 2, HIGH_PAIRS(n, kept), words >> WIDTH);
#else
    for (uint k = 0; mask != 0; k++, mask >>= 1) {
        if (mask & 1u)
            *out++ = (Pair)(node, pairs[k].y);
    }
#endif
}

// The stream as the paper's traversal leaves it, for a stream reduction of its own (cl/reduce.cl): all
// children of every pair with a flag each, first child 0 of all pairs, then child 1, ... (the paper's
// four render targets), so that runs stay runs.
kernel void expand_children(global const uint *restrict in_length, global const Pair *restrict in,
                            global const Mask *restrict masks, global Pair *restrict children,
                            global uchar *restrict keep)
{
    const uint n = *in_length;
    for (uint i = chunk_begin(n), end = chunk_end(n); i < end; i++) {
        const Pair pair = in[i];
        for (uint child = 0; child < ARITY; child++) {
            children[(ulong)n * child + i] = (Pair)(pair.x * ARITY + child, pair.y);
            keep[(ulong)n * child + i] = (masks[i] >> child) & 1;
        }
    }
}

inline ulong first_bits(uint count) { return count < 64 ? (1ul << count) - 1 : ~0ul; }

// Where each child's survivors of a run begin; returns where the last child's end.
inline uint place_children(global const Mask *masks, uint count, uint next, uint *places)
{
    uint sums[ARITY] = {0};
    for (uint k = 0; k < count; k += 64) {
        const ulong here = first_bits(count - k);
        for (uint child = 0; child < ARITY; child++)
            sums[child] += COUNT64(TEST64(masks + k, child) & here);
    }
    for (uint child = 0; child < ARITY; child++) {
        places[child] = next;
        next += sums[child];
    }
    return next;
}

// Survivors of up to 64 pairs of a run, to their children's places, which move on.
inline void write_block(global const Pair *pairs, global const Mask *masks, uint count,
                        uint first_child, uint *places, global Pair *out)
{
    ulong kept[ARITY];
    for (uint child = 0; child < ARITY; child++)
        kept[child] = TEST64(masks, child) & first_bits(count);
    for (uint k = 0; k < count; k += WIDTH, pairs += WIDTH) {
        const uint16 t = TRIANGLES_OF(pairs);
        for (uint child = 0; child < ARITY; child++) {
            const uint mask = (uint)(kept[child] >> k) & 0xffffu;
            if (mask) {
                write_survivors(pairs, t, first_child + child, mask, out + places[child]);
                places[child] += COUNT16(mask);
            }
        }
    }
}

// Survivors of a run, child by child: (node, triangle) with bit c becomes
// (node * ARITY + c, triangle), so that each child's pairs are a run again.
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
        const uint count = run_length(in, i, end);
        uint places[ARITY];
        next = place_children(masks + i, count, next, places);
        for (uint k = 0; k < count; k += 64)
            write_block(in + i + k, masks + i + k, MIN(count - k, 64u), in[i].x * ARITY, places,
                        out);
        i += count;
    }
}
