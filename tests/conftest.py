"""Fixtures shared by the tests: the device, random numbers, the folder of real scenes."""

import os
import pathlib

import numpy as np
import pytest

from raystream import device


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
