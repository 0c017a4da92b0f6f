"""The public tracer: input in every form, errors, moving vertices, device arrays."""

import threading

import numpy as np
import pyopencl as cl
import pyopencl.array as cla
import pytest
import trimesh
from raystream.baselines import BruteForceTracer, EmbreeTracer
from raystream.baselines.tolerance import differing, differing_occlusion
from soup import assert_same_hits, exact_tracer, random_rays, triangle_soup

import raystream as rs

METHODS = rs.methods()


@pytest.fixture(params=METHODS)
def method(request):
    return request.param


def test_the_default_is_dual(rng):
    scene, rays = triangle_soup(rng, 100), random_rays(rng, 100)
    for tracer in (rs.Tracer(scene), rs.Tracer(scene, "auto", builder="quality")):
        assert tracer.method == "dual"
        assert_same_hits(tracer.intersect(*rays), rs.Tracer(scene, "brute").intersect(*rays))


def test_methods_are_listed():
    assert METHODS == ["brute", "rsh", "crsh", "ldc", "packet", "dual"]


@pytest.mark.parametrize("count", [1, 2, 15, 16, 17, 64, 65, 1009])
def test_hits_equal_the_float64_oracle(rng, method, count):
    scene = triangle_soup(rng, 200)
    triangles = (scene.vertices, scene.faces, scene.first_prims)
    origins, directions = random_rays(rng, count)
    tracer, oracle = exact_tracer(scene, method), BruteForceTracer(*triangles)
    arguments = (origins, directions, 0.01, 3.0)
    hits = tracer.intersect(*arguments)
    agreement = differing(hits, oracle.intersect(*arguments), *triangles, *arguments)
    assert agreement.num_wrong == 0, agreement
    blocked = tracer.occluded(*arguments)
    assert blocked.dtype == bool and blocked.shape == (count,)
    agreement = differing_occlusion(blocked, oracle.occluded(*arguments), *triangles, *arguments)
    assert agreement.num_wrong == 0, agreement


def test_the_hit_point_is_where_the_ray_is(rng, method):
    scene = triangle_soup(rng, 400, size=0.6)
    origins, directions = random_rays(rng, 2000, spread=0.2)
    hits = exact_tracer(scene, method).intersect(origins, directions)
    hit = hits.prim_id >= 0
    assert 100 < hit.sum() < 2000
    flat = scene.first_prims[hits.geom_id[hit]] + hits.prim_id[hit]
    v0, v1, v2 = np.moveaxis(scene.vertices[scene.faces[flat]].astype(np.float64), 1, 0)
    u, v = hits.u[hit, None].astype(np.float64), hits.v[hit, None].astype(np.float64)
    on_ray = origins[hit] + hits.t[hit, None].astype(np.float64) * directions[hit]
    np.testing.assert_allclose((1 - u - v) * v0 + u * v1 + v * v2, on_ray, atol=2e-5)
    for field, missed in (("t", np.inf), ("prim_id", -1), ("geom_id", -1), ("u", 0), ("v", 0)):
        assert set(getattr(hits, field)[~hit].tolist()) <= {missed}, field


def test_types_of_the_results(method):
    hits = exact_tracer(rs.scenes.cornell(), method).intersect([[278, 273, -800]], [[0, 0, 1]])
    types = {name: getattr(hits, name).dtype for name in ("t", "prim_id", "geom_id", "u", "v")}
    assert types == {"t": np.float32, "prim_id": np.int32, "geom_id": np.int32,
                     "u": np.float32, "v": np.float32}  # fmt: skip


def test_segments_are_closed_and_in_units_of_the_direction(method):
    mesh = trimesh.Trimesh([[-9, -9, 2], [9, -9, 2], [0, 9, 2]], [[0, 1, 2]])
    tracer = exact_tracer(mesh, method)
    rays = np.zeros((6, 3)), np.tile([0, 0, 4.0], (6, 1))
    tnear = [0, 0.5, 0.500001, 0, 0, 1]
    tfar = [np.inf, np.inf, np.inf, 0.5, 0.499999, 0]  # the last: tfar < tnear, inactive
    hits = tracer.intersect(*rays, tnear, tfar)
    np.testing.assert_array_equal(hits.t, [0.5, 0.5, np.inf, 0.5, np.inf, np.inf])
    np.testing.assert_array_equal(tracer.occluded(*rays, tnear, tfar), np.isfinite(hits.t))
    assert tracer.statistics.rays == 5


@pytest.mark.parametrize("form", ["list", "float64", "int", "fortran", "strided"])
def test_arrays_of_any_real_type_and_order(form):
    origins, directions = np.zeros((50, 3)), np.tile([1.0, 2, 3], (50, 1))
    forms = {
        "list": lambda a: a.tolist(),
        "float64": lambda a: a,
        "int": lambda a: a.astype(np.int64),
        "fortran": np.asfortranarray,
        "strided": lambda a: np.repeat(a, 2, axis=0)[::2],
    }
    tracer = rs.Tracer(trimesh.creation.box(), "rsh")
    hits = tracer.intersect(forms[form](origins), forms[form](directions))
    np.testing.assert_allclose(hits.t, 1 / 6, rtol=1e-6)


def test_no_rays_give_typed_empty_results(method):
    tracer = exact_tracer(trimesh.creation.box(), method)
    hits = tracer.intersect(np.zeros((0, 3)), np.zeros((0, 3)))
    assert hits.t.shape == (0,) and hits.prim_id.dtype == np.int32
    blocked = tracer.occluded(np.zeros((0, 3)), np.zeros((0, 3)))
    assert blocked.shape == (0,) and blocked.dtype == bool
    assert tracer.statistics.rays == 0


def test_no_triangles_give_misses(method):
    tracer = exact_tracer(rs.Scene([]), method)
    hits = tracer.intersect(np.zeros((3, 3)), np.ones((3, 3)))
    assert (hits.prim_id == -1).all() and np.isposinf(hits.t).all()
    assert not tracer.occluded(np.zeros((3, 3)), np.ones((3, 3))).any()


def test_zero_area_triangles_are_never_hit(method):
    corners = np.array([[0, 0, 1], [1, 1, 1], [1, 1, 1], [0, 0, 1], [0.5, 0.5, 1], [1, 1, 1]])
    mesh = trimesh.Trimesh(corners, [[0, 1, 2], [3, 4, 5]], process=False)
    tracer = exact_tracer(mesh, method)
    hits = tracer.intersect([[0, 0, 0], [0.5, 0.5, 0], [1, 1, 0]], [[0, 0, 1]] * 3)
    assert (hits.prim_id == -1).all()


ONE = [[0.0, 0, 0]]
BAD_RAYS = [
    (([[0, 0]], ONE), r"origins: need shape \(n, 3\), got \(1, 2\)"),
    ((ONE, np.ones((2, 3))), r"directions: need shape \(1, 3\), got \(2, 3\)"),
    ((ONE, ONE), "directions: need a direction that is not zero, not so at index 0"),
    ((ONE * 3, [[1, 0, 0], [0, np.nan, 0], [1, 0, 0]]), "directions: need finite.*index 1"),
    (([[0, 0, np.inf]], [[1, 0, 0]]), "origins: need finite values, not so at index 0"),
    (([[0, 0, 1e300]], [[1, 0, 0]]), "origins: need finite"),
    ((ONE, [[1, 0, 0]], -1.0), "tnear: need a value of at least 0"),
    ((ONE, [[1, 0, 0]], np.nan), "tnear"),
    ((ONE, [[1, 0, 0]], 0.0, np.nan), "tfar: need a value that is not NaN"),
    ((ONE, [[1, 0, 0]], 0.0, [1.0, 2.0]), r"tfar: need shape \(1\), got \(2,\)"),
]


@pytest.mark.parametrize(("arguments", "message"), BAD_RAYS)
def test_bad_rays_are_refused(arguments, message):
    tracer = rs.Tracer(trimesh.creation.box())
    for query in (tracer.intersect, tracer.occluded):
        with pytest.raises(ValueError, match=message):
            query(*arguments)


def test_strings_are_refused():
    with pytest.raises(TypeError, match="origins: need real numbers"):
        rs.Tracer(trimesh.creation.box()).intersect([["a", "b", "c"]], [[1, 0, 0]])


@pytest.mark.parametrize(("options", "message"), [
    ({"method": "bvh"}, "'brute', 'rsh', 'crsh', 'ldc', 'packet', 'dual', 'auto', got 'bvh'"),
    ({"method": "rsh", "speed": 3}, "no option 'speed'; its options: arity, levels, reduction"),
    ({"method": "brute", "arity": 4}, "no option 'arity'; its options: none"),
    ({"method": "crsh", "arity": 5}, "arity: need one of 4, 8, got 5"),
    ({"method": "crsh", "levels": -1}, "levels: need a whole number"),
    ({"method": "crsh", "reduction": "sorted"}, "reduction: need one of 'fused'"),
    ({"memory_limit": 0}, "memory_limit"),
])  # fmt: skip
def test_bad_options_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        rs.Tracer(trimesh.creation.box(), **options)


def test_moving_vertices(rng, method):
    scene = triangle_soup(rng, 100)
    tracer = exact_tracer(scene, method)
    rays = random_rays(rng, 500)
    moved = scene.vertices + np.float32(0.3)
    before = tracer.intersect(*rays)
    tracer.update_vertices(moved)
    after = tracer.intersect(*rays)
    assert (after.prim_id != before.prim_id).any()
    fresh = exact_tracer(scene.with_vertices(moved), method).intersect(*rays)
    np.testing.assert_array_equal(after.t, fresh.t)
    np.testing.assert_array_equal(after.prim_id, fresh.prim_id)
    tracer.update_vertices(scene.vertices)
    np.testing.assert_array_equal(tracer.intersect(*rays).t, before.t)


def test_bad_vertices_are_refused_and_change_nothing(rng):
    scene = triangle_soup(rng, 20)
    tracer = rs.Tracer(scene)
    rays = random_rays(rng, 100)
    before = tracer.intersect(*rays)
    with pytest.raises(ValueError, match=r"vertices: need shape \(60, 3\), got \(59, 3\)"):
        tracer.update_vertices(scene.vertices[1:])
    broken = scene.vertices.copy()
    broken[7] = np.nan
    with pytest.raises(ValueError, match="vertices: need finite values, not so at index 7"):
        tracer.update_vertices(broken)
    np.testing.assert_array_equal(tracer.intersect(*rays).t, before.t)


@pytest.mark.parametrize("own_context", [False, True])
def test_device_arrays_in_device_arrays_out(rng, session, method, own_context):
    context = cl.Context([session.device]) if own_context else session.context
    queue = cl.CommandQueue(context)
    tracer = exact_tracer(triangle_soup(rng, 100), method)
    origins, directions = random_rays(rng, 300)
    tfar = rng.random(300).astype(np.float32) * 10
    expected = tracer.intersect(origins, directions, 0.0, tfar)
    arrays = [cla.to_device(queue, a) for a in (origins, directions)]
    hits = tracer.intersect(*arrays, 0.0, cla.to_device(queue, tfar))
    assert isinstance(hits.t, cla.Array) and hits.t.context == context
    for field in ("t", "prim_id", "geom_id", "u", "v"):
        np.testing.assert_array_equal(getattr(hits, field).get(), getattr(expected, field))
    blocked = tracer.occluded(*arrays, 0.0, 0.5)
    assert isinstance(blocked, cla.Array)
    expected = tracer.occluded(origins, directions, 0.0, 0.5)
    np.testing.assert_array_equal(blocked.get().astype(bool), expected)


@pytest.mark.parametrize(("change", "error", "message"), [
    (lambda o, d: (o.astype(np.float64), d), TypeError, "origins: need dtype float32"),
    (lambda o, d: (o, d[:5]), ValueError, "directions: need shape"),
    (lambda o, d: (o, d.get()), TypeError, "directions: need a pyopencl array"),
    (lambda o, d: (o, 0 * d), ValueError, "at index 0"),
])  # fmt: skip
def test_bad_device_arrays_are_refused(rng, session, change, error, message):
    arrays = [cla.to_device(session.queue, a) for a in random_rays(rng, 10)]
    tracer = rs.Tracer(trimesh.creation.box())
    with pytest.raises(error, match=message):
        tracer.intersect(*change(*arrays))


def test_a_tracer_works_in_another_thread(rng):
    tracer = rs.Tracer(triangle_soup(rng, 50))
    rays = random_rays(rng, 200)
    expected, found = tracer.intersect(*rays), []
    thread = threading.Thread(target=lambda: found.append(tracer.intersect(*rays)))
    thread.start()
    thread.join()
    np.testing.assert_array_equal(found[0].t, expected.t)


def test_trimesh_scenes_number_geometries_in_order_of_insertion():
    scene = trimesh.Scene()
    for k in range(3):
        box = trimesh.creation.box()
        scene.add_geometry(box, transform=trimesh.transformations.translation_matrix([3 * k, 0, 0]))
    hits = rs.Tracer(scene).intersect([[3 * k, 0, 5] for k in range(3)], [[0, 0, -1]] * 3)
    np.testing.assert_array_equal(hits.geom_id, [0, 1, 2])
    np.testing.assert_allclose(hits.t, 4.5)


def test_embree_agrees_on_a_large_soup(rng, method):
    scene = triangle_soup(rng, 5000, size=0.05)
    triangles = (scene.vertices, scene.faces, scene.first_prims)
    rays = random_rays(rng, 4096)
    hits = exact_tracer(scene, method).intersect(*rays)
    agreement = differing(hits, EmbreeTracer.from_scene(scene).intersect(*rays), *triangles, *rays)
    assert agreement.num_wrong == 0, agreement


def test_the_callers_array_may_change_after_an_update(rng):
    scene = triangle_soup(rng, 100)
    tracer, rays = rs.Tracer(scene), random_rays(rng, 300)
    expected = tracer.intersect(*rays)
    vertices = scene.vertices.copy()
    tracer.update_vertices(vertices)
    vertices += 100
    np.testing.assert_array_equal(tracer.intersect(*rays).t, expected.t)


def test_vertices_that_no_face_uses_may_hold_anything():
    corners = np.array([[0, 0, 1], [1, 0, 1], [0, 1, 1], [np.nan, 0, 0]])
    tracer = rs.Tracer(rs.Scene([rs.Mesh(corners, [[0, 1, 2]])]))
    tracer.update_vertices(corners + 1)
    assert tracer.intersect([[1.2, 1.2, 0]], [[0, 0, 1]]).t[0] == 2


def test_a_mesh_added_to_the_scene_later_is_not_traced(rng):
    scene = triangle_soup(rng, 20)
    tracer, rays = rs.Tracer(scene), random_rays(rng, 200)
    expected = tracer.intersect(*rays)
    scene.add(rs.scenes.mirror_ball((0.5, 0.5, 0.5), 5.0))
    np.testing.assert_array_equal(tracer.intersect(*rays).t, expected.t)
    assert tracer.statistics.triangles == 20


def test_statistics_are_those_of_the_last_call_whatever_ran_since(rng):
    scene = triangle_soup(rng, 200)
    one, other = rs.Tracer(scene), rs.Tracer(scene)
    one.intersect(*random_rays(rng, 1000))
    other.occluded(*random_rays(rng, 10_000))
    assert one.statistics.rays == 1000 and other.statistics.rays == 10_000
    assert one.statistics is one.statistics
    for tracer in (one, other):
        assert all(times["device"] > 0 for times in tracer.statistics.stages.values())
    assert "final intersection" in one.statistics.stages
    with pytest.raises(AttributeError):
        one.statistics = None


def test_a_finished_thread_leaves_nothing_behind(rng):
    import gc
    import weakref

    from raystream import device

    tracer, rays, seen = rs.Tracer(triangle_soup(rng, 20)), random_rays(rng, 50), []

    def work():
        tracer.intersect(*rays)
        seen.append(weakref.ref(device.session()))

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    gc.collect()
    assert seen[0]() is None


def test_arrays_of_two_contexts_or_none_are_refused(session):
    other = cl.CommandQueue(cl.Context([session.device]))
    tracer = rs.Tracer(trimesh.creation.box())
    origins = cla.to_device(session.queue, np.zeros((2, 3), np.float32))
    directions = cla.to_device(other, np.ones((2, 3), np.float32))
    with pytest.raises(ValueError, match="directions: need an array of the same context"):
        tracer.intersect(origins, directions)
    with pytest.raises(ValueError, match="need arrays with a queue"):
        tracer.intersect(origins.with_queue(None), directions)
    with pytest.raises(TypeError, match="directions: need a numpy array like the origins"):
        tracer.intersect(np.zeros((2, 3)), directions)
