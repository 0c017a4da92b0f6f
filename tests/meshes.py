"""Measures of meshes, and where the files of real scenes are, for the tests of scenes."""

import os

import numpy as np
import pytest

FOLDER = os.environ.get("RAYSTREAM_SCENES")
needs_files = pytest.mark.skipif(
    not FOLDER, reason="RAYSTREAM_SCENES does not name the folder of test scenes"
)


def triangles(scene):
    return scene.vertices[scene.faces].astype(np.float64)


def area(scene):
    a, b, c = triangles(scene).transpose(1, 0, 2)
    return np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2


def volume(mesh):
    return np.linalg.det(mesh.vertices[mesh.faces].astype(np.float64)).sum() / 6
