"""A scene's triangles on the device, with their bounds (cl/geometry.cl)."""

import numpy as np

from raystream.statistics import GEOMETRY

_BLOCK = 16  # triangles per block of bounds, see cl/geometry.cl
_BOUND_ROWS = 12
_GATHERED = 1024  # triangles to a work-item


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
        half thickness of a slab, and half extents of a box, and 0. Bounds are made when they are
        first asked for after an update, in the same arrays.
    bound_rows : Array of shape (num_blocks, 12, 16) float32
        The same as rows of 16 triangles.
    middles : Array of shape (m, 2, 4) float32
        Boxes that hold twice the middles of the triangles' boxes, a part of the triangles each:
        low and high corner.
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
        self._gatherers = -(-self._num_blocks * _BLOCK // _GATHERED)
        self.middles = session.empty((self._gatherers, 2, 4), np.float32)
        self._bounds, self._bounds_version = None, None
        self._kernels = session.kernels("geometry.cl", GATHERED=_GATHERED)
        self.update(scene.vertices)

    @property
    def bounds(self):
        return self._current_bounds()[0]

    @property
    def bound_rows(self):
        return self._current_bounds()[1]

    def update(self, vertices):
        """Take new vertices, (N, 3) float32 in the scene's order; topology unchanged.

        The array must not change until the device has been waited for.
        """
        self.session.queue.finish()  # before the vertices that are being gathered may go
        self._vertices = self.session.share(GEOMETRY, vertices)
        self.version += 1
        padded = self._num_blocks * _BLOCK
        self.session.launch(
            GEOMETRY,
            self._kernels["gather_triangles"],
            self._gatherers,
            np.uint32(self.num_triangles),
            np.uint32(padded),
            self._vertices,
            self.faces,
            self.triangles,
            self.middles,
        )

    def _current_bounds(self):
        if self._bounds is None:
            padded, rows = (self._num_blocks * _BLOCK, _BOUND_ROWS), (_BOUND_ROWS, _BLOCK)
            shapes = padded, (self._num_blocks, *rows)
            self._bounds = tuple(self.session.empty(shape, np.float32) for shape in shapes)
        if self._bounds_version != self.version:
            self.session.launch(
                GEOMETRY,
                self._kernels["bound_triangles"],
                self._num_blocks,
                np.uint32(self.num_triangles),
                self.triangles,
                *self._bounds,
            )
            self._bounds_version = self.version
        return self._bounds
