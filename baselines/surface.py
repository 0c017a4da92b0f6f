"""Surface attributes at hit points: normals, texture and vertex colours, material."""

from dataclasses import dataclass

import numpy as np


@dataclass
class SurfacePoints:
    """Where rays met the scene; both normals face the side that the ray came from.

    Attributes
    ----------
    position, face_normal, shading_normal : (n, 3) float64
    entering : (n,) bool
        Whether the ray met the front side (counter-clockwise corners).
    base, specular, reflectivity, transmission, emission : (n, 3) float64
        `base` is diffuse colour x texture x vertex colour.
    shininess, ior : (n, 1) float64
    """

    position: np.ndarray
    face_normal: np.ndarray
    shading_normal: np.ndarray
    entering: np.ndarray
    base: np.ndarray
    specular: np.ndarray
    reflectivity: np.ndarray
    transmission: np.ndarray
    emission: np.ndarray
    shininess: np.ndarray
    ior: np.ndarray


def surface_points(scene, hits, directions):
    """Evaluate the surface where rays hit.

    Parameters
    ----------
    scene : object
        With `meshes`; each has vertices, faces, normals, uv, colors and material.
    hits : Hits
        Of n rays that all hit.
    directions : (n, 3) float64
        Unit directions of the rays.

    Returns
    -------
    SurfacePoints
    """
    n = len(hits.t)
    position, face_normal, shading_normal, base = np.zeros((4, n, 3))
    for geom_id in np.unique(hits.geom_id):
        rows = np.flatnonzero(hits.geom_id == geom_id)
        mesh = scene.meshes[geom_id]
        u, v = (np.asarray(w, np.float64)[rows, None] for w in (hits.u, hits.v))
        weights = np.concatenate([1 - u - v, u, v], axis=1)
        faces = np.asarray(mesh.faces)[hits.prim_id[rows]]
        corners = np.asarray(mesh.vertices, np.float64)[faces]
        position[rows] = (weights[:, :, None] * corners).sum(axis=1)
        edges = corners[:, 1:] - corners[:, :1]
        face_normal[rows] = normalised(np.cross(edges[:, 0], edges[:, 1]))
        shading_normal[rows] = _vertex_normal(mesh, faces, weights, face_normal[rows])
        base[rows] = _base_colour(mesh, faces, weights)
    entering = dot(directions, face_normal)[:, 0] < 0
    face_normal[~entering] *= -1
    shading_normal[dot(shading_normal, face_normal)[:, 0] < 0] *= -1
    constants = _material_constants(scene, hits.geom_id)
    return SurfacePoints(position, face_normal, shading_normal, entering, base, **constants)


def dot(a, b):
    """Return the scalar products of rows, (n, 1)."""
    return (a * b).sum(axis=-1, keepdims=True)


def normalised(vectors):
    """Return (n, 3) vectors of unit length; zero stays zero."""
    lengths = np.linalg.norm(vectors, axis=1, keepdims=True)
    return vectors / np.where(lengths > 0, lengths, 1.0)


def decode_srgb(encoded):
    """Return linear values of sRGB bytes (IEC 61966-2-1)."""
    value = np.asarray(encoded, np.float64) / 255
    return np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)


def sample_texture(texture, uv):
    """Return linear colours: bilinear between decoded texels, repeating at the borders.

    Parameters
    ----------
    texture : (h, w, 3) uint8
        sRGB, first row on top.
    uv : (n, 2) float64
        v = 0 at the bottom; texel centres are at half integers.

    Returns
    -------
    (n, 3) float64
    """
    height, width = texture.shape[:2]
    place = np.stack([(1 - uv[:, 1]) * height - 0.5, uv[:, 0] * width - 0.5], axis=1)
    corner = np.floor(place)
    row_part, column_part = (place - corner).T[:, :, None]
    rows, columns = corner.astype(np.int64).T
    rows = [rows % height, (rows + 1) % height]
    columns = [columns % width, (columns + 1) % width]
    upper, lower = (
        (1 - column_part) * decode_srgb(texture[row, columns[0]])
        + column_part * decode_srgb(texture[row, columns[1]])
        for row in rows
    )
    return (1 - row_part) * upper + row_part * lower


def _vertex_normal(mesh, faces, weights, face_normal):
    """Return interpolated unit normals; the face's where there are none or they cancel."""
    if mesh.normals is None:
        return face_normal
    normal = normalised(_interpolated(mesh.normals, faces, weights))
    return np.where(normal.any(axis=1, keepdims=True), normal, face_normal)


def _base_colour(mesh, faces, weights):
    material = mesh.material
    colour = np.tile(np.asarray(material.diffuse, np.float64), (len(faces), 1))
    if material.texture is not None and mesh.uv is not None:
        colour *= sample_texture(material.texture, _interpolated(mesh.uv, faces, weights))
    if mesh.colors is not None:
        colour *= _interpolated(mesh.colors, faces, weights)
    return colour


def _interpolated(per_vertex, faces, weights):
    return (weights[:, :, None] * np.asarray(per_vertex, np.float64)[faces]).sum(axis=1)


def _material_constants(scene, geom_id):
    """Return the material values of each hit by their names in SurfacePoints."""
    materials = [mesh.material for mesh in scene.meshes]
    constants = {}
    for name in ("specular", "reflectivity", "transmission", "emission"):
        values = [np.broadcast_to(getattr(material, name), 3) for material in materials]
        constants[name] = np.array(values, np.float64)[geom_id]
    for name in ("shininess", "ior"):
        values = np.array([getattr(material, name) for material in materials], np.float64)
        constants[name] = values[geom_id][:, None]
    return constants
