"""Real scenes, small: every ray against Embree, the picture against the reference renderer."""

import pytest
from real_scenes import REAL_SCENES

from raystream import compare


@pytest.mark.parametrize("real", REAL_SCENES, ids=lambda real: real.name)
def test_rays_and_picture_meet_the_rules(scene_folder, real, monkeypatch):
    monkeypatch.setattr(compare, "TIMED_FRAMES", 1)
    scene = real.load(scene_folder)
    (result,), _ = compare.compare(scene, ["rsh"], real.camera, size=(128, 128))
    assert result.checks[compare.SECONDARY].rays > 0 and result.checks[compare.SHADOW].rays > 0
    assert result.ok, compare.table([result])


@pytest.mark.parametrize("name", ["bunny-69451", "mgf-office"])
def test_brute_force_meets_the_rules(scene_folder, name, monkeypatch):
    monkeypatch.setattr(compare, "TIMED_FRAMES", 1)
    real = next(real for real in REAL_SCENES if real.name == name)
    (result,), _ = compare.compare(real.load(scene_folder), ["brute"], real.camera, size=(40, 40))
    assert result.ok, compare.table([result])


def test_the_large_dragon_fits_into_256_megabytes(scene_folder):
    import numpy as np

    import raystream as rs

    scene = rs.load_scene(scene_folder / "dragon" / "dragon-871414.ply")
    camera = rs.Camera.look_at((0, 0.12, 0.4), (-0.006, 0.125, 0))
    rays = camera.rays((96, 96))
    unlimited = rs.Tracer(scene, "rsh")
    limited = rs.Tracer(scene, "rsh", memory_limit=4 << 20)
    expected, hits = unlimited.intersect(*rays), limited.intersect(*rays)
    assert limited.statistics.batches > 1
    assert limited.statistics.levels == unlimited.statistics.levels
    np.testing.assert_array_equal(hits.prim_id, expected.prim_id)
    np.testing.assert_array_equal(hits.t, expected.t)
