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

#ifdef COMPRESS16

#if ARITY == 4
#define NODES(p) p->s0000222244446666
#define TRIANGLES(p) p->s1111333355557777
#define LANES (uint16)(0, 1, 2, 3, 0, 1, 2, 3, 0, 1, 2, 3, 0, 1, 2, 3)
typedef uint8 PairGroup;
#elif ARITY == 8
#define NODES(p) (uint16)(p->s00000000, p->s22222222)
#define TRIANGLES(p) (uint16)(p->s11111111, p->s33333333)
#define LANES (uint16)(0, 1, 2, 3, 4, 5, 6, 7, 0, 1, 2, 3, 4, 5, 6, 7)
typedef uint4 PairGroup;
#else
#define NODES(p) (uint16)(p->x)
#define TRIANGLES(p) (uint16)(p->y)
#define LANES (uint16)(0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15)
typedef uint2 PairGroup;
#endif

// The surviving children of a group to out[0 ..], and whatever to the rest of sixteen places.
inline void write_group(global const PairGroup *group, uint mask, global uint16 *out)
{
    const uint16 n = COMPRESS16(NODES(group) * ARITY + LANES, mask);
    const uint16 t = COMPRESS16(TRIANGLES(group), mask);
    typedef uint16 Unaligned __attribute__((aligned(8)));
    global Unaligned *to = (global Unaligned *)out;
    to[0] = (uint16)(n.s0, t.s0, n.s1, t.s1, n.s2, t.s2, n.s3, t.s3, n.s4, t.s4, n.s5, t.s5, n.s6,
                     t.s6, n.s7, t.s7);
    if (COUNT16(mask) > 8)
        to[1] = (uint16)(n.s8, t.s8, n.s9, t.s9, n.sa, t.sa, n.sb, t.sb, n.sc, t.sc, n.sd, t.sd,
                         n.se, t.se, n.sf, t.sf);
}

#endif

// Survivor (member k, child) of a group becomes (node of k * ARITY + child, triangle of k).
kernel void scatter_children(global const uint *restrict in_length, global const Pair *restrict in,
                             global const ushort *restrict masks,
                             global const uint *restrict offsets,
                             global const uint *restrict chunk_hits,
                             global const uint *restrict out_length, global Pair *restrict out)
{
    if (*out_length == 0)
        return;
    const uint n = *in_length;
    uint next = offsets[get_global_id(0)];
    const uint stop = next + chunk_hits[get_global_id(0)];
    for (uint i = chunk_begin(n, GROUP), end = chunk_end(n, GROUP); i < end; i += GROUP) {
        uint mask = masks[i / GROUP];
#ifdef COMPRESS16
        // Sixteen places are written, so near the next chunk's survivors it goes one by one.
        if (next + 16 <= stop) {
            write_group((global const PairGroup *)(in + i), mask, (global uint16 *)(out + next));
            next += COUNT16(mask);
            continue;
        }
#endif
        for (uint bit = 0; mask != 0; bit++, mask >>= 1) {
            if (mask & 1u) {
                const Pair pair = in[i + bit / ARITY];
                out[next++] = (Pair)(pair.x * ARITY + bit % ARITY, pair.y);
            }
        }
    }
}
