"""Every ray against every triangle in float64: the last word where tracers differ."""

import numpy as np

from .arrays import float32_rays
from .tracer import HostTracer
from .watertight import intersect_pairs

# Pairs of (ray, triangle) held at once; at most 100 MB of temporaries.
PAIRS_PER_CHUNK = 1 << 18


class BruteForceTracer(HostTracer):
    """Closest and any hits in double precision; watertight. Arguments and errors of HostTracer.

    Vertices and rays are rounded to float32 on entry, as all tracers do, and all that follows is
    float64. Distances count as equal when they are equal rounded to float32, the precision in
    which hits are returned; then the smaller (geom_id, prim_id) wins. A triangle whose cross
    product is zero in float64 has no area and is never hit.
    """

    def intersect(self, origins, directions, tnear=0.0, tfar=np.inf):
        """Return the closest Hits; arguments and errors as for EmbreeTracer.intersect."""
        rays = float32_rays(origins, directions, tnear, tfar)
        num_rays = len(rays[0])
        ray, face, t, u, v = self.all_hits(*rays)
        order = np.lexsort((face, t.astype(np.float32), ray))
        hit_rays, first = np.unique(ray[order], return_index=True)
        closest = order[first]
        per_ray = np.zeros((3, num_rays))
        per_ray[:, hit_rays] = t[closest], u[closest], v[closest]
        faces = np.full(num_rays, -1)
        faces[hit_rays] = face[closest]
        return self.triangles.hits(faces, *per_ray)

    def occluded(self, origins, directions, tnear=0.0, tfar=1.0):
        """Return whether anything is hit between tnear and tfar, (n,) bool."""
        rays = float32_rays(origins, directions, tnear, tfar)
        blocked = np.zeros(len(rays[0]), bool)
        blocked[self.all_hits(*rays)[0]] = True
        return blocked

    def candidates(self, origin, direction, t, tolerance):
        """Return all triangles that a ray hits within a tolerance of a distance.

        Parameters
        ----------
        origin, direction : (3,) array_like
        t, tolerance : float
            Hits count from t - tolerance to t + tolerance, also before the origin.

        Returns
        -------
        face : (k,) int
            Flat face indices (over all meshes), by rising distance, then rising index.
        distances : (k,) float64
        """
        origins, directions, _, _ = float32_rays([origin], [direction], 0.0, np.inf)
        near, far = np.array([t - tolerance]), np.array([t + tolerance])
        _, face, distances, _, _ = self.all_hits(origins, directions, near, far)
        order = np.lexsort((face, distances))
        return face[order], distances[order]

    def all_hits(self, origins, directions, tnear, tfar):
        """Return every hit of every ray; what `intersect` chooses from.

        Parameters
        ----------
        origins, directions : (n, 3) float
            Taken as they are, in float64.
        tnear, tfar : (n,) float
            May be negative.

        Returns
        -------
        ray, face : (k,) int
            Ray and flat face index of each hit, in no particular order.
        t, u, v : (k,) float64
        """
        origins, directions = origins.astype(np.float64), directions.astype(np.float64)
        found = [self._hits_of_pairs(origins, directions, np.zeros((2, 0), int), tnear, tfar)]
        for pairs in self._near_pairs(origins, directions):
            found.append(self._hits_of_pairs(origins, directions, pairs, tnear, tfar))
        return tuple(np.concatenate(column) for column in zip(*found, strict=True))

    def _prepare(self, triangles):
        self._corners = triangles.corners().astype(np.float64)
        a, b, c = self._corners.transpose(1, 0, 2)
        self._with_area = np.flatnonzero(np.cross(b - a, c - a).any(axis=1))
        self._centres = self._corners.mean(axis=1)
        squared = ((self._corners - self._centres[:, None]) ** 2).sum(axis=2)
        self._squared_radii = squared.max(axis=1, initial=0)

    def _hits_of_pairs(self, origins, directions, pairs, tnear, tfar):
        ray, face = pairs
        hit, t, u, v = intersect_pairs(origins[ray], directions[ray], self._corners[face])
        kept = hit & (t >= tnear[ray]) & (t <= tfar[ray])
        return ray[kept], face[kept], t[kept], u[kept], v[kept]

    def _near_pairs(self, origins, directions):
        """Yield (rays, faces) chunks of all pairs whose line passes the triangle's sphere.

        The squared distance of a centre c from a line o + t d is |c - o|^2 - ((c - o) d)^2 with
        unit d. Its float64 error is below 32 eps (|c| + |o|)^2 (expanded scalar products of
        three terms and their differences); the allowance below is over fifty times that.
        """
        lengths = np.linalg.norm(directions, axis=1)
        units = directions / np.where(lengths > 0, lengths, 1)[:, None]
        faces_step = min(len(self._with_area), PAIRS_PER_CHUNK)
        rays_step = max(1, PAIRS_PER_CHUNK // max(faces_step, 1))
        for ray_start in range(0, len(origins), rays_step):
            rays = slice(ray_start, ray_start + rays_step)
            for face_start in range(0, len(self._with_area), max(faces_step, 1)):
                faces = self._with_area[face_start : face_start + faces_step]
                near = self._near(origins[rays], units[rays], faces)
                ray, column = np.nonzero(near)
                yield ray + ray_start, faces[column]

    def _near(self, origins, units, faces):
        """Return (rays, faces) bool: whether the line may meet the face's sphere."""
        centres = self._centres[faces]
        size_c, size_o = (centres**2).sum(axis=1), (origins**2).sum(axis=1)[:, None]
        along = units @ centres.T - (units * origins).sum(axis=1)[:, None]
        squared = size_c + size_o - 2 * (origins @ centres.T) - along**2
        allowance = 1e-12 * (size_c + size_o)
        return squared <= self._squared_radii[faces] * (1 + 1e-12) + allowance
