"""Choosing a device, sessions, the stage clock."""

import gc
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
    assert session.kernels("brute.cl") is session.kernels("brute.cl")


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


@pytest.mark.parametrize("shape", [(0,), (0, 3), (1,), (65, 3)])
def test_downloads_are_the_callers_own(session, shape, rng):
    host = rng.random(shape).astype(np.float32)
    (mine,) = session.download(session.upload("upload", host))
    np.testing.assert_array_equal(mine, host)
    assert mine.dtype == np.float32 and mine.shape == shape and mine.flags.writeable
    mine += 1
    for _ in range(3):  # nothing else gets this memory while `mine` is there
        session.fill("fill", session.empty(shape, np.float32), 9)
    session.finish()
    np.testing.assert_array_equal(mine, host + 1)


def test_memory_of_downloads_goes_back_to_the_pool(session):
    session.trim()
    before = session.pool.managed_bytes
    for _ in range(20):
        (part,) = session.download(session.empty(1 << 18, np.float32))
        part = part[5:].view(np.int32)  # what looks at it keeps it
    assert session.pool.managed_bytes - before <= 3 * part.base.nbytes


def test_downloads_outlive_their_session(rng):
    host, found = rng.random(10_007), []

    def work():
        session = device.session()
        found.extend(session.download(session.upload("upload", host)))

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    gc.collect()
    np.testing.assert_array_equal(found[0], host)
    found.clear()


def test_a_device_with_its_own_memory_gets_and_gives_copies(session, rng, monkeypatch):
    tracer = rs.Tracer(rs.scenes.cornell())
    rays = rng.random((2, 1009, 3))
    expected = tracer.intersect(*rays)
    monkeypatch.setattr(session, "_in_host_memory", False)
    tracer.update_vertices(tracer.scene.vertices)
    hits = tracer.intersect(*rays)
    for field in ("t", "prim_id", "geom_id", "u", "v"):
        np.testing.assert_array_equal(getattr(hits, field), getattr(expected, field))
    assert hits.t.flags.owndata
