import json
from pathlib import Path

import numpy as np
import pytest
from meshes import FOLDER, area, needs_files, volume
from scipy.spatial import cKDTree

from raystream import spd
from raystream.scene import load_scene

# --- counts ---

@pytest.mark.parametrize("size, spheres", [(1, 30), (2, 150), (3, 420)])
def test_rings_have_as_many_spheres_and_cylinders_as_published(size, spheres):
    scene = spd.rings(size)
    by_kind = {
        kind: sum(len(mesh.faces) for mesh in scene.meshes if mesh.name.endswith(kind))
        for kind in ("spheres", "cylinders")
    }
    assert by_kind == {"spheres": 80 * spheres, "cylinders": 24 * spheres}


@pytest.mark.parametrize("size, clear", [(1, 1), (2, 2), (4, 13)])
def test_gears_transmit_as_often_as_published(size, clear):
    gears = spd.gears(size).meshes[1:]
    assert len(gears) == size**3
    assert sum(mesh.material.transmission.max() > 0 for mesh in gears) == clear


@pytest.mark.parametrize("size, spheres", [(1, 10), (2, 91), (3, 820)])
def test_balls_have_as_many_spheres_as_published(size, spheres):
    assert len(spd.balls(size).meshes[1].faces) == 80 * spheres


def test_spheres_of_the_flake_touch_their_parents_and_nothing_else_of_their_generation():
    centers, radii = spd._sphereflake(2)
    parents = np.concatenate([np.zeros(9, int), 1 + np.repeat(np.arange(9), 9)])
    gaps = np.linalg.norm(centers[1:] - centers[parents], axis=1) - radii[1:] - radii[parents]
    np.testing.assert_allclose(gaps, 0, atol=1e-12)
    first = centers[1:10]
    apart = np.linalg.norm(first[:, None] - first, axis=-1)[~np.eye(9, dtype=bool)]
    assert (apart > 2 / 6 - 1e-9).all()


def test_ring_points_are_thirty_edge_midpoints_at_equal_distance():
    points = np.concatenate([spd._ring_points(ring) for ring in range(6)])
    np.testing.assert_allclose(np.linalg.norm(points, axis=1), 1)
    gaps = np.linalg.norm(points[:, None] - points, axis=-1)[~np.eye(30, dtype=bool)]
    # neighbouring edge midpoints of a dodecahedron whose edges lie at distance 1
    assert gaps.min() == pytest.approx(2 * np.sin(np.pi / 10))


def test_a_gear_has_the_area_of_its_outline_and_rim():
    ground, gear = spd.gears(1).meshes
    assert volume(gear) > 0
    sector = np.radians(10)
    outer = np.sin(0.38 * sector) / 2 * 0.995**2  # triangle between the two points of a tooth
    root = np.sin(0.4 * sector) / 2 * 0.9**2
    flank = 2 * np.sin(0.11 * sector) / 2 * 0.995 * 0.9
    thickness = 0.1
    assert volume(gear) == pytest.approx(36 * (outer + root + flank) * thickness, rel=1e-5)


# --- against the files ---


@needs_files
@pytest.mark.parametrize(
    "make, file",
    [
        (lambda: spd.rings(3), "rings-3"),
        (lambda: spd.gears(4), "gears-4"),
        (lambda: spd.balls(3), "balls-3"),
        (lambda: spd.mountain(6), "mount-6"),
    ],
)
def test_procedural_databases_equal_the_files_of_the_original_generator(make, file):
    scene, stored = make(), load_scene(Path(FOLDER, "spd", f"{file}.glb"))
    view = json.loads(Path(FOLDER, "spd", f"{file}.json").read_text())
    assert scene.num_triangles == stored.num_triangles
    mirrored = stored.bounds * (-1, 1, 1)
    np.testing.assert_allclose(scene.bounds, np.sort(mirrored, axis=0), atol=1e-4)
    assert area(scene) == pytest.approx(area(stored), rel=1e-5)
    np.testing.assert_allclose(scene.camera.eye * (-1, 1, 1), view["view"]["from"], atol=1e-5)
    positions = [light.position * (-1, 1, 1) for light in scene.lights]
    np.testing.assert_allclose(positions, view["lights"], atol=1e-5)
    np.testing.assert_allclose(scene.background, view["view"]["background"])


@needs_files
def test_mountain_has_the_triangles_of_the_original_in_their_order():
    rock = spd.mountain(6).meshes[1]
    stored = load_scene(Path(FOLDER, "spd", "mount-6.glb"))
    (original,) = [mesh for mesh in stored.meshes if mesh.name == "polygon-01"]
    ours = rock.vertices[rock.faces[:, [0, 2, 1]]] * (-1, 1, 1)
    np.testing.assert_allclose(ours, original.vertices[original.faces], atol=1e-6)


def primitives(file, kind, columns):
    text = Path(FOLDER, "spd", file).read_text()
    lines = [line.split() for line in text.splitlines() if line.startswith(f"{kind} ")]
    return np.array([line[1 : 1 + columns] for line in lines], dtype=np.float64)


@needs_files
def test_balls_4_and_rings_7_have_the_spheres_of_the_original():
    def assert_equal_sets(ours, theirs):
        assert len(ours) == len(theirs)
        assert cKDTree(ours).query(theirs)[0].max() < 1e-4
        assert cKDTree(theirs).query(ours)[0].max() < 1e-4

    centers, radii = spd._sphereflake(4)
    assert_equal_sets(np.column_stack([centers, radii]), primitives("balls-4.nff", "s", 4))
    beads = [
        mesh.vertices.reshape(-1, 42, 3).mean(axis=1) * (-1, 1, 1)
        for mesh in spd.rings(7).meshes
        if mesh.name.endswith("spheres")
    ]
    assert_equal_sets(np.concatenate(beads), primitives("rings-7.nff", "s", 3))
