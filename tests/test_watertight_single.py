"""The float32 triangle test is that of the device, bit for bit."""

import ctypes
import ctypes.util

import numpy as np
import pytest
from raystream.baselines import watertight_single as single
from raystream.baselines.brute_force import BruteForceTracer
from soup import random_rays, triangle_soup

import raystream as rs


def test_fma_rounds_once(rng):
    fmaf = ctypes.CDLL(ctypes.util.find_library("m")).fmaf
    fmaf.restype, fmaf.argtypes = ctypes.c_float, [ctypes.c_float] * 3
    a, b = rng.normal(size=(2, 20000)).astype(np.float32)
    near = -a * b * (1 + rng.choice([0, 1e-7, 1e-5, 1], 20000))  # cancels, or all but
    c = (near * 10.0 ** rng.choice([0, 0, 8, -8], 20000)).astype(np.float32)
    expected = np.array([fmaf(*values) for values in zip(a, b, c, strict=True)], np.float32)
    np.testing.assert_array_equal(single.fma(a, b, c), expected)
    twice = (a * b + c) != expected
    assert twice.mean() > 0.1  # so it can be told from a product and a sum


@pytest.mark.parametrize("tfar", [np.inf, 0.7])
def test_the_hits_of_the_device(rng, tfar):
    scene = triangle_soup(rng, 200, size=0.4)
    origins, directions = random_rays(rng, 1009)
    hits = rs.Tracer(scene, "brute").intersect(origins, directions, 0.01, tfar)
    closest = np.full(1009, np.inf, np.float32), np.full(1009, -1), *np.zeros((2, 1009), np.float32)
    limits = np.full(1009, 0.01, np.float32), np.full(1009, tfar, np.float32)
    for face, corners in enumerate(scene.vertices[scene.faces]):
        corners = np.broadcast_to(corners, (1009, 3, 3))
        hit, t, u, v = single.intersect_pairs(origins, directions, corners, *limits)
        nearer = hit & (t < closest[0])
        for values, found in zip(closest, (t, face, u, v), strict=True):
            values[nearer] = found[nearer] if isinstance(found, np.ndarray) else found
    flat = np.where(hits.prim_id < 0, -1, scene.first_prims[hits.geom_id] + hits.prim_id)
    for ours, theirs in zip((hits.t, flat, hits.u, hits.v), closest, strict=True):
        np.testing.assert_array_equal(ours, theirs)
    assert 10 < (flat >= 0).sum() < 1009


def test_close_to_the_oracle(rng):
    corners = rng.normal(size=(500, 3, 3)).astype(np.float32)
    origins = rng.normal(size=(500, 3)).astype(np.float32)
    directions = (corners.mean(axis=1) - origins).astype(np.float32)
    hit, t, _, _ = single.intersect_pairs(
        origins, directions, corners, np.zeros(500, np.float32), np.full(500, np.inf, np.float32)
    )
    assert hit.all()
    for face in range(0, 500, 50):
        oracle = BruteForceTracer(corners[face], [[0, 1, 2]])
        exact = oracle.intersect(origins[face : face + 1], directions[face : face + 1])
        np.testing.assert_allclose(t[face], exact.t[0], rtol=1e-4)


@pytest.mark.parametrize(("length", "expected"), [(1e-30, True), (1e30, True), (1e-39, False)])
def test_what_leaves_the_range_of_float_is_a_miss(length, expected):
    corners = np.float32([[[-1, -1, 1], [1, -1, 1], [0, 1, 1]]])
    ray = np.float32([[0, 0, 0]]), np.float32([[0, 0, length]])
    limits = np.zeros(1, np.float32), np.full(1, np.inf, np.float32)
    hit, t, _, _ = single.intersect_pairs(*ray, corners, *limits)
    assert hit[0] == expected
    np.testing.assert_allclose(t[hit], 1 / length, rtol=1e-6)
    huge = single.intersect_pairs(*ray, np.float32(1e38) * corners, *limits)
    assert not huge[0]
