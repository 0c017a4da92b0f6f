// Scan, stream reduction and radix sort by work-groups with local memory and barriers: for GPUs.
//
// A work-group takes a tile of GROUP * ITEMS consecutive elements, each work-item ITEMS of them. A
// first kernel sums every tile; the sums are scanned by the same kernels, which the host calls
// recursively, so any length is done; a second kernel takes each tile again and starts from the sum
// of all tiles before it. No array of the stream's length is made in between.
// - Scan within a group: Blelloch's balanced tree, swept up and down (Sengupta, Harris, Zhang,
//   Owens 2007, "Scan primitives for GPU computing").
// - Tiles of several elements per work-item, summed first and scanned after: Merrill and Grimshaw
//   2009, "Parallel scan for stream architectures".
// - Stable radix sort with the digit counts of all tiles scanned digit by digit: Satish, Harris,
//   Garland 2009, "Designing efficient sorting algorithms for manycore GPUs".
//
// Build-time constants: GROUP, work-items of a group, a power of two; ITEMS; those of one section:
//   scan                TYPE, what is summed, and SEGMENTED, 0 or 1
//   stream reduction    ELEMENT, an unsigned type of an element's size
//   radix sort          KEY, VALUE, unsigned types of their sizes
//
// Invariants: every work-item of a group reaches every barrier. The last tile of a stream may be
// partly filled: what lies past its end counts for nothing and is not written. Sums are joined by
// the same tree each time, so those of floats do not change from run to run.

#ifdef ELEMENT
#define TYPE uint
#elif defined(KEY)
#define DIGITS 16
#define TYPE ushort16 // a count per digit; a tile has fewer than 65,536 elements
#endif

// Before each kernel: lets the compiler give every work-item its share of the registers.
#define IN_GROUPS __attribute__((reqd_work_group_size(GROUP, 1, 1)))

// The sum of consecutive elements; in a segmented scan from the last head among them on.
typedef struct {
    TYPE sum;
#if SEGMENTED
    uint head; // 1 where a segment begins among the elements
#endif
} Partial;

// Of elements a and of the elements b that follow them.
inline Partial join(Partial a, Partial b)
{
#if SEGMENTED
    b.sum = b.head ? b.sum : a.sum + b.sum;
    b.head |= a.head;
#else
    b.sum += a.sum;
#endif
    return b;
}

// A sum in which no segment begins.
inline Partial partial(TYPE sum)
{
    Partial p;
    p.sum = sum;
#if SEGMENTED
    p.head = 0;
#endif
    return p;
}

// The up-sweep. tree[GROUP + i] is the leaf of work-item i, tree[p] the join of tree[2p] and
// tree[2p + 1]; so tree[1] is the sum of the tile.
inline void sum_tree(local Partial *tree, Partial leaf)
{
    const uint i = get_local_id(0);
    tree[GROUP + i] = leaf;
    for (uint width = GROUP / 2; width > 0; width /= 2) {
        barrier(CLK_LOCAL_MEM_FENCE);
        if (i < width)
            tree[width + i] = join(tree[2 * (width + i)], tree[2 * (width + i) + 1]);
    }
    barrier(CLK_LOCAL_MEM_FENCE);
}

// The up-sweep and the down-sweep. Returns the join of `before`, which is the same in all
// work-items and precedes the tile, with the leaves before this work-item's; so does
// tree[GROUP + i] for every work-item i.
inline Partial scan_tree(local Partial *tree, Partial leaf, Partial before)
{
    const uint i = get_local_id(0);
    sum_tree(tree, leaf);
    if (i == 0)
        tree[1] = before;
    for (uint width = 1; width < GROUP; width *= 2) {
        barrier(CLK_LOCAL_MEM_FENCE);
        if (i < width) {
            const Partial above = tree[width + i];
            const Partial left = tree[2 * (width + i)];
            tree[2 * (width + i)] = above;
            tree[2 * (width + i) + 1] = join(above, left);
        }
    }
    barrier(CLK_LOCAL_MEM_FENCE);
    return tree[GROUP + i];
}

#if defined(ELEMENT)

inline uint count_of_item(size_t first, uint n, global const uchar *keep)
{
    uint count = 0;
    for (uint k = 0; k < ITEMS; k++)
        count += first + k < n && keep[first + k] != 0;
    return count;
}

// counts[g] = elements of tile g with a nonzero keep. One group per tile.
IN_GROUPS
kernel void count_kept(const uint n, global const uchar *restrict keep,
                       global uint *restrict counts)
{
    local Partial tree[2 * GROUP];
    sum_tree(tree, partial(count_of_item(get_global_id(0) * ITEMS, n, keep)));
    if (get_local_id(0) == 0)
        counts[get_group_id(0)] = tree[1].sum;
}

// The kept elements to their places in `out`, in order; *count = how many they are. One group per
// tile; ends[g] = elements kept in tiles 0 to g, needed for all but the last tile.
IN_GROUPS
kernel void write_kept(const uint n, global const ELEMENT *restrict values,
                       global const uchar *restrict keep, global const uint *restrict ends,
                       global ELEMENT *restrict out, global uint *restrict count)
{
    local Partial tree[2 * GROUP];
    const size_t g = get_group_id(0), first = get_global_id(0) * ITEMS;
    const uint kept = count_of_item(first, n, keep);
    uint place = scan_tree(tree, partial(kept), partial(g > 0 ? ends[g - 1] : 0)).sum;
    if (get_global_id(0) == get_global_size(0) - 1)
        *count = place + kept;
    for (uint k = 0; k < ITEMS; k++) {
        if (first + k < n && keep[first + k] != 0)
            out[place++] = values[first + k];
    }
}

#elif defined(KEY)

// Digit of key i, DIGITS past the end of the keys.
inline uint digit_at(size_t i, uint n, global const KEY *keys, uint shift, uint mask)
{
    return i < n ? (uint)(keys[i] >> shift) & mask : DIGITS;
}

// 1 at the digit, all zero for DIGITS.
inline ushort16 one_at(uint digit)
{
    const ushort16 digits = (ushort16)(0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15);
    return as_ushort16(digits == (ushort16)(digit)) & (ushort16)(1);
}

inline ushort16 counts_of_item(size_t first, uint n, global const KEY *keys, uint shift, uint mask)
{
    ushort16 counts = 0;
    for (uint k = 0; k < ITEMS; k++)
        counts += one_at(digit_at(first + k, n, keys, shift, mask));
    return counts;
}

// counts[d * tiles + g] = keys of tile g whose digit, (key >> shift) & mask, is d. One group per
// tile.
IN_GROUPS
kernel void count_digits(const uint n, const uint shift, const uint mask,
                         global const KEY *restrict keys, global uint *restrict counts)
{
    local Partial tree[2 * GROUP];
    const size_t first = get_global_id(0) * ITEMS;
    sum_tree(tree, partial(counts_of_item(first, n, keys, shift, mask)));
    local const ushort *of_digit = (local const ushort *)&tree[1];
    for (uint d = get_local_id(0); d < DIGITS; d += GROUP)
        counts[d * get_num_groups(0) + get_group_id(0)] = of_digit[d];
}

// Every key, and its value where has_values is 1, to its place by this digit; equal digits keep
// their order. One group per tile; begins is the exclusive scan of `counts` of count_digits.
IN_GROUPS
kernel void scatter_digits(const uint n, const uint shift, const uint mask, const uint has_values,
                           global const KEY *restrict keys, global const VALUE *restrict values,
                           global const uint *restrict begins, global KEY *restrict out_keys,
                           global VALUE *restrict out_values)
{
    local Partial tree[2 * GROUP];
    const size_t first = get_global_id(0) * ITEMS;
    const Partial own = partial(counts_of_item(first, n, keys, shift, mask));
    scan_tree(tree, own, partial(0));
    // Per digit the number of keys before this one in the tile; only this work-item touches it now.
    local ushort *ranks = (local ushort *)&tree[GROUP + get_local_id(0)];
    for (uint k = 0; k < ITEMS; k++) {
        const uint digit = digit_at(first + k, n, keys, shift, mask);
        if (digit < DIGITS) {
            const uint place = begins[digit * get_num_groups(0) + get_group_id(0)] + ranks[digit]++;
            out_keys[place] = keys[first + k];
            if (has_values)
                out_values[place] = values[first + k];
        }
    }
}

#else

// Element i, zero past the end. Without SEGMENTED heads is not read.
inline Partial load(size_t i, uint n, global const TYPE *values, global const uchar *heads)
{
    Partial p = partial(i < n ? values[i] : 0);
#if SEGMENTED
    p.head = i < n && heads[i] != 0;
#endif
    return p;
}

// A work-item's elements; returns their sum.
inline Partial load_item(size_t first, uint n, global const TYPE *values, global const uchar *heads,
                         Partial *elements)
{
    Partial sum = elements[0] = load(first, n, values, heads);
    for (uint k = 1; k < ITEMS; k++) {
        elements[k] = load(first + k, n, values, heads);
        sum = join(sum, elements[k]);
    }
    return sum;
}

// The sum of each tile, and in tile_heads whether a segment begins in it. One group per tile.
IN_GROUPS
kernel void sum_tiles(const uint n, global const TYPE *restrict values,
                      global const uchar *restrict heads, global TYPE *restrict sums,
                      global uchar *restrict tile_heads)
{
    local Partial tree[2 * GROUP];
    Partial elements[ITEMS];
    sum_tree(tree, load_item(get_global_id(0) * ITEMS, n, values, heads, elements));
    if (get_local_id(0) == 0) {
        sums[get_group_id(0)] = tree[1].sum;
#if SEGMENTED
        tile_heads[get_group_id(0)] = (uchar)tree[1].head;
#endif
    }
}

// The scan, inclusive or not. One group per tile; ends is the inclusive scan of the sums of the
// tiles, needed for all but the last. `out` may be `values`: a group reads its own tile alone, all
// of it before it writes.
IN_GROUPS
kernel void scan_tiles(const uint n, const uint inclusive, global const TYPE *values,
                       global const uchar *restrict heads, global const TYPE *restrict ends,
                       global TYPE *out)
{
    local Partial tree[2 * GROUP];
    const size_t g = get_group_id(0), first = get_global_id(0) * ITEMS;
    const Partial before = partial(g > 0 ? ends[g - 1] : 0);
    Partial elements[ITEMS];
    Partial sum = scan_tree(tree, load_item(first, n, values, heads, elements), before);
    for (uint k = 0; k < ITEMS; k++) {
        TYPE exclusive = sum.sum;
#if SEGMENTED
        exclusive = elements[k].head ? 0 : exclusive;
#endif
        sum = join(sum, elements[k]);
        if (first + k < n)
            out[first + k] = inclusive ? sum.sum : exclusive;
    }
}

#endif
