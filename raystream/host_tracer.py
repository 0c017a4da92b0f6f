"""A tracer that works on numpy arrays (Embree) in the place of a device method."""

import numpy as np

from raystream.intersect import HitStream
from raystream.statistics import FINAL_INTERSECTION, Statistics

_INVALID = 0xFFFFFFFF


class HostTracer:
    """Wraps an object with ``intersect`` and ``occluded`` of the public protocol.

    Parameters
    ----------
    tracer : object
        `intersect(origins, directions, tnear, tfar)` returns hits with t, prim_id, geom_id, u, v;
        `occluded` returns bool (n,).
    scene : raystream.Scene
        Whose numbering of geometries the hits use.

    Attributes
    ----------
    statistics : Statistics
        Of the last call: the number of rays.
    """

    def __init__(self, tracer, scene):
        self._tracer, self._first_prims = tracer, scene.first_prims
        self._triangles = scene.num_triangles
        self.statistics = Statistics(triangles=self._triangles)

    def intersect_stream(self, session, rays):
        """As `Tracer.intersect_stream`, by way of the host."""
        active, arguments = self._active(rays)
        hits = self._tracer.intersect(*arguments)
        flat = np.where(hits.prim_id >= 0, self._first_prims[hits.geom_id] + hits.prim_id, _INVALID)
        count = len(rays)
        return HitStream(
            *(
                session.upload(FINAL_INTERSECTION, self._spread(active, values, count, missed))
                for values, missed in (
                    (np.asarray(hits.t, np.float32), np.inf),
                    (flat.astype(np.uint32), _INVALID),
                    (np.asarray(hits.u, np.float32), 0),
                    (np.asarray(hits.v, np.float32), 0),
                )
            )
        )

    def occluded_stream(self, session, rays):
        """As `Tracer.occluded_stream`, by way of the host."""
        active, arguments = self._active(rays)
        blocked = np.asarray(self._tracer.occluded(*arguments)).astype(np.uint8)
        return session.upload(FINAL_INTERSECTION, self._spread(active, blocked, len(rays), 0))

    def _active(self, rays):
        org_tnear, dir_tfar = rays.org_tnear.get(), rays.dir_tfar.get()
        active = np.flatnonzero(dir_tfar[:, 3] >= org_tnear[:, 3])
        org_tnear, dir_tfar = org_tnear[active], dir_tfar[active]
        self.statistics = Statistics(rays=len(active), triangles=self._triangles)
        return active, (org_tnear[:, :3], dir_tfar[:, :3], org_tnear[:, 3], dir_tfar[:, 3])

    @staticmethod
    def _spread(active, values, count, missed):
        spread = np.full(count, missed, values.dtype)
        spread[active] = values
        return spread
