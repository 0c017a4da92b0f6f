import numpy as np
import pytest
import trimesh
from test_mesh import SQUARE, TWO, save_ply_with_nan

import raystream as rs
from raystream.camera import Camera
from raystream.light import PointLight
from raystream.material import Material
from raystream.mesh import Mesh
from raystream.scene import Scene, as_scene, load_scene


def square(name="square", offset=(0, 0, 0)):
    return Mesh(SQUARE + offset, TWO, name, material=Material(name=f"{name}-paint"))


def test_concatenated_arrays_and_first_ids():
    single = Mesh([(9, 0, 0), (9, 1, 0), (9, 0, 1)], [(2, 1, 0)], "single")
    scene = Scene([square(), single, Mesh(np.zeros((0, 3)), []), square(offset=(5, 0, 0))])
    assert scene.num_triangles == 5
    assert scene.first_prims.tolist() == [0, 2, 3, 3, 5]
    assert scene.first_vertices.tolist() == [0, 4, 7, 7, 11]
    assert scene.geom_ids.tolist() == [0, 0, 1, 3, 3]
    assert scene.faces.tolist() == [[0, 1, 2], [2, 3, 0], [6, 5, 4], [7, 8, 9], [9, 10, 7]]
    assert scene.vertices[7].tolist() == [5, 0, 0]
    for field in ("faces", "geom_ids", "first_prims", "first_vertices"):
        assert getattr(scene, field).dtype == np.int32
    assert scene.vertices.dtype == np.float32


def test_bounds_are_those_of_the_faces():
    stray = Mesh(np.vstack([SQUARE, [(np.nan, 99, 99)]]), TWO)
    scene = Scene([stray, square(offset=(1, 2, 3))])
    assert scene.bounds.tolist() == [[0, 0, 0], [2, 3, 3]]
    assert scene.diagonal == pytest.approx(np.sqrt(4 + 9 + 9))


def test_an_empty_scene_has_zero_bounds_and_a_camera():
    scene = Scene([])
    assert scene.num_triangles == 0 and scene.bounds.tolist() == [[0, 0, 0], [0, 0, 0]]
    assert scene.vertices.shape == scene.faces.shape == (0, 3)
    assert scene.geom_ids.shape == (0,) and scene.first_prims.tolist() == [0]
    assert scene.camera.target.tolist() == [0, 0, 0] and len(scene.lights) == 1


def test_the_default_light_is_up_and_left_of_the_fitted_camera():
    scene = Scene([square()])
    right, up, _ = scene.camera.basis
    (light,) = scene.lights
    offset = light.position - scene.camera.eye
    assert offset @ up > 0 and offset @ right < 0


def test_given_camera_and_lights_are_kept_even_if_there_are_none():
    camera = Camera.look_at((0, 0, 9), (0, 0, 0))
    scene = Scene([square()], lights=[], camera=camera)
    assert scene.lights == () and scene.camera is camera


@pytest.mark.parametrize(
    "arguments, field",
    [
        ({"meshes": [SQUARE]}, r"meshes\[0\]"),
        ({"meshes": square()}, "meshes"),
        ({"meshes": [], "lights": [PointLight((0, 0, 0)), (0, 0, 0)]}, r"lights\[1\]"),
        ({"meshes": [], "camera": (0, 0, 0)}, "camera"),
    ],
)
def test_a_wrong_type_is_refused(arguments, field):
    with pytest.raises(TypeError, match=f"^{field}: need .*got"):
        Scene(**arguments)


def test_a_bad_background_is_refused():
    with pytest.raises(ValueError, match="^background"):
        Scene([], background=-1)


# --- editing ---


def test_set_lights_replaces_all_and_none_of_them_is_dark():
    scene = Scene([square()])
    lamp = PointLight((0, 3, 0))
    scene.set_lights([lamp])
    assert scene.lights == (lamp,)
    scene.set_lights([])
    assert scene.lights == ()
    scene.set_lights(None)
    assert scene.lights[0].position.tolist() == Scene([square()]).lights[0].position.tolist()


def test_set_lights_refuses_another_type_and_changes_nothing():
    lamp = PointLight((0, 3, 0))
    scene = Scene([square()], [lamp])
    with pytest.raises(TypeError, match=r"^lights\[1\]: need PointLight or .*, got tuple$"):
        scene.set_lights([lamp, (0, 0, 0)])
    with pytest.raises(TypeError, match="^lights: need a sequence, got PointLight$"):
        scene.set_lights(lamp)
    assert scene.lights == (lamp,)


def test_a_scene_with_no_light_shows_ambient_and_emission_only():
    scene = Scene([square()], ambient=0.25)
    scene.set_material("*", diffuse=(1, 0.5, 0), emission=(0, 0, 2))
    scene.set_lights([])
    image = rs.render(scene, Camera.look_at((0.5, 0.5, 1), (0.5, 0.5, 0)), size=(4, 4)).image
    np.testing.assert_allclose(image[1:3, 1:3], np.full((2, 2, 3), (0.25, 0.125, 2)), rtol=1e-6)


def test_set_material_matches_mesh_and_material_names():
    scene = Scene([square("wheel-1"), square("wheel-2"), square("body")])
    assert scene.set_material("wheel-?", diffuse=0.1, shininess=5) == 2
    assert [mesh.material.shininess for mesh in scene.meshes] == [5, 5, 32]
    assert scene.set_material("body-paint", diffuse=(1, 0, 0)) == 1
    assert scene.meshes[2].material.diffuse.tolist() == [1, 0, 0]
    assert scene.meshes[0].material.name == "wheel-1-paint"


def test_set_material_leaves_another_scene_of_the_same_meshes_alone():
    mesh = square()
    scene, other = Scene([mesh]), Scene([mesh])
    scene.set_material("*", transmission=0.5)
    assert other.meshes[0].material.transmission.max() == 0


def test_set_material_refuses_unknown_names_fields_and_values():
    scene = Scene([square(f"part-{k}") for k in range(12)])
    with pytest.raises(
        ValueError,
        match=r"no mesh or material fits 'wing'; the meshes are "
        r"'part-0', .*'part-9', \.\.\. \(12 in all\)",
    ):
        scene.set_material("wing", diffuse=1)
    with pytest.raises(TypeError, match="colour"):
        scene.set_material("*", colour=1)
    with pytest.raises(ValueError, match="^ior"):
        scene.set_material("*", ior=-1)


def test_mirror_and_glass():
    scene = Scene([square("a"), square("b")])
    assert scene.mirror("a") == scene.glass("b") == 1
    mirror, glass = (mesh.material for mesh in scene.meshes)
    assert mirror.reflectivity.min() >= 0.9 and mirror.transmission.max() == 0
    assert glass.transmission.tolist() == [1, 1, 1] and glass.ior == 1.5


def test_add_renews_arrays_camera_and_default_light():
    scene = Scene([square()])
    before = scene.camera.eye, scene.faces, scene.bounds
    scene.add(square("far", (50, 0, 0)), Material("blue", diffuse=(0, 0, 1)))
    assert scene.num_triangles == 4 and scene.first_prims.tolist() == [0, 2, 4]
    assert scene.bounds[1, 0] == 51
    assert scene.camera.eye.tolist() != before[0].tolist()
    assert len(before[1]) == 2
    assert scene.meshes[1].material.name == "blue"
    with pytest.raises(TypeError, match="^mesh: need Mesh, got ndarray"):
        scene.add(SQUARE)


def test_with_vertices_splits_by_mesh_and_keeps_the_rest():
    scene = Scene([square("a"), square("b")], name="two", background=0.5)
    moved = scene.with_vertices(scene.vertices.astype(np.float64) + (0, 0, 7))
    assert moved.meshes[1].vertices[:, 2].tolist() == [7] * 4
    assert moved.faces.tolist() == scene.faces.tolist()
    assert (moved.name, moved.background.tolist()) == ("two", [0.5] * 3)
    assert moved.camera is scene.camera and moved.lights == scene.lights
    assert scene.meshes[1].vertices[:, 2].tolist() == [0] * 4


def test_with_vertices_refuses_another_shape_and_vertices_that_are_not_finite():
    scene = Scene([square("a"), square("b")])
    with pytest.raises(ValueError, match=r"^vertices: need shape \(8, 3\), got \(7, 3\)"):
        scene.with_vertices(np.zeros((7, 3)))
    with pytest.raises(ValueError, match="mesh 'b'"):
        scene.with_vertices(np.vstack([SQUARE, SQUARE * np.nan]))


# --- conversion and files ---


def test_as_scene():
    scene = Scene([square()])
    assert as_scene(scene) is scene
    assert as_scene(square("m")).meshes[0].name == "m"
    ball = trimesh.creation.icosphere(1)
    assert as_scene(ball).faces.tolist() == ball.faces.tolist()
    assert as_scene(ball, smooth=True).meshes[0].normals is not None
    both = trimesh.Scene([ball, trimesh.creation.box()])
    assert as_scene(both).first_prims.tolist() == [0, 80, 92]
    with pytest.raises(TypeError, match="need a Scene, Mesh.* got str"):
        as_scene("kitchen.glb")


def test_as_scene_takes_the_camera_that_a_trimesh_scene_was_given():
    source = trimesh.Scene(trimesh.creation.box())
    assert as_scene(source)._camera is None
    matrix = trimesh.transformations.translation_matrix((0, 0, 5))
    source.camera = trimesh.scene.Camera(fov=(60, 40))
    source.camera_transform = matrix
    camera = as_scene(source).camera
    assert camera.eye.tolist() == [0, 0, 5] and camera.fov_y == pytest.approx(40)
    assert camera.basis[2].tolist() == [0, 0, -1]


def test_load_scene_of_a_file_without_camera_and_lights(tmp_path):
    trimesh.creation.box().export(tmp_path / "box.glb")
    scene = load_scene(str(tmp_path / "box.glb"))
    assert scene.num_triangles == 12 and scene.name == "box"
    assert len(scene.lights) == 1 and scene._camera is None


def test_load_scene_passes_its_options_on(tmp_path):
    path = save_ply_with_nan(tmp_path / "bad.ply")
    with pytest.raises(ValueError, match="invalid"):
        load_scene(path)
    scene = load_scene(path, on_invalid="drop", smooth=True)
    assert scene.meshes[0].dropped == 1 and scene.meshes[0].normals is not None


def test_gltf_camera_and_names_survive_a_round_trip_through_trimesh(tmp_path):
    source = trimesh.Scene()
    source.add_geometry(trimesh.creation.box(), node_name="crate", geom_name="crate")
    source.camera = trimesh.scene.Camera(fov=(60, 40))
    source.camera_transform = trimesh.transformations.translation_matrix((0, 1, 5))
    source.export(tmp_path / "a.glb")
    scene = load_scene(tmp_path / "a.glb")
    assert scene.camera.eye.tolist() == [0, 1, 5]
    assert scene.camera.fov_y == pytest.approx(40)
    assert [mesh.name for mesh in scene.meshes] == ["crate"]
