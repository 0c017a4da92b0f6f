"""build_bvh: every triangle in one leaf, exact boxes, sensible splits, and an end to each input."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from raystream.baselines.bvh import LEAF_SIZE, build_bvh, half_area, ranges


def soup(count, seed=3, size=0.05):
    rng = np.random.default_rng(seed)
    corners = rng.random((count, 1, 3)) + size * rng.normal(size=(count, 3, 3))
    return corners.astype(np.float32)


def check(bvh, corners, leaf_size=LEAF_SIZE):
    """Assert all that holds for every tree."""
    low, high = corners.min(axis=1), corners.max(axis=1)
    leaves = np.flatnonzero(bvh.left < 0)
    inner = np.flatnonzero(bvh.left >= 0)
    assert bvh.num_nodes == (2 * len(leaves) - 1 if len(corners) else 0)
    assert sorted(bvh.order.tolist()) == list(range(len(corners)))
    row, place = ranges(bvh.count[leaves])
    slots = bvh.first[leaves][row] + place
    assert sorted(slots.tolist()) == list(range(len(corners)))
    assert (bvh.count > 0).all() and (bvh.count[leaves] <= leaf_size).all()
    for node in range(bvh.num_nodes):
        own = bvh.order[bvh.first[node] : bvh.first[node] + bvh.count[node]]
        np.testing.assert_array_equal(bvh.low[node], low[own].min(axis=0))
        np.testing.assert_array_equal(bvh.high[node], high[own].max(axis=0))
    left, right = bvh.left[inner], bvh.left[inner] + 1
    assert sorted([*left, *right]) == list(range(1, bvh.num_nodes))
    np.testing.assert_array_equal(bvh.first[left], bvh.first[inner])
    np.testing.assert_array_equal(bvh.first[right], bvh.first[left] + bvh.count[left])
    np.testing.assert_array_equal(bvh.count[left] + bvh.count[right], bvh.count[inner])
    for child in (left, right):
        np.testing.assert_array_equal(bvh.depth[child], bvh.depth[inner] + 1)
        assert (bvh.low[child] >= bvh.low[inner]).all()
        assert (bvh.high[child] <= bvh.high[inner]).all()
    assert (bvh.depth[:1] == 0).all()


@pytest.mark.parametrize("count", [0, 1, 2, 3, 8, 9, 100, 1500])
def test_invariants(count):
    corners = soup(count)
    check(build_bvh(corners), corners)


@pytest.mark.parametrize("num_bins", [2, 3, 64])
@pytest.mark.parametrize("leaf_size", [1, 2, 50])
def test_options(num_bins, leaf_size):
    corners = soup(300)
    check(build_bvh(corners, num_bins, leaf_size), corners, leaf_size)


COORDINATES = st.sampled_from([0.0, 1, 2, 3, 1e-45, 1e-38, -5, 3e38, -3e38])


@settings(max_examples=60, deadline=None)
@given(
    arrays(np.float32, st.tuples(st.integers(0, 40), st.just(3), st.just(3)), elements=COORDINATES)
)
def test_invariants_on_awkward_triangles(corners):
    check(build_bvh(corners, leaf_size=2), corners, 2)


def test_all_triangles_in_one_point_end():
    corners = np.tile(np.float32([0.1, 0.2, 0.3]), (1000, 3, 1))
    bvh = build_bvh(corners)
    check(bvh, corners)
    assert bvh.num_levels == 8  # halves: 1000 / 2**7 < 8


def test_centroids_that_double_end():
    places = np.float32(2) ** np.arange(-100, 100)
    corners = np.tile(places[:, None, None], (1, 3, 3))
    check(build_bvh(corners, leaf_size=1), corners, 1)


def test_two_clusters_are_split_between():
    corners = soup(40)
    corners[::2, :, 1] += 100
    bvh = build_bvh(corners)
    assert bvh.axis[0] == 1
    assert sorted(bvh.order[:20]) == list(range(1, 40, 2))
    assert bvh.high[1, 1] < 50 < bvh.low[2, 1]


def test_a_leaf_where_splitting_does_not_pay():
    # The same large triangle: two children would both have the parent's box.
    corners = np.tile(np.eye(3, dtype=np.float32), (5, 1, 1))
    assert build_bvh(corners).num_nodes == 1
    assert build_bvh(corners, leaf_size=4).num_nodes == 3


def test_the_root_has_the_cheapest_split_of_all_bins():
    corners = soup(200, size=0.1)
    low, high = corners.min(axis=1), corners.max(axis=1)
    centre = low.astype(np.float64) + high
    extent = np.ptp(centre, axis=0)
    bins = np.minimum((centre - centre.min(axis=0)) / extent * 16, 15).astype(int)
    costs = {}
    for axis in range(3):
        for last in range(15):
            left = bins[:, axis] <= last
            costs[axis, last] = sum(
                half.sum() * half_area(low[half].min(axis=0)[None], high[half].max(axis=0)[None])[0]
                for half in (left, ~left)
            )
    bvh = build_bvh(corners)
    found = (bvh.count[1:3] * half_area(bvh.low[1:3], bvh.high[1:3])).sum()
    assert found == pytest.approx(min(costs.values()))
    axis, last = min(costs, key=costs.get)
    assert bvh.axis[0] == axis
    np.testing.assert_array_equal(
        np.sort(bvh.order[: bvh.count[1]]), np.flatnonzero(bins[:, axis] <= last)
    )


def test_far_cheaper_than_one_leaf():
    corners = soup(2000, size=0.02)
    assert build_bvh(corners).statistics()["sah_cost"] < 0.02 * len(corners)


def test_statistics_by_hand():
    corners = np.float32([[[0, 0, 0], [1, 0, 0], [0, 1, 1]], [[9, 0, 0], [10, 0, 0], [9, 1, 1]]])
    statistics = build_bvh(corners).statistics()
    area, child = 10 + 10 + 1, 3
    assert statistics == {
        "nodes": 3,
        "leaves": 2,
        "levels": 2,
        "triangles": 2,
        "largest_leaf": 1,
        "mean_leaf": 1.0,
        "sah_cost": pytest.approx(1 + 2 * child / area),
    }


def test_statistics_without_triangles():
    statistics = build_bvh(soup(0)).statistics()
    assert set(statistics.values()) == {0}


def test_equal_input_equal_tree():
    trees = [build_bvh(soup(500)) for _ in range(2)]
    for field in dataclasses.fields(trees[0]):
        np.testing.assert_array_equal(*(getattr(tree, field.name) for tree in trees))


@pytest.mark.parametrize("options", [{"num_bins": 1}, {"leaf_size": 0}])
def test_options_out_of_range(options):
    with pytest.raises(ValueError, match="num_bins >= 2, leaf_size >= 1"):
        build_bvh(soup(3), **options)


def test_half_area():
    low, high = np.float32([[0, 0, 0], [1, 1, 1]]), np.float32([[1, 2, 3], [0, 0, 0]])
    assert half_area(low, high).tolist() == [2 + 6 + 3, 0]
