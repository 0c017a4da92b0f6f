"""The scene hierarchy of `dual`: each triangle in one leaf, tight boxes, bounded depth."""

import numpy as np
import pytest
from soup import mesh_of, triangle_soup

import raystream as rs
from raystream import device, program
from raystream import tree as tree_module
from raystream.errors import MemoryLimitError
from raystream.geometry import Geometry
from raystream.tree import BUILDERS, SceneTree

LEAF, NO_CHILD, DEPTH = 0x80000000, 0xFFFFFFFF, 24  # cl/tree.h
SIZES = (1, 2, 7, 8, 9, 15, 16, 17, 63, 64, 65, 127, 128, 511, 512, 513, 1009, 5003, 40009)


@pytest.fixture(params=BUILDERS)
def builder(request):
    return request.param


def tree_of(session, scene, builder, **options):
    tree = SceneTree(session, Geometry(session, scene), builder, **options)
    tree.build()
    return tree


def scene_of(corners):
    return rs.Scene([mesh_of("soup", np.asarray(corners, np.float32))])


def boxes_and_numbers(tree):
    """Boxes (n, 8, 2, 3) of the nodes' children and their numbers (n, 8); the leaves' triangles."""
    nodes, leaves = tree.nodes.get(), tree.leaves.get()
    boxes = nodes[:, :6].reshape(-1, 2, 3, 8).transpose(0, 3, 1, 2)
    children = np.ascontiguousarray(nodes[:, 6]).view(np.uint32)
    corners = leaves[:, :9].reshape(-1, 3, 3, 8).transpose(0, 3, 1, 2)
    return boxes, children, corners, np.ascontiguousarray(leaves[:, 9]).view(np.uint32)


def check(tree, scene):
    """What cl/tree.h says of a tree; returns the number of levels of its nodes."""
    triangles = scene.vertices[scene.faces]
    boxes, children, corners, numbers = boxes_and_numbers(tree)
    used = children != NO_CHILD
    level, depth, found = np.array([0]), 0, []
    while len(level):
        depth += 1
        assert len(np.unique(level)) == len(level)
        empty = boxes[level][~used[level]]
        assert (empty[:, 0] == np.inf).all() and (empty[:, 1] == -np.inf).all()
        node, lane = np.nonzero(used[level])
        box, child = boxes[level[node], lane], children[level[node], lane]
        is_leaf = (child & LEAF) != 0
        leaf = child[is_leaf] & ~np.uint32(LEAF)
        found.append(numbers[leaf])
        real = numbers[leaf] != NO_CHILD
        assert real.any(axis=1).all()
        assert np.isnan(corners[leaf][~real]).all()
        np.testing.assert_array_equal(corners[leaf][real], triangles[numbers[leaf][real]])
        np.testing.assert_array_equal(box[is_leaf, 0], np.nanmin(corners[leaf], axis=(1, 2)))
        np.testing.assert_array_equal(box[is_leaf, 1], np.nanmax(corners[leaf], axis=(1, 2)))
        inner = child[~is_leaf]
        np.testing.assert_array_equal(box[~is_leaf, 0], boxes[inner, :, 0].min(axis=1))
        np.testing.assert_array_equal(box[~is_leaf, 1], boxes[inner, :, 1].max(axis=1))
        level = inner
    assert depth <= DEPTH
    found = np.concatenate(found).ravel()
    found = np.sort(found[found != NO_CHILD])
    np.testing.assert_array_equal(found, np.arange(scene.num_triangles))
    return depth


@pytest.mark.parametrize("count", SIZES)
def test_each_triangle_is_in_one_leaf_and_boxes_are_tight(session, rng, builder, count):
    scene = triangle_soup(rng, count, size=0.1)
    check(tree_of(session, scene, builder), scene)


def test_many_triangles_take_finer_cells(session, rng, monkeypatch):
    """Of a cluster as wide as 1/512 of the scene keys of 8 bits an axis tell nothing apart."""
    middles = 0.501 + rng.random((3001, 1, 3)) / 512
    middles[:2] = np.float32([[[0, 0, 0]], [[1, 1, 1]]])
    scene = scene_of(middles + 1e-6 * rng.normal(size=(3001, 3, 3)))
    keys = []
    for most in (3001, 3000):
        monkeypatch.setattr(tree_module, "_MANY_TRIANGLES", most)
        tree = tree_of(session, scene, "fast")
        check(tree, scene)
        keys.append(len(np.unique(tree._builder._pairs[0].get()[:3001])))
    assert keys[0] == 3 and keys[1] > 3


DEGENERATE = {
    "one point": lambda rng: np.full((3001, 3, 3), 0.25),
    "duplicates": lambda rng: np.tile(rng.random((1, 3, 3)), (4099, 1, 1)),
    "flat": lambda rng: rng.random((3001, 3, 3)) * (1, 1, 0),
    "on a line": lambda rng: rng.random((3001, 3, 3)) * (0, 1, 0),
    "one huge": lambda rng: np.concatenate([
        1e-3 * rng.random((3000, 3, 3)), 1e6 * rng.normal(size=(1, 3, 3))
    ]),
    "growing": lambda rng: 1.02 ** np.arange(3000)[:, None, None] * rng.normal(size=(3000, 3, 3)),
    "at the end of float": lambda rng: 3e38 * (2 * rng.random((999, 3, 3)) - 1),
    "tiny": lambda rng: 1e-42 * rng.random((999, 3, 3)),
}  # fmt: skip


@pytest.mark.parametrize("name", DEGENERATE)
def test_degenerate_scenes(session, rng, builder, name):
    scene = scene_of(DEGENERATE[name](rng))
    check(tree_of(session, scene, builder), scene)


@pytest.fixture
def with_line(monkeypatch):
    """A function that replaces a line of cl/subtree.h and gives a session that takes it."""
    expand = program.expand

    def replace(old, new):
        def changed(name):
            assert name != "sah.cl" or expand(name).count(old) == 1
            return expand(name).replace(old, new)

        monkeypatch.setattr(program, "expand", changed)
        return device.Session(device.default_device())

    return replace


def test_depth_is_bounded(session, with_line, rng):
    growing = 1.1 ** np.arange(300)[:, None, None] * rng.normal(size=(300, 3, 3))
    scene = scene_of(growing)
    assert check(tree_of(session, scene, "quality"), scene) > 5
    # 4^3 packed leaves hold 320 triangles at least.
    bounded = with_line("#define TASK_LEVELS 14", "#define TASK_LEVELS 3")
    assert check(tree_of(bounded, scene, "quality"), scene) <= 3


def test_splits_that_need_more_leaves_than_there_are_are_not_made(session, rng):
    """Eight triangles side by side and three on their own: two leaves, or by surface area three."""
    near, far = rng.normal(size=(2, 200, 8, 1, 3))
    far = 5 * far[:, :3] / np.linalg.norm(far[:, :3], axis=-1, keepdims=True)
    places = np.concatenate([1e-3 * near, np.arange(1, 4)[:, None, None] * far], axis=1)
    places += 100 * np.arange(200)[:, None, None, None] * (1, 0, 0)
    corners = places + 1e-3 * rng.normal(size=(200, 11, 3, 3))
    scene = scene_of(corners.reshape(-1, 3, 3) * (1, 3, 3))
    tree = tree_of(session, scene, "quality")
    check(tree, scene)
    assert len(reachable(tree)[1]) > scene.num_triangles // 4


def test_an_empty_scene_has_a_root_without_children(session, builder):
    tree = tree_of(session, scene_of(np.empty((0, 3, 3))), builder)
    boxes, children, *_ = boxes_and_numbers(tree)
    assert (children[0] == NO_CHILD).all() and (boxes[0, :, 0] > boxes[0, :, 1]).all()


def arrays(tree):
    return tree.nodes.get().view(np.uint32), tree.leaves.get().view(np.uint32)


def reachable(tree):
    """The arrays without nodes and leaves that no parent names: these mean nothing."""
    _, children, *_ = boxes_and_numbers(tree)
    level, nodes, leaves = np.array([0]), [], []
    while len(level):
        nodes.append(level)
        child = children[level]
        child = child[child != NO_CHILD]
        leaves.append(child[(child & LEAF) != 0] & ~np.uint32(LEAF))
        level = child[(child & LEAF) == 0]
    at = np.sort(np.concatenate(nodes)), np.sort(np.concatenate(leaves).astype(np.int64))
    return [array[rows] for array, rows in zip(arrays(tree), at, strict=True)]


def assert_same_tree(first, second):
    for a, b in zip(reachable(first), reachable(second), strict=True):
        np.testing.assert_array_equal(a, b)


def test_a_second_build_gives_the_same_tree(session, rng, builder):
    scene = triangle_soup(rng, 20011, size=0.1)
    tree = tree_of(session, scene, builder)
    before = reachable(tree)
    tree.build()
    for a, b in zip(before, reachable(tree), strict=True):
        np.testing.assert_array_equal(a, b)


def test_new_vertices_give_the_tree_of_a_new_scene(session, rng, builder):
    scene, moved = triangle_soup(rng, 3001), triangle_soup(rng, 3001)
    geometry = Geometry(session, scene)
    tree = SceneTree(session, geometry, builder)
    tree.build()
    geometry.update(moved.vertices)
    tree.build()
    check(tree, moved)
    assert_same_tree(tree, tree_of(session, moved, builder))


def moved(rng, scene, share):
    """The scene with every vertex moved by up to a share of its size."""
    vertices = scene.vertices + share * np.ptp(scene.vertices) * rng.random(scene.vertices.shape)
    return rs.Scene([rs.Mesh(vertices.astype(np.float32), scene.faces, name="moved")])


@pytest.mark.parametrize("count", SIZES)
def test_a_refitted_tree_holds_the_triangles_where_they_are(session, rng, count):
    scene = triangle_soup(rng, count, size=0.1)
    tree = tree_of(session, scene, "quality")
    for share in (0.0, 1e-3, 1.0):
        after = moved(rng, scene, share)
        tree.geometry.update(after.vertices)
        worse = tree.refit()
        check(tree, after)
        if count > 100:
            assert worse == pytest.approx(1, rel=0.03) if share < 1 else worse > 1.5


def test_a_vertex_that_flies_off_does_not_hide_that_a_tree_fits_no_more(session, rng):
    scene = triangle_soup(rng, 5003, size=0.1)
    tree = tree_of(session, scene, "quality")
    vertices = rng.permutation(scene.vertices.reshape(-1, 3, 3)).reshape(-1, 3)
    vertices[0] = 1000
    tree.geometry.update(vertices)
    assert tree.refit() > 1.5


def test_a_refit_where_nothing_has_moved_changes_nothing(session, rng):
    tree = tree_of(session, triangle_soup(rng, 20011, size=0.1), "quality")
    before = reachable(tree)
    assert tree.refit() == pytest.approx(1, rel=1e-4)
    for a, b in zip(before, reachable(tree), strict=True):
        np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize("name", DEGENERATE)
def test_degenerate_scenes_are_refitted(session, rng, name):
    scene = scene_of(DEGENERATE[name](rng))
    tree = tree_of(session, scene, "quality")
    shuffled = scene_of(rng.permutation(scene.vertices[scene.faces]))
    tree.geometry.update(shuffled.vertices)
    tree.refit()
    check(tree, shuffled)


def test_the_portable_path_gives_the_same_tree(session, rng, builder, monkeypatch):
    scene = triangle_soup(rng, 5003, size=0.1)
    expected = tree_of(session, scene, builder)
    monkeypatch.setattr(program, "_OPTIONS", (*program._OPTIONS, "-DPORTABLE"))
    monkeypatch.setattr(device, "_thread", type(device._thread)())
    assert_same_tree(tree_of(device.session(), scene, builder), expected)


def test_too_little_memory_is_refused_with_what_is_needed(session, rng, builder):
    scene = triangle_soup(rng, 1009)
    needed = tree_of(session, scene, builder).structure_bytes
    tree_of(session, scene, builder, memory_limit=needed)
    with pytest.raises(MemoryLimitError, match=f"1009 triangles need {needed} bytes"):
        tree_of(session, scene, builder, memory_limit=needed - 1)


def test_unknown_builders_are_refused(session, rng):
    with pytest.raises(ValueError, match="builder: need one of 'fast', 'quality'"):
        SceneTree(session, Geometry(session, triangle_soup(rng, 9)), "best")
