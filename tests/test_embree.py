"""EmbreeTracer: the facts about embreex that its docstring states, and its own protocol."""

import embreex.rtcore_scene
import numpy as np
import pytest
from embreex.mesh_construction import TriangleMesh
from raystream.baselines import BruteForceTracer, EmbreeTracer

VERTICES = np.float32([[0, 0, 5], [1, 0, 5], [0, 1, 5]])
FACES = np.int32([[0, 1, 2]])
ORIGIN = np.float32([[0.25, 0.5, 0]])
FORWARD = np.float32([[0, 0, 1]])


def layers(*heights):
    """Return vertices and faces of the triangle repeated at the given z."""
    vertices = np.concatenate([VERTICES * [1, 1, 0] + [0, 0, z] for z in heights])
    return vertices, np.arange(3 * len(heights)).reshape(-1, 3)


def raw_scene(faces=FACES):
    scene = embreex.rtcore_scene.EmbreeScene(robust=True)
    TriangleMesh(scene, VERTICES, faces)
    return scene


def test_barycentric_convention():
    hits = EmbreeTracer(VERTICES, FACES).intersect(ORIGIN, FORWARD)
    a, b, c = VERTICES
    u, v = hits.u[0], hits.v[0]
    np.testing.assert_allclose((1 - u - v) * a + u * b + v * c, [0.25, 0.5, 5], atol=1e-6)
    assert (u, v) == (0.25, 0.5)


@pytest.mark.parametrize("length", [0.01, 1, 7, 1000])
def test_distance_is_in_units_of_the_direction(length):
    hits = EmbreeTracer(VERTICES, FACES).intersect(ORIGIN, length * FORWARD)
    np.testing.assert_allclose(hits.t, 5 / length, rtol=1e-6)


def test_hit_and_miss_values_and_dtypes():
    hits = EmbreeTracer(VERTICES, FACES).intersect(ORIGIN.repeat(2, 0), [[0, 0, 1], [0, 0, -1]])
    assert hits.t.tolist() == [5, np.inf]
    assert hits.prim_id.tolist() == [0, -1] and hits.geom_id.tolist() == [0, -1]
    assert hits.u.tolist() == [0.25, 0] and hits.v.tolist() == [0.5, 0]
    dtypes = [getattr(hits, name).dtype for name in ("t", "prim_id", "geom_id", "u", "v")]
    assert dtypes == [np.float32, np.int32, np.int32, np.float32, np.float32]


def test_geometries_and_empty_geometry():
    vertices, faces = layers(5, 4, 3)
    tracer = EmbreeTracer(vertices, faces, first_prims=[0, 2, 2, 3])
    hits = tracer.intersect(ORIGIN.repeat(3, 0), FORWARD.repeat(3, 0), tnear=[0, 3.5, 4.5])
    assert hits.geom_id.tolist() == [2, 0, 0]
    assert hits.prim_id.tolist() == [0, 1, 0]


@pytest.mark.parametrize("tracer_class", [EmbreeTracer, BruteForceTracer])
def test_segment_ends_count(tracer_class):
    tracer = tracer_class(*layers(0, 2, 5))
    origins, directions = ORIGIN.repeat(6, 0), FORWARD.repeat(6, 0)
    tnear = np.array([0, 1, 2, 3, 3, 3])
    tfar = np.array([np.inf, np.inf, 2, 5, 4, 2])
    hits = tracer.intersect(origins, directions, tnear, tfar)
    assert hits.t.tolist() == [0, 2, 2, 5, np.inf, np.inf]
    assert tracer.occluded(origins, directions, tnear, tfar).tolist() == [True] * 4 + [False] * 2


@pytest.mark.parametrize("tracer_class", [EmbreeTracer, BruteForceTracer])
def test_inactive_rays_and_zero_directions_miss(tracer_class):
    tracer = tracer_class(VERTICES, FACES)
    assert not tracer.occluded(ORIGIN, FORWARD, 0, -1).any()
    assert not tracer.occluded(VERTICES[:1], 0 * FORWARD, 0, 1).any()
    assert tracer.intersect(ORIGIN, FORWARD, 0, -1).prim_id.tolist() == [-1]
    assert tracer.intersect(VERTICES[:1], 0 * FORWARD).prim_id.tolist() == [-1]


def test_embreex_calls_a_negative_tfar_occluded():
    assert raw_scene().run(ORIGIN, -FORWARD, dists=np.float32([-1]), query="OCCLUDED") == [0]


def test_embreex_overwrites_dists_and_the_tracer_does_not():
    dists = np.float32([9])
    raw_scene().run(ORIGIN, FORWARD, dists=dists, output=1)
    assert dists == [5]
    tfar = np.float32([9])
    tracer = EmbreeTracer(VERTICES, FACES)
    tracer.intersect(ORIGIN, FORWARD, tfar=tfar)
    tracer.occluded(ORIGIN, FORWARD, tfar=tfar)
    assert tfar == [9]


def test_embreex_default_tfar():
    assert raw_scene().run(ORIGIN, -FORWARD, output=1)["tfar"] == np.float32(1e37)


def test_embreex_ignores_later_meshes():
    scene = raw_scene()
    scene.run(ORIGIN, FORWARD)
    TriangleMesh(scene, VERTICES - np.float32([0, 0, 4]), FACES)
    assert scene.run(ORIGIN, FORWARD, output=1)["tfar"] == 5


@pytest.mark.parametrize("size", [1e-9, 1e3, 1e11])
def test_large_coordinates(size):
    hits = EmbreeTracer(size * VERTICES, FACES).intersect(size * ORIGIN, FORWARD)
    np.testing.assert_allclose(hits.t, 5 * size, rtol=1e-6)


def test_coordinates_that_embree_would_lose_are_refused():
    with pytest.raises(ValueError, match=r"coordinates up to 1e\+12"):
        EmbreeTracer(1e18 * VERTICES, FACES)


@pytest.mark.parametrize("tracer_class", [EmbreeTracer, BruteForceTracer])
def test_a_refused_update_changes_nothing(tracer_class):
    tracer = tracer_class(VERTICES, FACES)
    with pytest.raises(ValueError, match="vertices: row 0 is not finite"):
        tracer.update_vertices(VERTICES * np.nan)
    assert tracer.intersect(ORIGIN, FORWARD).t == [5]


def test_any_dtype_and_memory_order():
    rng = np.random.default_rng(2)
    origins, directions = rng.random((2, 50, 3)).astype(np.float32)
    directions[:, 2] += 3
    tracer = EmbreeTracer(VERTICES, FACES)
    expected = tracer.intersect(origins, directions)
    for convert in (
        np.asfortranarray,
        lambda a: a.astype(np.float64),
        lambda a: a.astype(">f4"),
    ):
        hits = tracer.intersect(convert(origins), convert(directions))
        np.testing.assert_array_equal(hits.t, expected.t)
    assert tracer.intersect([[0, 0, 0]], [[0, 0, 1]]).t == [5]


@pytest.mark.parametrize("tracer_class", [EmbreeTracer, BruteForceTracer])
def test_no_rays_and_no_triangles(tracer_class):
    none = np.zeros((0, 3))
    assert len(tracer_class(VERTICES, FACES).intersect(none, none)) == 0
    assert tracer_class(VERTICES, FACES).occluded(none, none).shape == (0,)
    for vertices in (VERTICES, none):
        tracer = tracer_class(vertices, np.zeros((0, 3), int))
        assert tracer.intersect(ORIGIN, FORWARD).prim_id.tolist() == [-1]
        assert tracer.occluded(ORIGIN, FORWARD, 0, np.inf).tolist() == [False]


@pytest.mark.parametrize("tracer_class", [EmbreeTracer, BruteForceTracer])
def test_update_vertices(tracer_class):
    vertices = VERTICES.copy()
    tracer = tracer_class(vertices, FACES)
    vertices[:] = 99  # the tracer has its own copy
    assert tracer.intersect(ORIGIN, FORWARD).t == [5]
    tracer.update_vertices(VERTICES + np.float32([0, 0, 2]))
    assert tracer.intersect(ORIGIN, FORWARD).t == [7]
    with pytest.raises(ValueError, match=r"vertices: need shape \(3, 3\)"):
        tracer.update_vertices(VERTICES[:2])


def test_from_scene():
    class Scene:
        vertices, faces = layers(5, 4)
        first_prims = np.array([0, 1, 2])

    hits = EmbreeTracer.from_scene(Scene).intersect(ORIGIN, FORWARD)
    assert (hits.geom_id, hits.prim_id) == ([1], [0])


@pytest.mark.parametrize("tracer_class", [EmbreeTracer, BruteForceTracer])
def test_unused_vertices_may_hold_anything(tracer_class):
    vertices = np.append(VERTICES, [[np.nan, np.inf, 1e30]], axis=0)
    assert tracer_class(vertices, FACES).intersect(ORIGIN, FORWARD).t == [5]


@pytest.mark.parametrize("tracer_class", [EmbreeTracer, BruteForceTracer])
@pytest.mark.parametrize(
    ("vertices", "faces", "first_prims", "error", "message"),
    [
        (VERTICES[:, :2], FACES, None, ValueError, r"vertices: need shape \(n, 3\)"),
        (VERTICES * np.nan, FACES, None, ValueError, "vertices: row 0 is not finite"),
        (VERTICES * 1j, FACES, None, TypeError, "vertices: need real numbers"),
        (VERTICES, FACES[0], None, ValueError, r"faces: need shape \(n, 3\)"),
        (VERTICES, FACES + 0.5, None, TypeError, "faces: need integers"),
        (
            VERTICES,
            FACES + 1,
            None,
            ValueError,
            "faces: indices must be between 0 and 2",
        ),
        (
            VERTICES,
            FACES - 1,
            None,
            ValueError,
            "faces: indices must be between 0 and 2",
        ),
        (VERTICES, FACES, [0, 2], ValueError, "first_prims: must rise from 0"),
        (VERTICES, FACES, [1], ValueError, "first_prims: must rise from 0"),
    ],
)
def test_bad_triangles(tracer_class, vertices, faces, first_prims, error, message):
    with pytest.raises(error, match=message):
        tracer_class(vertices, faces, first_prims)


@pytest.mark.parametrize("query", ["intersect", "occluded"])
@pytest.mark.parametrize(
    ("rays", "error", "message"),
    [
        ((ORIGIN[0], FORWARD[0]), ValueError, r"origins: need shape \(n, 3\)"),
        ((ORIGIN.repeat(2, 0), FORWARD), ValueError, "2 origins but 1 directions"),
        ((ORIGIN, FORWARD * np.nan), ValueError, "directions: row 0 is not finite"),
        (
            (ORIGIN * np.float64(1e300), FORWARD),
            ValueError,
            "origins: row 0 is not finite in float32",
        ),
        (([["a", "b", "c"]], FORWARD), TypeError, "origins: need real numbers"),
        ((ORIGIN, FORWARD, -1), ValueError, "tnear: need finite values >= 0"),
        ((ORIGIN, FORWARD, np.inf), ValueError, "tnear: need finite values >= 0"),
        ((ORIGIN, FORWARD, 0, np.nan), ValueError, "tfar: must not be NaN"),
        ((ORIGIN, FORWARD, 0, [1, 2]), ValueError, r"tfar: need shape \(1\)"),
    ],
)
def test_bad_rays(query, rays, error, message):
    for tracer_class in (EmbreeTracer, BruteForceTracer):
        with pytest.raises(error, match=message):
            getattr(tracer_class(VERTICES, FACES), query)(*rays)
