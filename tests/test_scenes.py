from pathlib import Path

import numpy as np
import pytest
import trimesh
from meshes import FOLDER, needs_files, triangles, volume

from raystream import scenes
from raystream.scene import load_scene

# --- counts ---


@pytest.mark.parametrize(
    "make, count",
    [
        (lambda: scenes.cornell(), 32),
        (lambda: scenes.cornell("mirrors"), 790),
        (lambda: scenes.rings(3), 43_682),
        (lambda: scenes.gears(4), 36_610),
        (lambda: scenes.balls(3), 65_602),
        (lambda: scenes.mountain(6), 13_312),
        (lambda: scenes.mountain(1), 8 + 4 * 1280),
        (lambda: scenes.balls(0), 82),
        (lambda: scenes.room(), 804),
        (lambda: scenes.toys(), 11_208),
        (lambda: scenes.meadow(), 172_688),
    ],
)
def test_triangle_counts(make, count):
    assert make().num_triangles == count


@pytest.mark.parametrize("n", [1, 3])
def test_bumpy_mirror_is_the_surface_cos_nx_cos_ny(n):
    mirror = scenes.bumpy_mirror(n).meshes[0]
    x, height, z = mirror.vertices.T
    np.testing.assert_allclose(height, np.cos(n * x) * np.cos(n * z), atol=1e-5)
    assert len(mirror.faces) == 2048 * n * n
    corners = mirror.vertices[mirror.faces]
    facing = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert (facing[:, 1] > 0).all()
    facing /= np.linalg.norm(facing, axis=1, keepdims=True)
    # a normal turns by at most n^2 times the diagonal of a cell, 0.83 rad for n = 3
    turned = np.einsum("ij,ij->i", mirror.normals[mirror.faces[:, 0]], facing)
    assert (turned > np.cos(n * n * np.sqrt(2) * 2 * np.pi / (32 * n))).all()


def test_a_mirror_ball_is_a_smooth_near_perfect_mirror_with_exact_normals():
    ball = scenes.mirror_ball((1, 2, 3), 0.5)
    assert ball.name == ball.material.name == "mirror-ball"
    assert len(ball.faces) == 20_480
    assert ball.material.reflectivity.min() >= 0.95
    assert not ball.material.diffuse.any() and not ball.material.transmission.any()
    np.testing.assert_allclose(ball.vertices - (1, 2, 3), 0.5 * ball.normals, atol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(ball.normals, axis=1), 1, atol=1e-6)
    assert volume(scenes.mirror_ball((0, 0, 0), 2)) == pytest.approx(4 / 3 * np.pi * 8, rel=1e-3)


@pytest.mark.parametrize(
    "arguments, field",
    [
        (((0, 0), 1), "center"),
        (((0, np.nan, 0), 1), "center"),
        (((0, 0, 0), 0), "radius"),
        (((0, 0, 0), -1), "radius"),
        (((0, 0, 0), "big"), "radius"),
    ],
)
def test_a_mirror_ball_of_no_place_or_size_is_refused(arguments, field):
    with pytest.raises(ValueError, match=f"^{field}: need .*got"):
        scenes.mirror_ball(*arguments)


# --- what every scene has ---

ALL = {
    "cornell": lambda: scenes.cornell(),
    "mirrors": lambda: scenes.cornell("mirrors"),
    "bumpy_mirror": lambda: scenes.bumpy_mirror(2),
    "rings": lambda: scenes.rings(2),
    "gears": lambda: scenes.gears(2),
    "balls": lambda: scenes.balls(2),
    "mountain": lambda: scenes.mountain(4),
    "demo": lambda: scenes.demo(),
    "room": lambda: scenes.room(),
    "toys": lambda: scenes.toys(),
    "meadow": lambda: scenes.meadow(),
}


@pytest.fixture(params=ALL)
def scene(request):
    return ALL[request.param]()


def test_names_are_unique_and_materials_named(scene):
    names = [mesh.name for mesh in scene.meshes]
    assert len(set(names)) == len(names)
    assert all(mesh.material.name for mesh in scene.meshes)


def test_there_are_lights_a_camera_and_no_triangle_without_area(scene):
    assert scene.lights and scene._camera is not None
    a, b, c = triangles(scene).transpose(1, 0, 2)
    assert (np.linalg.norm(np.cross(b - a, c - a), axis=1) > 0).all()


def test_the_camera_looks_at_the_scene(scene):
    offset = scene.bounds.mean(axis=0) - scene.camera.eye
    assert offset @ scene.camera.basis[2] > 0


def test_smooth_normals_are_unit_vectors_on_the_side_of_their_faces(scene):
    for mesh in scene.meshes:
        if mesh.normals is None:
            continue
        np.testing.assert_allclose(np.linalg.norm(mesh.normals, axis=1), 1, atol=1e-6)
        a, b, c = mesh.vertices[mesh.faces].transpose(1, 0, 2)
        facing = np.cross(b - a, c - a)
        assert (np.einsum("ij,ikj->ik", facing, mesh.normals[mesh.faces]) > 0).all()


def test_closed_transparent_shapes_face_outward(scene):
    transparent = [mesh for mesh in scene.meshes if mesh.material.transmission.max() > 0]
    for mesh in transparent:
        assert trimesh.Trimesh(mesh.vertices, mesh.faces).is_watertight
        assert volume(mesh) > 0


def test_the_mirror_box_is_closed_and_all_mirrors():
    scene = scenes.cornell("mirrors")
    walls = [mesh for mesh in scene.meshes if mesh.name.endswith("-mirror")]
    assert len(walls) == 6 and all(mesh.material.reflectivity.min() > 0.5 for mesh in walls)
    corners = np.concatenate([mesh.vertices[mesh.faces] for mesh in walls])
    box = trimesh.Trimesh(**trimesh.triangles.to_kwargs(corners))
    # the walls face inward, so that the volume is negative
    assert box.is_watertight and box.volume == pytest.approx(-8)


@pytest.mark.parametrize(
    "make, message",
    [
        (
            lambda: scenes.cornell("glass"),
            "variant: need one of 'measured', 'mirrors', got 'glass'",
        ),
        (lambda: scenes.rings(0), "size: need a whole number of at least 1, got 0"),
        (lambda: scenes.gears(1.5), "size: need a whole number of at least 1, got 1.5"),
        (lambda: scenes.balls(-1), "size: need a whole number of at least 0, got -1"),
        (lambda: scenes.mountain(11), "size: need a whole number from 1 to 10, got 11"),
        (lambda: scenes.bumpy_mirror(True), "n: need a whole number of at least 1, got True"),
    ],
)
def test_bad_sizes_and_variants_are_refused(make, message):
    with pytest.raises(ValueError) as caught:
        make()
    assert str(caught.value) == message


# --- against closed forms ---


@needs_files
def test_measured_cornell_box_equals_its_file():
    def as_set(scene):
        return {tuple(sorted(map(tuple, corners))) for corners in triangles(scene).tolist()}

    stored = load_scene(Path(FOLDER, "cornell-box", "cornell-box-measured.obj"))
    scene = scenes.cornell()
    assert as_set(scene) == as_set(stored)
    ours = {mesh.name: mesh.material for mesh in scene.meshes}
    for mesh in stored.meshes:
        np.testing.assert_allclose(ours[mesh.name].diffuse, mesh.material.diffuse, rtol=1e-6)
        np.testing.assert_allclose(ours[mesh.name].emission, mesh.material.emission)


@needs_files
@pytest.mark.parametrize(
    "file, count, placed",
    [
        ("sponza/sponza-dabrovic.obj", 66_454, 1),
        ("conference/conference-331179.ply", 331_179, 1),
        ("bunny/bunny-69451.ply", 69_451, 1),
        ("bunny/bunny-16301.ply", 16_301, 1),
        ("bunny/bunny-3851.ply", 3_851, 1),
        ("bunny/bunny-948.ply", 948, 1),
        ("dragon/dragon-871414.ply", 871_414, 1),
        ("dragon/dragon-47794.ply", 47_794, 1),
        ("dragon/dragon-11102.ply", 11_102, 1),
        ("teapot/teapot-6320.obj", 6_320, 1),
        ("cornell-box/cornell-box-measured.obj", 32, 8),
        ("cornell-box/cornell-box-radeonrays.obj", 32, 8),
        ("office/mgf-office.glb", 34_000, 123),
        ("bart-kitchen/bart-kitchen.glb", 110_561, 393),
        ("bart-museum/bart-museum.glb", 10_796, 152),
        ("bart-museum/art-key-0.ply", 1_024, 1),
        ("bart-museum/art-key-4.ply", 1_024, 1),
        ("munich/munich.glb", 38_936, 2_367),
        ("cat-gallop/cat-01.obj", 794, 1),
        ("cat-gallop/cat-36.obj", 794, 1),
        ("elephant-skin/elephant-00.ply", 12_064, 1),
        ("elephant-skin/elephant-15.ply", 12_064, 1),
        ("fox/fox.glb", 576, 1),
        ("foliage/japanese-maple.glb", 198_396, 2),
        ("flight-helmet/flight-helmet.glb", 94_722, 6),
        ("spd/gears-4.glb", 36_610, 63),
        ("spd/mount-6.glb", 13_312, 2),
        ("spd/rings-3.glb", 43_682, 13),
        ("spd/balls-3.glb", 65_602, 2),
    ],
)
def test_files_have_the_counts_of_their_table(file, count, placed):
    scene = load_scene(Path(FOLDER, file))
    assert scene.num_triangles == count
    assert len(scene.meshes) == placed
    assert np.isfinite(scene.bounds).all() and scene.diagonal > 0


@needs_files
def test_transparent_colours_of_the_files_transmit():
    stored = load_scene(Path(FOLDER, "spd", "mount-6.glb"))
    transmissions = {mesh.name: mesh.material.transmission.tolist() for mesh in stored.meshes}
    assert transmissions["polygon-01"] == [0, 0, 0]
    assert transmissions["sphere-00"] == pytest.approx([1 - 76 / 255] * 3)
