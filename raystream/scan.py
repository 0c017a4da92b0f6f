"""Sum scans on CPU devices (cl/scan.cl); GPUs take `groups`."""

import numpy as np

from raystream.statistics import STREAM_REDUCTION

# OpenCL types of the values that can be scanned.
TYPES = {"uint32": "uint", "int32": "int", "uint64": "ulong", "int64": "long", "float32": "float"}
_CHUNKS_PER_UNIT = 32
_CACHE_SHARE = 2  # a block takes this part of the cache; measured against 1 to 32


def scan(session, values, out, inclusive=False, heads=None):
    """Sums of all values before each (and with it, where `inclusive`).

    Parameters
    ----------
    session : raystream.device.Session
    values, out : Array of shape (n,)
        Of one of `TYPES`; `out` may be `values`.
    inclusive : bool
    heads : Array of shape (n,) uint8, optional
        The sums start anew where it is not 0.
    """
    count = values.shape[0]
    chunks = _CHUNKS_PER_UNIT * session.device.max_compute_units
    defines = {"TYPE": TYPES[values.dtype.name], "CHUNKS": chunks}
    if values.dtype.kind in "iu" and values.dtype.itemsize == 4:
        defines["VECTOR"] = 1
    kernels = session.kernels("scan.cl", **defines)
    sums, carry = session.empty(chunks, values.dtype), session.empty(1, values.dtype)
    session.fill(STREAM_REDUCTION, carry, 0)

    def launch(kernel, size, *args):
        session.launch(STREAM_REDUCTION, kernels[kernel], size, *args)

    has_head = session.empty(chunks, np.uint8)
    block = _block_length(session, values.dtype.itemsize)
    for first in range(0, count, block):
        part = np.uint64(first), np.uint64(min(block, count - first))
        if heads is None:
            launch("sum_chunks", chunks, *part, values, sums)
            launch("scan_sums", 1, sums, carry)
            launch("scan_chunks", chunks, *part, values, sums, np.uint32(inclusive), out)
        else:
            launch("sum_segments", chunks, *part, values, heads, sums, has_head)
            launch("scan_segment_sums", 1, sums, has_head, carry)
            launch("scan_segments", chunks, *part, values, heads, sums, np.uint32(inclusive), out)


def _block_length(session, itemsize):
    return max(1 << 16, session.device.global_mem_cache_size // (_CACHE_SHARE * itemsize))
