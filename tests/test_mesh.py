import json
import struct

import numpy as np
import pytest
import trimesh
from PIL import Image

from raystream.material import Material, srgb_to_linear
from raystream.mesh import Mesh, from_trimesh, invalid_faces, load_meshes
from raystream.shapes import smooth_normals

SQUARE = np.array([(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)], dtype=np.float64)
TWO = np.array([(0, 1, 2), (2, 3, 0)])


def box():
    return trimesh.creation.box((1, 2, 3))


def save_obj(path, lines, mtl=None):
    path.write_text("\n".join(lines) + "\n")
    if mtl is not None:
        path.with_suffix(".mtl").write_text("\n".join(mtl) + "\n")
    return path


def save_glb(path, header, payload):
    """A binary glTF of one buffer, so that a test can state every key of its JSON."""
    payload += bytes(-len(payload) % 4)
    header = {"asset": {"version": "2.0"}, "buffers": [{"byteLength": len(payload)}], **header}
    text = json.dumps(header).encode()
    text += b" " * (-len(text) % 4)
    length = 12 + 8 + len(text) + 8 + len(payload)
    path.write_bytes(
        struct.pack("<4sII", b"glTF", 2, length)
        + struct.pack("<I4s", len(text), b"JSON")
        + text
        + struct.pack("<I4s", len(payload), b"BIN\0")
        + payload
    )
    return path


def triangle_glb(path, material=None, color=None, **header):
    """One triangle (0 0 0) (1 0 0) (0 1 0) with a material and COLOR_0 bytes."""
    payload = np.array([(0, 0, 0), (1, 0, 0), (0, 1, 0)], np.float32).tobytes()
    views = [{"buffer": 0, "byteOffset": 0, "byteLength": 36}]
    accessors = [{"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3"}]
    primitive = {"attributes": {"POSITION": 0}}
    if color is not None:
        payload += np.array([[*color, 255]] * 3, np.uint8).tobytes()
        views.append({"buffer": 0, "byteOffset": 36, "byteLength": 12})
        accessors.append(
            {"bufferView": 1, "componentType": 5121, "count": 3, "type": "VEC4", "normalized": True}
        )
        primitive["attributes"]["COLOR_0"] = 1
    if material is not None:
        primitive["material"] = 0
        header["materials"] = [material]
    return save_glb(
        path,
        {
            "bufferViews": views,
            "accessors": accessors,
            "meshes": [{"primitives": [primitive]}],
            "nodes": [{"mesh": 0, "name": "triangle"}],
            "scenes": [{"nodes": [0]}],
            "scene": 0,
            **header,
        },
        payload,
    )


# --- Mesh ---


def test_arrays_are_stored_as_float32_and_int32():
    mesh = Mesh(SQUARE, TWO, uv=SQUARE[:, :2], colors=SQUARE, normals=SQUARE)
    for field in ("vertices", "uv", "colors", "normals"):
        assert getattr(mesh, field).dtype == np.float32
        assert getattr(mesh, field).flags.c_contiguous
    assert mesh.faces.dtype == np.int32 and mesh.faces.tolist() == TWO.tolist()


def test_an_empty_mesh_and_zero_area_triangles_are_allowed():
    assert Mesh(SQUARE, []).faces.shape == (0, 3)
    assert Mesh(np.zeros((0, 3)), []).vertices.shape == (0, 3)
    assert len(Mesh(SQUARE, [(0, 0, 1), (1, 1, 1)]).faces) == 2


def test_vertices_that_no_face_uses_may_hold_anything():
    vertices = np.vstack([SQUARE, [(np.nan, np.inf, 0)]])
    assert len(Mesh(vertices, TWO).vertices) == 5


@pytest.mark.parametrize("faces", [[(0, 1, 4)], [(0, -1, 2)], [(0, 1, 2**31)]])
def test_an_index_out_of_range_is_refused(faces):
    with pytest.raises(ValueError, match="^mesh 'roof': need .* got 1 invalid of 1 faces: 0$"):
        Mesh(SQUARE, faces, "roof")


@pytest.mark.parametrize("value", [np.nan, np.inf, 1e39])
def test_a_vertex_that_is_not_finite_in_float32_is_refused(value):
    vertices = np.vstack([SQUARE, [(0, value, 0)]])
    with pytest.raises(ValueError, match="got 2 invalid of 3 faces: 0, 2"):
        Mesh(vertices, [(0, 1, 4), (0, 1, 2), (4, 2, 3)])


def test_the_message_shows_only_the_first_faces():
    with pytest.raises(ValueError, match=r"100 invalid of 100 faces: 0, 1, 2, 3, 4, \.\.\.$"):
        Mesh(SQUARE, np.full((100, 3), 9))


@pytest.mark.parametrize(
    "arrays, wanted",
    [
        ({"vertices": SQUARE[:, :2]}, "vertices: need shape (n, 3)"),
        ({"faces": [(0, 1, 2, 3)]}, "faces: need integers (m, 3)"),
        ({"faces": [(0.0, 1.0, 2.0)]}, "faces: need integers (m, 3)"),
        ({"normals": SQUARE[:3]}, "normals: need shape (4, 3)"),
        ({"uv": SQUARE}, "uv: need shape (4, 2)"),
        ({"colors": SQUARE[:, :2]}, "colors: need shape (4, 3)"),
    ],
)
def test_a_wrong_shape_is_refused(arrays, wanted):
    with pytest.raises(ValueError) as caught:
        Mesh(**{"vertices": SQUARE, "faces": TWO, "name": "m", **arrays})
    assert str(caught.value).startswith(f"mesh 'm': {wanted}, got")


def test_invalid_faces_of_no_faces():
    assert invalid_faces(SQUARE, np.zeros((0, 3), int)).shape == (0,)


def test_with_vertices_keeps_the_topology_and_renews_smooth_normals():
    mesh = Mesh(SQUARE, TWO, "m", smooth_normals(SQUARE, TWO))
    turned = mesh.with_vertices(SQUARE[:, [2, 0, 1]])
    assert turned.faces.tolist() == TWO.tolist() and turned.name == "m"
    np.testing.assert_allclose(turned.normals, [(1, 0, 0)] * 4, atol=1e-7)
    np.testing.assert_allclose(mesh.normals, [(0, 0, 1)] * 4, atol=1e-7)
    with pytest.raises(ValueError, match=r"vertices: need shape \(4, 3\)"):
        mesh.with_vertices(SQUARE[:3])


# --- files ---


@pytest.mark.parametrize("suffix", ["obj", "ply", "stl", "off", "glb"])
def test_round_trip_keeps_face_order_and_positions(tmp_path, suffix):
    source = box()
    path = tmp_path / f"box.{suffix}"
    source.export(path)
    (mesh,) = load_meshes(path)
    assert mesh.faces.shape == (12, 3)
    np.testing.assert_allclose(mesh.vertices[mesh.faces], source.triangles, atol=1e-6)
    reference = trimesh.load(path, force="mesh", process=False)
    assert mesh.faces.tolist() == reference.faces.tolist()


@pytest.mark.parametrize("suffix", ["ply", "stl", "off", "glb"])
def test_files_without_normals_are_flat_unless_smooth(tmp_path, suffix):
    path = tmp_path / f"box.{suffix}"
    path.write_bytes(_bytes(trimesh.Trimesh(SQUARE, TWO, process=False), suffix))
    (flat,) = load_meshes(path)
    (smooth,) = load_meshes(path, smooth=True)
    assert flat.normals is None
    np.testing.assert_allclose(smooth.normals, [(0, 0, 1)] * len(smooth.vertices), atol=1e-6)


def _bytes(mesh, suffix):
    options = {"ply": {"vertex_normal": False}, "glb": {"include_normals": False}}.get(suffix, {})
    data = mesh.export(file_type=suffix, **options)
    return data.encode() if isinstance(data, str) else data


@pytest.mark.parametrize("suffix", ["obj", "ply", "glb"])
def test_normals_in_the_file_are_taken(tmp_path, suffix):
    normals = np.array([(0, 0.6, 0.8), (0, 0, 1), (0.6, 0, 0.8), (0, 0, 1)])
    source = trimesh.Trimesh(SQUARE, TWO, vertex_normals=normals, process=False)
    path = tmp_path / f"square.{suffix}"
    source.export(path, **{"vertex_normal" if suffix == "ply" else "include_normals": True})
    (mesh,) = load_meshes(path)
    np.testing.assert_allclose(mesh.normals[mesh.faces], normals[TWO], atol=1e-6)


def test_every_placed_mesh_comes_in_the_order_of_insertion(tmp_path):
    scene = trimesh.Scene()
    scene.add_geometry(box(), node_name="second", geom_name="shared")
    scene.add_geometry(trimesh.Trimesh(SQUARE, TWO), node_name="first", geom_name="plate")
    scene.graph.update(
        "third", geometry="shared", matrix=trimesh.transformations.translation_matrix((5, 0, 0))
    )
    meshes = from_trimesh(scene)
    assert [mesh.name for mesh in meshes] == ["second", "first", "third"]
    assert [len(mesh.faces) for mesh in meshes] == [12, 2, 12]
    np.testing.assert_allclose(meshes[2].vertices - meshes[0].vertices, [(5, 0, 0)] * 8)
    scene.export(tmp_path / "placed.glb")
    loaded = trimesh.load(tmp_path / "placed.glb", force="scene", process=False)
    assert [mesh.name for mesh in load_meshes(tmp_path / "placed.glb")] == list(
        loaded.graph.nodes_geometry
    )


def test_transforms_are_baked_and_normals_stay_perpendicular():
    slope = trimesh.Trimesh([(0, 0, 0), (1, 1, 0), (0, 0, 1)], [(0, 1, 2)], process=False)
    scene = trimesh.Scene()
    matrix = np.diag([3.0, 1, 1, 1])
    matrix[:3, 3] = (10, 20, 30)
    scene.add_geometry(slope, transform=matrix)
    (mesh,) = from_trimesh(scene, smooth=True)
    np.testing.assert_allclose(mesh.vertices[1], (13, 21, 30))
    expected = np.cross(mesh.vertices[1] - mesh.vertices[0], mesh.vertices[2] - mesh.vertices[0])
    np.testing.assert_allclose(mesh.normals, [expected / np.linalg.norm(expected)] * 3, atol=1e-6)


def test_a_mirroring_transform_keeps_the_order_of_vertices_and_turns_normals_outward():
    scene = trimesh.Scene()
    ball = trimesh.creation.icosphere(1)
    scene.add_geometry(ball, transform=np.diag([-1.0, 1, 1, 1]))
    (mesh,) = from_trimesh(scene, smooth=True)
    assert mesh.faces.tolist() == ball.faces.tolist()
    np.testing.assert_allclose(mesh.vertices, ball.vertices * (-1, 1, 1), atol=1e-6)
    assert (np.einsum("ij,ij->i", mesh.normals, mesh.vertices) > 0.9).all()


def test_a_trimesh_object_keeps_its_order_and_does_not_depend_on_what_it_has_computed():
    source = trimesh.Trimesh(SQUARE, TWO, process=False)
    assert source.vertex_normals is not None  # now in its cache
    (mesh,) = from_trimesh(source)
    assert mesh.faces.tolist() == TWO.tolist()
    assert mesh.vertices.tolist() == SQUARE.tolist()
    assert mesh.normals is None
    assert from_trimesh(source, smooth=True)[0].normals is not None


# --- materials and colours ---

QUAD = ["v 0 0 0", "v 1 0 0", "v 1 1 0", "v 0 1 0"]


def test_obj_with_mtl(tmp_path):
    path = save_obj(
        tmp_path / "a.obj",
        ["mtllib a.mtl", *QUAD, "usemtl tin", "f 1 2 3", "f 1 3 4"],
        ["newmtl tin", "Kd 0.5 0.25 0.125", "Ks 1 1 1", "Ns 9", "illum 3", "d 0.5"],
    )
    (mesh,) = load_meshes(path)
    assert mesh.material.name == "tin"
    assert mesh.material.diffuse.tolist() == [0.5, 0.25, 0.125]
    assert mesh.material.reflectivity.tolist() == [1, 1, 1]
    assert mesh.material.shininess == 9
    assert mesh.material.transmission.tolist() == [0.5] * 3


def test_mtl_without_ks_has_no_highlight(tmp_path):
    path = save_obj(
        tmp_path / "a.obj", ["mtllib a.mtl", *QUAD, "usemtl m", "f 1 2 3"], ["newmtl m", "Kd 1 1 1"]
    )
    assert load_meshes(path)[0].material.specular.max() == 0


@pytest.mark.parametrize("uv", [False, True])
def test_obj_whose_mtl_is_missing_loads_with_the_default_material(tmp_path, uv):
    corners = "f 1/1 2/2 3/3" if uv else "f 1 2 3"
    path = save_obj(
        tmp_path / "a.obj",
        ["mtllib none.mtl", *QUAD, "vt 0 0", "vt 1 0", "vt 1 1", "usemtl gone", corners],
    )
    (mesh,) = load_meshes(path)
    assert mesh.material.diffuse.tolist() == Material().diffuse.tolist()
    assert mesh.material.texture is None
    assert (mesh.uv is not None) == uv


def test_obj_texture_has_its_top_row_first_and_v_0_at_the_bottom(tmp_path):
    image = np.zeros((2, 2, 3), np.uint8)
    image[0] = (255, 0, 0)
    Image.fromarray(image).save(tmp_path / "t.png")
    path = save_obj(
        tmp_path / "a.obj",
        ["mtllib a.mtl", *QUAD, "vt 0 0", "vt 1 0", "vt 1 0.75", "usemtl m", "f 1/1 2/2 3/3"],
        ["newmtl m", "map_Kd t.png"],
    )
    (mesh,) = load_meshes(path)
    assert mesh.material.texture.tolist() == image.tolist()
    assert mesh.material.diffuse.tolist() == [1, 1, 1]
    np.testing.assert_allclose(mesh.uv[mesh.faces[0]], [(0, 0), (1, 0), (1, 0.75)])


def test_gltf_texture_coordinates_are_turned_so_that_v_0_is_the_bottom(tmp_path):
    image = Image.fromarray(np.full((2, 2, 3), 7, np.uint8))
    uv = np.array([(0, 0), (1, 0), (1, 1), (0, 1)])
    material = trimesh.visual.material.PBRMaterial(baseColorTexture=image, name="tiles")
    visual = trimesh.visual.TextureVisuals(uv=uv, material=material)
    trimesh.Trimesh(SQUARE, TWO, visual=visual, process=False).export(tmp_path / "a.glb")
    (mesh,) = load_meshes(tmp_path / "a.glb")
    np.testing.assert_allclose(mesh.uv, uv)
    assert mesh.material.name == "tiles" and (mesh.material.texture == 7).all()


def test_gltf_factors(tmp_path):
    path = triangle_glb(
        tmp_path / "a.glb",
        {
            "name": "lamp",
            "emissiveFactor": [1, 0.5, 0],
            "pbrMetallicRoughness": {"baseColorFactor": [1, 1, 1, 0.2], "metallicFactor": 0},
        },
    )
    (mesh,) = load_meshes(path)
    assert mesh.name == "triangle" and mesh.material.name == "lamp"
    np.testing.assert_allclose(mesh.material.transmission, 0.8)
    assert mesh.material.emission.tolist() == [1, 0.5, 0]


def test_vertex_colors_are_srgb_bytes_except_in_gltf_which_says_linear(tmp_path):
    colors = np.array(
        [(255, 0, 0, 255), (0, 128, 0, 255), (0, 0, 51, 255), (9, 9, 9, 255)], np.uint8
    )
    source = trimesh.Trimesh(SQUARE, TWO, vertex_colors=colors, process=False)
    source.export(tmp_path / "a.ply")
    for (mesh,) in (load_meshes(tmp_path / "a.ply"), from_trimesh(source)):
        np.testing.assert_array_equal(mesh.colors, srgb_to_linear(colors[:, :3]))
        assert mesh.material.diffuse.tolist() == [1, 1, 1]
    for material in (None, {"name": "m"}):
        (mesh,) = load_meshes(triangle_glb(tmp_path / "a.glb", material, color=(255, 51, 0)))
        np.testing.assert_allclose(mesh.colors, [(1, 0.2, 0)] * 3, atol=1e-7)


def test_face_colors_become_their_mean():
    source = trimesh.Trimesh(
        SQUARE, TWO, process=False, face_colors=[(255, 0, 0, 255), (0, 0, 255, 255)]
    )
    (mesh,) = from_trimesh(source)
    assert mesh.colors is None
    assert mesh.material.diffuse.tolist() == [0.5, 0, 0.5]


def test_several_materials_in_one_mesh_are_refused():
    materials = [trimesh.visual.material.SimpleMaterial() for _ in range(2)]
    visual = trimesh.visual.TextureVisuals(
        uv=SQUARE[:, :2], material=trimesh.visual.material.MultiMaterial(materials)
    )
    with pytest.raises(ValueError, match="mesh 'mesh': need one material .* got MultiMaterial"):
        from_trimesh(trimesh.Trimesh(SQUARE, TWO, visual=visual, process=False))


def test_a_simple_material_made_in_python_gives_its_colour():
    visual = trimesh.visual.TextureVisuals(
        material=trimesh.visual.material.SimpleMaterial(diffuse=(255, 0, 0, 255))
    )
    (mesh,) = from_trimesh(trimesh.Trimesh(SQUARE, TWO, visual=visual, process=False))
    assert mesh.material.diffuse.tolist() == [1, 0, 0]


def test_zero_normals_of_a_file_are_replaced(tmp_path):
    lines = [
        "ply",
        "format ascii 1.0",
        "element vertex 3",
        *(f"property float {name}" for name in ("x", "y", "z", "nx", "ny", "nz")),
        "element face 1",
        "property list uchar int vertex_indices",
        "end_header",
        "0 0 0 0 0 0",
        "1 0 0 0.6 0 0.8",
        "0 1 0 0 0 1",
        "3 0 1 2",
    ]
    (tmp_path / "a.ply").write_text("\n".join(lines) + "\n")
    (mesh,) = load_meshes(tmp_path / "a.ply")
    np.testing.assert_allclose(mesh.normals, [(0, 0, 1), (0.6, 0, 0.8), (0, 0, 1)], atol=1e-7)


# --- errors ---


def test_a_missing_file_and_a_folder_are_an_oserror(tmp_path):
    with pytest.raises(FileNotFoundError, match="none.glb"):
        load_meshes(tmp_path / "none.glb")
    with pytest.raises(OSError):
        load_meshes(tmp_path)


def test_an_unknown_suffix_is_refused_with_the_list(tmp_path):
    (tmp_path / "a.xyz123").write_text("")
    with pytest.raises(ValueError, match=r"unknown suffix '\.xyz123'.*\bglb\b.*\bply\b"):
        load_meshes(tmp_path / "a.xyz123")


@pytest.mark.parametrize("name", ["a.glb", "a.gltf", "a.ply", "a.off", "a.stl", "a.obj"])
@pytest.mark.parametrize("content", [b"", b"this is no mesh\n" * 20, b"glTF", b"\xff" * 100])
def test_content_that_is_no_mesh_is_a_one_line_valueerror(tmp_path, name, content):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(ValueError, match=name) as caught:
        load_meshes(tmp_path / name)
    assert "\n" not in str(caught.value)


def test_points_only_are_refused(tmp_path):
    trimesh.PointCloud(SQUARE).export(tmp_path / "points.ply")
    with pytest.raises(ValueError, match="points.ply: need triangles, found none"):
        load_meshes(tmp_path / "points.ply")


def save_ply_with_nan(path):
    lines = [
        "ply",
        "format ascii 1.0",
        "element vertex 5",
        "property float x",
        "property float y",
        "property float z",
        "element face 3",
        "property list uchar int vertex_indices",
        "end_header",
        "0 0 0",
        "1 0 0",
        "1 1 0",
        "0 1 0",
        "nan 0 0",
        "3 0 1 4",
        "3 0 1 2",
        "3 2 3 0",
    ]
    path.write_text("\n".join(lines) + "\n")
    return path


def test_invalid_faces_in_a_file_are_refused_or_dropped_and_counted(tmp_path):
    path = save_ply_with_nan(tmp_path / "bad.ply")
    with pytest.raises(ValueError, match=r"mesh 'bad\.ply': .* 1 invalid of 3 faces: 0$"):
        load_meshes(path)
    (mesh,) = load_meshes(path, on_invalid="drop")
    assert mesh.dropped == 1
    assert mesh.face_ids.tolist() == [1, 2]
    assert mesh.faces.tolist() == [[0, 1, 2], [2, 3, 0]]


def test_nothing_dropped_needs_no_map(tmp_path):
    box().export(tmp_path / "a.ply")
    (mesh,) = load_meshes(tmp_path / "a.ply", on_invalid="drop")
    assert mesh.dropped == 0 and mesh.face_ids is None


def test_an_unknown_choice_for_invalid_faces_is_refused(tmp_path):
    box().export(tmp_path / "a.ply")
    with pytest.raises(ValueError, match="on_invalid: need one of 'raise', 'drop', got 'ignore'"):
        load_meshes(tmp_path / "a.ply", on_invalid="ignore")


def test_obj_index_out_of_range_is_a_valueerror(tmp_path):
    path = save_obj(tmp_path / "a.obj", [*QUAD, "f 1 2 9"])
    with pytest.raises(ValueError, match="a.obj"):
        load_meshes(path)
