"""Scan, stream reduction and radix sort by work-groups with barriers, for GPUs (cl/groups.cl).

Correct on every device, but many times slower than fat work-items on a CPU. All arrays are
contiguous device arrays without an offset, of at most 2**32 - 1 elements; nothing is read back.
"""

import math

import numpy as np

from raystream.checks import check_choice
from raystream.statistics import STREAM_REDUCTION

GROUP = 256  # work-items of a group, a power of two; fewer where the device does not allow it
ITEMS = 4  # consecutive elements per work-item: 16 bytes of most types
_DIGIT_BITS = 4
_DIGITS = 1 << _DIGIT_BITS

# Two's complement sums are those of the unsigned type, which may overflow.
_SUM_TYPES = {
    "uint32": "uint",
    "int32": "uint",
    "uint64": "ulong",
    "int64": "ulong",
    "float32": "float",
}
_KEY_TYPES = {"uint32": "uint", "uint64": "ulong"}
_ELEMENTS = {4: "uint", 8: "uint2", 16: "uint4"}  # by bytes
_VALUES = {4: "uint", 8: "uint2"}


def scan(session, values, out, inclusive=False, heads=None):
    """Running sums of `values`, of the whole stream or of each of its segments.

    Parameters
    ----------
    session : raystream.device.Session
    values : Array of shape (n,) uint32, int32, uint64, int64 or float32
        Integers wrap around.
    out : Array of shape (n,) of the dtype of `values`
        May be `values`.
    inclusive : bool
        Whether the sum at an element includes it.
    heads : Array of shape (n,) uint8, optional
        Nonzero where a segment begins: the sum starts anew there.
    """
    check_choice("values: dtype", values.dtype.name, _SUM_TYPES)
    n = len(values)
    if n == 0:
        return
    segmented = heads is not None
    kernels = _kernels(session, TYPE=_SUM_TYPES[values.dtype.name], SEGMENTED=int(segmented))
    tiles = _num_tiles(session, n)
    # No tile follows the last one: it needs no sum. A single tile ends the recursion.
    sums = session.empty(tiles - 1, values.dtype)
    tile_heads = session.empty(tiles - 1 if segmented else 0, np.uint8)
    heads = heads if segmented else session.empty(0, np.uint8)
    n = np.uint32(n)
    _launch(session, kernels["sum_tiles"], tiles - 1, n, values, heads, sums, tile_heads)
    scan(session, sums, sums, inclusive=True, heads=tile_heads if segmented else None)
    inclusive = np.uint32(inclusive)
    _launch(session, kernels["scan_tiles"], tiles, n, inclusive, values, heads, sums, out)


def reduce(session, values, keep, out, count):
    """The elements of `values` that are kept, in order.

    Parameters
    ----------
    session : raystream.device.Session
    values : Array of shape (n, ...)
        Elements, or rows, of 4, 8 or 16 bytes.
    keep : Array of shape (n,) uint8
        Nonzero for an element that is kept.
    out : Array of the shape and dtype of `values`, not `values` itself
        Only its first `count` elements are written.
    count : Array of shape (1,) uint32
        The number of elements kept.
    """
    n, size = len(values), _element_bytes(values)
    check_choice("values: bytes per element", size, _ELEMENTS)
    if n == 0:
        session.fill(STREAM_REDUCTION, count, 0)
        return
    kernels = _kernels(session, ELEMENT=_ELEMENTS[size])
    tiles = _num_tiles(session, n)
    ends = session.empty(tiles - 1, np.uint32)
    n = np.uint32(n)
    _launch(session, kernels["count_kept"], tiles - 1, n, keep, ends)
    scan(session, ends, ends, inclusive=True)
    _launch(session, kernels["write_kept"], tiles, n, values, keep, ends, out, count)


def sort_by_key(session, keys, values, bits):
    """Keys in ascending order of their lowest `bits` bits, and their values; equal keys in order.

    Parameters
    ----------
    session : raystream.device.Session
    keys : Array of shape (n,) uint32 or uint64
    values : Array of shape (n, ...), or None
        Elements, or rows, of 4 or 8 bytes.
    bits : int
        0 to the number of bits of a key; higher bits are carried along.

    Returns
    -------
    keys : Array of shape (n,)
    values : Array of shape (n, ...), or None
        New arrays; the inputs are not changed.
    """
    check_choice("keys: dtype", keys.dtype.name, _KEY_TYPES)
    has_values = values is not None
    values = values if has_values else session.empty(0, np.uint32)
    size = _element_bytes(values)
    check_choice("values: bytes per element", size, _VALUES)
    kernels = _kernels(session, KEY=_KEY_TYPES[keys.dtype.name], VALUE=_VALUES[size])
    tiles = _num_tiles(session, len(keys))
    counts = session.empty(_DIGITS * tiles, np.uint32)
    target, spare = [
        (session.empty(keys.shape, keys.dtype), session.empty(values.shape, values.dtype))
        for _ in range(2)
    ]
    source = (keys, values)
    for shift in range(0, max(bits, 1), _DIGIT_BITS):  # 0 bits: one pass that copies
        mask = (1 << min(_DIGIT_BITS, bits - shift)) - 1
        digit = (np.uint32(len(keys)), np.uint32(shift), np.uint32(mask))
        _launch(session, kernels["count_digits"], tiles, *digit, source[0], counts)
        scan(session, counts, counts)
        _launch(
            session,
            kernels["scatter_digits"],
            tiles,
            *digit,
            np.uint32(has_values),
            *source,
            counts,
            *target,
        )
        source, target, spare = target, spare, target
    return source[0], source[1] if has_values else None


def _group(session):
    """Work-items of a group: a power of two."""
    return min(GROUP, 1 << (session.device.max_work_group_size.bit_length() - 1))


def _num_tiles(session, n):
    return -(-n // (_group(session) * ITEMS))


def _kernels(session, **defines):
    return session.kernels("groups.cl", GROUP=_group(session), ITEMS=ITEMS, **defines)


def _launch(session, kernel, groups, *args):
    group = _group(session)
    session.launch(STREAM_REDUCTION, kernel, groups * group, *args, local=group)


def _element_bytes(array):
    """Bytes of an element of a 1D array, of a row of another."""
    return array.dtype.itemsize * math.prod(array.shape[1:])
