"""Method `brute`: every ray against every triangle on the device (cl/brute.cl)."""

import numpy as np

from raystream import intersect
from raystream.statistics import FINAL_INTERSECTION, Statistics

_WIDTH = 16  # rays per work-item


class Brute:
    """The device-side oracle of the other methods.

    Parameters
    ----------
    session : raystream.device.Session
    geometry : raystream.geometry.Geometry
    memory_limit : int
        Not needed: no candidate stream is made.
    """

    def __init__(self, session, geometry, memory_limit):
        self.session, self.geometry = session, geometry

    def intersect(self, rays):
        """Closest hits of `rays`; returns (HitStream, Statistics)."""
        closest = self.session.empty(len(rays), np.uint64)
        statistics = self._run("intersect_brute", rays, closest)
        return intersect.resolve(self.session, closest, rays, self.geometry.triangles), statistics

    def occluded(self, rays):
        """Whether anything lies in each ray's segment; returns (uint8 Array, Statistics)."""
        blocked = self.session.empty(len(rays), np.uint8)
        return blocked, self._run("occlude_brute", rays, blocked)

    def _run(self, kernel, rays, result):
        groups = -(-len(rays) // _WIDTH)
        counts = self.session.empty((groups, 2), np.uint32)
        self.session.launch(
            FINAL_INTERSECTION,
            self.session.kernels("brute.cl")[kernel],
            groups,
            np.uint32(len(rays)),
            np.uint32(self.geometry.num_triangles),
            rays.org_tnear,
            rays.dir_tfar,
            self.geometry.triangles,
            result,
            counts,
        )
        active, hits = (int(x) for x in counts.get().sum(axis=0, dtype=np.uint64))
        return Statistics(
            final_tests=active * self.geometry.num_triangles,
            final_hits=hits,
            rays=active,
            triangles=self.geometry.num_triangles,
            batches=1,
        )
