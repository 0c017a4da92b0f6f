// The stream of (node, triangle) pairs and how work-items share it.
//
// A stream's length lives on the device; launches have a fixed number of work-items, CHUNKS, each of
// which takes one contiguous chunk of the stream. So nothing is read back between stages, and the
// order of a stream never depends on timing.
//
// Build-time constant: CHUNKS.

#include "common.h"

typedef uint2 Pair; // x: node, y: triangle

// Counts of one level, added to by `scan_chunks`.
#define LEVEL_TESTS 0
#define LEVEL_HITS 1
#define LEVEL_STREAM 2 // length of the level's input stream
#define LEVEL_COUNTS 3

inline ulong chunk_length(ulong n) { return (n + CHUNKS - 1) / CHUNKS; }

inline ulong chunk_begin(ulong n) { return MIN(get_global_id(0) * chunk_length(n), n); }

inline ulong chunk_end(ulong n) { return MIN((get_global_id(0) + 1) * chunk_length(n), n); }
