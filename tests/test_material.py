import numpy as np
import pytest

from raystream.material import Material, from_gltf, from_mtl, srgb_to_linear


def test_defaults_are_a_grey_opaque_surface():
    material = Material()
    assert material.diffuse.tolist() == pytest.approx([0.8] * 3)
    for field in ("specular", "reflectivity", "transmission", "emission"):
        assert getattr(material, field).tolist() == [0, 0, 0]
    assert (material.shininess, material.ior) == (32.0, 1.5)
    assert material.texture is None


def test_colors_are_float32_and_a_number_stands_for_three_channels():
    material = Material(reflectivity=0.25, diffuse=[1, 2, 3])
    assert material.reflectivity.dtype == material.diffuse.dtype == np.float32
    assert material.reflectivity.tolist() == [0.25, 0.25, 0.25]
    assert material.diffuse.tolist() == [1, 2, 3]


def test_materials_do_not_share_or_alias_the_callers_array():
    color = np.array([0.1, 0.2, 0.3], dtype=np.float32)
    material = Material(diffuse=color)
    color[:] = 9
    assert material.diffuse.max() < 1


@pytest.mark.parametrize(
    "field, value",
    [
        ("diffuse", -0.1),
        ("diffuse", [0, 0, np.nan]),
        ("diffuse", [1, 2]),
        ("diffuse", "red"),
        ("specular", np.inf),
        ("emission", [-1, 0, 0]),
        ("reflectivity", 1.5),
        ("reflectivity", [0, 0, 2]),
        ("transmission", -0.5),
        ("transmission", 1.01),
        ("transmission", None),
        ("ior", 0.0),
        ("ior", np.inf),
        ("shininess", -1),
        ("shininess", "x"),
        ("texture", np.zeros((2, 2), np.uint8)),
        ("texture", np.zeros((2, 2, 3))),
        ("texture", np.zeros((0, 2, 3), np.uint8)),
        ("texture", np.zeros((2, 2, 4), np.uint8)),
    ],
)
def test_a_value_out_of_range_is_refused_in_one_line_that_names_the_field(field, value):
    with pytest.raises(ValueError, match=f"^{field}: need .*got") as caught:
        Material(**{field: value})
    assert "\n" not in str(caught.value)


def test_srgb_fixed_points_and_middle_grey():
    linear = srgb_to_linear(np.array([0, 10, 128, 255], np.uint8))
    expected = [0, 10 / 255 / 12.92, ((128 / 255 + 0.055) / 1.055) ** 2.4, 1]
    np.testing.assert_allclose(linear, expected, rtol=1e-6)
    assert linear.dtype == np.float32


def test_gltf_dielectric_is_diffuse_only():
    material = from_gltf("clay", (0.5, 0.25, 1, 1), metallic=0, roughness=1)
    assert material.name == "clay"
    assert material.diffuse.tolist() == [0.5, 0.25, 1]
    assert material.reflectivity.max() == 0 and material.transmission.max() == 0
    np.testing.assert_allclose(material.specular, 0.04)


def test_gltf_polished_metal_is_a_tinted_mirror_and_rough_metal_stays_diffuse():
    polished = from_gltf("", (0.9, 0.6, 0.3, 1), metallic=1, roughness=0)
    np.testing.assert_allclose(polished.reflectivity, [0.9, 0.6, 0.3], rtol=1e-6)
    assert polished.diffuse.max() == 0 and polished.shininess == 1000
    half = from_gltf("", (1, 1, 1, 1), metallic=1, roughness=0.5)
    np.testing.assert_allclose(half.reflectivity, 0.25)
    np.testing.assert_allclose(half.diffuse * (1 - half.reflectivity), 0.75)
    np.testing.assert_allclose(half.shininess, 2 / 0.5**4 - 2)
    rough = from_gltf("", (0.9, 0.6, 0.3, 1), metallic=1, roughness=1)
    np.testing.assert_allclose(rough.diffuse, [0.9, 0.6, 0.3], rtol=1e-6)


@pytest.mark.parametrize("metallic, roughness", [(1, 0), (1, 0.3), (0.5, 0.1), (0, 0)])
def test_gltf_mirrored_and_opaque_shares_of_a_metal_make_up_its_colour(metallic, roughness):
    color = np.array([0.9, 0.6, 0.3])
    material = from_gltf("", (*color, 1), metallic, roughness)
    shown = material.diffuse * (1 - material.reflectivity) + material.reflectivity
    np.testing.assert_allclose(shown, color, rtol=1e-6)


def test_gltf_perfect_white_mirror_is_finite():
    material = from_gltf("", (1, 1, 1, 1), metallic=1, roughness=0)
    assert material.reflectivity.tolist() == [1, 1, 1] and material.diffuse.tolist() == [0, 0, 0]


def test_gltf_alpha_and_the_transmission_extension():
    by_alpha = from_gltf("", (1, 1, 1, 0.25), metallic=0)
    assert by_alpha.transmission.tolist() == [0.75] * 3
    np.testing.assert_allclose(by_alpha.diffuse, 1)
    by_extension = from_gltf("", (1, 0.5, 0, 0.25), metallic=0, transmission=0.5, ior=1.3)
    assert by_extension.transmission.tolist() == [0.5, 0.25, 0] and by_extension.ior == 1.3
    shown = by_extension.diffuse * (1 - by_extension.transmission)
    np.testing.assert_allclose(shown, [0.5, 0.25, 0], rtol=1e-6)


def test_mtl_keys():
    image = np.zeros((2, 2, 3), np.uint8)
    material = from_mtl(
        "paint",
        {
            "Kd": ["0.5", "0.25", "1"],
            "Ks": [0.1, 0.2, 0.3],
            "Ns": 12.0,
            "Ni": ["1.33"],
            "Ke": ["18", "13", "5"],
            "illum": ["2"],
        },
        image,
    )
    assert material.diffuse.tolist() == [0.5, 0.25, 1]
    np.testing.assert_allclose(material.specular, [0.1, 0.2, 0.3], rtol=1e-6)
    assert (material.shininess, material.ior) == (12.0, 1.33)
    assert material.emission.tolist() == [18, 13, 5]
    assert material.reflectivity.max() == 0
    assert material.texture is not None


@pytest.mark.parametrize(
    "properties",
    [{"d": ["0.25"]}, {"d": ["-halo", "0.25"]}, {"tr": ["0.75"]}, {"d": 0.25, "tr": 0.5}],
)
def test_mtl_dissolve_transmits_the_rest(properties):
    material = from_mtl("", {"kd": [1, 1, 1], **properties})
    assert material.transmission.tolist() == [0.75] * 3
    np.testing.assert_allclose(material.diffuse * (1 - material.transmission), 0.25)


def test_mtl_transmission_filter_tints_what_passes_and_not_what_is_shown():
    clear = from_mtl("", {"kd": [1, 1, 1], "d": ["0"], "tf": ["0.5", "1", "1"]})
    assert clear.transmission.tolist() == [0.5, 1, 1]
    half = from_mtl("", {"kd": [0.5, 0, 1], "d": ["0.5"], "tf": ["0.5", "1", "0"]})
    assert half.transmission.tolist() == [0.25, 0.5, 0]
    np.testing.assert_allclose(half.diffuse * (1 - half.transmission), [0.25, 0, 0.5], rtol=1e-6)


@pytest.mark.parametrize("illum, mirrored", [(1, False), (2, False), (3, True), (5, True)])
def test_mtl_illumination_models_3_and_5_mirror_with_ks(illum, mirrored):
    material = from_mtl("", {"ks": [0.5, 0.5, 0.25], "illum": [str(illum)]})
    assert material.reflectivity.tolist() == ([0.5, 0.5, 0.25] if mirrored else [0, 0, 0])


def test_mtl_without_kd_takes_the_default_or_the_texture_unchanged():
    assert from_mtl("", {}).diffuse.tolist() == Material().diffuse.tolist()
    assert from_mtl("", {}, np.zeros((1, 1, 3), np.uint8)).diffuse.tolist() == [1, 1, 1]


@pytest.mark.parametrize(
    "properties, key",
    [
        ({"ns": ["abc"]}, "ns"),
        ({"ni": ["0"]}, "ior"),
        ({"d": ["2"]}, "transmission"),
        ({"kd": ["1", "2"]}, "kd"),
    ],
)
def test_a_bad_mtl_value_names_material_and_key(properties, key):
    with pytest.raises(ValueError, match=f"^material 'glaze': {key}"):
        from_mtl("glaze", properties)
