// The stream of (node, triangle) pairs and how work-items share it.
//
// A stream's length lives on the device; launches have a fixed number of work-items, CHUNKS, each of
// which takes one contiguous chunk of the stream. So nothing is read back between stages, and the
// order of a stream never depends on timing.
//
// Streams are sorted by node as far as it matters for speed: within a chunk, pairs of one node stand
// together, a *run*. A run shares its node, so a pass works on one node and up to sixteen triangles at
// a time. Survivors of a pass are a mask per pair: bit c for child c.
//
// Build-time constant: CHUNKS.

#include "common.h"

typedef uint2 Pair; // x: node, y: triangle
#define WIDTH 16

typedef uchar Mask;

// Counts of one level, added to by `scan_chunks`.
#define LEVEL_TESTS 0
#define LEVEL_HITS 1
#define LEVEL_STREAM 2 // length of the level's input stream
#define LEVEL_COUNTS 3

#define NODES_OF(pairs)                                                                            \
    EVEN_LANES(LOAD_UNALIGNED(uint16, (global const uint *)(pairs)),                               \
               LOAD_UNALIGNED(uint16, (global const uint *)((pairs) + WIDTH / 2)))
#define TRIANGLES_OF(pairs)                                                                        \
    ODD_LANES(LOAD_UNALIGNED(uint16, (global const uint *)(pairs)),                                \
              LOAD_UNALIGNED(uint16, (global const uint *)((pairs) + WIDTH / 2)))

// Length of the run that begins at `first`. Reads up to WIDTH pairs more than `end`.
inline uint run_length(global const Pair *pairs, uint first, uint end)
{
    const uint node = pairs[first].x;
    for (uint i = first; i < end; i += WIDTH) {
        const uint others = ~MASK16(NODES_OF(pairs + i) == node) & 0xffffu;
        if (others)
            return MIN(i + LOWEST(others), end) - first;
    }
    return end - first;
}
