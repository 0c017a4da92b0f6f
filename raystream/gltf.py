"""What trimesh does not keep of a glTF file: its camera, its lights, extensions of materials."""

import json
import struct
from importlib.util import find_spec
from pathlib import Path

import numpy as np

from raystream.camera import Camera
from raystream.light import DirectionalLight, PointLight, SpotLight

_DRACO, _MESHOPT = "KHR_draco_mesh_compression", "EXT_meshopt_compression"
_LIGHTS = "KHR_lights_punctual"
_MESH_MODES = (0, 1, 4, 5)  # points, lines, triangles, a strip: what trimesh makes a geometry of
_IDENTITY = (0.0, 0.0, 0.0, 1.0)


def is_gltf(path):
    """Tell by its suffix whether a file is glTF, text or binary."""
    return Path(path).suffix.lower() in (".gltf", ".glb")


def read_header(path):
    """Read the JSON part of a .gltf or .glb file.

    Returns
    -------
    dict

    Raises
    ------
    OSError
        If the file cannot be read.
    ValueError
        If it is no glTF 2.0 file.
    """
    data = Path(path).read_bytes()
    if data[:4] == b"glTF":
        # header: magic, version, length; first chunk: length, type "JSON", text
        length = struct.unpack_from("<I", data, 12)[0] if len(data) >= 20 else 0
        data = data[20 : 20 + length]
    try:
        header = json.loads(data)
    except ValueError as error:
        raise ValueError(f"{path}: need glTF 2.0 JSON: {error}") from None
    if not isinstance(header, dict):
        raise ValueError(f"{path}: need glTF 2.0 JSON: got a {type(header).__name__}, no object")
    return header


def refuse_compressed(header, path):
    """Raise a ValueError for compressed geometry, of which trimesh would make zeros."""
    required = set(header.get("extensionsRequired", ())) & {_DRACO, _MESHOPT}
    if find_spec("DracoPy"):
        required.discard(_DRACO)
    if required:
        raise ValueError(
            f"{path}: need plain geometry (or DracoPy for Draco's), got "
            f"{', '.join(sorted(required))}"
        )


def material_extensions(header, names):
    """Find the material extensions of each geometry.

    Parameters
    ----------
    header : dict
    names : sequence of str
        What trimesh calls the geometries: one for each primitive, in the order of the file.

    Returns
    -------
    dict of str to dict
        By geometry; the keys of the inner ones are names of extensions.
    """
    materials = header.get("materials", [])
    if not any("extensions" in material for material in materials):
        return {}
    primitives = [
        primitive
        for mesh in header.get("meshes", [])
        for primitive in mesh["primitives"]
        if primitive.get("mode", 4) in _MESH_MODES
    ]
    return {
        name: materials[primitive["material"]].get("extensions", {})
        for name, primitive in zip(names, primitives, strict=True)
        if "material" in primitive
    }


def camera_and_lights(header, path):
    """Read the cameras and the lights (KHR_lights_punctual) of the default scene.

    Parameters
    ----------
    header : dict
    path : str or path-like
        For error messages.

    Returns
    -------
    camera : Camera or None
        The first perspective one in the order of the nodes.
    lights : list or None

    Raises
    ------
    ValueError
        If one of them cannot be read or is out of range.
    """
    try:
        return _camera_and_lights(header)
    except (AttributeError, KeyError, IndexError, TypeError, ValueError) as error:
        raise ValueError(f"{path}: cannot read its camera and lights: {error!r}") from error


def _camera_and_lights(header):
    cameras, lights = [], []
    shared = header.get("extensions", {}).get(_LIGHTS, {}).get("lights", [])
    for node, matrix in _placed_nodes(header):
        if "camera" in node:
            perspective = header["cameras"][node["camera"]].get("perspective")
            if perspective:  # orthographic cameras have no rays from one eye
                cameras.append(Camera.from_matrix(matrix, np.degrees(perspective["yfov"])))
        light = node.get("extensions", {}).get(_LIGHTS)
        if light:
            lights.append(_light(shared[light["light"]], matrix))
    return cameras[0] if cameras else None, lights or None


def _light(light, matrix):
    """One light of KHR_lights_punctual; it shines along -z of its node."""
    color = np.multiply(light.get("color", (1.0, 1.0, 1.0)), light.get("intensity", 1.0))
    position, direction = matrix[:3, 3], -matrix[:3, 2]
    if light["type"] == "directional":
        return DirectionalLight(direction, color)
    if light["type"] == "point":
        return PointLight(position, color, falloff=True)
    cone = light.get("spot", {})
    inner = np.degrees(cone.get("innerConeAngle", 0.0))
    outer = np.degrees(cone.get("outerConeAngle", np.pi / 4))
    return SpotLight(position, direction, color, inner, outer, falloff=True)


def _placed_nodes(header):
    """Yield (node, world matrix) for every node of the default scene, parents first."""
    nodes = header.get("nodes", [])
    scenes = header.get("scenes", [{}])
    stack = [(index, np.eye(4)) for index in scenes[header.get("scene", 0)].get("nodes", [])]
    stack.reverse()
    while stack:
        index, parent = stack.pop()
        matrix = parent @ _local_matrix(nodes[index])
        yield nodes[index], matrix
        stack += [(child, matrix) for child in reversed(nodes[index].get("children", []))]


def _local_matrix(node):
    """(4, 4) matrix of a node relative to its parent."""
    if "matrix" in node:
        return np.reshape(node["matrix"], (4, 4)).T  # stored by columns
    x, y, z, w = node.get("rotation", _IDENTITY)
    rotation = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )
    matrix = np.eye(4)
    matrix[:3, :3] = rotation * np.asarray(node.get("scale", (1.0, 1.0, 1.0)))
    matrix[:3, 3] = node.get("translation", (0.0, 0.0, 0.0))
    return matrix
