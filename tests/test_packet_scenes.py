import numpy as np
import pytest
import trimesh
from meshes import triangles, volume
from raystream.baselines import EmbreeTracer

from raystream import scenes
from raystream.shapes import rounded_box

ALL = {"room": scenes.room, "toys": scenes.toys, "meadow": scenes.meadow}


@pytest.fixture(params=ALL, scope="module")
def make(request):
    return ALL[request.param]


def camera_hits(scene, size=(64, 64)):
    """geom_id of what the camera sees, -1: nothing."""
    hits = EmbreeTracer.from_scene(scene).intersect(*scene.camera.rays(size))
    return hits.geom_id


def test_a_scene_is_the_same_each_time(make):
    first, second = make(), make()
    np.testing.assert_array_equal(first.vertices, second.vertices)
    np.testing.assert_array_equal(first.faces, second.faces)


def test_the_camera_sees_most_of_the_meshes_and_the_picture_is_mostly_filled(make):
    scene = make()
    seen = camera_hits(scene)
    assert (seen >= 0).mean() > 0.6
    assert len(np.unique(seen[seen >= 0])) > 0.6 * len(scene.meshes)


def test_the_lights_reach_something_that_the_camera_sees(make):
    scene = make()
    embree = EmbreeTracer.from_scene(scene)
    origins, directions = scene.camera.rays((64, 64))
    t = embree.intersect(origins, directions).t
    points = (origins + 0.999 * t[:, None] * directions)[np.isfinite(t)]
    for light in scene.lights:
        to_light = (light.position - points).astype(np.float32)
        assert not embree.occluded(points, to_light).all()


def test_the_room_is_closed_and_flat():
    scene = scenes.room()
    assert (camera_hits(scene) >= 0).all()
    assert all(mesh.normals is None for mesh in scene.meshes)
    lower, upper = scene.bounds
    assert (scene.camera.eye > lower).all() and (scene.camera.eye < upper).all()
    for mesh in scene.meshes:
        if not mesh.name.endswith(("wall", "walls", "ceiling", "floor")):
            assert trimesh.Trimesh(mesh.vertices, mesh.faces).is_watertight
            assert volume(mesh) > 0


def test_objects_of_the_meadow_are_small_and_large():
    corners = triangles(scenes.meadow()).astype(np.float64)
    longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    assert longest.max() / np.median(longest) > 50
    assert np.percentile(longest, 95) / np.percentile(longest, 5) > 5


@pytest.mark.parametrize("steps", [1, 2, 3])
def test_a_rounded_box_is_closed_and_keeps_its_size(steps):
    vertices, faces = rounded_box((1.0, 0.5, 0.4), 0.3, steps)
    box = trimesh.Trimesh(vertices, faces)
    assert len(faces) == 12 * (2 * steps + 1) ** 2
    assert box.is_watertight
    np.testing.assert_allclose(box.bounds, [(-1.0, -0.5, -0.4), (1.0, 0.5, 0.4)])
    # of the box that is rounded: no more than that, no less than the octahedron-cut one
    assert 0.75 * 1.6 < box.volume < 1.6


@pytest.mark.parametrize(
    "vary, name, field, share",
    [
        (scenes.all_reflective, "meadow-reflective", "reflectivity", 0.5),
        (scenes.all_refractive, "meadow-refractive", "transmission", 0.8),
    ],
)
def test_variants_change_all_materials_of_a_copy(vary, name, field, share):
    scene = scenes.meadow()  # has mirrors and glass, so that both are seen to go
    before = [mesh.material for mesh in scene.meshes]
    varied = vary(scene)
    assert [mesh.material for mesh in scene.meshes] == before
    assert varied.name == name
    other = {"reflectivity": "transmission", "transmission": "reflectivity"}[field]
    for mesh, old in zip(varied.meshes, before, strict=True):
        np.testing.assert_allclose(getattr(mesh.material, field), share, rtol=1e-6)
        assert not getattr(mesh.material, other).any()
        np.testing.assert_array_equal(mesh.material.diffuse, old.diffuse)
    np.testing.assert_array_equal(varied.vertices, scene.vertices)
    assert varied.lights == scene.lights and varied.camera is scene.camera
