"""The hierarchy built on the device is the tree of baselines/bvh.py, node by node."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from raystream.baselines.bvh import build_bvh
from soup import mesh_of

import raystream as rs
from raystream import device
from raystream.bvh import Bvh
from raystream.errors import DeviceError, MemoryLimitError
from raystream.geometry import Geometry

LIMIT = 1 << 30


def soup(count, seed=3, size=0.05):
    rng = np.random.default_rng(seed)
    corners = rng.random((count, 1, 3)) + size * rng.normal(size=(count, 3, 3))
    return corners.astype(np.float32)


def geometry(corners):
    return Geometry(device.session(), rs.Scene([mesh_of("soup", corners)]))


def assert_same_tree(bvh, corners):
    """Nodes, order and triangles of a `Bvh` are those of the numpy tree."""
    expected = build_bvh(corners)
    assert (bvh.num_nodes, bvh.num_levels) == (expected.num_nodes, expected.num_levels)
    nodes = bvh.nodes.get()[: bvh.num_nodes]
    integers = nodes.view(np.int32)[:, [3, 7]]
    leaf = integers[:, 1] >= 0
    np.testing.assert_array_equal(nodes[:, :3], expected.low)
    np.testing.assert_array_equal(nodes[:, 4:7], expected.high)
    np.testing.assert_array_equal(leaf, expected.left < 0)
    np.testing.assert_array_equal(integers[~leaf, 0], expected.left[~leaf])
    np.testing.assert_array_equal(-1 - integers[~leaf, 1], expected.axis[~leaf])
    np.testing.assert_array_equal(integers[leaf, 0], expected.first[leaf])
    np.testing.assert_array_equal(integers[leaf, 1], expected.count[leaf])
    order = bvh.order.get()
    np.testing.assert_array_equal(order, expected.order)
    triangles = bvh.triangles.get().reshape(-1, 3, 4)
    np.testing.assert_array_equal(triangles[..., :3], corners[order])
    np.testing.assert_array_equal(triangles[:, 0, 3].view(np.uint32), order)


@pytest.mark.parametrize("count", [1, 2, 3, 8, 9, 63, 64, 65, 1009, 20011])
def test_the_numpy_tree(count):
    corners = soup(count)
    assert_same_tree(Bvh(device.session(), geometry(corners), LIMIT), corners)


COORDINATES = st.sampled_from([0.0, 1, 2, 3, 1e-45, 1e-38, -5, 3e38, -3e38])


@settings(max_examples=60, deadline=None)
@given(
    arrays(np.float32, st.tuples(st.integers(1, 40), st.just(3), st.just(3)), elements=COORDINATES)
)
def test_the_numpy_tree_of_awkward_triangles(corners):
    assert_same_tree(Bvh(device.session(), geometry(corners), LIMIT), corners)


@pytest.mark.parametrize(
    "corners",
    [
        np.tile(np.float32([0.1, 0.2, 0.3]), (1000, 3, 1)),  # all in one point
        np.tile((np.float32(2) ** np.arange(-100, 100))[:, None, None], (1, 3, 3)),
        np.tile(np.eye(3, dtype=np.float32), (5, 1, 1)),  # a leaf where splitting does not pay
    ],
    ids=["point", "doubling", "equal"],
)
def test_the_numpy_tree_where_bins_do_not_part(corners):
    assert_same_tree(Bvh(device.session(), geometry(corners), LIMIT), corners)


def test_new_vertices():
    corners, moved = soup(300), soup(300, seed=4)
    triangles = geometry(corners)
    assert_same_tree(Bvh(device.session(), triangles, LIMIT), corners)
    triangles.update(moved.reshape(-1, 3))
    assert_same_tree(Bvh(device.session(), triangles, LIMIT), moved)


def test_memory_is_limited():
    with pytest.raises(MemoryLimitError, match="hierarchy of 300 triangles: need 55200 bytes"):
        Bvh(device.session(), geometry(soup(300)), 55199)
    assert Bvh(device.session(), geometry(soup(300)), 55200).nbytes < 55200


def test_a_device_without_double_precision_is_refused():
    class Session:
        class device:  # noqa: N801
            name, extensions = "small", "cl_khr_int64_base_atomics"

    with pytest.raises(DeviceError, match=r"small: need double precision \(cl_khr_fp64\)"):
        Bvh(Session, geometry(soup(3)), LIMIT)
