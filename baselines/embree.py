"""Embree behind the protocol of raystream's tracers, called through embreex without rescaling.

What embreex 4.4.0 does, found by experiment (tests/test_embree.py keeps the facts):

* Distances are in units of the given direction's length; both ends of the segment count, a
  hit at t = 0 too. A zero direction hits nothing. Both sides of a triangle are hit.
* `dists` is tfar, a float32 array or a number, and is **overwritten** with the hit distances;
  without it tfar is 1e37. Infinity is accepted.
* A negative tfar makes the OCCLUDED query answer "occluded", because Embree marks found
  occluders that way. Inactive rays are therefore masked here and never handed over.
* tnear is always 0, see `EmbreeTracer._advanced`.
* Origins and directions must be native float32 (any memory order); indices may be of any
  integer dtype; none of the lengths and none of the indices is checked.
* Of triangles at the same distance any may be returned (of copies, the last was), and the
  robust flag does not keep all rays from slipping between triangles that share an edge.
* Triangles are silently lost where products of three coordinates leave float32: from about
  1e13 in size, and below about 1e-12 the distances go wrong. So are triangles with a NaN.
* A mesh added after the first query is ignored: a changed scene is a new EmbreeScene. Vertices
  and indices are copied, and the scene keeps its device, so that nothing else must stay alive.
* Queries hold Python's global lock: threads are safe and gain nothing.
"""

import numpy as np
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene

from .arrays import float32_rays
from .tracer import HostTracer

# Beyond this, products of three coordinates come near the largest float32.
LARGEST_COORDINATE = 1e12


class EmbreeTracer(HostTracer):
    """Closest and any hits by Embree in single precision.

    Arguments and errors as for HostTracer; in addition, coordinates beyond 1e12 in size are
    refused with a ValueError.
    """

    def intersect(self, origins, directions, tnear=0.0, tfar=np.inf):
        """Return the closest hits.

        Parameters
        ----------
        origins, directions : (n, 3) array_like
        tnear, tfar : float or (n,) array_like
            Hits count from tnear to tfar, in units of the direction's length.

        Returns
        -------
        Hits

        Raises
        ------
        TypeError, ValueError
            One line that names the argument.
        """
        return self._closest(*float32_rays(origins, directions, tnear, tfar))

    def occluded(self, origins, directions, tnear=0.0, tfar=1.0):
        """Return whether anything is hit between tnear and tfar, (n,) bool; see `intersect`."""
        rays = float32_rays(origins, directions, tnear, tfar)
        if rays[2].any():  # a tnear above 0 needs distances
            return self._closest(*rays).prim_id >= 0
        origins, directions, _, tfar = rays
        blocked = np.zeros(len(origins), bool)
        active = tfar >= 0
        dists = tfar[active]
        found = self._scene.run(origins[active], directions[active], dists=dists, query="OCCLUDED")
        blocked[active] = found >= 0
        return blocked

    def _prepare(self, triangles):
        largest = np.abs(triangles.corners()).max(initial=0)
        if largest > LARGEST_COORDINATE:
            raise ValueError(f"vertices: need coordinates up to {LARGEST_COORDINATE:g} in size")
        self._scene = EmbreeScene(robust=True)
        TriangleMesh(self._scene, triangles.vertices, triangles.faces)

    def _closest(self, origins, directions, tnear, tfar):
        face, t, u, v = self._run(origins, directions, tfar)
        early = np.flatnonzero(t < tnear)
        if len(early):
            rest = self._advanced(origins[early], directions[early], tnear[early], tfar[early])
            face[early], t[early], u[early], v[early] = rest
        return self.triangles.hits(face, t, u, v)

    def _advanced(self, origins, directions, tnear, tfar):
        """Trace from the points at tnear, because embreex offers no tnear of its own.

        Only rays whose first hit lies before tnear come here; all others keep their exact ray.
        The new origin is rounded to float32, which shifts the ray by up to half a unit in the
        last place of the origin's coordinates: hits within that of tnear can go either way.
        """
        start = origins.astype(np.float64) + tnear[:, None].astype(np.float64) * directions
        with np.errstate(over="ignore"):  # from a start beyond float32 Embree hits nothing
            start = start.astype(np.float32)
        face, t, u, v = self._run(start, directions, tfar - tnear)
        return (
            face,
            np.minimum(t + tnear, tfar),
            u,
            v,
        )  # the sum may round to above tfar

    def _run(self, origins, directions, tfar):
        """Return flat face (-1 where missed), t, u, v of rays with tnear = 0."""
        face = np.full(len(origins), -1, np.int32)
        t = np.full(len(origins), np.inf, np.float32)
        u, v = np.zeros((2, len(origins)), np.float32)
        active = tfar >= 0
        dists = tfar[active]  # a copy: embreex writes the hit distances into it
        found = self._scene.run(origins[active], directions[active], dists=dists, output=1)
        hit = found["primID"] >= 0
        face[active] = found["primID"]
        t[active] = np.where(hit, found["tfar"], np.inf)
        u[active], v[active] = found["u"], found["v"]
        return face, t, u, v
