"""Triangles and their bounds on the device."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from soup import mesh_of, triangle_soup

import raystream as rs
from raystream import device
from raystream.geometry import Geometry

COUNTS = [1, 2, 15, 16, 17, 31, 33, 1009]


def spheres_of(geometry):
    """The spheres of the triangles and of the padding, float64; both layouts hold the same."""
    spheres = bounds_of(geometry)[:, :4]
    return spheres[: geometry.num_triangles], spheres[geometry.num_triangles :]


def bounds_of(geometry):
    """All bounds, (n, 12) float64; both layouts hold the same."""
    bounds = geometry.bounds.get()
    rows = geometry.bound_rows.get().transpose(0, 2, 1).reshape(-1, 12)
    np.testing.assert_array_equal(bounds, rows)
    return bounds.astype(np.float64)


@settings(max_examples=60, deadline=None)
@given(
    st.integers(0, 2**32 - 1),
    st.sampled_from([1e-3, 1.0, 1e3]),
    st.sampled_from([0.0, 100.0]),
    st.sampled_from([1.0, 1e-3, 1e-6, 0.0]),  # from round triangles to lines
)
def test_slabs_and_boxes_hold_their_triangles(seed, scale, offset, thinness):
    rng = np.random.default_rng(seed)
    corners = rng.normal(size=(50, 3, 3))
    corners[:, 2] = corners[:, 0] + 0.7 * (corners[:, 1] - corners[:, 0]) + thinness * corners[:, 2]
    corners = (scale * corners + offset).astype(np.float32)
    geometry = Geometry(device.session(), rs.Scene([mesh_of("soup", corners)]))
    bounds = bounds_of(geometry)[:50, None]
    away = corners.astype(np.float64) - bounds[..., :3]
    # Where there is no normal the slab has no end.
    distances = np.abs((away * bounds[..., 4:7]).sum(axis=2))
    assert (distances <= bounds[..., 7]).all()
    assert (np.abs(away) <= bounds[..., 8:11]).all() and (bounds[..., 11] == 0).all()
    with_normal = np.isfinite(bounds[:, 0, 7])
    np.testing.assert_allclose(
        np.linalg.norm(bounds[with_normal, 0, 4:7], axis=1), 1.0, rtol=1e-6
    )
    if thinness == 1.0:
        thickness = bounds[:, 0, 7] / bounds[:, 0, 3]
        assert with_normal.all() and (thickness < 1e-3 * (1 + offset / scale)).all()


@pytest.mark.parametrize("count", COUNTS)
def test_triangles_are_gathered_and_padding_has_no_radius(session, rng, count):
    scene = triangle_soup(rng, count)
    geometry = Geometry(session, scene)
    corners = geometry.triangles.get().reshape(-1, 3, 4)[:count, :, :3]
    np.testing.assert_array_equal(corners, scene.vertices[scene.faces])
    _, padding = spheres_of(geometry)
    assert len(padding) == -count % 16 and np.isneginf(padding[:, 3]).all()


@pytest.mark.parametrize("count", [*COUNTS, 1023, 1024, 1025, 3001])
def test_middles_hold_those_of_all_boxes_and_no_more(session, rng, count):
    scene = triangle_soup(rng, count)
    boxes = Geometry(session, scene).middles.get()[..., :3]
    corners = scene.vertices[scene.faces]
    middles = corners.min(axis=1) + corners.max(axis=1)
    np.testing.assert_array_equal(boxes[:, 0].min(axis=0), middles.min(axis=0))
    np.testing.assert_array_equal(boxes[:, 1].max(axis=0), middles.max(axis=0))


@pytest.mark.parametrize("offset", [0.0, 1000.0])
def test_spheres_hold_their_triangles_and_are_minimal(session, rng, offset):
    corners = (rng.random((500, 3, 3)) + offset).astype(np.float32)
    geometry = Geometry(session, rs.Scene([mesh_of("soup", corners)]))
    spheres, _ = spheres_of(geometry)
    exact = corners.astype(np.float64)
    distance = np.linalg.norm(exact - spheres[:, None, :3], axis=2)
    assert (distance <= spheres[:, 3:]).all()
    sides = np.linalg.norm(exact - np.roll(exact, 1, axis=1), axis=2)
    area = np.linalg.norm(np.cross(exact[:, 1] - exact[:, 0], exact[:, 2] - exact[:, 0]), axis=1)
    circumradius = sides.prod(axis=1) / (2 * area)
    longest = sides.max(axis=1)
    obtuse = 2 * longest**2 >= (sides**2).sum(axis=1)
    smallest = np.where(obtuse, longest / 2, circumradius)
    # Far from the origin the rounded centre costs up to a float32 step of the coordinates.
    np.testing.assert_allclose(spheres[:, 3], smallest, rtol=1e-5, atol=1e-7 * offset)


def test_degenerate_triangles_have_finite_spheres(session):
    point, line = np.ones((3, 3)), np.array([[0, 0, 0], [1, 1, 1], [2, 2, 2]])
    corners = np.stack([point, line]).astype(np.float32)
    spheres, _ = spheres_of(Geometry(session, rs.Scene([mesh_of("thin", corners)])))
    np.testing.assert_allclose(spheres[:, :3], 1.0)
    np.testing.assert_allclose(spheres[:, 3], [0.0, np.sqrt(3)], rtol=1e-5)


def test_new_vertices_replace_the_old_ones(session, rng):
    scene = triangle_soup(rng, 40)
    geometry = Geometry(session, scene)
    moved = scene.vertices + np.float32(0.5)
    geometry.update(moved)
    corners = geometry.triangles.get().reshape(-1, 3, 4)[:40, :, :3]
    np.testing.assert_array_equal(corners, moved[scene.faces])
