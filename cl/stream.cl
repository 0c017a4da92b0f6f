// Stream reduction: the hierarchical, segmented method (Roger et al. 2007, section 4.1).
//
// The stream is cut into segments (here one chunk per work-item), each is reduced alone, and the
// results are concatenated. The producer has left a mask of survivors per element and the number of
// survivors per chunk; the exclusive scan of these numbers says where each chunk's survivors go, and
// they are written straight to their place, in order. Rejected elements are never written.
//
// Build-time constants: CHUNKS, ARITY.

#include "stream.h"

#if ARITY > 8
typedef ushort Mask;
#else
typedef uchar Mask;
#endif

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

// Survivor `lane` of pair (node, triangle) becomes (node * ARITY + lane, triangle).
kernel void scatter_children(global const uint *restrict in_length, global const Pair *restrict in,
                             global const Mask *restrict masks, global const uint *restrict offsets,
                             global const uint *restrict out_length, global Pair *restrict out)
{
    if (*out_length == 0)
        return;
    const uint n = *in_length;
    uint next = offsets[get_global_id(0)];
    for (uint i = chunk_begin(n), end = chunk_end(n); i < end; i++) {
        const Pair pair = in[i];
        const uint mask = masks[i];
        for (uint lane = 0; lane < ARITY; lane++) {
            if (mask & (1u << lane))
                out[next++] = (Pair)(pair.x * ARITY + lane, pair.y);
        }
    }
}
