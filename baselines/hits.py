"""The answer of a ray query: one entry per ray."""

from dataclasses import dataclass

import numpy as np


@dataclass
class Hits:
    """Closest hits; the hit point is (1 - u - v) v0 + u v1 + v v2.

    Attributes
    ----------
    t : (n,) float32
        Distance in units of the ray direction's length; inf where missed.
    prim_id : (n,) int32
        Face index within its mesh; -1 where missed.
    geom_id : (n,) int32
        Index of the mesh in the scene; -1 where missed.
    u, v : (n,) float32
        Barycentric coordinates of the second and third vertex; 0 where missed.
    """

    t: np.ndarray
    prim_id: np.ndarray
    geom_id: np.ndarray
    u: np.ndarray
    v: np.ndarray

    @classmethod
    def missed(cls, num_rays):
        """Return the hits of `num_rays` rays that all missed."""
        return cls(
            t=np.full(num_rays, np.inf, np.float32),
            prim_id=np.full(num_rays, -1, np.int32),
            geom_id=np.full(num_rays, -1, np.int32),
            u=np.zeros(num_rays, np.float32),
            v=np.zeros(num_rays, np.float32),
        )

    def __len__(self):
        return len(self.t)
