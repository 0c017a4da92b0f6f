"""Choosing a device, sessions, the stage clock."""

import threading

import numpy as np
import pytest

import raystream as rs
from raystream import device
from raystream.errors import DeviceError, MemoryLimitError


def test_devices_are_listed_and_one_is_the_default():
    assert device.default_device() in rs.devices()


def test_no_device_says_what_to_install(monkeypatch):
    monkeypatch.setattr(device, "devices", list)
    with pytest.raises(DeviceError, match="no OpenCL device found: install"):
        device.default_device()


def test_an_environment_that_names_no_device_is_an_error(monkeypatch):
    monkeypatch.setenv("PYOPENCL_CTX", "99:99")
    with pytest.raises(DeviceError, match="PYOPENCL_CTX='99:99'"):
        device.default_device()


def test_a_device_of_another_type_is_refused():
    with pytest.raises(TypeError, match="need a pyopencl.Device"):
        rs.Tracer(rs.scenes.cornell(), device="gpu")


def test_one_session_per_thread_and_device():
    assert device.session() is device.session(device.default_device())
    others = []
    thread = threading.Thread(target=lambda: others.append(device.session()))
    thread.start()
    thread.join()
    assert others[0] is not device.session()


def test_kernels_are_built_once(session):
    assert session.kernels("rays.cl") is session.kernels("rays.cl")


def test_stage_times_add_up(session):
    session.finish()
    array = session.upload("first", np.zeros(1 << 20, np.float32))
    session.fill("second", array, 1)
    stages = session.finish()
    assert set(stages) == {"first", "second"}
    for seconds in stages.values():
        assert 0 < seconds["device"] <= seconds["wall"]
    assert session.finish() == {}


def test_too_large_a_buffer_is_one_clear_error(session):
    size = session.device.max_mem_alloc_size + 4
    with pytest.raises(MemoryLimitError, match=f"need a buffer of {size} bytes, the device allows"):
        session.empty(size // 4, np.float32)


@pytest.mark.parametrize("shape", [(0,), (0, 3), (1,), (65, 3)])
def test_upload_and_back(session, shape, rng):
    host = rng.random(shape).astype(np.float32)
    back = session.upload("upload", host).get()
    assert back.dtype == np.float32
    np.testing.assert_array_equal(back, host)
