"""Is PoCL usable here? Found out in a child process, once per machine, before work starts.

Two faults of the PoCL 3.0 wheel end a process or stop every build; Python cannot catch the first:

* The last step of each compile runs the system's linker (``ld ... -lgcc -lgcc_s -lc``). Where the
  linker or these libraries are missing, PoCL **aborts the process** inside the first launch.
* The wheel carries LLVM 14, which does not know processors newer than itself. It calls AMD's
  Zen 5 ``generic``, a name that PoCL's own compiler refuses: ``error: unknown target CPU
  'generic'`` (github.com/pocl/pocl/issues/1049); and Zen 4 ``znver3``, which has no AVX-512, while
  PoCL links its library for the AVX-512 that it finds: ``LLVM ERROR: Cannot select ... fsqrt``
  ends the process at the first square root of a float16. PoCL offers no setting for it, but keeps
  the name as a string that it reads at each build: `name_target` replaces that one pointer by the
  name of the x86-64 level that the processor has. It acts only on these two names, and the child
  process proves the result before this process relies on it.

Run as a script (``python pocl.py PLATFORM DEVICE``) this file is the check itself.
"""

import contextlib
import ctypes
import hashlib
import os
import pathlib
import subprocess
import sys

import pyopencl as cl

PLATFORM_NAME = "Portable Computing Language"
_CHECK_SECONDS = 120
_TRIPLE = b"x86_64-unknown-linux-gnu"
_UNKNOWN_TARGET = b"generic"
_TARGET_WITHOUT_AVX512 = b"znver3"
_STRUCT_BYTES = 1024  # the pointer lies 640 bytes into PoCL 3.0's device structure

# The x86-64 levels of the psABI, best first, with the /proc/cpuinfo flags that each needs.
_X86_64_LEVELS = (
    (b"x86-64-v4", {"avx512f", "avx512bw", "avx512cd", "avx512dq", "avx512vl"}),
    (b"x86-64-v3", {"avx", "avx2", "bmi1", "bmi2", "f16c", "fma", "abm", "movbe"}),
    (b"x86-64-v2", {"cx16", "lahf_lm", "popcnt", "sse4_1", "sse4_2", "ssse3"}),
    (b"x86-64", set()),
)
_names = {level: ctypes.create_string_buffer(level) for level, _ in _X86_64_LEVELS}


def is_pocl(device):
    """Whether `device` belongs to PoCL."""
    return device.platform.name == PLATFORM_NAME


@contextlib.contextmanager
def arranged_threads():
    """Have PoCL, should it start inside, keep each of its threads on a core, and behind ours.

    A thread that is woken is put on the core of the one that wakes it, and on a machine at rest two
    threads may stay on one core for 10 ms while the other is idle: kernels of 4 ms took 8 in a loop
    with pauses. Nothing is done where ``$POCL_AFFINITY`` says what is wanted, or where PoCL's
    threads are not as many as the cores that this process may use: it takes the first ones.

    On whichever core it is, the thread that launches kernels shares it with one of PoCL's, which at
    each launch takes the core from it: until the kernel has ended nothing more is launched. As
    batch work they do not.
    """
    before = _threads()
    if _has_a_thread_for_each_core():
        os.environ.setdefault("POCL_AFFINITY", "1")
    yield
    # Where the system forbids it launches take longer; nothing else is lost.
    with contextlib.suppress(OSError):
        for thread in _threads() - before:
            if len(os.sched_getaffinity(thread)) == 1:  # another platform's are not pinned
                os.sched_setscheduler(thread, os.SCHED_BATCH, os.sched_param(0))


def _threads():
    """Numbers of the threads of this process, where the system tells."""
    folder = pathlib.Path("/proc/self/task")
    return {int(task.name) for task in folder.iterdir()} if folder.is_dir() else set()


def _has_a_thread_for_each_core():
    cores = str(os.cpu_count())
    threads = os.environ.get("POCL_MAX_PTHREAD_COUNT") or cores
    allowed = str(len(os.sched_getaffinity(0))) if hasattr(os, "sched_getaffinity") else None
    return allowed == cores == threads


def name_target(device):
    """Name the processor to PoCL where its compiler does not know it; return the name or None.

    Parameters
    ----------
    device : pyopencl.Device
        Any device; one that is not PoCL's, or whose processor PoCL knows, is left alone.

    Returns
    -------
    bytes or None
        The LLVM target that now stands, None where nothing was changed.
    """
    if not is_pocl(device):
        return None
    said = device.version.rsplit("-", 1)[-1].encode()
    flags = _cpu_flags()
    level = next(name for name, needed in _X86_64_LEVELS if needed <= flags)
    if not _is_wrong(said, level):
        return None
    address = _target_pointer(device.int_ptr, said)
    if address is None:
        return None
    ctypes.c_void_p.from_address(address).value = ctypes.addressof(_names[level])
    return level


def _is_wrong(target, level):
    """Whether LLVM's name of a processor of this x86-64 level makes builds fail."""
    return target == _UNKNOWN_TARGET or (
        target == _TARGET_WITHOUT_AVX512 and level == _X86_64_LEVELS[0][0]
    )


def _target_pointer(structure, target):
    """Address of the `llvm_cpu` pointer to `target`: it follows the pointer to the triple."""
    try:
        memory = os.open("/proc/self/mem", os.O_RDONLY)  # a wrong address is an error, not a crash
    except OSError:
        return None
    try:
        block = os.pread(memory, _STRUCT_BYTES, structure)
        pointers = [int.from_bytes(block[i : i + 8], "little") for i in range(0, len(block), 8)]
        for index in range(len(pointers) - 1):
            if (
                _string_at(memory, pointers[index]) == _TRIPLE
                and _string_at(memory, pointers[index + 1]) == target
            ):
                return structure + 8 * (index + 1)
    finally:
        os.close(memory)
    return None


def _string_at(memory, address):
    try:
        return os.pread(memory, 64, address).split(b"\0")[0]
    except (OSError, OverflowError):  # not a pointer
        return b""


def _cpu_flags():
    for line in pathlib.Path("/proc/cpuinfo").read_text().splitlines():
        if line.startswith("flags"):
            return set(line.split(":", 1)[1].split())
    return set()


def failure(device):
    """Why `device` cannot compile and run a kernel, in one line; None if it can.

    The child process takes a few seconds; a success is remembered in the user's cache folder, under
    a name made of everything that the answer depends on, so later starts cost one file look-up.
    """
    marker = _marker(device)
    if marker is not None and marker.exists():
        return None
    message = _check_in_child(device)
    if message is None and marker is not None:
        _remember(marker)
    return message


def _marker(device):
    import platformdirs

    linker = next(
        (p for d in os.get_exec_path() if (p := pathlib.Path(d, "ld")).exists()), pathlib.Path()
    )
    facts = (device.name, device.version, device.driver_version, cl.VERSION_TEXT, str(linker))
    digest = hashlib.sha256(repr(facts).encode()).hexdigest()[:16]
    return pathlib.Path(platformdirs.user_cache_dir("raystream"), f"pocl-{digest}")


def _remember(marker):
    # In a read-only home the next process checks again; nothing is lost.
    with contextlib.suppress(OSError):
        marker.parent.mkdir(parents=True, exist_ok=True)
        marker.touch()


def _check_in_child(device):
    platforms = cl.get_platforms()
    platform = platforms.index(device.platform)
    number = device.platform.get_devices().index(device)
    # -P: this folder must not shadow the standard library's modules in the child.
    command = [sys.executable, "-P", __file__, str(platform), str(number)]
    try:
        child = subprocess.run(
            command, capture_output=True, text=True, timeout=_CHECK_SECONDS, check=False
        )
    except subprocess.TimeoutExpired:
        return f"PoCL did not build and run a test kernel within {_CHECK_SECONDS} seconds"
    if child.returncode == 0:
        return None
    said = [line.strip() for line in (child.stderr + child.stdout).splitlines() if line.strip()]
    detail = next((line for line in said if "error" in line.lower()), said[-1] if said else "")
    if "target CPU" in detail or "Cannot select" in detail:
        return (
            f"PoCL does not know this processor ({detail}); "
            "install another OpenCL runtime, for instance: pip install intel-opencl-rt"
        )
    return (
        "PoCL cannot compile a kernel; it needs the system's linker and C library: install "
        "binutils and gcc (Debian: apt-get install gcc libc6-dev); "
        f"its process ended with {child.returncode}: {detail}"
    )


def _main(platform, number):
    """Build and run one kernel on the device, in the child process."""
    device = cl.get_platforms()[platform].get_devices()[number]
    name_target(device)
    context = cl.Context([device])
    queue = cl.CommandQueue(context)
    program = cl.Program(
        context,
        # The square root comes from PoCL's library, in vectors as wide as the processor's.
        "kernel void probe(global uint *out) {"
        " size_t i = get_global_id(0); float16 x = (float16)(out[i] + 1764);"
        " out[i] = (uint)sqrt(x).s0; }",
    ).build()
    zeros = bytearray(4 * 64)
    out = cl.Buffer(context, cl.mem_flags.READ_WRITE | cl.mem_flags.COPY_HOST_PTR, hostbuf=zeros)
    program.probe(queue, (64,), (64,), out)
    result = bytearray(4 * 64)
    cl.enqueue_copy(queue, result, out)
    return 0 if result == bytes([42, 0, 0, 0]) * 64 else 1


if __name__ == "__main__":
    sys.exit(_main(int(sys.argv[1]), int(sys.argv[2])))
