"""Sum scans on CPU devices (cl/scan.cl); GPUs take `groups`."""

import numpy as np

from raystream.statistics import STREAM_REDUCTION

# OpenCL types of the values that can be scanned.
TYPES = {"uint32": "uint", "int32": "int", "uint64": "ulong", "int64": "long", "float32": "float"}
_CHUNKS_PER_UNIT = 32


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
    if session.exceeds_cache(2 * values.nbytes):
        defines["STREAMING"] = 1
    kernels = session.kernels("scan.cl", **defines)
    n, sums = np.uint64(count), session.empty(chunks, values.dtype)

    def launch(kernel, size, *args):
        session.launch(STREAM_REDUCTION, kernels[kernel], size, *args)

    if heads is None:
        launch("sum_chunks", chunks, n, values, sums)
        launch("scan_sums", 1, sums)
        launch("scan_chunks", chunks, n, values, sums, np.uint32(inclusive), out)
    else:
        has_head = session.empty(chunks, np.uint8)
        launch("sum_segments", chunks, n, values, heads, sums, has_head)
        launch("scan_segment_sums", 1, sums, has_head)
        launch("scan_segments", chunks, n, values, heads, sums, np.uint32(inclusive), out)
