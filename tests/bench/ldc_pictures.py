"""Pictures by `ldc` from samples, held against the reference renderer, and why they differ."""

import dataclasses

import numpy as np
from raystream.baselines import EmbreeTracer
from raystream.baselines.tolerance import ssim

import raystream as rs

APART = 0.005  # of the scene's diagonal: five of the published tolerance
REASONS = ("missed", "phantom", "early", "late")
# What becomes of the answers: taken as they are; the wrong ones replaced by Embree's, so that only
# inexact hits are left; the others replaced, so that only wrong ones are.
AS_TRACED, NO_WRONG, ONLY_WRONG = ANSWERS = ("as traced", "no wrong hits", "only wrong hits")


@dataclasses.dataclass
class WrongHits:
    """How many rays were traced, and how many of them were answered wrongly, by reason.

    A closest hit is wrong where Embree hits and `ldc` misses (missed), the other way about
    (phantom), or that of `ldc` is nearer (early) or farther (late) by over `APART` of the diagonal.
    """

    rays: int = 0
    missed: int = 0
    phantom: int = 0
    early: int = 0
    late: int = 0

    def add(self, *wrong):
        """Add the rays with an array of bool for each reason."""
        self.rays += len(wrong[0])
        for reason, rays in zip(REASONS, wrong, strict=False):
            setattr(self, reason, getattr(self, reason) + int(np.count_nonzero(rays)))

    @property
    def share(self):
        """Of wrong answers among all."""
        return sum(getattr(self, reason) for reason in REASONS) / max(1, self.rays)


class JudgedTracer:
    """`ldc` beside Embree, for `rs.render`: every answer is judged.

    Parameters
    ----------
    scene : raystream.Scene
    answer : one of ANSWERS
    **options
        Of `ldc`.

    Attributes
    ----------
    closest, shadow : WrongHits
        Of reflected and refracted rays, and of shadow rays.
    """

    def __init__(self, scene, answer=AS_TRACED, **options):
        self._ldc, self._embree = rs.Tracer(scene, "ldc", **options), EmbreeTracer.from_scene(scene)
        self._apart, self._answer = APART * scene.diagonal, answer
        self.closest, self.shadow = WrongHits(), WrongHits()

    def intersect(self, origins, directions, tnear=0.0, tfar=np.inf):
        """Closest hits, chosen by `answer`."""
        rays = origins, directions, tnear, tfar
        ours, theirs = self._ldc.intersect(*rays), self._embree.intersect(*rays)
        reasons = self._reasons(ours, theirs, np.linalg.norm(directions, axis=1))
        self.closest.add(*reasons)
        by_embree = self._by_embree(np.logical_or.reduce(reasons))
        return rs.Hits(
            *(
                np.where(by_embree, getattr(theirs, field.name), getattr(ours, field.name))
                for field in dataclasses.fields(rs.Hits)
            )
        )

    def occluded(self, origins, directions, tnear=0.0, tfar=np.inf):
        """Whether rays are blocked, chosen by `answer`."""
        rays = origins, directions, tnear, tfar
        ours, theirs = self._ldc.occluded(*rays), self._embree.occluded(*rays)
        self.shadow.add(theirs & ~ours, ours & ~theirs)
        return np.where(self._by_embree(ours != theirs), theirs, ours)

    def _reasons(self, ours, theirs, lengths):
        hit, expected = ours.prim_id >= 0, theirs.prim_id >= 0
        gap, both = np.zeros(len(hit)), hit & expected
        gap[both] = (ours.t[both] - theirs.t[both]) * lengths[both]
        return expected & ~hit, hit & ~expected, gap < -self._apart, gap > self._apart

    def _by_embree(self, wrong):
        if self._answer == AS_TRACED:
            return np.zeros_like(wrong)
        return wrong if self._answer == NO_WRONG else ~wrong


@dataclasses.dataclass
class Judgement:
    """A picture of one scene in one size: SSIM by kind of answer, and the wrong hits."""

    image: np.ndarray
    ssim: dict
    closest: WrongHits
    shadow: WrongHits


def judge(scene, size, reference, answers=ANSWERS, **options):
    """Render a scene by `ldc` with as many texels as pixels; returns a `Judgement`.

    Parameters
    ----------
    scene : raystream.Scene
    size : int
        Pixels along each edge of the picture, and texels along each edge of the cube.
    reference : (size, size, 3) float
        The picture by the reference renderer.
    answers : sequence of str
        Of ANSWERS; the first is the picture that is kept.
    **options
        Of `ldc`.
    """
    runs = {}
    for answer in answers:
        tracer = JudgedTracer(scene, answer, **{"resolution": size, **options})
        image = rs.render(scene, scene.camera, (size, size), tracer).image
        runs[answer] = image, tracer
    image, tracer = runs[answers[0]]
    similar = {answer: ssim(run[0], reference) for answer, run in runs.items()}
    return Judgement(image, similar, tracer.closest, tracer.shadow)
