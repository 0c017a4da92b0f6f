"""The builders of the scene hierarchy: time, surface area cost, nodes and leaves that rays visit.

Usage: RAYSTREAM_SCENES=folder python tests/bench/bench_tree.py [name ...]

Builders take turns with each other and with Embree's build through embreex, which copies the
triangles and is of Embree's medium quality; "refit" fits the better tree to the same triangles
once more. Rays: random ones through the scene, and reflections of
a view of it about the normals of the triangles seen.
"""

import os
import pathlib
import sys
import time

import numba
import numpy as np
import trimesh
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene

from raystream import device
from raystream.camera import Camera
from raystream.geometry import Geometry
from raystream.tracer import as_scene
from raystream.tree import BUILDERS, SceneTree

REPEATS = 7
RAYS = 20_000
LEAF, NO_CHILD = np.uint32(1 << 31), np.uint32(0xFFFFFFFF)  # cl/tree.h


def from_file(name):
    path = pathlib.Path(os.environ["RAYSTREAM_SCENES"], name)
    return as_scene(trimesh.load(path, process=False, force="mesh"))


def soup(count):
    rng = np.random.default_rng(0)
    size = 0.3 * count ** (-1 / 3)
    corners = rng.random((count, 1, 3)) + size * rng.normal(size=(count, 3, 3))
    faces = np.arange(3 * count).reshape(-1, 3)
    return as_scene(trimesh.Trimesh(corners.reshape(-1, 3), faces, process=False))


SCENES = {
    "bunny": lambda: from_file("bunny/bunny-69451.ply"),
    "conference": lambda: from_file("conference/conference-331179.ply"),
    "dragon": lambda: from_file("dragon/dragon-871414.ply"),
    "soup": lambda: soup(5_000_000),
}


@numba.njit(error_model="numpy")
def hit_distance(corners, lane, org, dir_, tfar):
    """Moeller and Trumbore (1997); `tfar` where there is no hit nearer."""
    e1 = corners[3:6, lane] - corners[0:3, lane]
    e2 = corners[6:9, lane] - corners[0:3, lane]
    p = np.cross(dir_, e2)
    det = np.dot(e1, p)
    s = org - corners[0:3, lane]
    q = np.cross(s, e1)
    u, v, t = np.dot(s, p) / det, np.dot(dir_, q) / det, np.dot(e2, q) / det
    return t if u >= 0 and v >= 0 and u + v <= 1 and 0 < t < tfar else tfar


@numba.njit(error_model="numpy")
def count_visits(nodes, children, leaves, org, dir_):
    """Distance of each ray's closest hit, and nodes and leaves visited, nearest children first."""
    distances = np.full(len(org), np.inf)
    visits = np.zeros(2, np.int64)
    stack, entries = np.empty(200, np.uint32), np.empty(200)
    for ray in range(len(org)):
        o, d = org[ray], dir_[ray]
        tfar, top = np.inf, 1
        stack[0], entries[0] = 0, 0.0
        while top > 0:
            top -= 1
            if entries[top] >= tfar:
                continue
            at = stack[top]
            if at & LEAF:
                visits[1] += 1
                for lane in range(8):
                    tfar = hit_distance(leaves[at & ~LEAF], lane, o, d, tfar)
                continue
            visits[0] += 1
            first = top
            for lane in range(8):
                if children[at, lane] == NO_CHILD:
                    continue
                near, far = 0.0, tfar
                for axis in range(3):
                    a = (nodes[at, axis, lane] - o[axis]) / d[axis]
                    b = (nodes[at, 3 + axis, lane] - o[axis]) / d[axis]
                    near, far = max(near, min(a, b)), min(far, max(a, b))
                if near > far * (1 + 1e-6):
                    continue
                k = top
                while k > first and entries[k - 1] < near:
                    stack[k], entries[k] = stack[k - 1], entries[k - 1]
                    k -= 1
                stack[k], entries[k] = children[at, lane], near
                top += 1
        distances[ray] = tfar
    return distances, visits


def half_area(low, high):
    e = high.astype(np.float64) - low
    return e[..., 0] * e[..., 1] + e[..., 1] * e[..., 2] + e[..., 2] * e[..., 0]


class Shape:
    """A tree read from the device."""

    def __init__(self, tree):
        self.nodes = tree.nodes.get()
        self.children = np.ascontiguousarray(self.nodes[:, 6]).view(np.uint32)
        self.leaves = tree.leaves.get().astype(np.float64)
        self.boxes = self.nodes[:, :6].reshape(-1, 2, 3, 8).transpose(0, 3, 1, 2)

    def cost(self):
        """Nodes and leaves that a random line through the root's box is expected to visit."""
        level, root, nodes, leaves = np.array([0]), None, 1.0, 0.0
        while len(level):
            node, lane = np.nonzero(self.children[level] != NO_CHILD)
            child, box = self.children[level[node], lane], self.boxes[level[node], lane]
            if root is None:
                root = half_area(box[:, 0].min(axis=0), box[:, 1].max(axis=0))
            area, is_leaf = half_area(box[:, 0], box[:, 1]) / root, (child & LEAF) != 0
            nodes, leaves = nodes + area[~is_leaf].sum(), leaves + area[is_leaf].sum()
            level = child[~is_leaf]
        return nodes, leaves

    def visits(self, org, dir_):
        distances, visits = count_visits(self.nodes, self.children, self.leaves, org, dir_)
        return distances, visits / len(org)


def random_rays(scene):
    rng = np.random.default_rng(1)
    low, high = scene.vertices.min(axis=0), scene.vertices.max(axis=0)
    org = low + (high - low) * rng.random((RAYS, 3))
    return org.astype(np.float64), rng.normal(size=(RAYS, 3))


def mirror_rays(scene, embree):
    low, high = scene.vertices.min(axis=0), scene.vertices.max(axis=0)
    side = int(RAYS**0.5)
    org, dir_ = Camera.fit([low, high]).rays((side, side))
    seen = embree.run(np.float32(org), np.float32(dir_), output=1)
    hit = seen["primID"] >= 0
    a, b, c = scene.vertices[scene.faces[seen["primID"][hit]]].transpose(1, 0, 2)
    n = np.cross(b - a, c - a).astype(np.float64)
    solid = (n != 0).any(axis=1)
    n = n[solid] / np.linalg.norm(n[solid], axis=1)[:, None]
    d = np.float64(dir_)[hit][solid]
    p = np.float64(org)[hit][solid] + d * seen["tfar"][hit][solid, None]
    d -= 2 * (d * n).sum(axis=1)[:, None] * n
    return p + 1e-4 * np.linalg.norm(high - low) * d / np.linalg.norm(d, axis=1)[:, None], d


def build_embree(corners):
    scene = EmbreeScene(robust=True)
    TriangleMesh(scene, corners)
    scene.run(np.zeros((1, 3), np.float32), np.ones((1, 3), np.float32), output=1)
    return scene


def seconds(function):
    begin = time.perf_counter()
    result = function()
    return time.perf_counter() - begin, result


def compare(name, session):
    scene = SCENES[name]()
    geometry = Geometry(session, scene)
    trees = {builder: SceneTree(session, geometry, builder) for builder in BUILDERS}
    corners = np.ascontiguousarray(scene.vertices[scene.faces])

    def build(tree):
        tree.build()
        session.finish()

    best = dict.fromkeys((*BUILDERS, "refit", "embree"), np.inf)
    for _ in range(REPEATS):
        for builder, tree in trees.items():
            build(tree)  # as in a loop over frames: awake, without Embree's data in the caches
            best[builder] = min(best[builder], seconds(lambda tree=tree: build(tree))[0])
        took, _ = seconds(trees["quality"].refit)
        best["refit"] = min(best["refit"], took)
        took, embree = seconds(lambda: build_embree(corners))
        best["embree"] = min(best["embree"], took)
    count = scene.num_triangles
    print(f"{name}: {count} triangles")
    for way in ("embree", "refit"):
        print(f"  {way:8} {1e3 * best[way]:7.1f} ms  {count / best[way] / 1e6:5.1f} M/s")
    rays = {"random": random_rays(scene), "mirror": mirror_rays(scene, embree)}
    found = {}
    for builder, tree in trees.items():
        shape = Shape(tree)
        text = "cost {:.1f} + {:.1f}".format(*shape.cost())
        for kind, (org, dir_) in rays.items():
            distances, visits = shape.visits(org, dir_)
            text += ", {} {:.1f} + {:.1f}".format(kind, *visits)
            # Triangles in one plane differ in the last bit, and the first one met is kept.
            np.testing.assert_allclose(found.setdefault(kind, distances), distances, rtol=1e-12)
        rate = count / best[builder] / 1e6
        print(f"  {builder:8} {1e3 * best[builder]:7.1f} ms  {rate:5.1f} M/s  {text}", flush=True)


def main(names):
    session = device.session()
    for name in names or SCENES:
        compare(name, session)


if __name__ == "__main__":
    main(sys.argv[1:])
