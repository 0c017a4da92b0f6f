"""Real scenes, small: every ray against Embree, the picture against the reference renderer."""

import numpy as np
import pytest
from raystream.baselines.tolerance import MAX_SHARE
from real_scenes import COUNT_SCENES, REAL_SCENES

import raystream as rs
from raystream import compare, tables


@pytest.mark.parametrize("real", REAL_SCENES, ids=lambda real: real.name)
def test_rays_and_picture_meet_the_rules(scene_folder, real, monkeypatch):
    monkeypatch.setattr(compare, "TIMED_FRAMES", 1)
    scene = real.load(scene_folder)
    results, _ = compare.compare(scene, ["rsh", "crsh", "dual"], real.camera, size=(128, 128))
    for result in results:
        assert result.checks[compare.SECONDARY].rays > 0 and result.checks[compare.SHADOW].rays > 0
        assert result.ok, tables.table([result])
    first, second, dual = (result.frame for result in results)
    np.testing.assert_array_equal(first.image, second.image)
    np.testing.assert_array_equal(first.image, dual.image)
    assert first.statistics.final_hits == second.statistics.final_hits


@pytest.mark.parametrize("surface", ["mirror", "glass"])
@pytest.mark.parametrize("name", COUNT_SCENES)
def test_coherent_rays_of_every_kind_meet_the_rules(scene_folder, name, surface):
    """Every surface a mirror, or of glass: reflection, refraction and shadow rays."""
    real = COUNT_SCENES[name]
    scene = real.load(scene_folder)
    getattr(scene, surface)("*")
    paper = {"hash": "paper", "bound": "paper", "arity": 8, "levels": 2}
    for options in ({}, paper):
        tracer = compare.CheckedTracer(scene, "crsh", **options)
        rs.Renderer(scene, tracer).render(real.camera, (80, 80), max_bounces=1)
        for kind in (compare.SECONDARY, compare.SHADOW):
            check = tracer.checks[kind]
            assert check.rays > 0 and check.wrong <= MAX_SHARE * check.rays, (kind, check)


@pytest.mark.parametrize("name", ["bunny-69451", "mgf-office"])
def test_brute_force_meets_the_rules(scene_folder, name, monkeypatch):
    monkeypatch.setattr(compare, "TIMED_FRAMES", 1)
    real = next(real for real in REAL_SCENES if real.name == name)
    (result,), _ = compare.compare(real.load(scene_folder), ["brute"], real.camera, size=(40, 40))
    assert result.ok, tables.table([result])


@pytest.mark.parametrize("method", ["rsh", "crsh"])
def test_the_large_dragon_fits_into_little_memory(scene_folder, method):
    """Hits as in much memory; 256 MB at 512 x 512: bench/bench_counts.py --memory."""
    scene = rs.load_scene(scene_folder / "dragon" / "dragon-871414.ply")
    camera = rs.Camera.look_at((0, 0.12, 0.4), (-0.006, 0.125, 0))
    rays = camera.rays((96, 96))
    unlimited = rs.Tracer(scene, method)
    limited = rs.Tracer(scene, method, memory_limit=4 << 20)
    expected, hits = unlimited.intersect(*rays), limited.intersect(*rays)
    assert limited.statistics.batches > 1
    assert limited.statistics.levels == unlimited.statistics.levels
    np.testing.assert_array_equal(hits.prim_id, expected.prim_id)
    np.testing.assert_array_equal(hits.t, expected.t)
