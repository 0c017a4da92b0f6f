import json

import numpy as np
import pytest
from test_mesh import triangle_glb

from raystream import gltf
from raystream.light import DirectionalLight, PointLight, SpotLight
from raystream.mesh import load_meshes
from raystream.scene import load_scene


@pytest.mark.parametrize(
    "name, expected", [("a.GLB", True), ("b/a.gltf", True), ("a.obj", False), ("glb", False)]
)
def test_gltf_is_told_by_suffix(name, expected):
    assert gltf.is_gltf(name) == expected


def test_text_and_binary_have_the_same_header(tmp_path):
    header = {"asset": {"version": "2.0"}, "nodes": [{"name": "Bärbel"}]}
    (tmp_path / "a.gltf").write_text(json.dumps(header))
    binary = triangle_glb(tmp_path / "a.glb", nodes=header["nodes"])
    assert gltf.read_header(tmp_path / "a.gltf") == header
    assert gltf.read_header(binary)["nodes"] == header["nodes"]


@pytest.mark.parametrize("content", [b"", b"glTF", b"glTF" + bytes(16), b"{", b"\xff", b"[1]"])
def test_what_is_no_header_is_a_one_line_valueerror_that_names_the_file(tmp_path, content):
    path = tmp_path / "a.glb"
    path.write_bytes(content)
    with pytest.raises(ValueError, match="a.glb: need glTF 2.0 JSON: ") as caught:
        gltf.read_header(path)
    assert "\n" not in str(caught.value)


def test_material_extensions_skip_primitives_that_trimesh_skips():
    triangles, loop = {"material": 1}, {"mode": 2, "material": 0}
    header = {
        "materials": [{"extensions": {"A": {}}}, {"extensions": {"B": {"x": 1}}}],
        "meshes": [{"primitives": [loop, triangles]}, {"primitives": [{"mode": 0}]}],
    }
    assert gltf.material_extensions(header, ["first", "second"]) == {"first": {"B": {"x": 1}}}
    assert gltf.material_extensions({"materials": [{}]}, ["first"]) == {}


def test_a_header_without_a_scene_has_no_camera_and_no_lights():
    assert gltf.camera_and_lights({}, "a.glb") == (None, None)


def test_compressed_gltf_is_refused_rather_than_read_as_zeros(tmp_path):
    path = triangle_glb(tmp_path / "a.glb", extensionsRequired=["EXT_meshopt_compression"])
    with pytest.raises(ValueError, match="a.glb: need plain geometry.*EXT_meshopt_compression"):
        load_meshes(path)


def test_gltf_transmission_and_ior_extensions(tmp_path):
    path = triangle_glb(
        tmp_path / "a.glb",
        {
            "extensions": {
                "KHR_materials_transmission": {"transmissionFactor": 0.75},
                "KHR_materials_ior": {"ior": 1.33},
            }
        },
    )
    (mesh,) = load_meshes(path)
    assert mesh.material.transmission.tolist() == [0.75] * 3
    assert mesh.material.ior == 1.33


def test_gltf_camera_is_placed_by_all_its_parents(tmp_path):
    half = np.sqrt(0.5)
    path = triangle_glb(
        tmp_path / "a.glb",
        scenes=[{"nodes": [0, 1]}],
        cameras=[
            {"type": "orthographic", "orthographic": {}},
            {"type": "perspective", "perspective": {"yfov": np.pi / 3, "znear": 0.1}},
        ],
        nodes=[
            {"mesh": 0},
            {"translation": [1, 2, 3], "scale": [2, 2, 2], "children": [2, 3]},
            {"camera": 0},
            {"camera": 1, "translation": [0, 0, 5], "rotation": [0, half, 0, half]},
        ],
    )
    camera = load_scene(path).camera
    np.testing.assert_allclose(camera.eye, (1, 2, 13), atol=1e-12)
    # a quarter turn about y takes -z to -x
    np.testing.assert_allclose(camera.basis[2], (-1, 0, 0), atol=1e-12)
    np.testing.assert_allclose(camera.basis[1], (0, 1, 0), atol=1e-12)
    assert camera.fov_y == pytest.approx(60)


def test_gltf_lights(tmp_path):
    lights = [
        {"type": "point", "color": [1, 0.5, 0], "intensity": 10},
        {"type": "directional", "intensity": 2},
        {"type": "spot", "spot": {"innerConeAngle": 0.1, "outerConeAngle": 0.5}},
        {"type": "spot"},
    ]
    nodes = [{"mesh": 0}] + [
        {"translation": [k, 4, 0], "extensions": {"KHR_lights_punctual": {"light": k}}}
        for k in range(4)
    ]
    down = [1, 0, 0, 0, 0, 0, 1, 0, 0, -1, 0, 0, 0, 0, 0, 1]  # columns: takes -z to +y
    nodes[2] = {"matrix": down, "extensions": {"KHR_lights_punctual": {"light": 1}}}
    path = triangle_glb(
        tmp_path / "a.glb",
        scenes=[{"nodes": [0, 1, 2, 3, 4]}],
        nodes=nodes,
        extensions={"KHR_lights_punctual": {"lights": lights}},
    )
    point, sun, spot, default_spot = load_scene(path).lights
    assert isinstance(point, PointLight) and point.falloff
    assert point.position.tolist() == [0, 4, 0] and point.color.tolist() == [10, 5, 0]
    assert isinstance(sun, DirectionalLight) and sun.color.tolist() == [2, 2, 2]
    assert sun.direction.tolist() == [0, 1, 0]
    assert isinstance(spot, SpotLight) and spot.falloff and spot.position.tolist() == [2, 4, 0]
    assert spot.direction.tolist() == [0, 0, -1]
    assert np.radians([spot.inner_angle, spot.outer_angle]).tolist() == pytest.approx([0.1, 0.5])
    assert (default_spot.inner_angle, default_spot.outer_angle) == (0, pytest.approx(45))


@pytest.mark.parametrize(
    "header",
    [
        {"nodes": [{"mesh": 0, "extensions": {"KHR_lights_punctual": {"light": 3}}}]},
        {
            "nodes": [{"mesh": 0}, {"camera": 0}],
            "scenes": [{"nodes": [0, 1]}],
            "cameras": [{"perspective": {"yfov": 0.0}, "type": "perspective"}],
        },
    ],
)
def test_a_bad_gltf_camera_or_light_is_a_valueerror_that_names_the_file(tmp_path, header):
    path = triangle_glb(tmp_path / "a.glb", **header)
    with pytest.raises(ValueError, match="a.glb: cannot read its camera and lights"):
        load_scene(path)
