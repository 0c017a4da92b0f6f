"""Stream primitives for anyone: reduction, scan and sort on OpenCL devices.

numpy arrays in, numpy arrays out; `pyopencl.array` arrays in, arrays of the same context out, and
nothing is read back. CPU devices take kernels whose work-items each walk a chunk of the stream,
other devices kernels of work-groups with local memory (`groups`).
"""

import numpy as np
import pyopencl as cl
import pyopencl.array as cla

from raystream import device as devices
from raystream import groups, scan, sort
from raystream.checks import check_choice, check_count
from raystream.reduce import ELEMENTS, METHODS, SEGMENT_SIZE, Reducer
from raystream.statistics import STREAM_REDUCTION

_MOST = 2**32 - 1  # elements: places are 32 bits, byte offsets 64


def reduce(values, keep, method="segmented", segment_size=None):
    """Keep some elements of a stream.

    Parameters
    ----------
    values : array of shape (n,) or (n, ...)
        Elements, along the first axis, of 4, 8 or 16 bytes: any dtype, structured ones and rows.
    keep : (n,) bool or uint8
        An element is kept where it is not 0.
    method : {"segmented", "scan", "horn", "append"}
        See cl/reduce.cl; all but "append" keep the order. Devices that are no CPU have one method,
        which keeps the order, for "segmented" and "scan".
    segment_size : int, optional
        Elements per segment of "segmented": 64 in the paper; default 4096, the fastest measured.

    Returns
    -------
    kept : array
        On the device of the shape of `values`; its first `count` elements are the survivors, the
        rest means nothing. A numpy array holds the survivors only.
    count : int, or pyopencl.array.Array of shape (1,) uint32
        On the device where the values are.

    Raises
    ------
    ValueError, TypeError
        Names the argument, what was wanted and what came.
    """
    check_choice("method", method, METHODS)
    size = _segment_size(segment_size)
    call = _Call(values=values, keep=keep)
    source, flags = call.words("values"), call.flags("keep", len(values))
    session = call.session
    out, total = session.empty(source.shape, source.dtype), session.empty(1, np.uint32)
    if _walks_chunks(session) or method in ("horn", "append"):
        reducer = Reducer(session, _element_bytes("values", values))
        reducer.reduce(method, len(values), source, flags, out, total, size)
    else:
        groups.reduce(session, source, flags, out, total)
    if call.on_device:
        return call.result(_like(out, values)), call.result(total)
    count = int(total.get()[0])
    return call.result(out).view(_dtype(values)).reshape(values.shape)[:count], count


def reduce_segments(values, keep, segment_size=None):
    """The first half of "segmented": every segment reduced alone and left in its place.

    For consumers that can read segments, which saves the concatenation. CPU devices only.

    Parameters
    ----------
    values, keep, segment_size
        As for `reduce`.

    Returns
    -------
    segments : array
        Of the shape of `values`; survivors of segment s begin at s * segment_size.
    lengths : array of shape (number of segments,) uint32
        How many they are.
    """
    size = _segment_size(segment_size)
    call = _Call(values=values, keep=keep)
    source, flags = call.words("values"), call.flags("keep", len(values))
    segments = call.session.empty(source.shape, source.dtype)
    lengths = call.session.empty(-(-len(values) // size), np.uint32)
    if len(values):
        reducer = Reducer(call.session, _element_bytes("values", values))
        reducer.segments(len(values), source, flags, segments, lengths, size)
    if call.on_device:
        return call.result(_like(segments, values)), call.result(lengths)
    host = call.result(segments).view(_dtype(values)).reshape(values.shape)
    return host, call.result(lengths)


def exclusive_scan(values, heads=None):
    """Sums of all values before each.

    Parameters
    ----------
    values : (n,) uint32, int32, uint64, int64 or float32
    heads : (n,) bool or uint8, optional
        The sums start anew at every element whose head flag is set.

    Returns
    -------
    (n,) array of the dtype of `values`
        Integers wrap around; float32 sums are rounded in an order of their own.

    Raises
    ------
    ValueError, TypeError
        Names the argument, what was wanted and what came.
    """
    return _scan(values, heads, inclusive=False)


def inclusive_scan(values, heads=None):
    """Sums of all values up to and with each; parameters and result as for `exclusive_scan`."""
    return _scan(values, heads, inclusive=True)


def _scan(values, heads, inclusive):
    named = {"values": values} if heads is None else {"values": values, "heads": heads}
    call = _Call(**named)
    source = call.vector("values", tuple(scan.TYPES))
    flags = None if heads is None else call.flags("heads", len(values))
    out = call.session.empty(source.shape, source.dtype)
    design = scan.scan if _walks_chunks(call.session) else groups.scan
    design(call.session, source, out, inclusive, flags)
    return call.result(out)


def sort_by_key(keys, values=None, bits=None):
    """Sort by key, stable and ascending.

    Parameters
    ----------
    keys : (n,) uint32 or uint64
    values : (n,), 4 or 8 bytes an element, optional
        Put into the order of their keys.
    bits : int, optional
        Only the lowest `bits` bits of the keys count; default: all.

    Returns
    -------
    keys, values : array
        New arrays; `values` is None where none were given.

    Raises
    ------
    ValueError, TypeError
        Names the argument, what was wanted and what came.
    """
    call = _Call(keys=keys) if values is None else _Call(keys=keys, values=values)
    source = call.vector("keys", ("uint32", "uint64"))
    width = 8 * source.dtype.itemsize
    bits = width if bits is None else check_count("bits", bits, least=0)
    if bits > width:
        raise ValueError(f"bits: need at most {width} for {source.dtype} keys, got {bits}")
    payload = None if values is None else call.payload("values", len(keys))
    design = sort.sort_by_key if _walks_chunks(call.session) else groups.sort_by_key
    keys_out, values_out = design(call.session, source, payload, bits)
    if values is None:
        return call.result(keys_out), None
    if call.on_device:
        return call.result(keys_out), call.result(_like(values_out, values))
    return call.result(keys_out), call.result(values_out).view(_dtype(values))


def _segment_size(given):
    return SEGMENT_SIZE if given is None else min(check_count("segment_size", given), _MOST)


def _walks_chunks(session):
    return bool(session.device.type & cl.device_type.CPU)


class _Call:
    """The arguments of one call on the device: the caller's arrays, or numpy arrays uploaded."""

    def __init__(self, **named):
        kinds = {isinstance(array, cla.Array) for array in named.values()}
        if len(kinds) == 2:
            raise TypeError(f"{', '.join(named)}: need all on the device or none")
        self.on_device = kinds == {True}
        self._named = named
        first = next(iter(named.values()))
        for name, array in named.items():
            _check_length(name, array)
        self.session = (
            devices.session_of_arrays(named) if self.on_device else devices.session()
        )
        # Our work must be done before theirs goes on.
        self._foreign = self.on_device and first.queue != self.session.queue

    def words(self, name):
        """Elements as they are on the device, as rows of uint32 from numpy."""
        array = self._named[name]
        size = _element_bytes(name, array)
        if self.on_device:
            return _contiguous(name, array)
        host = np.ascontiguousarray(array)
        return self._upload(host.reshape(-1).view(np.uint32).reshape(len(host), size // 4))

    def vector(self, name, types):
        """A one-dimensional array of one of the dtypes named."""
        array = self._named[name]
        dtype = _dtype(array)
        if dtype.name not in types:
            raise TypeError(f"{name}: need dtype {', '.join(types)}, got {dtype}")
        if array.ndim != 1:
            raise ValueError(f"{name}: need shape (n,), got {array.shape}")
        return _contiguous(name, array) if self.on_device else self._upload(np.asarray(array))

    def flags(self, name, count):
        """A flag per element as uint8."""
        array = self._named[name]
        if _dtype(array).itemsize != 1:
            raise TypeError(f"{name}: need dtype bool or uint8, got {_dtype(array)}")
        if array.shape != (count,):
            raise ValueError(f"{name}: need shape ({count},), got {array.shape}")
        if self.on_device:
            return _contiguous(name, array)
        return self._upload(np.ascontiguousarray(array).view(np.uint8))

    def payload(self, name, count):
        """Values that travel with keys, as uint32 or uint64."""
        array = self._named[name]
        if array.shape != (count,):
            raise ValueError(f"{name}: need shape ({count},), got {array.shape}")
        size = _dtype(array).itemsize
        if size not in (4, 8):
            raise TypeError(f"{name}: need elements of 4 or 8 bytes, got {size}")
        unsigned = np.uint32 if size == 4 else np.uint64
        if self.on_device:
            return _contiguous(name, array).view(unsigned)
        return self._upload(np.ascontiguousarray(array).view(unsigned))

    def result(self, array):
        """The array as the caller gets it."""
        if self.on_device:
            if self._foreign:
                self.session.queue.finish()
            self.session.clock.forget()
            return array
        host = array.get()
        self.session.clock.forget()
        return host

    def _upload(self, host):
        return self.session.upload(STREAM_REDUCTION, host)


def _check_length(name, array):
    if not isinstance(array, (np.ndarray, cla.Array)):
        raise TypeError(f"{name}: need a numpy or pyopencl array, got {type(array).__name__}")
    if not np.dtype(array.dtype).isnative:
        raise TypeError(f"{name}: need the machine's byte order, got dtype {array.dtype}")
    if array.ndim == 0 or array.shape[0] > _MOST:
        raise ValueError(f"{name}: need 0 to {_MOST} elements, got shape {array.shape}")


def _contiguous(name, array):
    if not array.flags.c_contiguous or array.offset:
        raise ValueError(f"{name}: need a C-contiguous device array that starts its buffer")
    return array


def _element_bytes(name, array):
    size = _dtype(array).itemsize * int(np.prod(array.shape[1:]))
    if size not in ELEMENTS:
        raise TypeError(f"{name}: need elements of 4, 8 or 16 bytes, got {size}")
    return size


def _dtype(array):
    return np.dtype(array.dtype)


def _like(array, values):
    """A device array with the dtype and shape of the caller's."""
    return array if array.dtype == values.dtype else array.view(values.dtype)
