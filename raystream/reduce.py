"""Stream reduction on CPU devices (cl/reduce.cl); GPUs take `groups`."""

import numpy as np

from raystream.statistics import STREAM_REDUCTION

METHODS = ("segmented", "scan", "horn", "append")
ELEMENTS = {4: "uint", 8: "uint2", 16: "uint4"}
SEGMENT_SIZE = 4096  # measured best; 64 in the paper
_CHUNKS_PER_UNIT = 32
_APPEND_BLOCK = 16384  # cl/reduce.cl


class Reducer:
    """The kernels for one element size, and the small arrays that they share.

    Parameters
    ----------
    session : raystream.device.Session
    element_bytes : {4, 8, 16}
    """

    def __init__(self, session, element_bytes):
        self.session = session
        self._chunks = _CHUNKS_PER_UNIT * session.device.max_compute_units
        self._kernels = session.kernels(
            "reduce.cl",
            ELEMENT=ELEMENTS[element_bytes],
            BYTES=element_bytes,
            CHUNKS=self._chunks,
        )
        self._offsets = session.empty(self._chunks + 1, np.uint64)

    def reduce(self, method, count, values, keep, out, total, segment_size, scratch=None):
        """Survivors among the first `count` values to the front of `out`, their number to `total`.

        Parameters
        ----------
        method : str
            One of `METHODS`.
        count : int
        values, out : Array of at least `count` elements
        keep : Array of at least `count` uint8
        total : Array of shape (1,) uint32
        segment_size : int
            For "segmented".
        scratch : Array like `values`, optional
            Room for the segments of "segmented"; allocated where it is not given.
        """
        if count == 0:
            self.session.fill(STREAM_REDUCTION, total, 0)
        elif method == "segmented":
            if scratch is None:
                scratch = self.session.empty(values.shape, values.dtype)
            lengths = self.session.empty(-(-count // segment_size), np.uint32)
            self.segments(count, values, keep, scratch, lengths, segment_size)
            self._launch("scan_counts", 1, self._offsets, total)
            sizes = np.uint64(count), np.uint64(segment_size)
            self._launch("concatenate", self._chunks, *sizes, scratch, lengths, self._offsets, out)
        elif method == "scan":
            self.scan(count, keep, total, (values, out))
        elif method == "horn":
            self._horn(np.uint64(count), values, keep, out, total)
        else:
            self.session.fill(STREAM_REDUCTION, total, 0)
            blocks = -(-count // _APPEND_BLOCK)
            self._launch("append_kept", blocks, np.uint64(count), values, keep, out, total)

    def scan(self, count, keep, total, *pairs):
        """Reduction "scan" of several (values, out) by the same flags, which are counted once."""
        n = np.uint64(count)
        self._launch("count_kept", self._chunks, n, keep, self._offsets)
        self._launch("scan_counts", 1, self._offsets, total)
        for values, out in pairs:
            self._launch("write_kept", self._chunks, n, values, keep, self._offsets, out)

    def segments(self, count, values, keep, segments, lengths, segment_size):
        """Each segment reduced alone: survivors of segment s from place s * segment_size on."""
        sizes = np.uint64(count), np.uint64(segment_size)
        arrays = values, keep, segments, lengths, self._offsets
        self._launch("reduce_segments", self._chunks, *sizes, *arrays)

    def _horn(self, count, values, keep, out, total):
        sums, other = (self.session.empty(int(count), np.uint32) for _ in range(2))
        self._launch("count_rejected", self._chunks, count, keep, sums)
        distance = 1
        while distance < count:
            self._launch("add_distant", self._chunks, count, np.uint64(distance), sums, other)
            sums, other = other, sums
            distance *= 2
        self._launch("gather_kept", self._chunks, count, values, sums, out, total)

    def _launch(self, kernel, size, *args):
        self.session.launch(STREAM_REDUCTION, self._kernels[kernel], size, *args)
