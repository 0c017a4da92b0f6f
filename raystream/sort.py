"""Stable radix sort on CPU devices (cl/sort.cl); GPUs take `groups`."""

import numpy as np

from raystream.statistics import STREAM_REDUCTION

_MOST_DIGIT_BITS = 8  # 256 lines being written fit a core's first cache; measured against 10 to 12
_CHUNKS_PER_UNIT = 4
_KEY_TYPES = {4: "uint", 8: "ulong"}


def sort_by_key(session, keys, values, bits):
    """Keys in ascending order by their lowest `bits` bits, and values in the order of their keys.

    Parameters
    ----------
    session : raystream.device.Session
    keys : Array of shape (n,) uint32 or uint64
    values : Array of shape (n,), 4 or 8 bytes an element, or None
    bits : int

    Returns
    -------
    keys, values : Array
        New arrays, stable; values None where there were none.
    """
    return _Sort(session, keys, values).run(bits)


class _Sort:
    def __init__(self, session, keys, values):
        self.session, self.count = session, keys.shape[0]
        self.chunks = _CHUNKS_PER_UNIT * session.device.max_compute_units
        # Packed words hold a 32-bit key and a 32-bit value.
        self.packs = values is not None and keys.dtype.itemsize == values.dtype.itemsize == 4
        self.keys, self.values = keys, values

    def run(self, bits):
        """One pass per digit."""
        passes = -(-bits // _MOST_DIGIT_BITS)
        if passes == 0 or self.count == 0:
            return self._copies()
        digit_bits = -(-bits // passes)
        counts = self.session.empty(self.chunks << digit_bits, np.uint32)
        source = _Elements(self.keys, self.values, None)
        for step in range(passes):
            # The last digit may be narrower: bits above `bits` must not take part.
            width = min(digit_bits, bits - step * digit_bits)
            target = self._target(packed=self.packs and step < passes - 1)
            self._pass(source, target, np.uint32(step * digit_bits), width, counts)
            source = target
        return source.keys, source.values

    def _copies(self):
        return [None if array is None else array.copy() for array in (self.keys, self.values)]

    def _target(self, packed):
        if packed:
            return _Elements(None, None, self.session.empty((self.count, 2), np.uint32))
        keys = self.session.empty(self.count, self.keys.dtype)
        if self.values is None:
            return _Elements(keys, None, None)
        return _Elements(keys, self.session.empty(self.count, self.values.dtype), None)

    def _pass(self, source, target, shift, width, counts):
        kernels = self._kernels(source, target, width)
        count = np.uint64(self.count)
        unused = counts  # stands for an array that the pass does not touch

        def launch(kernel, size, *args):
            self.session.launch(STREAM_REDUCTION, kernels[kernel], size, *args)

        keys_in, packed_in = source.keys_or(unused), source.packed_or(unused)
        launch("count_digits", self.chunks, count, shift, keys_in, packed_in, counts)
        launch("scan_digits", 1, counts)
        launch(
            "scatter_digits",
            self.chunks,
            count,
            shift,
            keys_in,
            *source.values_or(unused, self.values),
            packed_in,
            counts,
            target.keys_or(unused),
            *target.values_or(unused, self.values),
            target.packed_or(unused),
        )

    def _kernels(self, source, target, width):
        defines = {
            "KEY": _KEY_TYPES[self.keys.dtype.itemsize],
            "CHUNKS": self.chunks,
            "DIGITS": 1 << width,
        }
        if self.values is not None:
            defines["VALUE"] = _KEY_TYPES[self.values.dtype.itemsize]
        if source.packed is not None:
            defines["FROM_PACKED"] = 1
        if target.packed is not None:
            defines["TO_PACKED"] = 1
        return self.session.kernels("sort.cl", **defines)


class _Elements:
    """Keys and values of a pass, apart or packed."""

    def __init__(self, keys, values, packed):
        self.keys, self.values, self.packed = keys, values, packed

    def keys_or(self, unused):
        return unused if self.keys is None else self.keys

    def packed_or(self, unused):
        return unused if self.packed is None else self.packed

    def values_or(self, unused, wanted):
        """The kernel's value argument: none where keys are sorted alone."""
        if wanted is None:
            return []
        return [unused if self.values is None else self.values]
