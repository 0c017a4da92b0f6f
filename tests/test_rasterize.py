"""Primary visibility: a float64 oracle, closed surfaces without holes, Embree's primary rays."""

import pathlib

import numpy as np
import pyopencl as cl
import pytest
from meshes import FOLDER, needs_files

from raystream import program, rasterize
from raystream.camera import Camera
from raystream.rasterize import Rasterizer

INVALID = 0xFFFFFFFF
EDGE = 1e-3  # pixels from an edge within which float32 and float64 may disagree
ROUNDING = 2e-6  # of positions, relative to the triangle's farthest coordinate from the eye


@pytest.fixture
def rasterizer(session):
    return Rasterizer(session)


def draw(rasterizer, corners, camera, size, offset=(0.5, 0.5)):
    """Render triangles (n, 3, 3); return prim, t, u, v as numpy arrays."""
    session = rasterizer._session
    packed = np.zeros((len(corners), 3, 4), np.float32)
    packed[:, :, :3] = corners
    triangles = session.upload("test", packed.reshape(-1, 12))
    hits = rasterizer.render(triangles, camera, size, offset)
    prim, t, u, v = (array.get() for array in (hits.prim, hits.t, hits.u, hits.v))
    session.finish()
    assert not np.isnan(np.stack([t, u, v])).any()
    assert ((prim == INVALID) == np.isinf(t)).all()
    assert (u >= 0).all() and (v >= 0).all() and (u + v <= 1 + 1e-6).all()
    return prim, t, u, v


def oracle(corners, camera, size, offset):
    """Depth and distance inside (pixels, negative outside) of each triangle at each pixel."""
    directions = exact_rays(camera, size, offset)
    a, b, c = np.moveaxis(np.float32(corners).astype(float) - np.float32(camera.eye), 1, 0)
    normals = np.stack([np.cross(b, c), np.cross(c, a), np.cross(a, b)])  # of the planes by the eye
    edges = normals @ directions.T  # (3, triangle, pixel)
    determinant = np.einsum("ij,ij->i", a, normals[0])
    with np.errstate(divide="ignore", invalid="ignore"):
        t = determinant[:, None] / edges.sum(axis=0)
        right, up, _ = camera.basis
        gradient = np.hypot(normals @ right, normals @ up)[:, :, None] * pixel_height(camera, size)
        inside = (edges * np.sign(determinant)[:, None] / gradient).min(axis=0)
    depth = np.stack([p @ camera.basis[2] for p in (a, b, c)])
    near = 2.0**-20 * np.abs(depth).max(axis=0)[:, None]
    return np.where(np.nan_to_num(t, nan=-1.0) > near, t, np.inf), inside


def position_tolerance(corners, camera, directions):
    """Rounding of a hit's position (triangle, pixel): it grows where a ray grazes the triangle."""
    a, b, c = np.moveaxis(np.asarray(corners, float), 1, 0)
    normals = np.cross(b - a, c - a)
    lengths = np.linalg.norm(normals, axis=1)[:, None] * np.linalg.norm(directions, axis=1)
    scale = np.abs(corners - camera.eye).max(axis=(1, 2))
    return ROUNDING * scale[:, None] * lengths / np.abs(normals @ directions.T)


def exact_rays(camera, size, offset):
    (width, height), (right, up, forward) = size, camera.basis
    unit = pixel_height(camera, size)
    x = (np.arange(width) + offset[0] - width / 2) * unit
    y = (height / 2 - np.arange(height) - offset[1]) * unit
    return (forward + x[None, :, None] * right + y[:, None, None] * up).reshape(-1, 3)


def pixel_height(camera, size):
    return 2 * np.tan(np.radians(camera.fov_y) / 2) / size[1]


def check_against_oracle(rasterizer, corners, camera, size, offset=(0.5, 0.5)):
    """Each pixel shows a triangle that is there, and none that lies clearly before it is missed."""
    prim, t, u, v = draw(rasterizer, corners, camera, size, offset)
    depth, inside = oracle(corners, camera, size, offset)
    tolerance = position_tolerance(corners, camera, exact_rays(camera, size, offset))
    latest = np.where(inside > EDGE, depth + tolerance, np.inf)
    assert (t <= latest.min(axis=0, initial=np.inf)).all()
    pixels = np.flatnonzero(prim != INVALID)
    shown = prim[pixels]
    assert (inside[shown, pixels] > -EDGE).all()
    barycentric = np.stack([1 - u - v, u, v])[:, pixels]
    point = np.einsum("ki,ikj->ij", barycentric, corners[shown])
    on_ray = camera.eye + t[pixels, None] * exact_rays(camera, size, offset)[pixels]
    assert (np.abs(point - on_ray).max(axis=1) <= tolerance[shown, pixels]).all()
    return prim


def soup(rng, count, spread, extent):
    """Triangles with centres in a cube about the origin."""
    centres = rng.uniform(-spread, spread, (count, 1, 3))
    return np.float32(centres + rng.normal(size=(count, 3, 3)) * extent)


def sphere(subdivisions):
    """A closed sphere about the origin: corners of its triangles, wound outwards."""
    corners = np.array([[0, 1, 2], [1, 3, 2], [3, 4, 2], [4, 0, 2]])
    vertices = np.concatenate([np.eye(3), -np.eye(3)])
    triangles = vertices[np.concatenate([corners, (corners[:, ::-1] + 3) % 6])]
    for _ in range(subdivisions):
        middles = (triangles + np.roll(triangles, -1, axis=1)) / 2
        parts = [np.stack([triangles[:, k], middles[:, k], middles[:, k - 1]], 1) for k in range(3)]
        triangles = np.concatenate([*parts, middles])
    return np.float32(triangles / np.linalg.norm(triangles, axis=2, keepdims=True))


def coverings(rasterizer, corners, camera, size):
    """How many triangles each pixel shows, 2 standing for more than one.

    Two triangles differ in a bit of their index, so one of the partitions by a bit has one on each
    side and both are drawn.
    """
    result = np.zeros(size[0] * size[1], int)
    for bit in range(max(1, (len(corners) - 1).bit_length())):
        side = np.arange(len(corners)) >> bit & 1
        halves = [draw(rasterizer, corners[side == k], camera, size)[0] for k in (0, 1)]
        result = np.maximum(result, sum((half != INVALID).astype(int) for half in halves))
    return result


@pytest.mark.parametrize("size", [(1, 1), (7, 5), (33, 21), (64, 64), (101, 67)])
def test_random_triangles_match_the_oracle(rasterizer, size):
    rng = np.random.default_rng(1)
    camera = Camera.look_at((0.3, 0.2, 4.0), (0, 0, 0), fov_y=50)
    check_against_oracle(rasterizer, soup(rng, 100, 1.5, 0.4), camera, size)
    check_against_oracle(rasterizer, soup(rng, 400, 1.5, 0.03), camera, size, offset=(0.2, 0.85))


@pytest.mark.parametrize("extent", [0.5, 30.0, 3000.0])
def test_triangles_that_cross_the_plane_of_the_eye(rasterizer, extent):
    rng = np.random.default_rng(2)
    corners = soup(rng, 60, 1.0, extent)
    crossing = 0
    for axis in [*np.eye(3), *-np.eye(3)]:
        target = axis + np.array([0.1, 0.2, 0.05])
        camera = Camera.look_at((0, 0, 0), target, fov_y=80)
        depth = corners @ camera.basis[2]
        crossing += ((depth.min(axis=1) < 0) & (depth.max(axis=1) > 0)).sum()
        check_against_oracle(rasterizer, corners, camera, (75, 50))
    assert crossing > 50


@pytest.mark.parametrize("size", [(97, 64), (200, 150)])
def test_closed_sphere_has_no_hole_from_inside(rasterizer, size):
    rng = np.random.default_rng(3)
    corners = sphere(4)
    for _ in range(3):
        eye = rng.uniform(-0.5, 0.5, 3)
        camera = Camera.look_at(eye, eye + rng.normal(size=3), fov_y=90)
        assert (coverings(rasterizer, corners, camera, size) == 1).all()


def test_closed_sphere_from_outside_is_entered_and_left_once(rasterizer):
    corners = sphere(4)
    camera = Camera.look_at((0.4, 1.2, 3.0), (0.1, 0, 0), fov_y=35)
    outward = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    front = np.einsum("ij,ij->i", outward, corners[:, 0] - camera.eye) < 0
    before = coverings(rasterizer, corners[front], camera, (150, 130))
    behind = coverings(rasterizer, corners[~front], camera, (150, 130))
    assert before.max() == 1 and 0 < before.mean() < 1
    np.testing.assert_array_equal(before, behind)


def test_vertices_on_pixel_centres_are_covered_once(rasterizer):
    """Every ray meets a vertex; six triangles share it, and one of them is shown."""
    x, y = np.meshgrid(np.arange(-21, 21) + 0.5, np.arange(-17, 17) + 0.5)
    grid = np.stack([x, y, np.full_like(x, -16.0)], axis=-1)
    quads = grid[:-1, :-1], grid[:-1, 1:], grid[1:, 1:], grid[1:, :-1]
    a, b, c, d = (corner.reshape(-1, 3) for corner in quads)
    corners = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
    for right in (1, -1):  # seen upright and upside down
        camera = Camera.look_at((0, 0, 0), (0, 0, -1), up=(0, right, 0), fov_y=90)
        assert (coverings(rasterizer, corners, camera, (40, 32)) == 1).all()


def test_rays_through_the_vertices_of_a_sphere(rasterizer):
    """A one-pixel picture aimed at each vertex in turn, from inside."""
    corners = sphere(3)
    for vertex in np.unique(corners.reshape(-1, 3), axis=0)[::7]:
        camera = Camera.look_at((0, 0, 0), vertex, up=(0.3, 0.5, 0.7), fov_y=1)
        assert (coverings(rasterizer, corners, camera, (1, 1)) == 1).all()


def test_difference_of_products_has_the_exact_sign(session):
    rng = np.random.default_rng(7)
    a, b, c = rng.uniform(1, 2, (3, 20000)).astype(np.float32)
    d = a * b / c  # a * b and c * d differ by roundings
    source = program.expand("rasterize.h") + """
        kernel void differences(global float *a, global float *b, global float *c, global float *d)
        {
            const uint i = get_global_id(0);
            a[i] = difference(a[i], b[i], c[i], d[i]);
        }"""
    kernel = cl.Program(session.context, source).build().differences
    arrays = [session.upload("test", x) for x in (a, b, c, d)]
    session.launch("test", kernel, len(a), *arrays)
    exact = a.astype(float) * b - c.astype(float) * d  # products of float32 are exact in float64
    np.testing.assert_array_equal(np.sign(arrays[0].get()), np.sign(exact))


def test_equal_depth_goes_to_the_smaller_index(rasterizer):
    rng = np.random.default_rng(4)
    once = soup(rng, 50, 1.0, 0.4)
    camera = Camera.look_at((0, 0, 3), (0, 0, 0))
    first = draw(rasterizer, once, camera, (90, 60))
    again = draw(rasterizer, np.concatenate([once, once[::-1], once]), camera, (90, 60))
    for expected, actual in zip(first, again, strict=True):
        np.testing.assert_array_equal(expected, actual)


@pytest.mark.parametrize("scale", [2.0**-40, 2.0**40])
def test_scenes_of_any_scale_look_alike(rasterizer, scale):
    corners = soup(np.random.default_rng(8), 80, 1.0, 0.5)
    eye = np.array([0.5, 0.25, 2.0])
    expected = draw(rasterizer, corners, Camera.look_at(eye, (0, 0, 0)), (60, 50))
    prim, t, u, v = draw(
        rasterizer, scale * corners, Camera.look_at(scale * eye, (0, 0, 0)), (60, 50)
    )
    for ours, theirs in zip((prim, t / np.float32(scale), u, v), expected, strict=True):
        np.testing.assert_array_equal(ours, theirs)


def test_empty_mesh(rasterizer):
    camera = Camera.look_at((0, 0, 3), (0, 0, 0))
    prim, t, u, v = draw(rasterizer, np.zeros((0, 3, 3)), camera, (40, 30))
    assert (prim == INVALID).all() and np.isinf(t).all() and not u.any() and not v.any()


def test_one_triangle(rasterizer):
    """A right triangle whose picture can be written down: its legs are the axes through pixels."""
    camera = Camera.look_at((0, 0, 2), (0, 0, 0), fov_y=90)  # 4 x 4 pixels are 4 x 4 units at z = 0
    corners = np.array([[[-2, -2, 0], [2, -2, 0], [-2, 2, 0]]])
    prim, t, u, v = (a.reshape(4, 4) for a in draw(rasterizer, corners, camera, (4, 4), (0.4, 0.5)))
    inside = np.tri(4, dtype=bool)
    np.testing.assert_array_equal(prim, np.where(inside, 0, INVALID))
    np.testing.assert_allclose(t[inside], 2, rtol=1e-6)
    column, row = np.meshgrid(np.arange(4) + 0.4, np.arange(4) + 0.5)
    np.testing.assert_allclose(u[inside], column[inside] / 4, atol=1e-6)
    np.testing.assert_allclose(v[inside], (1 - row / 4)[inside], atol=1e-6)


def test_nothing_is_drawn_of_degenerate_and_invisible_triangles(rasterizer):
    camera = Camera.look_at((0, 0, 0), (0, 0, -1), fov_y=90)
    a, b, c = [-1, -1, -2], [1, -1, -2], [0, 1, -2]
    corners = [
        [a, a, b], [a, a, a], [a, b, b], [a, [0, -1, -2], b],  # no area
        [[-1, 0, -2], [1, 0, -2], [0, 0, -5]], [[0, 0, 0], a, b],  # in a plane with the eye
        [[0, 0, 0], [0, 0, 0], [0, 0, 0]],  # at the eye
        [[-1, -1, 2], [1, -1, 2], [0, 1, 2]],  # behind
        [[9, 9, -2], [10, 9, -2], [9, 10, -2]],  # beside
        [a, b, [0, np.nan, -2]], [a, [np.inf, 0, -2], c], [a, b, [0, 1, -np.inf]],
        [[np.nan] * 3] * 3, [[3e38, 3e38, 3e38], [-3e38, 0, 3e38], [0, 3e38, -3e38]],
    ]
    prim = draw(rasterizer, np.array(corners, np.float32), camera, (64, 48))[0]
    assert (prim == INVALID).all()


def test_crowded_tile_is_cut_into_bands(rasterizer):
    rng = np.random.default_rng(5)
    count = rasterize.CROWDED + 500
    corners = soup(rng, count, 0.12, 0.05)
    camera = Camera.look_at((0, 0, 3), (0, 0, 0), fov_y=10)
    check_against_oracle(rasterizer, corners, camera, (30, 27))
    assert rasterizer._buffers["length"].get()[1] == rasterize.BANDS


@pytest.mark.parametrize("list_bytes", [256, 2000, 20000])
def test_batches_give_the_same_picture(session, rasterizer, list_bytes):
    corners = np.concatenate([sphere(2), sphere(2), soup(np.random.default_rng(6), 99, 2, 1)])
    camera = Camera.look_at((1, 0.5, 3), (0, 0, 0))
    whole = draw(rasterizer, corners, camera, (130, 70))
    batched = Rasterizer(session, list_bytes=list_bytes)
    for expected, actual in zip(whole, draw(batched, corners, camera, (130, 70)), strict=True):
        np.testing.assert_array_equal(expected, actual)
    assert batched._buffers["list"].nbytes <= min(list_bytes, rasterizer._buffers["list"].nbytes)


def test_frames_are_reproducible_and_allocate_nothing(session, rasterizer):
    corners, camera = sphere(4), Camera.look_at((0, 0.2, 0.1), (0, 0, -1), fov_y=100)
    first = draw(rasterizer, corners, camera, (160, 120))
    buffers = dict(rasterizer._buffers)
    again = draw(rasterizer, corners, camera, (160, 120))
    for expected, actual in zip(first, again, strict=True):
        np.testing.assert_array_equal(expected, actual)
    assert all(rasterizer._buffers[name] is buffer for name, buffer in buffers.items())


def test_one_rasterizer_draws_pictures_of_many_sizes(session, rasterizer):
    corners = sphere(3)
    camera = Camera.look_at((0.2, 1, 3), (0, 0, 0))
    for size in [(200, 90), (31, 33), (200, 90), (1, 300)]:
        expected = draw(Rasterizer(session), corners, camera, size)
        for ours, fresh in zip(draw(rasterizer, corners, camera, size), expected, strict=True):
            np.testing.assert_array_equal(ours, fresh)


def test_only_the_first_triangles(session, rasterizer):
    corners, camera = sphere(2), Camera.look_at((0, 0, 3), (0, 0, 0))
    expected = draw(rasterizer, corners[:40], camera, (50, 50))[0]
    packed = np.pad(corners, ((0, 0), (0, 0), (0, 1))).reshape(-1, 12)
    triangles = session.upload("test", packed)
    hits = rasterizer.render(triangles, camera, (50, 50), num_triangles=40)
    np.testing.assert_array_equal(hits.prim.get(), expected)


@pytest.mark.parametrize("size", [(0, 4), (4, 0), (65536, 1)])
def test_impossible_sizes_are_refused(session, rasterizer, size):
    triangles = session.upload("test", np.zeros((1, 12), np.float32))
    with pytest.raises(ValueError, match="size"):
        rasterizer.render(triangles, Camera.look_at((0, 0, 3), (0, 0, 0)), size)


def test_wrong_arrays_are_refused(session, rasterizer):
    camera = Camera.look_at((0, 0, 3), (0, 0, 0))
    for wrong in (np.zeros((1, 9), np.float32), np.zeros((1, 12))):
        with pytest.raises(ValueError, match="triangles"):
            rasterizer.render(session.upload("test", wrong), camera, (4, 4))
    one = session.upload("test", np.zeros((1, 12), np.float32))
    with pytest.raises(ValueError, match="num_triangles"):
        rasterizer.render(one, camera, (4, 4), num_triangles=2)


@needs_files
@pytest.mark.parametrize(
    ("file", "eye", "direction", "fov_y"),
    [
        ("bunny/bunny-69451.ply", None, None, 45),
        ("sponza/sponza-dabrovic.obj", (-12, 4, 0), (1, -0.05, 0.1), 60),
    ],
)
def test_embree_meets_the_same_triangles(rasterizer, file, eye, direction, fov_y):
    trimesh = pytest.importorskip("trimesh")
    from raystream.baselines import EmbreeTracer

    path = pathlib.Path(FOLDER, file)
    if not path.exists():
        pytest.skip(f"RAYSTREAM_SCENES has no {file}")
    mesh = trimesh.load(path, process=False, force="mesh")
    if eye is None:
        camera = Camera.fit(mesh.bounds, fov_y=fov_y)
    else:
        camera = Camera.look_at(eye, np.add(eye, direction), fov_y=fov_y)
    size = (512, 512)
    corners = np.float32(mesh.vertices)[mesh.faces]
    prim, t, _, _ = draw(rasterizer, corners, camera, size)
    embree = EmbreeTracer(mesh.vertices, mesh.faces).intersect(*camera.rays(size))
    hit = embree.prim_id >= 0
    differ = np.where(hit, embree.prim_id, -1) != prim.astype(np.int32)
    assert differ.mean() <= 1e-3
    same = ~differ & hit
    np.testing.assert_allclose(t[same], embree.t[same], rtol=1e-4)
    for pixel in np.flatnonzero(differ):
        shown = [p for p in (prim[pixel], embree.prim_id[pixel]) if p not in (INVALID, -1)]
        _, inside = oracle(corners[shown], camera, size, (0.5, 0.5))
        assert (np.abs(inside[:, pixel]) < 1).all()
