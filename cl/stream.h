// The stream of (node, triangle) pairs and how work-items share it.
//
// A stream's length lives on the device; launches have a fixed number of work-items, CHUNKS, each of
// which takes one contiguous chunk of the stream. So nothing is read back between stages, and the
// order of a stream never depends on timing.
//
// A pass handles GROUP pairs at a time, whose GROUP * ARITY children fill sixteen lanes; chunks are
// whole groups. Survivors of a pass are a 16-bit mask per group: bit GROUP-member * ARITY + child.
//
// Build-time constants: CHUNKS, ARITY.

#include "common.h"

typedef uint2 Pair; // x: node, y: triangle
#define GROUP (16 / ARITY)

// Counts of one level, added to by `scan_chunks`.
#define LEVEL_TESTS 0
#define LEVEL_HITS 1
#define LEVEL_STREAM 2 // length of the level's input stream
#define LEVEL_COUNTS 3

// Chunk of this work-item in a stream of n elements taken `unit` at a time: first and last + 1.
inline ulong chunk_begin(ulong n, uint unit)
{
    const ulong length = (n + (ulong)CHUNKS * unit - 1) / ((ulong)CHUNKS * unit) * unit;
    return MIN(get_global_id(0) * length, n);
}

inline ulong chunk_end(ulong n, uint unit)
{
    const ulong length = (n + (ulong)CHUNKS * unit - 1) / ((ulong)CHUNKS * unit) * unit;
    return MIN((get_global_id(0) + 1) * length, n);
}
