"""Reflections by environment cube maps (Greene 1986), what the layered depth cube is shown against.

Every mesh that mirrors has a map: what is seen, without that mesh, from the middle of its bounding
box. A reflected ray is looked up by its direction alone, so a mesh never mirrors itself and what is
near is in the wrong place.
"""

import numpy as np
from raystream.baselines import EmbreeTracer, render_reference
from raystream.baselines.reference import (
    primary_rays,
    ray_offset,
    secondary_rays,
    select_hits,
    shade,
)
from raystream.baselines.surface import surface_points

import raystream as rs

# Line of sight and upright direction of each face.
_VIEWS = [(side * axis, np.roll(axis, 1)) for axis in np.eye(3) for side in (1, -1)]


class CubeMap:
    """What is seen from a point in all directions, without reflections.

    Parameters
    ----------
    scene : raystream.Scene
    centre : (3,) float
    size : int
        Pixels along the edge of each of the six faces.
    """

    def __init__(self, scene, centre, size=512):
        self._size = size
        cameras = [rs.Camera.look_at(centre, centre + view, up, 90.0) for view, up in _VIEWS]
        self._axes = np.array([camera.basis for camera in cameras])  # (6, 3, 3)
        tracer = EmbreeTracer.from_scene(scene)
        faces = [
            render_reference(scene, camera, (size, size), max_bounces=0, tracer=tracer).image
            for camera in cameras
        ]
        self._faces = np.stack(faces)

    def look_up(self, directions):
        """(n, 3) linear RGB seen in (n, 3) directions, interpolated between pixels."""
        face = np.einsum("fk,nk->nf", self._axes[:, 2], directions).argmax(axis=1)
        x, y, depth = np.einsum("nak,nk->an", self._axes[face], directions)
        last = self._size - 1
        column = np.clip((x / depth + 1) * self._size / 2 - 0.5, 0, last)
        row = np.clip((1 - y / depth) * self._size / 2 - 0.5, 0, last)
        left, top = (np.minimum(v.astype(int), last - 1) for v in (column, row))
        right, down = (column - left)[:, None], (row - top)[:, None]
        upper, lower = (
            (1 - right) * self._faces[face, line, left] + right * self._faces[face, line, left + 1]
            for line in (top, top + 1)
        )
        return (1 - down) * upper + down * lower


def render_cube_map(scene, camera, size, map_size=512):
    """The picture with one bounce of reflection, by cube maps: (height, width, 3) float32."""
    rays = primary_rays(camera, size, (0.5, 0.5))
    tracer = EmbreeTracer.from_scene(scene)
    hits = tracer.intersect(rays.origins.astype(np.float32), rays.directions.astype(np.float32))
    hit = hits.prim_id >= 0
    image = np.tile(np.asarray(scene.background, np.float64), (len(hit), 1))
    directions = rays.directions[hit] / np.linalg.norm(rays.directions[hit], axis=1, keepdims=True)
    points = surface_points(scene, select_hits(hits, hit), directions)
    offset = ray_offset(scene.bounds)
    image[hit] = shade(scene, points, directions, offset, tracer)
    bounced = secondary_rays(rays.weights[hit], rays.pixels[hit], points, directions, offset)
    mesh_of_ray = hits.geom_id[bounced.pixels]
    for geom_id in np.unique(mesh_of_ray):
        of_mesh = bounced[mesh_of_ray == geom_id]
        seen = map_of(scene, geom_id, map_size).look_up(of_mesh.directions)
        np.add.at(image, of_mesh.pixels, of_mesh.weights * seen)
    return image.astype(np.float32).reshape(size[1], size[0], 3)


def map_of(scene, geom_id, size):
    """The cube map of one mesh of the scene."""
    vertices = scene.meshes[geom_id].vertices[scene.meshes[geom_id].faces]
    centre = (vertices.min(axis=(0, 1)) + vertices.max(axis=(0, 1))) / 2
    others = [mesh for k, mesh in enumerate(scene.meshes) if k != geom_id]
    rest = rs.Scene(others, scene.lights, scene.camera, scene.background, scene.ambient)
    return CubeMap(rest, centre.astype(np.float64), size)
