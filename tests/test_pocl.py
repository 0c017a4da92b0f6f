"""The check of PoCL: its messages, its memory, the processor's name."""

import os
import subprocess
import sys
import types

import pytest

from raystream import device, pocl
from raystream.errors import DeviceError


@pytest.fixture
def cpu():
    found = [d for d in device.devices() if pocl.is_pocl(d)]
    if not found:
        pytest.skip("PoCL is not installed here")
    return found[0]


@pytest.fixture
def fresh_cache(tmp_path, monkeypatch):
    import platformdirs

    monkeypatch.setattr(platformdirs, "user_cache_dir", lambda _name: str(tmp_path / "cache"))
    return tmp_path / "cache"


def child(monkeypatch, returncode, stderr):
    ended = types.SimpleNamespace(returncode=returncode, stderr=stderr, stdout="")
    monkeypatch.setattr(subprocess, "run", lambda *_args, **_kwargs: ended)


def test_a_working_device_is_checked_once(cpu, fresh_cache, monkeypatch):
    assert pocl.failure(cpu) is None
    assert len(list(fresh_cache.iterdir())) == 1
    monkeypatch.setattr(subprocess, "run", None)  # a second child would fail
    assert pocl.failure(cpu) is None


_COUNT_PINNED = """
import os, raystream as rs
rs.Tracer(rs.scenes.cornell()).occluded([[0, 0, 0]], [[0, 0, 1]])
threads = [int(name) for name in os.listdir("/proc/self/task")]
pinned = [t for t in threads if len(os.sched_getaffinity(t)) == 1]
batch = [t for t in threads if os.sched_getscheduler(t) == os.SCHED_BATCH]
print(len(pinned), len(batch), pinned == batch)
"""


@pytest.mark.parametrize("variables", [{}, {"POCL_AFFINITY": "0"}, {"POCL_MAX_PTHREAD_COUNT": "1"}])
def test_threads_are_pinned_one_to_a_core_as_batch_work(cpu, variables):
    cores = os.cpu_count()
    if cores == 1 or len(os.sched_getaffinity(0)) != cores:
        pytest.skip("this process may not use all cores, or there is one")
    inherited = {k: v for k, v in os.environ.items() if not k.startswith("POCL_")}
    done = subprocess.run(
        [sys.executable, "-c", _COUNT_PINNED],
        env={**inherited, **variables},
        capture_output=True,
        text=True,
        check=True,
    )
    expected = 0 if variables else cores
    assert done.stdout.split() == [str(expected), str(expected), "True"]


def test_an_abort_for_want_of_a_linker_says_what_to_install(cpu, fresh_cache, monkeypatch):
    child(monkeypatch, -6, "collect2: fatal error: cannot find 'ld'\nAborted")
    message = pocl.failure(cpu)
    assert "binutils" in message and "gcc" in message and "\n" not in message
    assert not fresh_cache.exists()


@pytest.mark.parametrize(
    "said", ["error: unknown target CPU 'generic'", "LLVM ERROR: Cannot select: 0x7f: i64 = fsqrt"]
)
def test_an_unknown_processor_says_what_to_install(cpu, fresh_cache, monkeypatch, said):
    child(monkeypatch, 1, said)
    assert "intel-opencl-rt" in pocl.failure(cpu)


def test_an_unusable_device_is_a_device_error(cpu, monkeypatch):
    monkeypatch.setattr(pocl, "failure", lambda _device: "it does not work")
    with pytest.raises(DeviceError, match="it does not work"):
        device.check_device(cpu)


def test_a_device_with_a_known_processor_is_left_alone():
    known = types.SimpleNamespace(
        platform=types.SimpleNamespace(name=pocl.PLATFORM_NAME),
        version="OpenCL 3.0 PoCL HSTR: pthread-x86_64-unknown-linux-gnu-skylake-avx512",
    )
    assert pocl.name_target(known) is None


def test_a_structure_without_the_two_strings_is_left_alone():
    import ctypes

    block = ctypes.create_string_buffer(4096)
    assert pocl._target_pointer(ctypes.addressof(block), b"generic") is None


def test_the_pointer_is_found_behind_the_triple():
    import ctypes

    triple = ctypes.create_string_buffer(b"x86_64-unknown-linux-gnu")
    name = ctypes.create_string_buffer(b"generic")
    block = (ctypes.c_uint64 * 256)()
    block[80], block[81] = ctypes.addressof(triple), ctypes.addressof(name)
    address = ctypes.addressof(block)
    assert pocl._target_pointer(address, b"generic") == address + 81 * 8
    assert pocl._target_pointer(address, b"znver3") is None


@pytest.mark.parametrize(
    ("target", "level", "wrong"),
    [
        (b"generic", b"x86-64-v2", True),
        (b"znver3", b"x86-64-v4", True),  # Zen 4: LLVM's name leaves out the AVX-512 it has
        (b"znver3", b"x86-64-v3", False),
        (b"icelake-server", b"x86-64-v4", False),
    ],
)
def test_names_that_make_builds_fail(target, level, wrong):
    assert pocl._is_wrong(target, level) is wrong
