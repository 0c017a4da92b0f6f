"""Whitted pictures: closed-form colours, the reference renderer, options, errors."""

import numpy as np
import pytest
import trimesh
from raystream.baselines import EmbreeTracer, render_reference
from raystream.baselines.tolerance import psnr, ssim
from soup import exact_tracer

import raystream as rs
from raystream.renderer import RAY_KINDS, parse_method

HEAD_ON = rs.Camera.look_at((0, 0, 5), (0, 0, 0), fov_y=20)
SKY = np.array([0.2, 0.3, 0.4])


def square(z=0.0, half=3.0, **material):
    x, y = [-half, half, half, -half], [-half, -half, half, half]
    vertices = np.stack([x, y, np.full(4, z)], axis=1)
    return rs.Mesh(vertices, [[0, 1, 2], [0, 2, 3]], material=rs.Material(**material))


def centre(meshes, lights=(), ambient=0.0, **options):
    """Colour of the middle pixel, seen along -z."""
    scene = rs.Scene(meshes, lights, HEAD_ON, background=SKY, ambient=ambient)
    return rs.render(scene, size=(9, 9), **options).image[4, 4]


def test_the_background_shows_where_nothing_is():
    np.testing.assert_allclose(centre([]), SKY, rtol=1e-6)


def test_emission_and_ambient_light():
    surface = square(diffuse=(0.5, 1, 0), emission=(0, 0.1, 0.2))
    np.testing.assert_allclose(centre([surface], ambient=0.4), [0.2, 0.5, 0.2], rtol=1e-6)


@pytest.mark.parametrize(("light", "expected"), [
    (rs.PointLight((0, 0, 2), 0.5), 0.4),
    (rs.PointLight((0, 0, 2), 2.0, falloff=True), 0.4),
    (rs.DirectionalLight((0, 0, -3), 0.5), 0.4),
    (rs.SpotLight((0, 0, 2), (0, 0, -1), 0.5), 0.4),
    (rs.SpotLight((0, 0, 2), (0, 1, -1), 0.5, 20, 30), 0.0),
    (rs.PointLight((0, 0, -2)), 0.0),
    (rs.DirectionalLight((0, 0, 1)), 0.0),
])  # fmt: skip
def test_lambert_head_on(light, expected):
    np.testing.assert_allclose(centre([square(diffuse=0.8)], [light]), [expected] * 3, atol=1e-6)


def test_half_way_through_a_spot_light():
    inner, outer = 20.0, 40.0
    cosine = (np.cos(np.radians(inner)) + np.cos(np.radians(outer))) / 2
    angle = np.arccos(cosine)
    light = rs.SpotLight((0, 0, 2), (0, np.sin(angle), -cosine), 1.0, inner, outer)
    np.testing.assert_allclose(centre([square(diffuse=1.0)], [light]), 0.25, rtol=1e-4)


def test_several_lights_add_up():
    lights = [rs.PointLight((0, 0, 2), (0.3, 0, 0)), rs.PointLight((0, 0, 3), (0.1, 0.2, 0))]
    np.testing.assert_allclose(centre([square(diffuse=1.0)], lights), [0.4, 0.2, 0], atol=1e-6)


@pytest.mark.parametrize("shadows", [True, False])
def test_a_blocker_casts_a_shadow(shadows):
    blocker = square(z=8.0, diffuse=0.0)  # behind the camera, between the light and the square
    lights = [rs.PointLight((0, 0, 20)), rs.DirectionalLight((0, 0, -1))]
    lit = 0.0 if shadows else 2.0
    colour = centre([square(diffuse=1.0), blocker], lights, shadows=shadows)
    np.testing.assert_allclose(colour, [lit] * 3, atol=1e-6)


def test_the_highlight_is_seen_in_the_mirror_direction():
    light = rs.PointLight((0, 0, 9))
    shiny = {"diffuse": 0.0, "specular": (0.5, 0.4, 0.3), "shininess": 10.0}
    np.testing.assert_allclose(centre([square(**shiny)], [light]), [0.5, 0.4, 0.3], rtol=1e-4)


@pytest.mark.parametrize("bounces", [0, 1, 2, 5])
def test_facing_mirrors(bounces):
    mirror = {"diffuse": 0.0, "reflectivity": 0.5, "emission": 1.0}
    colour = centre([square(**mirror), square(z=10.0, **mirror)], max_bounces=bounces)
    np.testing.assert_allclose(colour, sum(0.5**k for k in range(bounces + 1)), rtol=1e-5)


def test_rays_of_little_weight_are_dropped():
    mirror = {"diffuse": 0.0, "reflectivity": 0.25, "emission": 1.0}
    colour = centre([square(**mirror), square(z=10.0, **mirror)], max_bounces=9)
    np.testing.assert_allclose(colour, sum(0.25**k for k in range(5)), rtol=1e-5)


def test_a_glass_pane_head_on():
    glass = {"diffuse": 1.0, "transmission": 1.0, "ior": 1.5}
    front, back = square(**glass), square(z=-1.0, **glass)
    back.faces = back.faces[:, ::-1].copy()
    share = (0.5 / 2.5) ** 2
    colour = centre([front, back], max_bounces=2)
    np.testing.assert_allclose(colour, (share + (1 - share) ** 2) * SKY, rtol=1e-4)


def test_total_internal_reflection_inside_glass():
    prism = trimesh.creation.box(extents=(4, 4, 4))
    scene = rs.Scene([rs.Mesh(prism.vertices, prism.faces,
                              material=rs.Material(diffuse=0.0, transmission=1.0, ior=1.5))],
                     [], rs.Camera.look_at((1.9, 0, 0), (0, 1.9, 0), fov_y=1),
                     background=1.0, ambient=0.0)  # fmt: skip
    image = rs.render(scene, size=(3, 3), max_bounces=12).image
    assert image.max() <= 1 + 1e-5
    # At 45 degrees every inner face reflects all light: nothing of the outside is ever seen.
    np.testing.assert_allclose(image[1, 1], 0.0, atol=1e-6)


@pytest.mark.parametrize("name", ["demo", "cornell", "mirrors", "bumpy_mirror"])
def test_pictures_equal_the_reference(name):
    scene = rs.scenes.cornell("mirrors") if name == "mirrors" else getattr(rs.scenes, name)()
    frame = rs.render(scene, size=(96, 64), max_bounces=3, samples=2)
    reference = render_reference(scene, scene.camera, size=(96, 64), max_bounces=3, samples=2)
    assert ssim(frame.image, reference.image) >= 0.995
    assert psnr(frame.image, reference.image) >= 40


def textured_scene():
    texels = np.random.default_rng(4).integers(0, 256, (6, 4, 3), dtype=np.uint8)
    plane = square(texture=texels, diffuse=(1, 0.5, 1))
    plane.uv = np.array([[-0.5, -0.7], [1.6, -0.7], [1.6, 2.3], [-0.5, 2.3]], np.float32)
    tinted = square(z=0.5, half=0.8)
    tinted.colors = np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 1]], np.float32)
    light = rs.PointLight((1, 2, 4))
    return rs.Scene([plane, tinted], [light], rs.Camera.look_at((1, 2, 8), (0, 0, 0)))


def test_textures_and_vertex_colours_equal_the_reference():
    scene = textured_scene()
    frame = rs.render(scene, size=(64, 64))
    reference = render_reference(scene, scene.camera, size=(64, 64))
    assert psnr(frame.image, reference.image) >= 60
    assert frame.image.std() > 0.1


def test_embree_can_stand_in_for_a_method():
    scene = rs.scenes.demo()
    options = {"size": (64, 48), "max_bounces": 3}
    ours = rs.render(scene, method="rsh", **options)
    theirs = rs.render(scene, method=EmbreeTracer.from_scene(scene), **options)
    assert psnr(ours.image, theirs.image) >= 60
    assert theirs.statistics.rays > 0


def test_methods_make_the_same_picture():
    scene = rs.scenes.cornell("mirrors")
    tracers = [exact_tracer(scene, m) for m in rs.methods()]
    images = [rs.render(scene, size=(40, 40), method=tracer).image for tracer in tracers]
    np.testing.assert_array_equal(images[0], images[1])


def test_the_first_hits_are_in_the_frame():
    scene = rs.scenes.cornell()
    frame = rs.render(scene, size=(32, 24), max_bounces=0)
    hits = rs.Tracer(scene).intersect(*scene.camera.rays((32, 24)))
    np.testing.assert_allclose(frame.depth.ravel(), hits.t, rtol=1e-5)
    assert (frame.geom_id.ravel() == hits.geom_id).mean() > 0.99
    assert frame.image.shape == (24, 32, 3) and frame.image.dtype == np.float32


def test_frames_of_a_moving_mesh():
    scene = rs.scenes.cornell()
    tracer = rs.Tracer(scene)
    renderer = rs.Renderer(scene, tracer)
    still = renderer.render(size=(32, 32))
    moved = scene.vertices + np.float32([0, 0, 100])
    tracer.update_vertices(moved)
    fresh = rs.render(scene.with_vertices(moved), scene.camera, size=(32, 32))
    np.testing.assert_allclose(renderer.render(size=(32, 32)).image, fresh.image, atol=1e-3)
    tracer.update_vertices(scene.vertices)
    np.testing.assert_array_equal(renderer.render(size=(32, 32)).image, still.image)


def test_statistics_and_stages_of_a_frame():
    scene = rs.scenes.cornell("mirrors")
    frame = rs.render(scene, size=(64, 64), method="rsh")
    counts = frame.statistics
    assert counts.levels[0]["nodes"] == counts.batches  # one root per ray stream
    assert counts.total_tests == counts.final_tests + sum(x["tests"] for x in counts.levels)
    assert set(counts.stages) >= {"ray creation", "hierarchy creation", "traversal",
                                  "stream reduction", "final intersection", "shading",
                                  "rasterisation"}  # fmt: skip
    again = rs.render(scene, size=(64, 64), method="rsh")
    assert again.statistics.levels == counts.levels


COUNTS = ("rays", "mesh_tests", "final_tests", "final_hits", "total_tests")


def test_traced_primary_visibility_is_that_of_the_rasteriser():
    scene = rs.scenes.demo()
    raster, traced = (
        rs.render(scene, size=(64, 48), method="packet", primary=primary)
        for primary in ("raster", "trace")
    )
    assert (raster.prim_id == traced.prim_id).mean() > 0.999
    same = raster.prim_id == traced.prim_id
    np.testing.assert_allclose(raster.depth[same], traced.depth[same], rtol=1e-5)
    assert psnr(traced.image, raster.image) > 40
    assert list(traced.kinds) == ["primary", *RAY_KINDS] and list(raster.kinds) == list(RAY_KINDS)
    assert traced.kinds["primary"].rays == 64 * 48
    assert "rasterisation" not in traced.statistics.stages
    twice = rs.render(scene, size=(64, 48), samples=2, primary="trace")
    assert twice.kinds["primary"].rays == 2 * 64 * 48


@pytest.mark.parametrize("options", [
    {}, {"method": "crsh", "arity": 8, "levels": 2}, {"method": "brute"}
], ids=str)  # fmt: skip
def test_the_kinds_of_ray_add_up_to_the_frame(options):
    frame = rs.render(rs.scenes.demo(), size=(48, 32), max_bounces=3, samples=2, **options)
    kinds = frame.kinds.values()
    assert tuple(frame.kinds) == RAY_KINDS
    for name in COUNTS:
        assert sum(getattr(k, name) for k in kinds) == getattr(frame.statistics, name), name
    for i, level in enumerate(frame.statistics.levels):
        assert level == {key: sum(k.levels[i][key] for k in kinds) for key in level}
    assert all(k.triangles == frame.statistics.triangles and not k.stages for k in kinds)


def test_rays_are_counted_by_their_kind():
    mirror, glass = {"diffuse": 0.0, "reflectivity": 1.0}, {"diffuse": 1.0, "transmission": 1.0}
    meshes = [square(z=-1.0, **mirror), square(half=0.3, **glass)]
    scene = rs.Scene(meshes, [], HEAD_ON)
    kinds = rs.render(scene, size=(9, 9), max_bounces=1).kinds
    assert {kind: counts.rays for kind, counts in kinds.items()} == {
        "reflection": 9 * 9,
        "refraction": 3 * 3,
    }


def test_kinds_without_rays_are_left_out():
    options = {"size": (16, 16), "max_bounces": 2}
    assert list(rs.render(rs.scenes.cornell(), **options).kinds) == ["shadow"]
    mirrors = rs.scenes.cornell("mirrors")
    assert list(rs.render(mirrors, shadows=False, **options).kinds) == ["reflection"]
    assert rs.render(rs.scenes.cornell(), shadows=False, **options).kinds == {}


def test_embree_has_kinds_too():
    scene = rs.scenes.demo()
    ours, theirs = (
        rs.render(scene, method=method, size=(32, 24)).kinds
        for method in ("rsh", EmbreeTracer.from_scene(scene))
    )
    assert {k: c.rays for k, c in theirs.items()} == {k: c.rays for k, c in ours.items()}


def test_stage_times_by_kind_where_asked():
    renderer = rs.Renderer(rs.scenes.demo(), "rsh")
    renderer.render(size=(48, 32))  # the first frame makes the bounds of the triangles, too
    plain = renderer.render(size=(48, 32))
    timed = renderer.render(size=(48, 32), stages_by_kind=True)
    np.testing.assert_array_equal(timed.image, plain.image)
    assert set(timed.statistics.stages) == set(plain.statistics.stages)
    for kind, counts in timed.kinds.items():
        assert counts.levels == plain.kinds[kind].levels
        assert {"hierarchy creation", "traversal", "final intersection"} <= set(counts.stages)
        assert not {"ray creation", "shading", "rasterisation"} & set(counts.stages)
    traversals = [counts.stages["traversal"]["device"] for counts in timed.kinds.values()]
    np.testing.assert_allclose(sum(traversals), timed.statistics.stages["traversal"]["device"])


@pytest.mark.parametrize("by_kind", [False, True])
def test_a_frame_waits_for_its_times_once_per_sample(session, monkeypatch, by_kind):
    renderer, waits, finish = rs.Renderer(rs.scenes.demo()), [], session.finish
    monkeypatch.setattr(session, "finish", lambda: waits.append(1) or finish())
    renderer.render(size=(16, 16), samples=3, stages_by_kind=by_kind)
    assert (len(waits) == 3) != by_kind


@pytest.mark.parametrize(("text", "options"), [
    ("rsh", {}),
    ("rsh:arity=8:levels=2", {"arity": 8, "levels": 2}),
    ("rsh:levels=none:a=true:b=False", {"levels": None, "a": True, "b": False}),
    ("rsh:a=0.5:b=-3:c=1e3:d=paper:e=", {"a": 0.5, "b": -3, "c": 1000.0, "d": "paper", "e": ""}),
    ("rsh:a=b=c", {"a": "b=c"}),
])  # fmt: skip
def test_a_method_with_options_as_text(text, options):
    name, parsed = parse_method(text, rs.methods())
    assert (name, parsed) == ("rsh", options)
    assert [type(value) for value in parsed.values()] == [type(v) for v in options.values()]


@pytest.mark.parametrize(("text", "message"), [
    ("bvh:arity=8", "method: need one of .*'rsh'.*, got 'bvh'"),
    ("", "method: need one of"),
    ("rsh:arity", "method 'rsh': need key=value, each key once, got 'arity'"),
    ("rsh:=8", "got '=8'"),
    ("rsh:", "got ''"),
    ("rsh:arity=4:arity=8", "got 'arity=8'"),
])  # fmt: skip
def test_what_is_no_method_with_options(text, message):
    with pytest.raises(ValueError, match=message):
        parse_method(text, rs.methods())


def test_samples_are_averaged_and_reported():
    done = []
    scene = rs.scenes.cornell()
    smooth = rs.render(scene, size=(16, 16), samples=3, progress=lambda *a: done.append(a))
    assert done == [(1, 3), (2, 3), (3, 3)]
    reference = render_reference(scene, scene.camera, size=(16, 16), samples=3)
    assert psnr(smooth.image, reference.image) >= 60


@pytest.mark.parametrize(("arguments", "error", "message"), [
    ({"size": (0, 4)}, ValueError, "size"),
    ({"size": (4, 4, 4)}, ValueError, "size"),
    ({"max_bounces": -1}, ValueError, "max_bounces: need a whole number"),
    ({"samples": 0}, ValueError, "samples"),
    ({"camera": "front"}, TypeError, "camera: need a raystream.Camera, got str"),
    ({"method": "bvh"}, ValueError, "method: need one of"),
    ({"method": 3}, TypeError, "method: need a name or a tracer, got int"),
    ({"arity": 5}, ValueError, "arity"),
    ({"primary": "rays"}, ValueError, "primary: need one of 'raster', 'trace', got 'rays'"),
])  # fmt: skip
def test_bad_arguments_are_refused(arguments, error, message):
    with pytest.raises(error, match=message):
        rs.render(rs.scenes.cornell(), **arguments)


def test_a_tracer_of_another_scene_is_refused():
    with pytest.raises(ValueError, match="the tracer holds 12 triangles, the scene 32"):
        rs.render(rs.scenes.cornell(), method=rs.Tracer(trimesh.creation.box()))


def test_save_goes_by_suffix(tmp_path):
    frame = rs.render(rs.scenes.cornell(), size=(8, 8))
    frame.save(tmp_path / "a.npy")
    np.testing.assert_array_equal(np.load(tmp_path / "a.npy"), frame.image)
