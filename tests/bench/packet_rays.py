"""The scenes of Overbeck et al. (2008), or of their kinds, and their rays by kind on the device."""

import json
import pathlib
import re

import numpy as np
from real_scenes import BUNNY, COUNT_SCENES

import raystream as rs
from raystream import device, rays
from raystream.geometry import Geometry
from raystream.shade import Shader

PRIMARY, SHADOW, REFLECTION, REFRACTION = KINDS = ("primary", "shadow", "reflection", "refraction")
MUSEUM, KITCHEN = "bart-museum", "bart-kitchen"
ART_KEYS = range(5)
# Simple to complex, as the columns of figure 5; rings(3) has 43 682 triangles.
STUDIED = {
    "room": rs.scenes.room,
    "toys": rs.scenes.toys,
    "meadow": rs.scenes.meadow,
    "rings": lambda: rs.scenes.rings(3),
}
# Table 2: scene, generations of secondary rays and lights that cast shadows, as in figure 1.
TABLE = {"toys": (1, 2), "meadow": (1, 0), MUSEUM: (3, 0), KITCHEN: (4, 1)}
_DEPTH = 2  # of reflections and refractions in figures 5 and 7


def ray_kinds(scene, size, depth=_DEPTH, camera=None):
    """The ray streams of a picture by kind, on the device: lists of `Rays`.

    Every material reflects for the reflection rays and refracts for the refraction rays; those of
    a deeper generation start from the last one's hits. A shadow stream goes to each light.
    """
    camera = scene.camera if camera is None else camera
    session = device.session()
    primary = rays.from_camera(session, camera, size)
    streams = {PRIMARY: [primary]}
    shader, surfaces, weights = _surfaces(session, scene, primary)
    lights = range(shader.num_lights)
    streams[SHADOW] = [shader.shadow_rays(k, surfaces, weights, size) for k in lights]
    for kind, vary in (
        (REFLECTION, rs.scenes.all_reflective),
        (REFRACTION, rs.scenes.all_refractive),
    ):
        streams[kind] = _generations(session, vary(scene), primary, kind, depth)
    return streams


def _generations(session, scene, stream, kind, depth):
    generations = []
    for _ in range(depth):
        shader, surfaces, weights = _surfaces(session, scene, stream)
        spawned = dict(zip((REFLECTION, REFRACTION), shader.spawn(stream, surfaces, weights),
                           strict=True))  # fmt: skip
        stream, _, alive = spawned[kind]
        if not alive:
            break
        generations.append(stream)
    return generations


def _surfaces(session, scene, stream):
    """What a stream hits, and the shader that knows it; every ray has the full weight."""
    tracer = rs.Tracer(scene, "packet")
    hits = tracer.intersect_stream(session, stream)
    shader = Shader(session, Geometry(session, scene), scene)
    weights, image = (session.empty((len(stream), 4), np.float32) for _ in range(2))
    session.fill("shading", weights, 1)
    session.fill("shading", image, 0)
    return shader, shader.evaluate(hits, stream, weights, image), weights


def live_rays(stream):
    """The active rays of a stream as arrays on the host: origins, directions, tnear, tfar."""
    org_tnear, dir_tfar = stream.org_tnear.get(), stream.dir_tfar.get()
    active = dir_tfar[:, 3] >= org_tnear[:, 3]
    org_tnear, dir_tfar = org_tnear[active], dir_tfar[active]
    return active, (org_tnear[:, :3], dir_tfar[:, :3], org_tnear[:, 3], dir_tfar[:, 3])


def load(name, folder):
    """A scene by name, with its camera: one of the study, of BART or a real one."""
    if name in STUDIED:
        return STUDIED[name]()
    if name.startswith((MUSEUM, KITCHEN)):
        return _bart(name, folder)
    real = BUNNY if name == "bunny" else COUNT_SCENES[name]
    scene = real.load(folder)
    return _with_camera(scene, real.camera)


def _bart(name, folder):
    """A BART scene at its first keyframe; the museum with the triangle soup of `name`'s key."""
    place, _, key = name.partition(" ")
    folder = pathlib.Path(folder, place)
    scene = rs.load_scene(folder / f"{place}.glb")
    with open(folder / f"{place}.json") as file:
        facts = json.load(file)
    for mesh in scene.meshes:
        of_mesh = facts["materials"][re.match(r".*?-\d{3}", mesh.name)[0]]
        if of_mesh["transmittance"]:
            changes = {"transmission": of_mesh["transmittance"], "ior": of_mesh["ior"]}
        else:
            changes = {"reflectivity": of_mesh["specular"]}
        scene.set_material(re.sub(r"([\[\]*?])", r"[\1]", mesh.name), **changes)
    if place == MUSEUM:
        art = rs.load_scene(folder / f"art-key-{key or 0}.ply").meshes[0]
        scene.add(art, rs.Material("art", diffuse=(0.5, 0.3, 0.1), reflectivity=0.3))
    scene.set_lights([rs.PointLight(light["pos"], light["color"]) for light in facts["lights"]])
    view = min(facts["camera_frames"], key=lambda frame: abs(frame["t"]))
    camera = rs.Camera.look_at(
        view["eye"], np.add(view["eye"], view["dir"]), view["up"], facts["view"]["angle"][0]
    )
    scene.background = np.array(facts["background"], np.float32)
    return _with_camera(scene, camera)


def _with_camera(scene, camera):
    return rs.Scene(scene.meshes, scene.lights, camera, scene.background, scene.ambient, scene.name)
