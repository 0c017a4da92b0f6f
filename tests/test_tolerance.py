"""The rules by which tracers and images count as equal."""

import copy

import numpy as np
import pytest
from raystream.baselines import BruteForceTracer, EmbreeTracer
from raystream.baselines.tolerance import (
    MAX_SHARE,
    Agreement,
    differing,
    differing_occlusion,
    distance_tolerance,
    psnr,
    ssim,
)

FORWARD = np.array([0.0, 0, 1])
# Two squares of two triangles each, at z = 1 and z = 2, as two meshes; seen along +z.
SQUARE = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
VERTICES = np.concatenate([SQUARE + FORWARD, SQUARE + 2 * FORWARD])
FACES = np.array([[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]])
FIRST_PRIMS = np.array([0, 2, 4])
SCENE = (VERTICES, FACES, FIRST_PRIMS)
INSIDE, DIAGONAL, BORDER = [0.75, 0.25, 0], [0.5, 0.5, 0], [1, 0.5, 0]


def rays(*origins):
    return np.array(origins, float), np.tile(FORWARD, (len(origins), 1))


def exact_hits(origins, directions):
    return BruteForceTracer(*SCENE).intersect(origins, directions)


def verdict_after(change, origin):
    """Return the verdict on the exact hit after `change`, and None when it counts as equal."""
    reference = exact_hits(*rays(origin))
    hits = copy.deepcopy(reference)
    change(hits)
    agreement = differing(hits, reference, *SCENE, *rays(origin))
    opposite = differing(reference, hits, *SCENE, *rays(origin))
    mirrored = {"theirs": "ours", "ours": "theirs"}
    assert [mirrored.get(v, v) for v in agreement.verdicts] == opposite.verdicts.tolist()
    return agreement.verdicts[0] if len(agreement.rays) else None


def miss(hits):
    hits.t[:], hits.prim_id[:], hits.geom_id[:] = np.inf, -1, -1


def other_triangle(hits):
    hits.prim_id[:] = 1 - hits.prim_id


def square_behind(hits):
    hits.t[:], hits.geom_id[:] = 2, 1


def wrong_distance(hits):
    hits.t[:] *= 1.001


def nan_distance(hits):
    hits.t[:] = np.nan


def rounding(hits):
    hits.t[:] = np.nextafter(hits.t, np.float32(2))


@pytest.mark.parametrize("change", [miss, other_triangle, square_behind, wrong_distance,
                                    nan_distance])  # fmt: skip
def test_wrong_answers_inside_a_triangle(change):
    assert verdict_after(change, INSIDE) == "theirs"


@pytest.mark.parametrize("origin", [INSIDE, DIAGONAL, BORDER])
def test_rounding_is_no_difference(origin):
    assert verdict_after(rounding, origin) is None


def test_either_triangle_at_a_shared_edge_but_no_leak():
    assert verdict_after(other_triangle, DIAGONAL) is None
    assert verdict_after(miss, DIAGONAL) == "theirs"
    assert verdict_after(square_behind, DIAGONAL) == "theirs"


def test_silhouette_may_be_hit_or_missed():
    assert verdict_after(miss, BORDER) == "tie"
    assert verdict_after(wrong_distance, BORDER) == "theirs"


def test_nothing_right_is_neither():
    origins, directions = rays(INSIDE)
    hits, reference = exact_hits(origins, directions), exact_hits(origins, directions)
    miss(hits)
    square_behind(reference)
    assert differing(hits, reference, *SCENE, origins, directions).verdicts == ["neither"]


@pytest.mark.parametrize("tfar", [0.9, 1, 1.1])
def test_occlusion(tfar):
    origins, directions = rays(INSIDE, [2, 2, 0])
    right = np.array([tfar >= 1, False])
    agreement = differing_occlusion(right, ~right, *SCENE, origins, directions, 0, tfar)
    first = "tie" if tfar == 1 else "ours"  # the end of the segment is on the square
    assert agreement.verdicts.tolist() == [first, "ours"]
    assert agreement.num_wrong == 0


@pytest.mark.parametrize("scale", [1e-4, 1, 1e4])
def test_rules_do_not_depend_on_scale_or_direction_length(scale):
    origins, directions = rays(*np.random.default_rng(0).random((200, 3)) * [1, 1, 0.5])
    tracer = BruteForceTracer(scale * VERTICES, FACES, FIRST_PRIMS)
    for length in (0.01, 100):
        queries = scale * origins, length * directions
        reference = tracer.intersect(*queries)
        for factor, number in ((1 + 1e-6, 0), (1 + 1e-3, 200)):
            hits = copy.deepcopy(reference)
            hits.t *= np.float32(factor)
            triangles = scale * VERTICES, FACES, FIRST_PRIMS
            agreement = differing(hits, reference, *triangles, *queries)
            assert agreement.count("theirs") == number


def test_embree_is_right_within_the_share_on_random_triangles():
    rng = np.random.default_rng(8)
    vertices = (rng.random((300, 1, 3)) + 0.1 * rng.normal(size=(300, 3, 3))).reshape(-1, 3)
    triangles = vertices, np.arange(900).reshape(-1, 3), None
    queries = rng.random((3000, 3)), rng.normal(size=(3000, 3))
    embree, exact = EmbreeTracer(*triangles), BruteForceTracer(*triangles)
    assert differing(embree.intersect(*queries), exact.intersect(*queries), *triangles, *queries).ok
    blocked = embree.occluded(*queries, 0, 0.5), exact.occluded(*queries, 0, 0.5)
    assert differing_occlusion(*blocked, *triangles, *queries, 0, 0.5).ok


def test_summary_and_share():
    verdicts = np.array(["tie", "theirs", "ours", "theirs"])
    agreement = Agreement(20000, np.arange(4), verdicts)
    assert agreement.share == MAX_SHARE and agreement.ok
    assert str(agreement) == (
        "20000 rays, 4 differ (1 tie, 1 ours, 2 theirs, 0 neither), wrong share 0.0001 "
        "(at most 0.0001)"
    )
    assert not Agreement(19999, np.arange(4), verdicts).ok
    assert Agreement(0, np.arange(0), verdicts[:0]).ok


def test_no_rays():
    origins = np.zeros((0, 3))
    hits = exact_hits(origins, origins)
    assert differing(hits, hits, *SCENE, origins, origins).ok


def test_number_of_answers_is_checked():
    hits = exact_hits(*rays(INSIDE))
    with pytest.raises(ValueError, match="need one for each of 2 rays, got 1 and 1"):
        differing(hits, hits, *SCENE, *rays(INSIDE, INSIDE))


@pytest.mark.parametrize("name", ["geom_id", "prim_id"])
def test_ids_that_do_not_exist_are_refused(name):
    hits = exact_hits(*rays(INSIDE))
    getattr(hits, name)[:] = 2
    with pytest.raises(ValueError, match=f"{name}: need values below"):
        differing(hits, hits, *SCENE, *rays(INSIDE))


def test_customary_tolerance_at_unit_size():
    tolerance = distance_tolerance(np.array([3.0]), np.array([1.0]), FORWARD[None])
    np.testing.assert_allclose(tolerance, 1e-5 * (1 + 3))


def test_image_metrics():
    image = np.random.default_rng(9).random((16, 20, 3))
    assert ssim(image, image) == 1 and psnr(image, image) == np.inf
    assert 0.9 < ssim(image, image * 0.98) < 1
    grey = np.full((8, 8, 3), 0.5)
    encoded = 1.055 * 0.5 ** (1 / 2.4) - 0.055
    np.testing.assert_allclose(psnr(grey, 2 * grey), -20 * np.log10(1 - encoded))
    assert psnr(4 * grey, 2 * grey) == np.inf  # both clip to white
    with pytest.raises(ValueError, match=r"images: need equal \(h, w, 3\)"):
        psnr(image, image[1:])
    with pytest.raises(ValueError, match="at least 7 x 7"):
        ssim(image[:6], image[:6])
