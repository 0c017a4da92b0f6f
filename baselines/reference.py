"""Whitted ray tracing in numpy float64 over any tracer: the image that the device must match.

Breadth-first: one generation of rays at a time, all pixels together. Whitted 1980 with exact
Fresnel reflectances; the formulas are those of the renderer, written a second time.
"""

from dataclasses import dataclass

import numpy as np

from .embree import EmbreeTracer
from .hits import Hits
from .lighting import direct_light
from .optics import fresnel, reflect, refract
from .surface import dot, normalised, surface_points

# Rays that can change a pixel by less than this share are not traced on.
SMALLEST_WEIGHT = 1 / 512
# Steps of the R2 low-discrepancy sequence: 1 / p and 1 / p^2 with p^3 = p + 1 (Roberts 2018).
R2 = np.array([0.7548776662466927, 0.5698402909980532])


@dataclass
class ReferenceFrame:
    """A rendered image, top row first.

    Attributes
    ----------
    image : (height, width, 3) float32
        Linear RGB.
    prim_id, geom_id : (height, width) int32
        The primary hits of the first pass, -1 where the background shows.
    """

    image: np.ndarray
    prim_id: np.ndarray
    geom_id: np.ndarray


@dataclass
class _Rays:
    """One generation of rays: unit or primary directions, and what they add to which pixel."""

    origins: np.ndarray
    directions: np.ndarray
    weights: np.ndarray
    pixels: np.ndarray

    def __getitem__(self, rows):
        return _Rays(
            self.origins[rows],
            self.directions[rows],
            self.weights[rows],
            self.pixels[rows],
        )


def render_reference(
    scene, camera, size=(512, 512), max_bounces=2, shadows=True, tracer=None, samples=1
):
    """Render a scene.

    Parameters
    ----------
    scene : object
        With meshes, lights, background, ambient, bounds, and, without a `tracer`, vertices,
        faces and first_prims.
    camera : object
        With eye, basis (right, up, forward) and fov_y in degrees.
    size : (int, int)
        Width and height in pixels.
    max_bounces : int
        Generations of reflected and refracted rays.
    shadows : bool
        Whether lights are blocked.
    tracer : object, optional
        Answers `intersect` and `occluded`; default: EmbreeTracer.
    samples : int
        Passes with different positions in the pixels, averaged; the first is at the centres.

    Returns
    -------
    ReferenceFrame

    Raises
    ------
    ValueError
        A size or number of samples below 1, or a negative number of bounces.
    """
    width, height = size
    if min(width, height, samples) < 1 or max_bounces < 0:
        raise ValueError("render_reference: need size and samples >= 1 and max_bounces >= 0")
    tracer = EmbreeTracer.from_scene(scene) if tracer is None else tracer
    total, first_hits = np.zeros((height * width, 3)), None
    for sample in range(samples):
        rays = primary_rays(camera, size, (0.5 + sample * R2) % 1)
        radiance, hits = _trace(scene, tracer, rays, max_bounces, shadows)
        first_hits = hits if first_hits is None else first_hits
        total += radiance
    return ReferenceFrame(
        (total / samples).astype(np.float32).reshape(height, width, 3),
        first_hits.prim_id.reshape(height, width),
        first_hits.geom_id.reshape(height, width),
    )


def primary_rays(camera, size, place):
    """Return one ray through (x, y) = `place` of each pixel, row by row from the top."""
    width, height = size
    right, up, forward = (np.asarray(axis, np.float64) for axis in camera.basis)
    half_height = np.tan(np.radians(camera.fov_y) / 2)
    x = (2 * (np.arange(width) + place[0]) / width - 1) * half_height * width / height
    y = (1 - 2 * (np.arange(height) + place[1]) / height) * half_height
    directions = forward + x[None, :, None] * right + y[:, None, None] * up
    directions = directions.reshape(-1, 3)
    origins = np.tile(np.asarray(camera.eye, np.float64), (len(directions), 1))
    return _Rays(origins, directions, np.ones_like(directions), np.arange(len(directions)))


def _trace(scene, tracer, rays, max_bounces, shadows):
    """Return the radiance (pixels, 3) of one pass and the hits of its primary rays."""
    radiance, primary_hits = np.zeros_like(rays.directions), None
    for bounces_left in range(max_bounces, -1, -1):
        hits = tracer.intersect(rays.origins.astype(np.float32), rays.directions.astype(np.float32))
        primary_hits = hits if primary_hits is None else primary_hits
        hit = hits.prim_id >= 0
        _add(radiance, rays[~hit], np.asarray(scene.background, np.float64))
        rays = rays[hit]
        if not len(rays.pixels):
            break
        directions = normalised(rays.directions)
        points = surface_points(scene, select_hits(hits, hit), directions)
        offset = ray_offset(scene.bounds)
        shadow_tracer = tracer if shadows else None
        _add(radiance, rays, shade(scene, points, directions, offset, shadow_tracer))
        if bounces_left:
            rays = secondary_rays(rays.weights, rays.pixels, points, directions, offset)
    return radiance, primary_hits


def select_hits(hits, rows):
    return Hits(*(values[rows] for values in (hits.t, hits.prim_id, hits.geom_id, hits.u, hits.v)))


def _add(radiance, rays, colours):
    """Add weight x colour to the pixels of rays, several of which may share a pixel."""
    np.add.at(radiance, rays.pixels, rays.weights * colours)


def ray_offset(bounds):
    """Return how far secondary rays start from a surface, against hitting it again."""
    bounds = np.asarray(bounds, np.float64)
    diagonal = np.linalg.norm(bounds[1] - bounds[0])
    ulp = np.spacing(np.float32(np.abs(bounds).max()))
    return max(1e-5 * diagonal, 4 * float(ulp))


def shade(scene, points, directions, offset, shadow_tracer):
    """Return the radiance (n, 3) that leaves the points without further specular bounces."""
    opaque = (1 - points.transmission) * (1 - points.reflectivity)
    colour = points.emission + np.asarray(scene.ambient, np.float64) * points.base * opaque
    for light in scene.lights:
        colour = colour + direct_light(light, points, directions, offset, shadow_tracer)
    return colour


def secondary_rays(weights, pixels, points, directions, offset):
    """Return the reflected and refracted rays whose weight still counts."""
    normals = _specular_normals(points, directions)
    eta = np.where(points.entering[:, None], 1 / points.ior, points.ior)
    share = fresnel(directions, normals, eta)
    tau = points.transmission
    reflected = _Rays(
        points.position + offset * points.face_normal,
        reflect(directions, normals),
        weights * ((1 - tau) * points.reflectivity + tau * share),
        pixels,
    )
    into, total = _refracted_directions(points, directions, normals, eta)
    refracted = _Rays(
        points.position - offset * points.face_normal,
        into,
        weights * tau * (1 - share),
        pixels,
    )
    kept = [
        reflected[_counts(reflected)],
        refracted[_counts(refracted) & ~total],
    ]
    columns = ("origins", "directions", "weights", "pixels")
    return _Rays(*(np.concatenate([getattr(rays, name) for rays in kept]) for name in columns))


def _counts(rays):
    return rays.weights.max(axis=1) >= SMALLEST_WEIGHT


def _specular_normals(points, directions):
    """Return the shading normals, or the face's where these would reflect into the surface."""
    normals = points.shading_normal
    above = dot(reflect(directions, normals), points.face_normal) > 0
    return np.where((dot(directions, normals) < 0) & above, normals, points.face_normal)


def _refracted_directions(points, directions, normals, eta):
    """Return refracted directions (n, 3), and (n,) where there are none.

    A direction that the shading normal bends back out of the surface is computed again with
    the face's normal.
    """
    into, total = refract(directions, normals, eta)
    outside = ~total & (dot(into, points.face_normal)[:, 0] >= 0)
    by_face, total_by_face = refract(directions, points.face_normal, eta)
    into[outside] = by_face[outside]
    return into, np.where(outside, total_by_face, total)
