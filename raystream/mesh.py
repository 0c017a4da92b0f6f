"""Triangle meshes, and the one place where trimesh reads files or hands over its objects.

Shading normals: taken from the file where it has vertex normals; everything else is shaded flat
unless `smooth=True`, which computes angle-weighted vertex normals. A vertex that the file
repeats for each face (STL, unindexed glTF) stays flat even then: no connection, no average.
"""

import sys
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from raystream import gltf
from raystream.checks import as_float_array, check_choice
from raystream.material import Material, from_gltf, from_mtl, srgb_to_linear
from raystream.shapes import smooth_normals, unit

_SHOWN_FACES = 5
_TRIMESH_GREY = (102, 102, 102, 255)  # what trimesh puts where a material has no colour
_TRIMESH_BLANK = (2, 2), (100, 100, 100, 255)  # size and colour where it has no texture


@dataclass(eq=False)
class Mesh:
    """A triangle mesh in world space with one material.

    Parameters
    ----------
    vertices : (n, 3) float
        Positions; stored as float32. Vertices that no face uses may hold anything.
    faces : (m, 3) int
        Vertex indices; stored as int32. Triangles of zero area are kept: no ray hits them.
        m = 0 is allowed.
    name : str
    normals : (n, 3) float32, optional
        Smooth unit vertex normals; without them the mesh is shaded flat.
    uv : (n, 2) float32, optional
        Texture coordinates; v = 0 is the bottom of the texture.
    colors : (n, 3) float32, optional
        Linear RGB vertex colours that multiply the material's `diffuse`.
    material : Material
    face_ids : (m,) int32, optional
        Index of each face in the source, where invalid faces were dropped; else None.
    dropped : int
        Number of invalid faces left out when the mesh was loaded.

    Raises
    ------
    ValueError
        If an array has the wrong shape, or a face is invalid: an index out of range, or a
        vertex that is not finite in float32. The message names the mesh and the first faces.
    """

    vertices: np.ndarray
    faces: np.ndarray
    name: str = ""
    normals: np.ndarray | None = None
    uv: np.ndarray | None = None
    colors: np.ndarray | None = None
    material: Material = Material()
    face_ids: np.ndarray | None = None
    dropped: int = 0

    def __post_init__(self):
        self.vertices = self._rows("vertices", self.vertices, None, 3)
        faces = _face_rows(self.name, self.faces)
        _refuse_invalid(self.name, invalid_faces(self.vertices, faces))
        self.faces = np.ascontiguousarray(faces, dtype=np.int32)
        for field, columns in (("normals", 3), ("uv", 2), ("colors", 3)):
            values = getattr(self, field)
            if values is not None:
                setattr(self, field, self._rows(field, values, len(self.vertices), columns))

    def _rows(self, field, values, rows, columns):
        return as_float_array(f"mesh {self.name!r}: {field}", values, (rows, columns))

    def with_vertices(self, vertices):
        """Return a mesh of the same topology with other (n, 3) vertices.

        Smooth normals, where the mesh has them, are computed anew for the new shape.
        """
        vertices = self._rows("vertices", vertices, len(self.vertices), 3)
        moved = replace(self, vertices=vertices, normals=None)
        if self.normals is not None:
            moved.normals = smooth_normals(vertices, self.faces)
        return moved


def invalid_faces(vertices, faces):
    """Tell which faces cannot be rendered.

    Parameters
    ----------
    vertices : (n, 3) float
    faces : (m, 3) int

    Returns
    -------
    (m,) bool
        True where an index is out of range or a vertex has a coordinate that is not finite.
    """
    outside = ((faces < 0) | (faces >= len(vertices))).any(axis=1)
    usable = np.isfinite(vertices).all(axis=1)
    if outside.all() or usable.all():
        return outside
    return outside | ~usable[np.where(outside[:, None], 0, faces)].all(axis=1)


def from_shape(name, shape, smooth=False, **material):
    """A mesh of a shape (see shapes.py) whose material, given by fields, bears the same name."""
    vertices, faces = shape
    normals = smooth_normals(vertices, faces) if smooth else None
    return Mesh(vertices, faces, name, normals, material=Material(name=name, **material))


def load_meshes(path, smooth=False, on_invalid="raise"):
    """Read every triangle mesh of a file, placed in the world.

    Parameters
    ----------
    path : str or path-like
        Any mesh file that trimesh reads.
    smooth : bool
        Compute normals for meshes that have none in the file.
    on_invalid : {"raise", "drop"}
        What to do about faces with an index out of range or a vertex that is not finite.

    Returns
    -------
    list of Mesh
        One for each placed mesh, in the order in which trimesh inserts the placed nodes, faces
        in the order of `trimesh.load(path, force="scene", process=False)`.

    Raises
    ------
    OSError
        If the file is missing or cannot be opened.
    ValueError
        If trimesh does not know the suffix or cannot read the content, if there are no
        triangles, or if a face is invalid and `on_invalid` is "raise".
    """
    import trimesh  # here, because it takes longer to import than the rest of raystream

    path = Path(path)
    with path.open("rb"):  # a missing or unreadable file is an OSError, whatever its suffix
        pass
    suffix = path.suffix.lower().lstrip(".")
    if suffix not in trimesh.available_formats():
        known = ", ".join(sorted(trimesh.available_formats()))
        raise ValueError(f"{path}: unknown suffix {path.suffix!r}; trimesh reads {known}")
    header = gltf.read_header(path) if gltf.is_gltf(path) else None
    if header is not None:
        gltf.refuse_compressed(header, path)
    try:
        loaded = trimesh.load(path, force="scene", process=False)
    except Exception as error:  # noqa: BLE001 - each of trimesh's readers raises its own kinds
        reason = " ".join(str(error).split()) or type(error).__name__
        raise ValueError(f"{path}: trimesh cannot read it: {reason}") from error
    extensions = None if header is None else gltf.material_extensions(header, loaded.geometry)
    conversion = _Conversion(smooth, on_invalid, from_file=True, extensions=extensions)
    meshes = _placed_meshes(loaded, conversion)
    if not any(len(mesh.faces) + mesh.dropped for mesh in meshes):
        raise ValueError(f"{path}: need triangles, found none (points or curves only)")
    return meshes


def is_trimesh(thing):
    """Tell whether `thing` is a trimesh.Trimesh or trimesh.Scene, without importing trimesh."""
    trimesh = sys.modules.get("trimesh")
    return trimesh is not None and isinstance(thing, (trimesh.Trimesh, trimesh.Scene))


def from_trimesh(thing, smooth=False, on_invalid="raise"):
    """Convert an object of trimesh.

    Parameters
    ----------
    thing : trimesh.Trimesh or trimesh.Scene
        Vertices and faces are taken in the given order.
    smooth : bool
        Take the object's `vertex_normals`; otherwise shading is flat, because trimesh does not
        tell given normals from those it has computed on the way.
    on_invalid : {"raise", "drop"}
        As for `load_meshes`.

    Returns
    -------
    list of Mesh
        One for each placed mesh, in the order of insertion of the placed nodes.

    Raises
    ------
    ValueError
        If a face is invalid and `on_invalid` is "raise".
    """
    conversion = _Conversion(smooth, on_invalid)
    if hasattr(thing, "geometry"):
        return _placed_meshes(thing, conversion)
    name = str(thing.metadata.get("name") or "mesh")
    return [_convert(thing, name, np.eye(4), conversion)]


@dataclass(frozen=True)
class _Conversion:
    """What to do about a trimesh object; see `load_meshes` and `from_trimesh`."""

    smooth: bool
    on_invalid: str
    from_file: bool = False
    extensions: dict | None = None  # of materials by geometry name; None: not from glTF

    def __post_init__(self):
        check_choice("on_invalid", self.on_invalid, ("raise", "drop"))


def _placed_meshes(scene, conversion):
    import trimesh

    meshes = []
    for node in scene.graph.nodes_geometry:
        matrix, geometry = scene.graph[node]
        source = scene.geometry[geometry]
        if isinstance(source, trimesh.Trimesh):
            extensions = (conversion.extensions or {}).get(geometry, {})
            meshes.append(_convert(source, str(node), matrix, conversion, extensions))
    return meshes


def _convert(source, name, matrix, conversion, extensions=None):
    """One trimesh.Trimesh, placed by a (4, 4) matrix."""
    faces = _face_rows(name, source.faces)
    # vertices that are not finite are judged below, face by face
    with np.errstate(invalid="ignore", over="ignore"):
        placed = np.asarray(source.vertices) @ matrix[:3, :3].T + matrix[:3, 3]
    vertices = as_float_array(f"mesh {name!r}: vertices", placed, (None, 3))
    invalid = invalid_faces(vertices, faces)
    if conversion.on_invalid == "raise":
        _refuse_invalid(name, invalid)
    kept = faces[~invalid]
    colors = _vertex_colors(source.visual, linear=conversion.extensions is not None)
    uv = getattr(source.visual, "uv", None)
    return Mesh(
        vertices=vertices,
        faces=kept,
        name=name,
        normals=_normals(source, matrix, vertices, kept, conversion),
        uv=None if uv is None else uv[:, :2],
        colors=colors,
        material=_material(name, source.visual, colors is not None, extensions or {}),
        face_ids=np.flatnonzero(~invalid).astype(np.int32) if invalid.any() else None,
        dropped=int(invalid.sum()),
    )


def _normals(source, matrix, vertices, faces, conversion):
    # trimesh computes missing normals on access; only its cache tells that the file had some
    given = conversion.from_file and "vertex_normals" in source._cache
    if not (given or conversion.smooth):
        return None
    if conversion.from_file and not given:
        return smooth_normals(vertices, faces)
    linear = np.asarray(matrix, dtype=np.float64)[:3, :3]
    # cofactors are the inverse transpose times the determinant, and exist for flat scalings too
    cofactors = np.cross(np.roll(linear, -1, axis=0), np.roll(linear, -2, axis=0))
    sign = -1.0 if np.linalg.det(linear) < 0 else 1.0
    normals = unit(np.asarray(source.vertex_normals) @ (sign * cofactors).T)
    unusable = ~(np.abs(np.linalg.norm(normals, axis=1) - 1) < 0.5)  # zero or not finite
    if unusable.any():
        normals[unusable] = smooth_normals(vertices, faces)[unusable]
    return normals


def _vertex_colors(visual, linear):
    """Linear RGB (n, 3) float32, or None.

    Colours are sRGB bytes, except that glTF says its COLOR_0 is linear.
    """
    if visual.kind == "vertex":
        colors = np.asarray(visual.vertex_colors)
    else:
        colors = getattr(visual, "vertex_attributes", {}).get("color")
    if colors is None:
        return None
    colors = np.asarray(colors)[:, :3]
    if colors.dtype.kind == "u" and linear:
        return (colors / np.iinfo(colors.dtype).max).astype(np.float32)
    return srgb_to_linear(colors) if colors.dtype == np.uint8 else colors.astype(np.float32)


def _material(mesh_name, visual, has_colors, extensions):
    """The Material of a trimesh visual; the mapping tables are in material.py."""
    source = getattr(visual, "material", None)
    if source is None:
        return _plain_material(visual, has_colors)
    name = str(getattr(source, "name", None) or "")
    if hasattr(source, "baseColorFactor"):
        return _gltf_material(name, source, extensions)
    if hasattr(source, "kwargs"):
        return _mtl_material(name, source)
    raise ValueError(
        f"mesh {mesh_name!r}: need one material for each mesh, got {type(source).__name__}"
    )


def _plain_material(visual, has_colors):
    """For meshes with colours only: one per vertex, or the mean of those of the faces."""
    if has_colors:
        return Material(diffuse=1.0)
    if visual.kind == "face":
        return Material(diffuse=srgb_to_linear(visual.face_colors[:, :3]).mean(axis=0))
    return Material()


def _gltf_material(name, source, extensions):
    factor = source.baseColorFactor
    color = np.ones(4) if factor is None else np.asarray(factor) / 255.0
    transmission = extensions.get("KHR_materials_transmission", {})
    return from_gltf(
        name=name,
        base_color=color,
        metallic=1.0 if source.metallicFactor is None else source.metallicFactor,
        roughness=1.0 if source.roughnessFactor is None else source.roughnessFactor,
        emissive=0.0
        if source.emissiveFactor is None or source.emissiveTexture is not None
        else source.emissiveFactor,
        texture=_texture(source.baseColorTexture),
        transmission=transmission.get("transmissionFactor", 0.0) if transmission else None,
        ior=extensions.get("KHR_materials_ior", {}).get("ior", 1.5),
    )


def _mtl_material(name, source):
    texture = None if _is_blank(source.image) else _texture(source.image)
    properties = dict(source.kwargs)
    assigned = tuple(source.diffuse) != _TRIMESH_GREY
    if "kd" not in properties and texture is None and assigned:
        properties["kd"] = srgb_to_linear(source.diffuse[:3])
    return from_mtl(name, properties, texture)


def _is_blank(image):
    """True for the image that trimesh makes up where an OBJ has UV but no MTL."""
    size, color = _TRIMESH_BLANK
    return (
        image is not None
        and image.size == size
        and image.mode == "RGBA"
        and bool((np.asarray(image) == color).all())
    )


def _texture(image):
    return None if image is None else np.asarray(image.convert("RGB"))


def _face_rows(name, values):
    faces = np.asarray(values)
    if faces.size == 0:
        return np.zeros((0, 3), dtype=np.int64)
    if faces.ndim != 2 or faces.shape[1] != 3 or faces.dtype.kind not in "iu":
        raise ValueError(
            f"mesh {name!r}: faces: need integers (m, 3), got {faces.dtype} {faces.shape}"
        )
    return faces


def _refuse_invalid(name, invalid):
    if invalid.any():
        ids = np.flatnonzero(invalid)
        more = ", ..." if len(ids) > _SHOWN_FACES else ""
        shown = ", ".join(map(str, ids[:_SHOWN_FACES])) + more
        raise ValueError(
            f"mesh {name!r}: need indices in range and finite vertices, got "
            f"{len(ids)} invalid of {len(invalid)} faces: {shown}"
        )
