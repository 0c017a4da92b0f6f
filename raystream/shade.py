"""Whitted shading on the device: surfaces, direct light, the next ray streams (cl/shade.cl)."""

import dataclasses

import numpy as np
import pyopencl.array as cla

from raystream.light import DirectionalLight, SpotLight
from raystream.material import srgb_to_linear
from raystream.rays import Rays, float4
from raystream.statistics import RAY_CREATION, SHADING

MIN_WEIGHT = 1 / 512  # rays that count for less than half a step of an 8-bit image are dropped
_LOCAL = 64
_PER_ITEM = 64  # rays per work-item of spawn_rays
_HAS_NORMALS, _HAS_COLORS = 1, 2
_POINT, _DIRECTIONAL, _SPOT = 0.0, 1.0, 2.0
_OFFSET = 1e-5  # of the scene's diagonal: how far rays start off a surface
_OFFSET_ULPS = 4


@dataclasses.dataclass
class Surfaces:
    """The G-buffer of a hit stream: float4 arrays of shape (n, 4), see cl/shade.cl."""

    position: cla.Array
    shading: cla.Array
    geometric: cla.Array
    base: cla.Array


def ray_offset(scene):
    """How far rays start off a surface, along its geometric normal: the rule of self-intersection.

    1e-5 of the scene's diagonal, at least 4 float32 steps of its largest coordinate.
    """
    largest = float(np.abs(scene.bounds).max())
    return max(_OFFSET * scene.diagonal, _OFFSET_ULPS * float(np.finfo(np.float32).eps) * largest)


class Shader:
    """The shading data of a scene on one device.

    Parameters
    ----------
    session : raystream.device.Session
    geometry : raystream.geometry.Geometry
        Of the same scene.
    scene : raystream.Scene
    """

    def __init__(self, session, geometry, scene):
        self.session, self.geometry = session, geometry
        self._kernels = session.kernels("shade.cl")
        self._offset = np.float32(ray_offset(scene))
        self._background, self._ambient = float4(scene.background), float4(scene.ambient)
        self._materials = self._upload(_material_table(scene.meshes))
        info, texels = _texture_table(scene.meshes)
        self._attributes = [
            self._upload(_per_vertex(scene.meshes, "normals", 3)),
            self._upload(_per_vertex(scene.meshes, "uv", 2)),
            self._upload(_per_vertex(scene.meshes, "colors", 3)),
            self._materials,
            self._upload(info),
            self._upload(texels),
            self._upload(srgb_to_linear(np.arange(256, dtype=np.uint8)).astype(np.float32)),
        ]
        self._lights = [self._upload(_light_record(light)) for light in scene.lights]
        # A directional light is nowhere: its shadow rays start at the surfaces.
        self._from_light = [not isinstance(light, DirectionalLight) for light in scene.lights]

    @property
    def num_lights(self):
        """Number of light sources."""
        return len(self._lights)

    def evaluate(self, hits, rays, weights, image):
        """The surfaces of a hit stream; adds their own light, and the background, to the image."""
        count = len(rays)
        surfaces = Surfaces(*(self.session.empty((count, 4), np.float32) for _ in range(4)))
        self._launch(
            SHADING,
            "evaluate_surfaces",
            count,
            hits.triangle,
            hits.u,
            hits.v,
            rays.dir_tfar,
            self.geometry.triangles,
            self.geometry.faces,
            self.geometry.geom_ids,
            *self._attributes,
            self._background,
            self._ambient,
            weights,
            *self._fields(surfaces),
            image,
        )
        return surfaces

    def shadow_rays(self, light, surfaces, weights, size):
        """Rays between the light of that number and every surface that faces it."""
        count = weights.shape[0]
        arrays = (self.session.empty((count, 4), np.float32) for _ in range(2))
        rays = Rays(*arrays, size, light if self._from_light[light] else None)
        self._launch(
            RAY_CREATION,
            "make_shadow_rays",
            count,
            self._lights[light],
            self._offset,
            weights,
            surfaces.position,
            surfaces.shading,
            surfaces.geometric,
            rays.org_tnear,
            rays.dir_tfar,
        )
        return rays

    def add_light(self, light, blocked, rays, surfaces, weights, image):
        """Add the light of that number to the image wherever it is not blocked."""
        self._launch(
            SHADING,
            "add_light",
            weights.shape[0],
            self._lights[light],
            blocked,
            rays.dir_tfar,
            weights,
            *self._fields(surfaces),
            self._materials,
            image,
        )

    def spawn(self, rays, surfaces, weights):
        """Reflection and refraction rays.

        Returns
        -------
        list of (Rays, Array, int)
            For each kind the rays, their weights, and how many are active (read from the device).
        """
        count = len(rays)
        streams = [[self.session.empty((count, 4), np.float32) for _ in range(3)] for _ in range(2)]
        alive = self.session.empty(2, np.uint32)
        self.session.fill(RAY_CREATION, alive, 0)
        self.session.launch(
            RAY_CREATION,
            self._kernels["spawn_rays"],
            -(-count // _PER_ITEM),
            np.uint32(count),
            self._offset,
            np.float32(MIN_WEIGHT),
            rays.dir_tfar,
            weights,
            surfaces.position,
            surfaces.shading,
            surfaces.geometric,
            self._materials,
            *streams[0],
            *streams[1],
            alive,
        )
        return [
            (Rays(org, direction, rays.size), weight, int(number))
            for (org, direction, weight), number in zip(streams, alive.get(), strict=True)
        ]

    def _upload(self, array):
        return self.session.upload(SHADING, array)

    def _launch(self, stage, kernel, count, *args):
        self.session.launch(
            stage, self._kernels[kernel], count, np.uint32(count), *args, local=_LOCAL
        )

    @staticmethod
    def _fields(surfaces):
        return surfaces.position, surfaces.shading, surfaces.geometric, surfaces.base


def _material_table(meshes):
    """(meshes, 5, 4) float32, see cl/shade.cl."""
    rows = [
        [
            [*m.diffuse, m.shininess],
            [*m.specular, m.ior],
            [*m.reflectivity, 0.0],
            [*m.transmission, 0.0],
            [*m.emission, 0.0],
        ]
        for m in (mesh.material for mesh in meshes)
    ]
    return np.array(rows, np.float32).reshape(-1, 5, 4)


def _texture_table(meshes):
    """(meshes, 4) uint32: first texel, width, height, flags; and all texels, (n, 3) uint8."""
    info = np.zeros((len(meshes), 4), np.uint32)
    texels, places, next_texel = [], {}, 0
    for row, mesh in zip(info, meshes, strict=True):
        row[3] = _HAS_NORMALS * (mesh.normals is not None) + _HAS_COLORS * (mesh.colors is not None)
        texture = mesh.material.texture
        if texture is None or mesh.uv is None:
            continue
        if id(texture) not in places:  # meshes share a material's texture
            places[id(texture)] = next_texel
            texels.append(texture.reshape(-1, 3))
            next_texel += len(texels[-1])
        row[:3] = places[id(texture)], texture.shape[1], texture.shape[0]
    return info, np.concatenate(texels or [np.zeros((0, 3), np.uint8)])


def _per_vertex(meshes, name, columns):
    """An attribute of all meshes' vertices one after another, zeros for a mesh without it."""
    parts = [getattr(mesh, name) for mesh in meshes]
    if all(part is None for part in parts):
        return np.zeros((0, columns), np.float32)
    filled = [
        np.zeros((len(mesh.vertices), columns), np.float32) if part is None else part
        for mesh, part in zip(meshes, parts, strict=True)
    ]
    return np.concatenate(filled).astype(np.float32)


def _light_record(light):
    """(4, 4) float32, see cl/shade.cl."""
    directional, spot = isinstance(light, DirectionalLight), isinstance(light, SpotLight)
    kind = _DIRECTIONAL if directional else _SPOT if spot else _POINT
    position = np.zeros(3) if directional else light.position
    direction = light.direction if directional or spot else np.zeros(3)
    falloff = 0.0 if directional else float(light.falloff)
    angles = (light.inner_angle, light.outer_angle) if spot else (0.0, 0.0)
    cosines = np.cos(np.radians(angles))
    return np.array(
        [[*position, kind], [*direction, falloff], [*light.color, 0.0], [*cosines, 0.0, 0.0]],
        np.float32,
    )
