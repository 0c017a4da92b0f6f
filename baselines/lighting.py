"""Direct light at surface points: what each light sends and whether it arrives."""

import numpy as np

from .surface import dot, normalised


def direct_light(light, points, directions, offset, tracer):
    """Return the radiance reflected from one light towards the ray's origin, (n, 3).

    Parameters
    ----------
    light : object
        With inner_angle (spot light), else position (point light), else direction.
    points : SurfacePoints
    directions : (n, 3) float64
        Unit directions of the incoming rays.
    offset : float
        Distance of the shadow rays' ends from the surface.
    tracer : object or None
        Answers `occluded`; None for no shadows.
    """
    to_light, intensity = _arriving(light, points.position)
    cosine = dot(points.shading_normal, to_light)
    lit = (cosine > 0) & (dot(points.face_normal, to_light) > 0)
    lit = np.flatnonzero(lit[:, 0] & (intensity > 0).any(axis=1))
    if tracer is not None and len(lit):
        ends = (points.position + offset * points.face_normal)[lit]
        lit = lit[~_blocked(light, ends, tracer)]
    opaque = (1 - points.transmission[lit]) * (1 - points.reflectivity[lit])
    half = normalised(to_light[lit] - directions[lit])
    highlight = np.maximum(0, dot(points.shading_normal[lit], half)) ** points.shininess[lit]
    reflected = opaque * points.base[lit] * cosine[lit] + points.specular[lit] * highlight
    radiance = np.zeros_like(points.position)
    radiance[lit] = intensity[lit] * reflected
    return radiance


def _arriving(light, positions):
    """Return unit vectors to the light and the light arriving unoccluded, both (n, 3)."""
    intensity = np.tile(np.asarray(light.color, np.float64), (len(positions), 1))
    if not hasattr(light, "position"):
        return np.tile(-_unit(light.direction), (len(positions), 1)), intensity
    to_light = np.asarray(light.position, np.float64) - positions
    if light.falloff:
        intensity /= np.maximum(dot(to_light, to_light), np.finfo(np.float64).tiny)
    to_light = normalised(to_light)
    if hasattr(light, "inner_angle"):
        intensity *= _spot(light, -to_light) ** 2
    return to_light, intensity


def _spot(light, from_light):
    """Return 1 inside the inner angle, falling to 0 at the outer one linearly in the cosine."""
    inner, outer = np.cos(np.radians([light.inner_angle, light.outer_angle]))
    width = max(inner - outer, np.finfo(np.float64).eps)  # equal angles make a sharp edge
    return np.clip((dot(from_light, _unit(light.direction)) - outer) / width, 0, 1)


def _blocked(light, ends, tracer):
    """Return whether anything stands between the light and the points `ends`, (n,) bool."""
    if not hasattr(light, "position"):
        to_light = np.tile(-_unit(light.direction), (len(ends), 1))
        return tracer.occluded(_single(ends), _single(to_light), 0.0, np.inf)
    origins = np.tile(np.asarray(light.position, np.float64), (len(ends), 1))
    return tracer.occluded(_single(origins), _single(ends - origins), 0.0, 1.0)


def _unit(vector):
    return normalised(np.asarray(vector, np.float64)[None])[0]


def _single(vectors):
    return vectors.astype(np.float32)
