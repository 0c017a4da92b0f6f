"""Fixtures shared by the tests: the device, random numbers, the folder of real scenes."""

import os
import pathlib

import numpy as np
import pytest

from raystream import device, program


@pytest.fixture(scope="session")
def session():
    return device.session()


@pytest.fixture
def rng():
    return np.random.default_rng(20071)


@pytest.fixture
def scene_folder():
    folder = os.environ.get("RAYSTREAM_SCENES")
    if not folder:
        pytest.skip("RAYSTREAM_SCENES does not name the folder of test scenes")
    return pathlib.Path(folder)


@pytest.fixture
def portable(monkeypatch):
    """Sessions made inside compile without the x86 built-ins."""
    monkeypatch.setattr(program, "_OPTIONS", (*program._OPTIONS, "-DPORTABLE"))
    monkeypatch.setattr(device, "_thread", type(device._thread)())


@pytest.fixture(params=["built-ins", "portable"])
def path(request):
    """Both paths of cl/simd.h, for what is compiled inside."""
    if request.param == "portable":
        request.getfixturevalue("portable")
    return request.param
