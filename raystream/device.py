"""Choosing an OpenCL device, and the session (context, queue, programs, memory) on it."""

import copy
import functools
import os
import threading

import numpy as np
import pyopencl as cl
import pyopencl.array
import pyopencl.tools

from raystream import pocl, program
from raystream.errors import DeviceError, MemoryLimitError
from raystream.statistics import StageClock

_NO_DEVICE = (
    "no OpenCL device found: install a runtime, for instance PoCL for the CPU: "
    "pip install pyopencl[pocl]"
)


def devices():
    """All OpenCL devices of this machine.

    Returns
    -------
    list of pyopencl.Device
        In the order of the platforms; empty where there is none.
    """
    with pocl.arranged_threads():
        try:
            platforms = cl.get_platforms()
        except cl.Error:  # the loader raises where no platform is installed
            return []
        return [device for platform in platforms for device in platform.get_devices()]


def default_device():
    """The device named by ``$PYOPENCL_CTX``, else the first GPU, else the first device.

    Raises
    ------
    DeviceError
        There is no device, or ``$PYOPENCL_CTX`` names none.
    """
    found = devices()
    if not found:
        raise DeviceError(_NO_DEVICE)
    wanted = os.environ.get("PYOPENCL_CTX")
    if wanted:
        try:
            return cl.create_some_context(interactive=False).devices[0]
        except (cl.Error, RuntimeError, IndexError, ValueError) as error:
            raise DeviceError(f"PYOPENCL_CTX={wanted!r} names no OpenCL device: {error}") from None
    return next((d for d in found if d.type & cl.device_type.GPU), found[0])


def check_device(device):
    """Refuse what cannot run raystream, in one line; make a PoCL device ready.

    Raises
    ------
    TypeError, DeviceError
    """
    if not isinstance(device, cl.Device):
        raise TypeError(f"device: need a pyopencl.Device (see raystream.devices()), got {device!r}")
    major, minor = (int(x) for x in device.version.split()[1].split("."))
    if (major, minor) < (1, 2):
        raise DeviceError(f"{device.name}: need OpenCL 1.2 or newer, got {device.version}")
    if "cl_khr_int64_extended_atomics" not in device.extensions:
        raise DeviceError(f"{device.name}: need 64-bit atomics (cl_khr_int64_extended_atomics)")
    if pocl.is_pocl(device):
        pocl.name_target(device)
        failure = pocl.failure(device)
        if failure is not None:
            raise DeviceError(f"{device.name}: {failure}")


_POOL_SHARE = 2  # the pool holds no more than this part of the device's memory
_PROTOTYPES = 256
_thread = threading.local()


def session(device=None, context=None):
    """The session of this thread on a device, made at the first call and kept.

    Parameters
    ----------
    device : pyopencl.Device, optional
        Default: `default_device`.
    context : pyopencl.Context, optional
        A caller's own context, so that its arrays can be used in place.
    """
    sessions = _thread.__dict__.setdefault("sessions", {})
    if device is None:
        if not hasattr(_thread, "default"):
            _thread.default = default_device()
        device = _thread.default
    if not isinstance(device, cl.Device):
        check_device(device)
    key = (device.int_ptr, None if context is None else context.int_ptr)
    if key not in sessions:
        check_device(device)
        sessions[key] = Session(device, context)
    return sessions[key]


def session_of(array):
    """The session of this thread that works in the context and on the device of an array."""
    queue = array.queue
    if queue is None:
        raise ValueError("device arrays: need arrays with a queue, got one without")
    for known in _thread.__dict__.get("sessions", {}).values():
        if known.context == queue.context and known.device == queue.device:
            return known
    return session(queue.device, queue.context)


def session_of_arrays(named):
    """The session that the arrays of a call share; work that others queued on them is waited for.

    Parameters
    ----------
    named : dict of str to pyopencl.array.Array
        Arguments by name, the first decides.

    Raises
    ------
    ValueError
        An array has no queue or is of another context than the first.
    """
    shared = None
    for name, array in named.items():
        shared = session_of(array) if shared is None else shared
        if array.queue is None or array.queue.context != shared.context:
            raise ValueError(f"{name}: need an array of the same context as the others")
        if array.queue != shared.queue:
            array.queue.finish()
    return shared


class Session:
    """A context and an in-order queue on one device, with its programs and its memory pool.

    Not to be shared between threads: kernel objects hold their arguments. Use `session`.
    """

    def __init__(self, device, context=None):
        self.device = device
        self.context = cl.Context([device]) if context is None else context
        self.queue = cl.CommandQueue(
            self.context, device, properties=cl.command_queue_properties.PROFILING_ENABLE
        )
        # Two bin sizes an octave: what calls of many sizes leave behind in the pool stays bounded.
        self._allocator = cl.tools.ImmediateAllocator(self.queue)
        self.pool = cl.tools.MemoryPool(self._allocator, leading_bits_in_bin_id=1)
        self._nothing = self.pool.allocate(64)
        self._in_host_memory = bool(device.type & cl.device_type.CPU)
        of_a_kind = functools.partial(cl.array.Array, self.queue, allocator=self.pool)
        self._prototype = functools.lru_cache(_PROTOTYPES)(of_a_kind)
        self.clock = StageClock()
        self.cache = {}  # small device arrays that stages keep between calls, by their own keys
        self._kernels = {}

    def kernels(self, name, **defines):
        """The kernels of ``cl/<name>``, built once per set of `defines`."""
        key = (name, tuple(sorted(defines.items())))
        if key not in self._kernels:
            self._kernels[key] = program.build(self.context, name, key[1])
        return self._kernels[key]

    def launch(self, stage, kernel, size, *args, local=1):
        """Run `kernel` over `size` work-items in groups of `local`, timed under `stage`.

        `size` is rounded up to whole groups (a prime size is three times slower otherwise), so
        kernels guard their index. Arrays are passed as their buffers, None stands for one that the
        kernel does not touch. A size of 0 launches nothing.
        """
        if size == 0:
            return
        buffers = [self._buffer(a) for a in args]
        rounded = -(-size // local) * local
        self.clock.record(stage, kernel(self.queue, (rounded,), (local,), *buffers))

    def exceeds_cache(self, nbytes):
        """Whether a stream of so many bytes has left the device's cache before it is read again."""
        return nbytes > self.device.global_mem_cache_size

    def trim(self):
        """Give the memory back that the pool holds and no array uses."""
        self.queue.finish()
        self.pool.free_held()

    def _buffer(self, argument):
        # An empty array has no buffer, and PoCL ends the process where a kernel's argument is null.
        if isinstance(argument, cl.array.Array):
            return argument.data if argument.size else self._nothing
        return self._nothing if argument is None else argument

    def empty(self, shape, dtype):
        """An uninitialised device array from the pool.

        Raises
        ------
        MemoryLimitError
            The device does not allow a buffer of that size, or has no memory left.
        """
        dtype = np.dtype(dtype)
        # Copies of an array take a fifth of the time that its constructor takes.
        array = copy.copy(self._prototype(shape, dtype, data=self._nothing))
        size, most = array.nbytes, self.device.max_mem_alloc_size
        if size > most:
            raise MemoryLimitError(
                f"{self.device.name}: need a buffer of {size} bytes, the device allows {most}"
            )
        if self.pool.managed_bytes + size > self.device.global_mem_size // _POOL_SHARE:
            self.trim()
        try:
            array.base_data = self.pool.allocate(size) if size else None
        except (cl.MemoryError, cl.LogicError):
            return self._empty_without_pool(shape, dtype, size)
        array.events = []
        return array

    def _empty_without_pool(self, shape, dtype, size):
        """What the pool cannot give: it rounds sizes up, and holds what it has given before."""
        self.trim()
        try:
            return cl.array.Array(self.queue, shape, dtype, allocator=self._allocator)
        except (cl.MemoryError, cl.LogicError) as error:
            raise MemoryLimitError(
                f"{self.device.name}: no memory for a buffer of {size} bytes: {error}"
            ) from None

    def fill(self, stage, array, value):
        """Set every element of `array` to `value`."""
        if array.nbytes:
            pattern = np.asarray(value, array.dtype)
            event = cl.enqueue_fill_buffer(self.queue, array.base_data, pattern, 0, array.nbytes)
            self.clock.record(stage, event)

    def upload(self, stage, array, target=None):
        """Copy a contiguous numpy array to the device, into `target` where one is given."""
        array = np.ascontiguousarray(array)
        target = self.empty(array.shape, array.dtype) if target is None else target
        if array.nbytes:
            # The event keeps `array` alive until the clock lets go of it.
            event = cl.enqueue_copy(self.queue, target.base_data, array, is_blocking=False)
            self.clock.record(stage, event)
        return target

    def share(self, stage, array):
        """A kernel's argument that holds a contiguous numpy array, which must not change meanwhile.

        A device that works in the host's memory reads the array where it is, others get a copy.
        """
        if not self._in_host_memory or not array.nbytes:
            return self.upload(stage, array)
        flags = cl.mem_flags.READ_ONLY | cl.mem_flags.USE_HOST_PTR
        return cl.Buffer(self.context, flags, hostbuf=np.ascontiguousarray(array))

    def fetch(self, stage, array):
        """A numpy array that holds what `array` does, once the queue has been waited for."""
        target = np.empty(array.shape, array.dtype)
        event = cl.enqueue_copy(self.queue, target, array.base_data, is_blocking=False)
        self.clock.record(stage, event)
        return target

    def download(self, *arrays):
        """Device arrays, which the caller gives up, as numpy arrays; waits for the launches.

        A device that works in the host's memory hands out that memory: nothing is copied, and the
        pool gets it back when the last array that looks at it is gone.
        """
        if not self._in_host_memory:
            return [array.get() for array in arrays]
        mapped = [_Mapped(array) if array.nbytes else array.get() for array in arrays]
        self.queue.finish()
        return [np.asarray(array) for array in mapped]

    def finish(self):
        """Wait for all launches; return the seconds by stage since the last call."""
        self.queue.finish()
        return self.clock.take()


class _Mapped:
    """A device array's memory as the host sees it: keeps it from the pool."""

    def __init__(self, array):
        flags = cl.map_flags.READ | cl.map_flags.WRITE
        order = array.queue, array.base_data, flags, array.offset, array.shape, array.dtype
        self._view, _ = cl.enqueue_map_buffer(*order, is_blocking=False)
        self._array = array
        self.__array_interface__ = self._view.__array_interface__
