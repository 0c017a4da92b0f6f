"""render_reference against values that can be worked out by hand."""

from types import SimpleNamespace

import numpy as np
import pytest
from raystream.baselines import BruteForceTracer, render_reference
from raystream.baselines.optics import fresnel, reflect, refract
from raystream.baselines.surface import decode_srgb, sample_texture

MATERIAL = {
    "diffuse": (0.5, 0.25, 0.125),
    "specular": (0, 0, 0),
    "shininess": 1.0,
    "reflectivity": (0, 0, 0),
    "transmission": 0.0,
    "ior": 1.5,
    "emission": (0, 0, 0),
    "texture": None,
}
KD = np.array(MATERIAL["diffuse"])
BACKGROUND = np.array([0.1, 0.2, 0.3])
SQUARE = np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])


def square(z=0.0, size=10.0, flip=False, **material):
    """Return a square across the z axis whose front faces +z, or -z with `flip`."""
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    return SimpleNamespace(
        vertices=(size * SQUARE + [0, 0, z]).astype(np.float32),
        faces=faces[:, ::-1] if flip else faces,
        normals=None,
        uv=None,
        colors=None,
        material=SimpleNamespace(**{**MATERIAL, **material}),
    )


def make_scene(*meshes, lights=(), ambient=(0, 0, 0), background=BACKGROUND):
    first_vertices = np.cumsum([0] + [len(mesh.vertices) for mesh in meshes])
    vertices = np.concatenate([mesh.vertices for mesh in meshes])
    return SimpleNamespace(
        meshes=meshes,
        lights=lights,
        ambient=ambient,
        background=background,
        vertices=vertices,
        faces=np.concatenate([m.faces + k for m, k in zip(meshes, first_vertices, strict=False)]),
        first_prims=np.cumsum([0] + [len(mesh.faces) for mesh in meshes]),
        bounds=np.array([vertices.min(axis=0), vertices.max(axis=0)]),
    )


def camera(eye=(0, 0, 5), fov_y=1e-3):
    """Return a camera that looks along -z; by default all pixels see the same point."""
    basis = np.array([1.0, 0, 0]), np.array([0, 1.0, 0]), np.array([0, 0, -1.0])
    return SimpleNamespace(eye=np.array(eye, float), basis=basis, fov_y=fov_y)


def point_light(position=(0, 0, 5), color=(1, 1, 1), falloff=False):
    return SimpleNamespace(position=position, color=color, falloff=falloff)


def centre(*args, **options):
    """Render one pixel and return its colour."""
    eye = options.pop("eye", (0, 0, 5))
    return render_reference(*args, camera(eye), size=(1, 1), **options).image[0, 0]


def test_square_lit_head_on_has_radiance_kd():
    scene = make_scene(square(), lights=[point_light()])
    np.testing.assert_allclose(centre(scene), KD, rtol=1e-6)


def test_falloff_divides_by_the_squared_distance():
    light = point_light(color=(3, 2, 1), falloff=True)
    np.testing.assert_allclose(
        centre(make_scene(square(), lights=[light])), KD * [3, 2, 1] / 25, rtol=1e-6
    )


def test_lambert_cosine_of_a_directional_light():
    light = SimpleNamespace(direction=(-3, 0, -4), color=(2, 2, 2))
    np.testing.assert_allclose(
        centre(make_scene(square(), lights=[light])), 2 * KD * 0.8, rtol=1e-6
    )


@pytest.mark.parametrize(("degrees", "share"), [(0, 1), (20, 1), (30, None), (40, 0), (50, 0)])
def test_spot_falls_off_between_its_angles(degrees, share):
    if share is None:
        inner, outer, middle = np.cos(np.radians([20, 40, 30]))
        share = ((middle - outer) / (inner - outer)) ** 2
    x, z = np.sin(np.radians(degrees)), np.cos(np.radians(degrees))
    spot = SimpleNamespace(
        position=(0, 0, 5), direction=(3 * x, 0, -3 * z), color=(1, 1, 1),
        inner_angle=20.0, outer_angle=40.0, falloff=False,
    )  # fmt: skip
    np.testing.assert_allclose(
        centre(make_scene(square(), lights=[spot])), KD * share, rtol=1e-5, atol=1e-7
    )


def test_highlight():
    x, z = np.sin(np.radians(60)), np.cos(np.radians(60))
    mesh = square(diffuse=(0, 0, 0), specular=(1, 0.5, 0.25), shininess=10.0)
    scene = make_scene(mesh, lights=[point_light((5 * x, 0, 5 * z))])
    expected = np.array([1, 0.5, 0.25]) * np.cos(np.radians(30)) ** 10  # H is half way
    np.testing.assert_allclose(centre(scene), expected, rtol=1e-5)


def test_ambient_and_emission():
    scene = make_scene(square(emission=(1, 2, 3)), ambient=(0.5, 1, 2))
    np.testing.assert_allclose(centre(scene), np.array([1, 2, 3]) + KD * [0.5, 1, 2], rtol=1e-6)


@pytest.mark.parametrize("light", [
    point_light((0, 0, 20)),
    SimpleNamespace(direction=(0, 0, -1), color=(1, 1, 1)),
])  # fmt: skip
def test_shadow(light):
    scene = make_scene(square(), square(z=8.0, size=1.0), lights=[light])
    assert (centre(scene) == 0).all()
    np.testing.assert_allclose(centre(scene, shadows=False), KD, rtol=1e-6)


def test_what_is_behind_the_light_casts_no_shadow():
    scene = make_scene(square(), square(z=8.0), lights=[point_light((0, 0, 7.99))])
    np.testing.assert_allclose(centre(scene), KD, rtol=1e-6)


def test_both_sides_are_shaded_and_only_the_lit_side():
    for flip in (False, True):
        front = make_scene(square(flip=flip), lights=[point_light((0, 0, 5))])
        np.testing.assert_allclose(centre(front), KD, rtol=1e-6)
        assert (centre(make_scene(square(flip=flip), lights=[point_light((0, 0, -5))])) == 0).all()


@pytest.mark.parametrize("bounces", [0, 1])
def test_mirror_shows_the_background_tinted(bounces):
    reflectivity = np.array([0.75, 0.5, 0.25])
    scene = make_scene(square(reflectivity=reflectivity), lights=[point_light()])
    expected = KD * (1 - reflectivity) + bounces * reflectivity * BACKGROUND
    np.testing.assert_allclose(centre(scene, max_bounces=bounces), expected, rtol=1e-6)


@pytest.mark.parametrize("bounces", [0, 1, 2, 5])
def test_two_facing_mirrors_give_a_geometric_series(bounces):
    mirror = {"diffuse": (0, 0, 0), "reflectivity": (0.5,) * 3, "emission": (1, 1, 1)}
    scene = make_scene(square(**mirror), square(z=10.0, **mirror))
    expected = sum(0.5**k for k in range(bounces + 1))
    np.testing.assert_allclose(centre(scene, max_bounces=bounces), [expected] * 3, rtol=1e-6)


def test_rays_of_little_weight_are_dropped():
    mirror = {"diffuse": (0, 0, 0), "reflectivity": (0.25,) * 3, "emission": (1, 1, 1)}
    scene = make_scene(square(**mirror), square(z=10.0, **mirror))
    expected = sum(0.25**k for k in range(5))  # 1/256 is traced, 1/1024 is not
    np.testing.assert_allclose(centre(scene, max_bounces=9), [expected] * 3, rtol=1e-6)


def test_glass_pane_head_on():
    glass = {"diffuse": (1, 1, 1), "transmission": 1.0}
    scene = make_scene(square(**glass), square(z=-1.0, flip=True, **glass))
    share = (0.5 / 2.5) ** 2
    first = centre(scene, max_bounces=1)
    np.testing.assert_allclose(first, share * BACKGROUND, rtol=1e-5)  # the other ray is inside
    both = share * BACKGROUND + (1 - share) ** 2 * BACKGROUND
    np.testing.assert_allclose(centre(scene, max_bounces=2), both, rtol=1e-5)


def test_total_internal_reflection_keeps_all_light():
    direction = np.array([[np.sin(1.0), 0, -np.cos(1.0)]])  # 57 degrees; critical are 41.8
    normal, eta = np.array([[0, 0, 1.0]]), np.array([[1.5]])
    assert fresnel(direction, normal, eta) == 1
    assert refract(direction, normal, eta)[1] == [True]


@pytest.mark.parametrize("ior", [1.1, 1.5, 2.4])
def test_fresnel_at_normal_incidence_and_brewster_angle(ior):
    normal, eta = np.array([[0, 0, 1.0]]), np.array([[1 / ior]])
    np.testing.assert_allclose(fresnel(-normal, normal, eta), ((ior - 1) / (ior + 1)) ** 2)
    np.testing.assert_allclose(fresnel(-normal, normal, 1 / eta), ((ior - 1) / (ior + 1)) ** 2)
    brewster = np.arctan(ior)  # one polarisation is not reflected at all
    direction = np.array([[np.sin(brewster), 0, -np.cos(brewster)]])
    expected = np.cos(2 * brewster) ** 2 / 2
    np.testing.assert_allclose(fresnel(direction, normal, eta), expected)
    assert fresnel(np.array([[1.0, 0, 0]]), normal, eta) == 1


def test_reflection_and_refraction_obey_their_laws():
    rng = np.random.default_rng(0)
    normal = np.tile([0, 0, 1.0], (100, 1))
    direction = rng.normal(size=(100, 3)) - [0, 0, 3]
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    mirrored = reflect(direction, normal)
    np.testing.assert_allclose(mirrored, direction * [1, 1, -1])
    refracted, total = refract(direction, normal, np.full((100, 1), 1 / 1.5))
    assert not total.any()
    np.testing.assert_allclose(np.linalg.norm(refracted, axis=1), 1)
    np.testing.assert_allclose(refracted[:, :2], direction[:, :2] / 1.5)  # Snell
    assert (refracted[:, 2] < 0).all()


def test_image_orientation_and_ids():
    left_top = square(z=0.0, size=1.0, emission=(9, 9, 9))
    left_top.vertices += np.float32([-1, 1, 0])
    frame = render_reference(make_scene(left_top), camera(fov_y=40.0), size=(8, 4))
    hit = (frame.image == 9).all(axis=2)
    assert frame.image.shape == (4, 8, 3) and frame.image.dtype == np.float32
    assert hit[:2, 2:4].all() and hit.sum() == 4
    np.testing.assert_array_equal(frame.geom_id, np.where(hit, 0, -1))
    np.testing.assert_array_equal(frame.prim_id >= 0, hit)
    np.testing.assert_allclose(frame.image[~hit], np.tile(BACKGROUND, (28, 1)), rtol=1e-6)


def test_field_of_view():
    fov_y = np.degrees(2 * np.arctan(1 / 5))  # the square just fills the height
    frame = render_reference(make_scene(square(size=1.0)), camera(fov_y=fov_y), size=(20, 10))
    expected = np.zeros((10, 20), bool)
    expected[:, 5:15] = True
    np.testing.assert_array_equal(frame.geom_id == 0, expected)


def test_samples_are_averaged_over_different_places():
    half = square(size=1.0, emission=(1, 1, 1))
    half.vertices += np.float32([0.99, 0, 0])  # covers x >= -0.01
    scene = make_scene(half, background=(0, 0, 0))
    fov_y = np.degrees(2 * np.arctan(0.5 / 5))
    images = [
        render_reference(scene, camera(fov_y=fov_y), size=(1, 1), samples=n).image[0, 0, 0]
        for n in (2, 3, 100)
    ]
    # Places across the pixel: 0.5, which is on the square, 0.25 and 0.01, which are not, ...
    assert images[0] == 0.5
    np.testing.assert_allclose(images[1:], [1 / 3, 0.5], atol=0.02)


def test_vertex_colours_and_texture_multiply_the_diffuse_colour():
    texture = np.array([[[255, 0, 0], [0, 255, 0]], [[0, 0, 255], [255, 255, 255]]], np.uint8)
    mesh = square(size=1.0, diffuse=(1, 1, 1), texture=texture)
    mesh.uv = np.array([[0, 0], [1, 0], [1, 1], [0, 1.0]])
    mesh.colors = np.full((4, 3), 0.5)
    scene = make_scene(mesh, ambient=(1, 1, 1))
    corner = centre(scene, eye=(-0.5, 0.5, 5))  # the middle of the upper left texel
    np.testing.assert_allclose(corner, [0.5, 0, 0], atol=1e-5)
    np.testing.assert_allclose(centre(scene, eye=(0.5, -0.5, 5)), [0.5] * 3, atol=1e-5)
    np.testing.assert_allclose(centre(scene), [0.25] * 3, atol=1e-5)


def test_texture_is_filtered_after_decoding_and_repeats():
    texture = np.array([[[0] * 3, [255] * 3]], np.uint8)
    uv = np.array([[0.25, 0.5], [0.5, 0.5], [0.75, 0.5], [1.0, 0.5], [-0.25, 7.0]])
    np.testing.assert_allclose(sample_texture(texture, uv)[:, 0], [0, 0.5, 1, 0.5, 1])


def test_srgb_decoding():
    np.testing.assert_allclose(
        decode_srgb([0, 10, 128, 255]), [0, 0.0030353, 0.2158605, 1], rtol=1e-5
    )


def test_interpolated_normals():
    mesh = square(size=1.0)
    mesh.normals = np.array([[-1, 0, 1], [1, 0, 1], [1, 0, 1], [-1, 0, 1.0]])
    scene = make_scene(mesh, lights=[SimpleNamespace(direction=(0, 0, -1), color=(1, 1, 1))])
    np.testing.assert_allclose(centre(scene), KD, rtol=1e-5)
    tilted = 1 / np.hypot(0.5, 1)  # half way to the border
    np.testing.assert_allclose(centre(scene, eye=(0.5, 0, 5)), KD * tilted, rtol=1e-4)


def test_normals_that_cancel_or_point_inwards():
    light = SimpleNamespace(direction=(0, 0, -1), color=(1, 1, 1))
    for normal in ([0, 0, 0], [0, 0, -1]):
        mesh = square()
        mesh.normals = np.tile(np.array(normal, float), (4, 1))
        np.testing.assert_allclose(centre(make_scene(mesh, lights=[light])), KD, rtol=1e-6)


def test_bent_normal_that_would_reflect_into_the_surface():
    mesh = square(diffuse=(0, 0, 0), reflectivity=(1, 1, 1))
    bent = np.radians(80)
    mesh.normals = np.tile([np.sin(bent), 0, np.cos(bent)], (4, 1))
    np.testing.assert_allclose(centre(make_scene(mesh)), BACKGROUND, rtol=1e-6)


def test_any_tracer_gives_the_same_image():
    scene = make_scene(
        square(reflectivity=(0.5,) * 3), square(z=2.0, size=0.5), lights=[point_light((3, 2, 4))]
    )
    exact = BruteForceTracer.from_scene(scene)
    images = [
        render_reference(scene, camera(fov_y=45.0), size=(40, 30), tracer=tracer).image
        for tracer in (None, exact)
    ]
    assert (np.abs(images[0] - images[1]).max(axis=2) > 1e-4).sum() <= 2


def test_scene_without_triangles_is_background():
    empty = square()
    empty.faces = np.zeros((0, 3), int)
    np.testing.assert_allclose(centre(make_scene(empty)), BACKGROUND, rtol=1e-6)


@pytest.mark.parametrize("options", [{"size": (0, 1)}, {"samples": 0}, {"max_bounces": -1}])
def test_bad_options(options):
    with pytest.raises(ValueError, match="render_reference: need size and samples >= 1"):
        render_reference(make_scene(square()), camera(), **options)
