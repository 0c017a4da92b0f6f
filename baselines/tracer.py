"""What the host tracers share: how they are made and how they take new vertices."""

from .triangles import Triangles


class HostTracer:
    """A tracer over checked triangles; a subclass prepares itself in `_prepare(triangles)`.

    Parameters
    ----------
    vertices : (n, 3) array_like
        Positions; those that a face uses must be finite.
    faces : (m, 3) array_like of int
        Indices into `vertices`, the meshes one after another.
    first_prims : (g + 1,) array_like of int, optional
        Mesh k owns the faces first_prims[k] to first_prims[k + 1] - 1; default: one mesh.

    Raises
    ------
    TypeError, ValueError
        One line that names the array.

    Attributes
    ----------
    triangles : Triangles
    """

    def __init__(self, vertices, faces, first_prims=None):
        self._take(Triangles.checked(vertices, faces, first_prims))

    @classmethod
    def from_scene(cls, scene):
        """Make a tracer from `scene.vertices`, `scene.faces` and `scene.first_prims`."""
        return cls(scene.vertices, scene.faces, scene.first_prims)

    def update_vertices(self, vertices):
        """Replace the positions, (n, 3) as at the start; the faces stay."""
        self._take(self.triangles.moved(vertices))

    def _take(self, triangles):
        self._prepare(triangles)  # may refuse them, and then nothing has changed
        self.triangles = triangles
