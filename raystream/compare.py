"""Comparing methods with each other, with Embree and with the reference renderer."""

import dataclasses
import time

import numpy as np

from raystream.baselines import EmbreeTracer, render_reference
from raystream.baselines.tolerance import (
    MAX_SHARE,
    differing,
    differing_occlusion,
    psnr,
    ssim,
)
from raystream.image import to_srgb
from raystream.renderer import PRIMARY, SHADOW, Frame, Renderer, parse_method
from raystream.tracer import Tracer, methods

EMBREE = "embree"
SECONDARY = "reflection and refraction"
KINDS = (PRIMARY, SECONDARY, SHADOW)
PRIMARY_SHARE = 1e-3  # rasterised pixels that may show another triangle than Embree's ray
MIN_SSIM, MIN_PSNR = 0.995, 40.0
TIMED_FRAMES = 3
MOST_SECONDS = 5.0  # no further frame is timed after so long
AMPLIFICATION = 10


@dataclasses.dataclass
class RayCheck:
    """All rays of one kind of a frame against Embree.

    Attributes
    ----------
    rays, differing : int
        Rays traced; those whose answer is not Embree's.
    ties, ours, wrong : int
        Of the differing ones: both answers acceptable to the float64 oracle, only ours, not ours.
    """

    rays: int = 0
    differing: int = 0
    ties: int = 0
    ours: int = 0
    wrong: int = 0

    def add(self, agreement):
        """Add the counts of an `Agreement` of baselines.tolerance."""
        self.rays += agreement.num_rays
        self.differing += len(agreement.rays)
        self.ties += agreement.count("tie")
        self.ours += agreement.count("ours")
        self.wrong += agreement.num_wrong


@dataclasses.dataclass
class Comparison:
    """What one method did with a scene.

    Attributes
    ----------
    method : str
        With its options, as it was given.
    seconds : float
        Of one frame, the fastest of the timed ones.
    frame : raystream.renderer.Frame
        That frame.
    checks : dict of str to RayCheck
        By kind of ray (KINDS); empty for Embree itself.
    ssim, psnr : float
        Of the picture against the reference renderer's, psnr in dB.
    """

    method: str
    seconds: float
    frame: Frame
    checks: dict
    ssim: float
    psnr: float

    @property
    def ok(self):
        """Whether the picture and every kind of ray meet the rules."""
        return (
            self.ssim >= MIN_SSIM
            and self.psnr >= MIN_PSNR
            and all(_passes(kind, check) for kind, check in self.checks.items())
        )


def _passes(kind, check):
    share = PRIMARY_SHARE if kind == PRIMARY else MAX_SHARE
    return check.wrong <= share * check.rays


class CheckedTracer(Tracer):
    """A tracer whose answers to ray streams are all held against Embree's.

    Parameters
    ----------
    scene, method, **options
        As for `Tracer`.

    Attributes
    ----------
    checks : dict of str to RayCheck
        Summed over all streams since it was made.
    """

    def __init__(self, scene, method, **options):
        super().__init__(scene, method, **options)
        self._embree = EmbreeTracer.from_scene(self.scene)
        self.checks = {kind: RayCheck() for kind in KINDS}

    def check_primary(self, frame, camera):
        """Hold the rasterised hits of a frame against Embree's primary rays."""
        height, width = frame.prim_id.shape
        hits = _Hits(frame.depth.ravel(), frame.prim_id.ravel(), frame.geom_id.ravel())
        rays = (*camera.rays((width, height)), 0.0, np.inf)
        reference = self._embree.intersect(*rays)
        self.checks[PRIMARY].add(differing(hits, reference, *self._triangles(), *rays))

    def intersect_stream(self, session, stream):
        """As `Tracer.intersect_stream`."""
        hits = super().intersect_stream(session, stream)
        active, rays = _active_rays(stream)
        flat = hits.triangle.get()[active].astype(np.int64)
        hit = flat < self.scene.num_triangles
        geom_id = np.where(hit, self.scene.geom_ids[np.where(hit, flat, 0)], -1)
        prim_id = np.where(hit, flat - self.scene.first_prims[geom_id], -1)
        ours = _Hits(hits.t.get()[active], prim_id, geom_id)
        reference = self._embree.intersect(*rays)
        kind = PRIMARY if stream.primary else SECONDARY
        self.checks[kind].add(differing(ours, reference, *self._triangles(), *rays))
        return hits

    def occluded_stream(self, session, stream):
        """As `Tracer.occluded_stream`."""
        blocked = super().occluded_stream(session, stream)
        active, rays = _active_rays(stream)
        ours, reference = blocked.get()[active].astype(bool), self._embree.occluded(*rays)
        self.checks[SHADOW].add(differing_occlusion(ours, reference, *self._triangles(), *rays))
        return blocked

    def _triangles(self):
        return self.scene.vertices, self.scene.faces, self.scene.first_prims


@dataclasses.dataclass
class _Hits:
    t: np.ndarray
    prim_id: np.ndarray
    geom_id: np.ndarray


def _active_rays(stream):
    """Which rays of a stream are active, and these as (origins, directions, tnear, tfar)."""
    org_tnear, dir_tfar = stream.org_tnear.get(), stream.dir_tfar.get()
    active = dir_tfar[:, 3] >= org_tnear[:, 3]
    org_tnear, dir_tfar = org_tnear[active], dir_tfar[active]
    return active, (org_tnear[:, :3], dir_tfar[:, :3], org_tnear[:, 3], dir_tfar[:, 3])


def as_method(given):
    """A method as `compare` takes it, as (label, name, options); ValueError where it is none."""
    if not isinstance(given, str):
        return given
    return (given, *parse_method(given, (*methods(), EMBREE)))


def compare(scene, names, camera=None, size=(512, 512), max_bounces=2, progress=None, **options):
    """Render a scene by several methods and hold all of it against Embree.

    Each method renders once to warm up, then up to `TIMED_FRAMES` times for the clock, then once
    with every ray checked.

    Parameters
    ----------
    scene : raystream.Scene
    names : list of str or (str, str, dict)
        Of `raystream.methods`, or "embree"; with options as in "rsh:arity=8:levels=2", or as
        (label, name, options).
    camera, size, max_bounces
        As for `raystream.render`.
    progress : callable, optional
        Called with a line of text before each step.
    **options
        Of `Tracer`: device, memory_limit and options that all the device methods have.

    Returns
    -------
    list of Comparison, (height, width, 3) float32
        One per name, and the reference renderer's picture.
    """
    camera = scene.camera if camera is None else camera
    step = progress or (lambda _line: None)
    chosen = [as_method(name) for name in names]
    for _, method, own in chosen:
        _check_options(scene, method, own, options)
    step("reference renderer")
    reference = render_reference(scene, camera, size=size, max_bounces=max_bounces).image
    results = []
    for label, method, own in chosen:
        step(f"{label}: timing")
        merged = {**options, **own}
        seconds, frame = _timed(scene, method, camera, size, max_bounces, merged)
        checks = {}
        if method != EMBREE:
            step(f"{label}: checking every ray against Embree")
            checks = _checked(scene, method, camera, size, max_bounces, merged)
        scores = ssim(frame.image, reference), psnr(frame.image, reference)
        results.append(Comparison(label, seconds, frame, checks, *scores))
    return results, reference


def _check_options(scene, method, own, options):
    """Refuse wrong options before any time goes into rendering."""
    if method != EMBREE:
        Tracer(scene, method, **{**options, **own})
    elif own:
        raise ValueError(f"method {EMBREE!r} has no options, got {', '.join(own)}")


def _timed(scene, name, camera, size, max_bounces, options):
    method = EmbreeTracer.from_scene(scene) if name == EMBREE else name
    device = {key: options[key] for key in ("device",) if key in options}
    renderer = Renderer(scene, method, **(device if name == EMBREE else options))
    renderer.render(camera, size, max_bounces)
    timed = []
    for _ in range(TIMED_FRAMES):
        start = time.perf_counter()
        frame = renderer.render(camera, size, max_bounces)
        timed.append((time.perf_counter() - start, frame))
        if sum(seconds for seconds, _ in timed) > MOST_SECONDS:
            break
    return min(timed, key=lambda pair: pair[0])


def _checked(scene, name, camera, size, max_bounces, options):
    tracer = CheckedTracer(scene, name, **options)
    device = options.get("device")
    frame = Renderer(scene, tracer, device).render(camera, size, max_bounces)
    tracer.check_primary(frame, camera)
    return tracer.checks


def side_by_side(results, reference):
    """The reference and each method's picture above its difference, ten times amplified.

    Returns
    -------
    (2 * height, (1 + methods) * width, 3) uint8
        The first column holds the reference above black.
    """
    columns = [np.concatenate([to_srgb(reference), np.zeros_like(to_srgb(reference))])]
    for result in results:
        difference = to_srgb(difference_image(result.frame.image, reference))
        columns.append(np.concatenate([to_srgb(result.frame.image), difference]))
    return np.concatenate(columns, axis=1)


def difference_image(image, reference):
    """Absolute difference of two linear images, ten times amplified."""
    return AMPLIFICATION * np.abs(image - reference)
