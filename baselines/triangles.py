"""The triangles of a scene in flat arrays, and the way back to (geom_id, prim_id)."""

from dataclasses import dataclass

import numpy as np

from .arrays import check_finite, float32_array
from .hits import Hits


@dataclass(frozen=True)
class Triangles:
    """Checked triangles of all meshes, one mesh after another.

    Attributes
    ----------
    vertices : (n, 3) float32
    faces : (m, 3) int32
        Indices into `vertices`.
    first_prims : (g + 1,) int32
        Mesh k owns the faces first_prims[k] to first_prims[k + 1] - 1.
    """

    vertices: np.ndarray
    faces: np.ndarray
    first_prims: np.ndarray

    @classmethod
    def checked(cls, vertices, faces, first_prims=None):
        """Check the arrays and copy them; without `first_prims` all faces are one mesh.

        Raises
        ------
        TypeError, ValueError
            One line that names the array.
        """
        vertices = float32_array("vertices", vertices, (None, 3)).copy()
        faces = _checked_faces(faces, len(vertices))
        _check_used(vertices, faces)
        return cls(vertices, faces, _checked_first_prims(first_prims, len(faces)))

    def moved(self, vertices):
        """Return the same faces with other vertices, (n, 3) as before.

        Raises
        ------
        TypeError, ValueError
            One line that names the array.
        """
        vertices = float32_array("vertices", vertices, self.vertices.shape).copy()
        _check_used(vertices, self.faces)
        return Triangles(vertices, self.faces, self.first_prims)

    def corners(self, face=slice(None)):
        """Return the corners of all or of the given k faces as (k, 3 corners, 3) float32."""
        return self.vertices[self.faces[face]]

    def flat(self, geom_id, prim_id):
        """Return the flat face index of (geom_id, prim_id), -1 where geom_id is -1.

        Raises
        ------
        ValueError
            There is no such mesh or face.
        """
        geom_id, prim_id = np.asarray(geom_id), np.asarray(prim_id)
        hit = geom_id >= 0
        if (geom_id >= len(self.first_prims) - 1).any():
            raise ValueError(f"geom_id: need values below {len(self.first_prims) - 1}")
        counts = np.diff(self.first_prims)[geom_id[hit]]
        if ((prim_id[hit] < 0) | (prim_id[hit] >= counts)).any():
            raise ValueError("prim_id: need values below the number of faces of the mesh")
        face = np.full(geom_id.shape, -1)
        face[hit] = self.first_prims[geom_id[hit]] + prim_id[hit]
        return face

    def hits(self, face, t, u, v):
        """Return Hits from flat face indices, -1 (with any t, u and v) where missed."""
        hits = Hits.missed(len(face))
        found = face >= 0
        geom_id = np.searchsorted(self.first_prims, face[found], side="right") - 1
        hits.geom_id[found] = geom_id
        hits.prim_id[found] = face[found] - self.first_prims[geom_id]
        hits.t[found], hits.u[found], hits.v[found] = t[found], u[found], v[found]
        return hits


def _check_used(vertices, faces):
    """Raise ValueError when a face has a vertex that is not finite; unused ones may be anything."""
    used = np.zeros(len(vertices), bool)
    used[faces] = True
    check_finite("vertices", np.where(used[:, None], vertices, 0))


def _checked_faces(faces, num_vertices):
    faces = np.asarray(faces)
    if faces.ndim != 2 or faces.shape[1] != 3:
        raise ValueError(f"faces: need shape (n, 3), got {faces.shape}")
    if faces.size and not np.issubdtype(faces.dtype, np.integer):
        raise TypeError(f"faces: need integers, got dtype {faces.dtype}")
    # Embree reads wherever an index points to, so this check also keeps it inside its buffer.
    if faces.size and not (faces.min() >= 0 and faces.max() < num_vertices):
        raise ValueError(f"faces: indices must be between 0 and {num_vertices - 1}")
    return np.array(faces, np.int32, order="C")


def _checked_first_prims(first_prims, num_faces):
    if first_prims is None:
        return np.array([0, num_faces], np.int32)
    first_prims = np.array(first_prims, np.int32)
    rises = first_prims.ndim == 1 and len(first_prims) > 0 and (np.diff(first_prims) >= 0).all()
    if not rises or first_prims[0] != 0 or first_prims[-1] != num_faces:
        raise ValueError(f"first_prims: must rise from 0 to the number of faces, {num_faces}")
    return first_prims
