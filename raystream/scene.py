"""A scene: placed meshes, lights, a camera and a background."""

from dataclasses import replace
from fnmatch import fnmatchcase
from functools import cached_property
from pathlib import Path

import numpy as np

from raystream import gltf
from raystream.camera import Camera
from raystream.checks import as_float_array, check_color, check_type, check_types
from raystream.light import DirectionalLight, PointLight, SpotLight
from raystream.mesh import Mesh, from_trimesh, is_trimesh, load_meshes

_SHOWN_NAMES = 10
_LIGHTS = PointLight, DirectionalLight, SpotLight


class Scene:
    """Meshes with their lights, camera and background.

    Parameters
    ----------
    meshes : sequence of Mesh
        A mesh's index here is its geom_id.
    lights : sequence of PointLight, DirectionalLight and SpotLight, optional
        Default: one white point light up and left of the camera; an empty one: no light.
    camera : Camera, optional
        Default: fitted to the bounds, looking along -z with +y up.
    background : (3,) float
        Linear RGB of rays that hit nothing.
    ambient : (3,) float
        Linear RGB that lights every surface equally.
    name : str

    Raises
    ------
    TypeError
        If a mesh, light or the camera is of another type.
    ValueError
        If a colour is negative or not finite.
    """

    def __init__(self, meshes, lights=None, camera=None, background=0.0, ambient=0.1, name=""):
        self._meshes = check_types("meshes", meshes, Mesh)
        self.set_lights(lights)
        self._camera = None if camera is None else check_type("camera", camera, Camera)
        self.background = check_color("background", background)
        self.ambient = check_color("ambient", ambient)
        self.name = name

    def __repr__(self):
        return f"<Scene {self.name!r}: {len(self.meshes)} meshes, {self.num_triangles} triangles>"

    @property
    def meshes(self):
        """Tuple of Mesh; the index is the geom_id."""
        return self._meshes

    @property
    def camera(self):
        """The given camera, else one that sees the whole scene."""
        return self._camera or self._fitted_camera

    @property
    def lights(self):
        """The given lights as a tuple, else one point light up and left of the camera."""
        return self._default_lights if self._lights is None else self._lights

    @cached_property
    def vertices(self):
        """(N, 3) float32: the meshes' vertices one after another."""
        return np.concatenate(
            [mesh.vertices for mesh in self.meshes] or [np.zeros((0, 3), np.float32)]
        )

    @cached_property
    def faces(self):
        """(M, 3) int32: indices into `vertices`."""
        return np.concatenate(
            [
                mesh.faces + first
                for mesh, first in zip(self.meshes, self.first_vertices, strict=False)
            ]
            or [np.zeros((0, 3), np.int32)]
        )

    @cached_property
    def geom_ids(self):
        """(M,) int32: the mesh of each face."""
        return np.repeat(np.arange(len(self.meshes), dtype=np.int32), np.diff(self.first_prims))

    @cached_property
    def first_prims(self):
        """(G + 1,) int32: index in `faces` of each mesh's first face; the last is M."""
        return _first_ids(len(mesh.faces) for mesh in self.meshes)

    @cached_property
    def first_vertices(self):
        """(G + 1,) int32: index in `vertices` of each mesh's first vertex; the last is N."""
        return _first_ids(len(mesh.vertices) for mesh in self.meshes)

    @property
    def num_triangles(self):
        """Number of faces of all meshes."""
        return int(self.first_prims[-1])

    @cached_property
    def bounds(self):
        """(2, 3) float64: smallest and largest corner over the faces; zeros without a face."""
        if not len(self.faces):
            return np.zeros((2, 3))
        # only vertices of faces: the others may hold anything
        used = self.vertices[np.unique(self.faces)]
        return np.array([used.min(axis=0), used.max(axis=0)], dtype=np.float64)

    @property
    def diagonal(self):
        """Length of the diagonal of `bounds`."""
        return float(np.linalg.norm(self.bounds[1] - self.bounds[0]))

    def add(self, mesh, material=None):
        """Append a mesh, with another material if one is given.

        A fitted camera and the default light adapt; arrays taken earlier do not change.
        """
        mesh = check_type("mesh", mesh, Mesh)
        self._meshes += (mesh if material is None else replace(mesh, material=material),)
        self._forget(
            "vertices",
            "faces",
            "geom_ids",
            "first_prims",
            "first_vertices",
            "bounds",
            "_fitted_camera",
            "_default_lights",
        )

    def set_lights(self, lights):
        """Replace all lights; a renderer made earlier keeps those it has.

        Parameters
        ----------
        lights : sequence of PointLight, DirectionalLight and SpotLight, or None
            An empty sequence: no light, only `ambient` and what surfaces emit. None: the
            default light.

        Raises
        ------
        TypeError
            If a light is of another type.
        """
        self._lights = None if lights is None else check_types("lights", lights, _LIGHTS)

    def set_material(self, pattern, **changes):
        """Change the material of every mesh whose name or material name fits a pattern.

        Parameters
        ----------
        pattern : str
            As for `fnmatch`, for example "wheel-*"; upper and lower case differ.
        **changes
            Fields of `Material` with their new values.

        Returns
        -------
        int
            Number of meshes changed.

        Raises
        ------
        ValueError
            If no mesh fits, or a value is out of range.
        TypeError
            If a field does not exist.
        """
        fits = [
            fnmatchcase(mesh.name, pattern) or fnmatchcase(mesh.material.name, pattern)
            for mesh in self.meshes
        ]
        if not any(fits):
            raise ValueError(
                f"no mesh or material fits {pattern!r}; the meshes are "
                f"{_shortened([mesh.name for mesh in self.meshes])}"
            )
        # new meshes: the old ones may be shared with another scene
        self._meshes = tuple(
            replace(mesh, material=replace(mesh.material, **changes)) if fit else mesh
            for mesh, fit in zip(self.meshes, fits, strict=True)
        )
        return sum(fits)

    def mirror(self, pattern):
        """Make what fits `pattern` a mirror; see `set_material`."""
        return self.set_material(
            pattern,
            diffuse=0.0,
            specular=0.5,
            shininess=200.0,
            reflectivity=0.9,
            transmission=0.0,
            texture=None,
        )

    def glass(self, pattern):
        """Make what fits `pattern` clear glass; see `set_material`."""
        return self.set_material(
            pattern,
            diffuse=0.0,
            specular=0.5,
            shininess=200.0,
            reflectivity=0.0,
            transmission=1.0,
            ior=1.5,
            texture=None,
        )

    def with_vertices(self, vertices):
        """Return a scene of the same topology with other vertices.

        Smooth normals are computed anew; a fitted camera and the default light stay as they
        are, so that an animation does not move them.

        Parameters
        ----------
        vertices : (N, 3) float
            The meshes' vertices one after another, as in `vertices`.

        Raises
        ------
        ValueError
            If the shape differs or a vertex of a face is not finite.
        TypeError
            If they are not real numbers.
        """
        vertices = as_float_array("vertices", vertices, self.vertices.shape)
        parts = np.split(vertices, self.first_vertices[1:-1])
        meshes = [mesh.with_vertices(part) for mesh, part in zip(self.meshes, parts, strict=True)]
        return Scene(meshes, self.lights, self.camera, self.background, self.ambient, self.name)

    @cached_property
    def _fitted_camera(self):
        return Camera.fit(self.bounds)

    @cached_property
    def _default_lights(self):
        right, up, _ = self.camera.basis
        return (PointLight(self.camera.eye + 0.5 * (self.diagonal or 1.0) * (up - right)),)

    def _forget(self, *names):
        for name in names:
            self.__dict__.pop(name, None)


def load_scene(path, *, smooth=False, on_invalid="raise"):
    """Read a scene from a file.

    Parameters
    ----------
    path : str or path-like
        Any mesh file that trimesh reads. Camera and lights (KHR_lights_punctual) come from
        glTF files that have them; the first camera in the order of the nodes is taken.
    smooth : bool
        Compute vertex normals for meshes that have none in the file; otherwise those are flat.
    on_invalid : {"raise", "drop"}
        What to do about faces with an index out of range or a vertex that is not finite.
        Dropped faces are counted in the mesh's `dropped`.

    Returns
    -------
    Scene

    Raises
    ------
    OSError
        If the file is missing or cannot be opened.
    ValueError
        If the format is unknown, the content cannot be read or holds no triangles, or a face
        is invalid.
    """
    meshes = load_meshes(path, smooth, on_invalid)
    camera = lights = None
    if gltf.is_gltf(path):
        camera, lights = gltf.camera_and_lights(gltf.read_header(path), path)
    return Scene(meshes, lights, camera, name=Path(path).stem)


def as_scene(thing, *, smooth=False, on_invalid="raise"):
    """Return a scene of whatever can stand for one.

    Parameters
    ----------
    thing : Scene, Mesh, trimesh.Trimesh or trimesh.Scene
        A Scene is returned as it is.
    smooth, on_invalid
        For trimesh objects, as for `load_scene`.

    Returns
    -------
    Scene

    Raises
    ------
    TypeError
        If it is of another type.
    ValueError
        If a face is invalid and `on_invalid` is "raise".
    """
    if isinstance(thing, Scene):
        return thing
    if isinstance(thing, Mesh):
        return Scene([thing], name=thing.name)
    if is_trimesh(thing):
        return Scene(from_trimesh(thing, smooth, on_invalid), camera=_trimesh_camera(thing))
    raise TypeError(
        f"need a Scene, Mesh, trimesh.Trimesh or trimesh.Scene, got {type(thing).__name__}"
    )


def _trimesh_camera(thing):
    """The camera of a trimesh.Scene, where it has been given one."""
    if not getattr(thing, "has_camera", False):
        return None
    return Camera.from_matrix(thing.camera_transform, float(thing.camera.fov[1]))


def _first_ids(counts):
    return np.cumsum([0, *counts], dtype=np.int64).astype(np.int32)


def _shortened(names):
    more = f", ... ({len(names)} in all)" if len(names) > _SHOWN_NAMES else ""
    return ", ".join(map(repr, names[:_SHOWN_NAMES])) + more
