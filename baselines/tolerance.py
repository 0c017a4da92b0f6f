"""When two tracers or two images count as equal: the one place of these rules.

Distances. float32 keeps each coordinate to a relative 6e-8, so a hit point cannot be better than
that times the coordinates it is made from. Two distances agree when they differ by at most

    DISTANCE * (|t| + M / |d|),    M = largest |coordinate| of the ray's origin and the triangles,

in units of the direction's length |d|. At unit size with unit directions this is the customary
1e-5 (1 + |t|), and unlike that it holds for a scene scaled by any factor. DISTANCE is some 170
roundings: the handful that a tracer makes, seen at a grazing angle.

Verdicts. Where two answers differ, the float64 oracle traces the ray and eight parallel ones on
a circle of radius EDGE * M around it. An answer is acceptable when it is right for one of the
nine within the tolerance of distances, the ends tnear and tfar included. So at a silhouette both
hit and miss are acceptable; at an edge that two triangles share a miss is not: all nine hit.
"""

from dataclasses import dataclass

import numpy as np

from .arrays import float32_rays
from .brute_force import BruteForceTracer
from .nearness import distance_outside, largest_coordinate, slopes, with_neighbours

DISTANCE = 1e-5
# 16 roundings of M, and one for each of the 3.5 M that a hit is away from the origin at most.
EDGE = 1.2e-6
# The share of rays that may be wrong for two tracers to count as equal.
MAX_SHARE = 1e-4
VERDICTS = ("tie", "ours", "theirs", "neither")
# Rays judged at once: the nine variants of each are traced together.
RAYS_PER_CHUNK = 1024


@dataclass
class Agreement:
    """How a tracer's answers compare with a reference's.

    Attributes
    ----------
    num_rays : int
    rays : (k,) int
        Indices of the rays whose answers differ.
    verdicts : (k,) str
        Of each of them: "tie" (both answers acceptable), "ours" (only the tracer's), "theirs"
        (only the reference's) or "neither".
    """

    num_rays: int
    rays: np.ndarray
    verdicts: np.ndarray

    def count(self, verdict):
        """Return the number of rays with the verdict, one of VERDICTS."""
        return int((self.verdicts == verdict).sum())

    @property
    def num_wrong(self):
        """Number of rays whose answer by the tracer is not acceptable."""
        return self.count("theirs") + self.count("neither")

    @property
    def share(self):
        """Share of all rays whose answer by the tracer is not acceptable."""
        return self.num_wrong / max(self.num_rays, 1)

    @property
    def ok(self):
        """Whether the share is at most MAX_SHARE."""
        return self.share <= MAX_SHARE

    def __str__(self):
        counts = ", ".join(f"{self.count(verdict)} {verdict}" for verdict in VERDICTS)
        return (
            f"{self.num_rays} rays, {len(self.rays)} differ ({counts}), "
            f"wrong share {self.share:.2g} (at most {MAX_SHARE:g})"
        )


def differing(
    hits,
    reference,
    vertices,
    faces,
    first_prims,
    origins,
    directions,
    tnear=0.0,
    tfar=np.inf,
):
    """Compare the closest hits of a tracer with a reference's and judge the differences.

    Rays differ when one hits and the other does not, when their distances do not agree, or when
    they name different primitives and not both of these contain the hit point. (On an edge and
    on coincident triangles both do.)

    Parameters
    ----------
    hits, reference : Hits
        Or anything with t, prim_id and geom_id of shape (n,).
    vertices, faces, first_prims
        The triangles, as for EmbreeTracer.
    origins, directions, tnear, tfar
        The rays, as for EmbreeTracer.intersect.

    Returns
    -------
    Agreement

    Raises
    ------
    TypeError, ValueError
        One line that names the argument.
    """
    rays = float32_rays(origins, directions, tnear, tfar)
    oracle = BruteForceTracer(vertices, faces, first_prims)
    _check_lengths(len(rays[0]), len(hits.t), len(reference.t))
    answers = [_Answer.read(found, oracle.triangles, *rays[:2]) for found in (hits, reference)]
    ours, theirs = answers
    sizes = np.maximum(ours.size, theirs.size)
    differ = (ours.face >= 0) != (theirs.face >= 0)
    both = np.flatnonzero((ours.face >= 0) & (theirs.face >= 0))
    ours_hit, theirs_hit = ours[both], theirs[both]
    farther = np.maximum(ours_hit.t, theirs_hit.t)
    tolerance = distance_tolerance(farther, sizes[both], rays[1][both])
    apart = ~(np.abs(ours_hit.t - theirs_hit.t) <= tolerance)  # so that a NaN is apart, too
    misplaced = (ours_hit.face != theirs_hit.face) & ~(ours_hit.on_face & theirs_hit.on_face)
    differ[both] = apart | misplaced
    return _judged(oracle, rays, sizes, differ, answers, _closest_acceptable)


def differing_occlusion(
    blocked,
    reference,
    vertices,
    faces,
    first_prims,
    origins,
    directions,
    tnear=0.0,
    tfar=1.0,
):
    """Compare (n,) bool answers of `occluded`; otherwise as `differing`.

    An answer tells no triangle, so that M is taken over all triangles.
    """
    rays = float32_rays(origins, directions, tnear, tfar)
    oracle = BruteForceTracer(vertices, faces, first_prims)
    answers = [np.asarray(answer, bool) for answer in (blocked, reference)]
    _check_lengths(len(rays[0]), *(len(answer) for answer in answers))
    largest = np.abs(oracle.triangles.corners()).max(initial=0)
    sizes = np.maximum(largest, largest_coordinate(rays[0]))
    differ = answers[0] != answers[1]
    return _judged(oracle, rays, sizes, differ, answers, _occlusion_acceptable)


def distance_tolerance(t, sizes, directions):
    """Return by how much distances may differ, in units of the directions' lengths.

    Parameters
    ----------
    t : (n,) float
        The larger of the distances compared.
    sizes : (n,) float
        M: largest |coordinate| of each ray's origin and of the triangles it hits.
    directions : (n, 3) float

    Returns
    -------
    (n,) float64
    """
    lengths = np.linalg.norm(np.asarray(directions, np.float64), axis=1)
    lengths = np.where(lengths > 0, lengths, 1.0)  # a zero direction never hits
    return DISTANCE * (np.abs(t) + sizes / lengths)


def ssim(image, reference):
    """Return the structural similarity of two linear images after sRGB encoding, 1 if equal.

    Parameters
    ----------
    image, reference : (h, w, 3) float
        Linear RGB, at least 7 x 7 pixels; values are clipped to [0, 1].

    Raises
    ------
    ValueError
        The shapes differ or are too small.
    """
    from skimage.metrics import (
        structural_similarity,
    )  # heavy to import, and only needed here

    image, reference = _encoded_pair(image, reference)
    if min(image.shape[:2]) < 7:
        raise ValueError(f"ssim: need at least 7 x 7 pixels, got {image.shape[:2]}")
    return float(structural_similarity(image, reference, data_range=1.0, channel_axis=2))


def psnr(image, reference):
    """Return the peak signal-to-noise ratio in dB after sRGB encoding, inf if equal.

    Arguments and errors as for `ssim`, but of any size.
    """
    image, reference = _encoded_pair(image, reference)
    mean_squared = np.mean((image - reference) ** 2)
    return float("inf") if mean_squared == 0 else float(-10 * np.log10(mean_squared))


def _encoded_pair(image, reference):
    image, reference = np.asarray(image, np.float64), np.asarray(reference, np.float64)
    if image.shape != reference.shape or image.ndim != 3 or image.shape[2] != 3:
        raise ValueError(f"images: need equal (h, w, 3), got {image.shape} and {reference.shape}")
    return _srgb_encoded(image), _srgb_encoded(reference)


def _srgb_encoded(linear):
    """Return clipped linear values in the sRGB transfer function (IEC 61966-2-1)."""
    linear = np.clip(linear, 0, 1)
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)


def _check_lengths(num_rays, *lengths):
    if any(length != num_rays for length in lengths):
        found = " and ".join(str(length) for length in lengths)
        raise ValueError(f"answers: need one for each of {num_rays} rays, got {found}")


@dataclass
class _Answer:
    """A tracer's closest hits: (n,) flat face (-1 for a miss) and t, float64, and

    Attributes
    ----------
    size : (n,) float64
        M of the ray's origin and of the face.
    on_face : (n,) bool
        Whether the point at t is on the face within the tolerance; True for a miss.
    """

    face: np.ndarray
    t: np.ndarray
    size: np.ndarray
    on_face: np.ndarray

    @classmethod
    def read(cls, hits, triangles, origins, directions):
        """Take the answer from `hits` for the given rays."""
        face, t = (
            triangles.flat(hits.geom_id, hits.prim_id),
            np.asarray(hits.t, np.float64),
        )
        size = largest_coordinate(origins)
        on_face = np.ones(len(face), bool)
        hit = np.flatnonzero(face >= 0)
        directions = directions[hit].astype(np.float64)
        corners = triangles.corners(face[hit]).astype(np.float64)
        size[hit] = np.maximum(size[hit], largest_coordinate(corners))
        allowed = distance_tolerance(t[hit], size[hit], directions)
        allowed += 2 * EDGE * size[hit] * slopes(corners, directions)
        outside = distance_outside(origins[hit] + t[hit, None] * directions, corners)
        on_face[hit] = outside <= allowed * np.linalg.norm(directions, axis=1)
        return cls(face, t, size, on_face)

    def __getitem__(self, rays):
        return _Answer(self.face[rays], self.t[rays], self.size[rays], self.on_face[rays])


def _judged(oracle, rays, sizes, differ, answers, acceptable):
    """Return the Agreement on the rays where `differ`, judged in chunks of bounded size."""
    indices = np.flatnonzero(differ)
    verdicts = np.zeros(len(indices), dtype="U7")
    for start in range(0, len(indices), RAYS_PER_CHUNK):
        chunk = indices[start : start + RAYS_PER_CHUNK]
        nearby = _NearbyHits.found(oracle, *(array[chunk] for array in rays), sizes[chunk])
        ours, theirs = (acceptable(nearby, answer[chunk]) for answer in answers)
        verdicts[start : start + RAYS_PER_CHUNK] = np.select(
            [ours & theirs, ours, theirs], VERDICTS[:3], VERDICTS[3]
        )
    return Agreement(len(differ), indices, verdicts)


@dataclass
class _NearbyHits:
    """Every possible hit of some rays and of the eight neighbours of each.

    Attributes
    ----------
    num_rays : int
    row : (k,) int
        9 * ray + variant; variant 0 is the ray itself.
    t, tolerance : (k,) float64
        Distance and by how much it may differ.
    spread : (k,) float64
        How far apart the distances of the nine variants to the face's plane can be.
    nearest : (9 * num_rays,) float64
        By row: up to where a closest hit can be, the least t + tolerance of the hits that are
        certainly between tnear and tfar; inf where there is none.
    """

    num_rays: int
    row: np.ndarray
    t: np.ndarray
    tolerance: np.ndarray
    spread: np.ndarray
    nearest: np.ndarray

    @classmethod
    def found(cls, oracle, origins, directions, tnear, tfar, sizes):
        """Trace the rays and their neighbours with the oracle."""
        radii = EDGE * sizes
        starts = with_neighbours(origins, directions, radii).reshape(-1, 3)
        everywhere = np.full(len(starts), np.inf)
        row, face, t, _, _ = oracle.all_hits(
            starts, np.repeat(directions, 9, axis=0), -everywhere, everywhere
        )
        ray = row // 9
        corners = oracle.triangles.corners(face).astype(np.float64)
        hit_sizes = np.maximum(largest_coordinate(corners), largest_coordinate(origins)[ray])
        tolerance = distance_tolerance(t, hit_sizes, directions[ray])
        possible = (t >= tnear[ray] - tolerance) & (t <= tfar[ray] + tolerance)
        certain = (t >= tnear[ray] + tolerance) & (t <= tfar[ray] - tolerance)
        nearest = np.full(len(starts), np.inf)
        np.minimum.at(nearest, row[certain], (t + tolerance)[certain])
        spread = 2 * radii[ray] * slopes(corners, directions[ray])
        kept = (array[possible] for array in (row, t, tolerance, spread))
        return cls(len(origins), *kept, nearest)

    def may_miss(self):
        """Return (num_rays,) bool: whether some variant has no certain hit."""
        return np.isinf(self.nearest).reshape(-1, 9).any(axis=1)


def _closest_acceptable(nearby, answer):
    """Return (num_rays,) bool: whether the answer may be the closest hit.

    A hit may be when it lies on its face, and some variant hits something at its distance with
    nothing certainly in front. That need not be the same face: one seen edge-on is too thin.
    """
    ray = nearby.row // 9
    right = np.abs(nearby.t - answer.t[ray]) <= nearby.tolerance + nearby.spread
    right &= nearby.t - nearby.tolerance <= nearby.nearest[nearby.row]
    may_hit = np.zeros(nearby.num_rays, bool)
    may_hit[ray[right]] = True
    return np.where(answer.face < 0, nearby.may_miss(), may_hit & answer.on_face)


def _occlusion_acceptable(nearby, blocked):
    """Return (num_rays,) bool: whether the answer of `occluded` may be right."""
    may_hit = np.zeros(nearby.num_rays, bool)
    may_hit[nearby.row // 9] = True
    return np.where(blocked, may_hit, nearby.may_miss())
