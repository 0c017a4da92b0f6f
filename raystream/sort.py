"""Stable radix sort on CPU devices (cl/sort.cl); GPUs take `groups`."""

import dataclasses

import numpy as np
import pyopencl.array as cla

from raystream.statistics import STREAM_REDUCTION

# The 256 lines being written fit a core's first cache (measured against 10 to 12 bits). Beyond the
# last cache three buffered passes of 11 bits win: 170 M pairs/s at 16 M, four of 8 bits 150, not
# buffered 85.
_DIGIT_BITS, _BUFFERED_DIGIT_BITS = 8, 11
_LINE = 16  # cl/sort.cl
_CHUNKS_PER_UNIT = 2
_TYPES = {4: "uint", 8: "ulong"}


def sort_by_key(
    session, keys, values, bits, length=None, digit_bits=_DIGIT_BITS, keep_keys=True
):
    """Keys in ascending order by their lowest `bits` bits, and values in the order of their keys.

    Parameters
    ----------
    session : raystream.device.Session
    keys : Array of shape (n,) uint32 or uint64
    values : Array of shape (n,), 4 or 8 bytes an element, or None
    bits : int
    length : Array of shape (1,) uint32, optional
        How many elements there are, where only the device knows: the first `length` are sorted,
        the rest of the result means nothing. Default: all n.
    keep_keys : bool
        Whether the sorted keys are asked for; a store less for each pair where they are not.
    digit_bits : int
        Of a pass, where the keys fit the cache. 12 are faster than 8 where keys near each other
        in the stream are close, half as fast where they are not.

    Returns
    -------
    keys, values : Array
        New arrays, stable; values None where there were none, keys None where not asked for.
    """
    nbytes = keys.nbytes + (0 if values is None else values.nbytes)
    buffered = session.exceeds_cache(nbytes)
    passes = -(-bits // (_BUFFERED_DIGIT_BITS if buffered else digit_bits))
    if passes == 0 or keys.size == 0:
        arrays = keys if keep_keys else None, values
        return [None if array is None else array.copy() for array in arrays]
    if length is None:
        length = session.empty(1, np.uint32)
        session.fill(STREAM_REDUCTION, length, keys.size)
    source = _Elements(keys, values)
    run = _Passes(session, source, length, bits, -(-bits // passes), buffered)
    for step in range(passes):
        last = step == passes - 1
        source = run.scatter(source, step, last, keep_keys or not last)
    return source.keys if keep_keys else None, source.values


@dataclasses.dataclass
class _Elements:
    """Keys and values of a pass: apart, or packed in words of 64 bits."""

    keys: cla.Array = None
    values: cla.Array = None
    packed: cla.Array = None


class _Passes:
    def __init__(self, session, elements, length, bits, digit_bits, buffered):
        self.session, self.bits, self.digit_bits = session, bits, digit_bits
        self.length = length
        self.keys, self.values = elements.keys, elements.values
        self.chunks = _CHUNKS_PER_UNIT * session.device.max_compute_units
        self.counts = session.empty(self.chunks << digit_bits, np.uint32)
        self.lines = self._apart((self.chunks * _LINE) << digit_bits) if buffered else None
        # Packed words hold a 32-bit key and a 32-bit value.
        pair = (
            self.values is not None and self.keys.dtype.itemsize == self.values.dtype.itemsize == 4
        )
        self.packs = pair and not buffered

    def _apart(self, count):
        """Uninitialised arrays like those to sort."""
        arrays = (self.keys, self.values)
        return _Elements(*(a if a is None else self.session.empty(count, a.dtype) for a in arrays))

    def scatter(self, source, step, last, keep_keys):
        """One pass: `source` in the order of digit `step`."""
        count, shift = self.keys.size, np.uint32(step * self.digit_bits)
        if self.packs and not last:
            target = _Elements(packed=self.session.empty((count, 2), np.uint32))
        else:
            target = self._apart(count)
            if self.packs and not keep_keys:
                target.keys = None
        kernels = self._kernels(source, target, step)
        length, counts = self.length, self.counts

        def launch(kernel, size, *args):
            self.session.launch(STREAM_REDUCTION, kernels[kernel], size, *args)

        launch("count_digits", self.chunks, length, shift, source.keys, source.packed, counts)
        launch("scan_digits", 1, counts)
        sources, targets = (source.keys, source.values), (target.keys, target.values)
        if self.lines is None:
            args = *sources, source.packed, counts, *targets, target.packed
            launch("scatter_digits", self.chunks, length, shift, *args)
        else:
            args = *sources, counts, self.lines.keys, self.lines.values, *targets
            launch("scatter_lines", self.chunks, length, shift, *args)
        return target

    def _kernels(self, source, target, step):
        # The last digit may be narrower: bits above `bits` must not take part.
        width = min(self.digit_bits, self.bits - step * self.digit_bits)
        defines = {
            "CHUNKS": self.chunks,
            "DIGITS": 1 << width,
            "KEY": _TYPES[self.keys.dtype.itemsize],
        }
        if self.values is None:
            defines |= {"VALUE": "uint", "KEYS_ALONE": 1}
        else:
            defines["VALUE"] = _TYPES[self.values.dtype.itemsize]
        if source.packed is not None:
            defines["FROM_PACKED"] = 1
        if target.packed is not None:
            defines["TO_PACKED"] = 1
        elif target.keys is None:
            defines["VALUES_ALONE"] = 1
        return self.session.kernels("sort.cl", **defines)
