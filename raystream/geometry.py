"""A scene's triangles on the device, with their bounds (cl/geometry.cl)."""

import numpy as np

from raystream.statistics import GEOMETRY

_BLOCK = 16  # triangles per block of bounds, see cl/geometry.cl
_BOUND_ROWS = 12


class Geometry:
    """Triangles of a scene on one device; a new frame is one upload of vertices.

    Parameters
    ----------
    session : raystream.device.Session
    scene : raystream.Scene

    Attributes
    ----------
    num_triangles : int
    triangles : Array of shape (num_blocks * 16, 12) float32
        v0, v1, v2 as float4, the fourth component unused.
    bounds : Array of shape (num_blocks * 16, 12) float32
        Centre and radius of each triangle's bounding sphere; around that centre unit normal and
        half thickness of a slab, and half extents of a box, and 0.
    bound_rows : Array of shape (num_blocks, 12, 16) float32
        The same as rows of 16 triangles.
    geom_ids : Array of shape (num_triangles,) uint32
    first_prims : Array of shape (num_meshes + 1,) uint32
        First flat triangle of each mesh.
    version : int
        Counts the updates: what is derived from the vertices is made anew where it changed.
    """

    def __init__(self, session, scene):
        self.session, self.version = session, 0
        self.num_triangles = scene.num_triangles
        self._num_blocks = -(-self.num_triangles // _BLOCK)
        self.faces = session.upload(GEOMETRY, scene.faces.astype(np.uint32))
        self.geom_ids = session.upload(GEOMETRY, scene.geom_ids.astype(np.uint32))
        self.first_prims = session.upload(GEOMETRY, scene.first_prims.astype(np.uint32))
        self.triangles = session.empty((self._num_blocks * _BLOCK, 12), np.float32)
        self.bounds = session.empty((self._num_blocks * _BLOCK, _BOUND_ROWS), np.float32)
        self.bound_rows = session.empty((self._num_blocks, _BOUND_ROWS, _BLOCK), np.float32)
        self._vertices = session.empty(scene.vertices.shape, np.float32)
        self.update(scene.vertices)

    def update(self, vertices):
        """Take new vertices, (N, 3) float32 in the scene's order; topology unchanged."""
        self.session.upload(GEOMETRY, vertices, self._vertices)
        self._gather(self._vertices)
        self.version += 1

    def _gather(self, vertices):
        self.session.launch(
            GEOMETRY,
            self.session.kernels("geometry.cl")["gather_triangles"],
            self._num_blocks,
            np.uint32(self.num_triangles),
            vertices,
            self.faces,
            self.triangles,
            self.bounds,
            self.bound_rows,
        )
