"""PacketTracer: the oracle's hits, and the counts of the paper's loops written out ray by ray."""

import collections
import dataclasses
import functools
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from raystream.baselines import BruteForceTracer, EmbreeTracer, render_reference
from raystream.baselines.packet import (
    PACKET_SIZES,
    TRAVERSALS,
    PacketStatistics,
    PacketTracer,
    render_packets,
)
from raystream.baselines.tolerance import differing, differing_occlusion

SIZE = (29, 18)  # no multiple of any packet but the smallest
EYE, LIGHT = np.array([0.3, 0.4, 3.0]), np.array([2.0, 3.0, 2.5])
FIELDS = ("t", "prim_id", "geom_id", "u", "v")


def wavy_ball(rings=9, sectors=12):
    """Vertices, faces and normals of a curved closed mesh."""
    polar, turn = np.meshgrid(
        np.linspace(0, np.pi, rings + 1), np.linspace(0, 2 * np.pi, sectors + 1), indexing="ij"
    )
    unit = np.stack([np.sin(polar) * np.cos(turn), np.cos(polar), np.sin(polar) * np.sin(turn)], -1)
    points = unit * (1 + 0.1 * np.sin(5 * turn) * np.sin(polar))[..., None]
    corner = (np.arange(rings)[:, None] * (sectors + 1) + np.arange(sectors)).ravel()
    faces = np.concatenate(
        [corner[:, None] + [0, 1, sectors + 2], corner[:, None] + [0, sectors + 2, sectors + 1]]
    )
    return points.reshape(-1, 3), faces, unit.reshape(-1, 3)


@functools.cache
def scene():
    """A wavy ball over a floor of random triangles, two meshes."""
    vertices, faces, _ = wavy_ball()
    rng = np.random.default_rng(11)
    floor = rng.uniform(-3, 3, (80, 1, 3)) + 0.4 * rng.normal(size=(80, 3, 3))
    floor[..., 1] = 0.1 * floor[..., 1] - 1.4
    faces = np.concatenate([faces, len(vertices) + np.arange(240).reshape(-1, 3)])
    vertices = np.concatenate([vertices, floor.reshape(-1, 3)]).astype(np.float32)
    return vertices, faces, np.array([0, len(faces) - 80, len(faces)])


def camera_rays(size=SIZE, eye=EYE):
    width, height = size
    x = (2 * (np.arange(width) + 0.5) / width - 1) * width / height
    y = 1 - 2 * (np.arange(height) + 0.5) / height
    directions = np.stack(np.broadcast_arrays(0.6 * x, 0.6 * y[:, None], -1.0), axis=-1)
    directions = directions.reshape(-1, 3).astype(np.float32)
    return np.tile(np.float32(eye), (len(directions), 1)), directions


@functools.cache
def rays_of(kind):
    """Origins, directions and keywords of intersect for one kind of ray."""
    origins, directions = camera_rays()
    if kind == "primary":
        return origins, directions, {"size": SIZE}
    if kind == "primary in order":
        return origins, directions, {}
    if kind == "soup":
        rng = np.random.default_rng(5)
        lengths = 10.0 ** rng.uniform(-3, 3, (300, 1))
        tnear, length = rng.random(300) / lengths[:, 0], rng.uniform(-0.2, 4, 300) / lengths[:, 0]
        origins, directions = rng.uniform(-2, 2, (300, 3)), lengths * rng.normal(size=(300, 3))
        directions[::50], directions[1::7, 1] = 0, 0
        return origins, directions, {"tnear": tnear, "tfar": tnear + length}
    hits = BruteForceTracer(*scene()).intersect(origins, directions)
    pixels = np.flatnonzero(hits.geom_id == 0)
    points = origins[pixels] + hits.t[pixels, None] * directions[pixels].astype(np.float64)
    normals = points / np.linalg.norm(points, axis=1, keepdims=True)
    points += 1e-4 * normals
    keywords = {"size": SIZE, "pixels": pixels}
    if kind == "shadow":
        return np.tile(LIGHT, (len(points), 1)), points - LIGHT, {**keywords, "tfar": 1.0}
    if kind == "parallel":
        return points, np.tile([0.3, 1.0, 0.2], (len(points), 1)), keywords
    into = directions[pixels]
    return points, into - 2 * (into * normals).sum(axis=1, keepdims=True) * normals, keywords


KINDS = ("primary", "primary in order", "shadow", "reflection", "parallel", "soup")


@functools.cache
def exact(kind):
    origins, directions, keywords = rays_of(kind)
    limits = {name: keywords[name] for name in ("tnear", "tfar") if name in keywords}
    return BruteForceTracer(*scene()).intersect(origins, directions, **limits)


@functools.cache
def traced(kind, traversal="partition", packet_size=16, culling=True):
    """Hits, what was occluded, and the statistics of both."""
    options = {"traversal": traversal, "packet_size": packet_size, "frustum_culling": culling}
    tracer = PacketTracer(*scene(), **options)
    origins, directions, keywords = rays_of(kind)
    hits = tracer.intersect(origins, directions, **keywords)
    counts = tracer.statistics
    blocked = tracer.occluded(origins, directions, **{"tfar": np.inf, **keywords})
    return hits, blocked, counts, tracer.statistics


def assert_same_counts(ours, theirs, without=()):
    for field in dataclasses.fields(PacketStatistics):
        if field.name not in without:
            np.testing.assert_array_equal(
                getattr(ours, field.name), getattr(theirs, field.name), err_msg=field.name
            )


@pytest.mark.parametrize("culling", [True, False])
@pytest.mark.parametrize("packet_size", PACKET_SIZES)
@pytest.mark.parametrize("traversal", TRAVERSALS)
@pytest.mark.parametrize("kind", KINDS)
def test_the_oracles_hits(kind, traversal, packet_size, culling):
    hits, blocked, counts, _ = traced(kind, traversal, packet_size, culling)
    for name in FIELDS:
        np.testing.assert_array_equal(getattr(hits, name), getattr(exact(kind), name), name)
    np.testing.assert_array_equal(blocked, exact(kind).prim_id >= 0)
    assert counts.hits == blocked.sum()


@pytest.mark.parametrize("kind", KINDS)
def test_embrees_hits(kind):
    origins, directions, keywords = rays_of(kind)
    limits = [keywords.get("tnear", 0.0), keywords.get("tfar", np.inf)]
    embree = EmbreeTracer(*scene())
    hits, blocked, _, _ = traced(kind)
    reference = embree.intersect(origins, directions, *limits)
    agreement = differing(hits, reference, *scene(), origins, directions, *limits)
    assert agreement.num_wrong == 0 and (reference.prim_id >= 0).sum() > 10
    reference = embree.occluded(origins, directions, *limits)
    agreement = differing_occlusion(blocked, reference, *scene(), origins, directions, *limits)
    assert agreement.num_wrong == 0


def scalar_traversal(tracer, lanes, rays, any_hit):
    """The paper's loops for one packet without frustum: figure 2 and the appendix, mended.

    `lanes` are the packet's SIMD rays, lists of ray indices; `rays` origins, directions, tnear,
    tfar. Returns Counter of (name, depth).
    """
    bvh, size = tracer.bvh, len(lanes)
    corners = tracer.triangles.corners()
    brute = [BruteForceTracer(*_alone(corners[face])) for face in range(len(corners))]
    origins, directions, tnear, tfar = (np.array(a, np.float64) for a in rays)
    best = {ray: (np.float32(np.inf), -1) for simd in lanes for ray in simd}
    counts = collections.Counter()

    def meets(i, cell):
        """rayIntersectsAABB for SIMD ray i."""
        for ray in lanes[i]:
            closest, face = best[ray]
            limit = tfar[ray] if face < 0 else np.nextafter(closest, np.float32(np.inf))
            enter, leave = tnear[ray], -np.inf if any_hit and face >= 0 else limit
            for axis in range(3):
                o, d = origins[ray, axis], directions[ray, axis]
                ends = np.array([bvh.low[cell, axis] - 1e-11, bvh.high[cell, axis] + 1e-11]) - o
                if d == 0:
                    if not ends[0] <= 0 <= ends[1]:
                        enter = np.inf
                    continue
                enter, leave = max(enter, (ends / d).min()), min(leave, (ends / d).max())
            if enter <= leave:
                return True
        return False

    def tested(i, cell):
        counts["box_tests", bvh.depth[cell]] += 1
        return meets(i, cell)

    def get_first_hit(cell, ia):
        for i in range(ia, size):
            if tested(i, cell):
                return i
        return size

    def get_last_hit(cell, ia):
        for ie in range(size - 1, ia, -1):
            if tested(ie, cell):
                return ie + 1
        return ia + 1

    def part_rays(cell, indices, ia):
        ie = 0
        for i in range(ia):
            if tested(indices[i], cell):
                indices[ie], indices[i] = indices[i], indices[ie]
                ie += 1
        return ie

    def intersect_triangles(active, cell):
        depth = bvh.depth[cell]
        counts["leaves", depth] += 1
        counts["active", depth] += len(active)
        counts["alive", depth] += sum(meets(i, cell) for i in active)
        for face in bvh.order[bvh.first[cell] : bvh.first[cell] + bvh.count[cell]]:
            for i in active:
                counts["triangle_tests", depth] += 1
                for ray in lanes[i]:
                    one = (values[ray : ray + 1] for values in (origins, directions, tnear, tfar))
                    hit = brute[face].intersect(*one)
                    if hit.prim_id[0] >= 0:
                        known = best[ray]
                        closer = known[1] < 0 or (hit.t[0], face) < known
                        best[ray] = (hit.t[0], face) if closer else known

    total = sum(directions[ray] for simd in lanes for ray in simd)
    indices = list(range(size))
    cell, stack = 0, []
    ia = size if tracer.traversal == "partition" else 0
    while True:
        inner = bvh.left[cell] >= 0
        counts["visits", bvh.depth[cell]] += 1
        if tracer.traversal == "masked":
            if inner:
                reached = get_first_hit(cell, 0) < size
            else:
                active = [i for i in range(size) if tested(i, cell)]
                reached = bool(active)
        elif tracer.traversal == "ranged":
            ia = get_first_hit(cell, ia)
            reached = ia < size
            if reached and not inner:
                active = list(range(ia, get_last_hit(cell, ia)))
        else:
            ia = part_rays(cell, indices, ia)
            reached = ia > 0
            active = indices[:ia]
        if reached and inner:
            left = int(bvh.left[cell])
            backward = total[bvh.axis[cell]] < 0
            stack.append((left if backward else left + 1, ia))
            cell = left + 1 if backward else left
            continue
        if reached:
            intersect_triangles(active, cell)
        all_blocked = all(best[ray][1] >= 0 for ray in best)
        if not stack or (any_hit and reached and all_blocked):
            return counts
        cell, ia = stack.pop()


def _alone(corners):
    return corners, np.array([[0, 1, 2]])


@pytest.mark.parametrize("any_hit", [False, True])
@pytest.mark.parametrize("traversal", TRAVERSALS)
@pytest.mark.parametrize("kind", ["primary", "shadow", "soup", "blocked"])
def test_counts_of_the_papers_loops(kind, traversal, any_hit):
    rng = np.random.default_rng(8)
    centres = rng.uniform(-1, 1, (24, 1, 3))
    vertices = (centres + 0.4 * rng.normal(size=(24, 3, 3))).reshape(-1, 3)
    if kind == "blocked":  # all rays by one triangle, with more of the tree behind
        vertices = np.concatenate([vertices, [[-50, -50, 0], [50, -50, 0], [0, 80, 0]]])
    faces = np.arange(len(vertices)).reshape(-1, 3)
    size, packet_size = (6, 5), 4
    origins, directions = camera_rays(size)
    tnear, tfar = np.zeros(30, np.float32), np.full(30, np.inf, np.float32)
    if kind == "shadow":
        origins, directions = np.tile(np.float32(LIGHT), (30, 1)), origins + directions * 3 - LIGHT
    if kind == "soup":
        origins, directions = rng.uniform(-2, 2, (30, 3)), rng.normal(size=(30, 3))
        tnear, tfar = (limits.astype(np.float32) for limits in rng.uniform(0, 2, (2, 30)))
    rays = origins.astype(np.float32), directions.astype(np.float32), tnear, tfar
    tracer = PacketTracer(
        vertices, faces, traversal=traversal, packet_size=packet_size, frustum_culling=False
    )
    (tracer.occluded if any_hit else tracer.intersect)(*rays, size=size)
    expected = collections.Counter()
    for tile_y in range(0, 5, packet_size):
        for tile_x in range(0, 6, packet_size):
            expected += scalar_traversal(tracer, _tile(tile_x, tile_y, size, rays), rays, any_hit)
    for name in ("visits", "box_tests", "triangle_tests", "leaves", "active", "alive"):
        counted = getattr(tracer.statistics, name + "_by_depth").tolist()
        assert counted == [expected[name, depth] for depth in range(len(counted))], name
    assert tracer.statistics.total_tests == sum(
        expected[name, depth] for depth in range(50) for name in ("box_tests", "triangle_tests")
    )


def _tile(tile_x, tile_y, size, rays):
    """Rays of the SIMD rays of one 4 x 4 tile, row by row, those without a ray left out."""
    lanes = []
    for y in (tile_y, tile_y + 2):
        for x in (tile_x, tile_x + 2):
            pixels = [(x + k % 2, y + k // 2) for k in range(4)]
            inside = [j * size[0] + i for i, j in pixels if i < size[0] and j < size[1]]
            lanes.append([ray for ray in inside if rays[3][ray] >= rays[2][ray]])
    return [simd for simd in lanes if simd]


@pytest.mark.parametrize("precision", ["double", "single"])
@pytest.mark.parametrize("traversal", TRAVERSALS)
@pytest.mark.parametrize("kind", KINDS)
def test_wide_simd_rays(kind, traversal, precision):
    """SIMD rays of 4 x 4: the same hits, and the counts of four times as wide ones."""
    options = {"traversal": traversal, "precision": precision, "packet_size": 8}
    origins, directions, keywords = rays_of(kind)
    wide, narrow = (PacketTracer(*scene(), **options, simd_width=width) for width in (16, 4))
    hits, same = (t.intersect(origins, directions, **keywords) for t in (wide, narrow))
    for name in FIELDS:
        np.testing.assert_array_equal(getattr(hits, name), getattr(same, name), name)
    if precision == "double":
        np.testing.assert_array_equal(hits.t, exact(kind).t)
    ours, theirs = wide.statistics, narrow.statistics
    assert (ours.rays, ours.packets, ours.hits) == (theirs.rays, theirs.packets, theirs.hits)
    np.testing.assert_array_equal(ours.visits_by_depth, theirs.visits_by_depth)
    np.testing.assert_array_equal(ours.leaves_by_depth, theirs.leaves_by_depth)
    assert (ours.alive_by_depth <= theirs.alive_by_depth).all()
    assert (theirs.alive_by_depth <= 4 * ours.alive_by_depth).all()
    assert (ours.box_hits_by_depth <= ours.box_tests_by_depth).all()


@pytest.mark.parametrize("traversal", TRAVERSALS)
def test_frusta_are_asked_where_enough_rays_are_active(traversal):
    origins, directions, keywords = rays_of("primary")
    asked = []
    for least_active in (1, 3, 16, 65):
        tracer = PacketTracer(*scene(), traversal=traversal, least_active=least_active)
        hits = tracer.intersect(origins, directions, **keywords)
        np.testing.assert_array_equal(hits.t, exact("primary").t)
        counts = tracer.statistics
        asked.append(
            int((counts.frustum_box_tests_by_depth + counts.frustum_triangle_tests_by_depth).sum())
        )
    assert asked[0] > asked[1] >= asked[2] > asked[3] == 0


def all_counts(kind, packet_size, culling, query):
    return {name: traced(kind, name, packet_size, culling)[2 + query] for name in TRAVERSALS}


@pytest.mark.parametrize("query", [0, 1], ids=["intersect", "occluded"])
@pytest.mark.parametrize("culling", [True, False])
@pytest.mark.parametrize("packet_size", PACKET_SIZES)
@pytest.mark.parametrize("kind", KINDS)
def test_relations_between_the_traversals(kind, packet_size, culling, query):
    counts = all_counts(kind, packet_size, culling, query)
    masked, ranged, partition = (counts[name] for name in ("masked", "ranged", "partition"))
    for other in (masked, ranged):  # a node is gone through when any ray is alive in it
        np.testing.assert_array_equal(other.visits_by_depth, partition.visits_by_depth)
        np.testing.assert_array_equal(other.leaves_by_depth, partition.leaves_by_depth)
        np.testing.assert_array_equal(other.alive_by_depth, partition.alive_by_depth)
    for exactly_alive in (masked, partition):
        np.testing.assert_array_equal(exactly_alive.active_by_depth, partition.alive_by_depth)
    assert (ranged.active_by_depth >= ranged.alive_by_depth).all()
    assert (ranged.triangle_tests_by_depth >= partition.triangle_tests_by_depth).all()
    np.testing.assert_array_equal(masked.triangle_tests_by_depth, partition.triangle_tests_by_depth)
    assert (ranged.frustum_box_tests_by_depth <= masked.frustum_box_tests_by_depth).all()
    np.testing.assert_array_equal(
        ranged.frustum_box_culls_by_depth, masked.frustum_box_culls_by_depth
    )
    if packet_size == 2:  # one SIMD ray: nothing to tell apart
        assert_same_counts(
            masked, partition, () if not culling else ("frustum_box_tests_by_depth",)
        )
        if not culling:
            assert_same_counts(ranged, partition)
            np.testing.assert_array_equal(masked.box_tests_by_depth, masked.visits_by_depth)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("traversal", TRAVERSALS)
def test_what_culling_changes(kind, traversal):
    for query in (2, 3):
        culled, plain = (traced(kind, traversal, 8, culling)[query] for culling in (True, False))
        for name in ("visits", "leaves", "active", "alive"):
            np.testing.assert_array_equal(
                getattr(culled, name + "_by_depth"), getattr(plain, name + "_by_depth")
            )
        assert (culled.box_tests_by_depth <= plain.box_tests_by_depth).all()
        assert (culled.triangle_tests_by_depth <= plain.triangle_tests_by_depth).all()
        assert plain.frustum_box_tests_by_depth.sum() == 0
        if kind not in ("soup", "primary in order"):
            assert culled.frustum_box_culls_by_depth.sum() > 0
            assert kind == "reflection" or culled.frustum_triangle_culls_by_depth.sum() > 0
            assert culled.box_tests < plain.box_tests


def test_partition_tests_each_alive_ray_against_both_children():
    """Without hits no ray dies but by leaving boxes: the sums can be had from the tree alone."""
    vertices, faces, _ = scene()
    flat = np.stack([faces[:, 0], faces[:, 1], faces[:, 1]], axis=1)  # no area, never hit
    origins, directions = camera_rays()
    alive, leaves = [], []
    for packet_size in PACKET_SIZES:
        tracer = PacketTracer(
            vertices, flat, packet_size=packet_size, traversal="partition", frustum_culling=False
        )
        assert (tracer.intersect(origins, directions, size=SIZE).prim_id < 0).all()
        counts = tracer.statistics
        assert counts.box_tests_by_depth[0] == counts.simd_rays == 15 * 9
        assert (counts.box_tests_by_depth[1:] % 2 == 0).all()
        alive.append(counts.alive_by_depth)
        leaves.append(counts.leaves_by_depth)
        np.testing.assert_array_equal(alive[0], alive[-1])  # whatever the packets
        np.testing.assert_array_equal(counts.box_tests_by_depth[1:].sum() % 2, 0)
        if len(leaves) > 1:  # larger packets reach the same leaves together
            assert (leaves[-1] <= leaves[-2]).all() and leaves[-1].sum() < leaves[-2].sum()


def test_the_papers_findings():
    """Figure 6: Ranged tests fewer boxes for primary, Partition fewer of all for reflections."""
    size = (160, 100)
    origins, directions = camera_rays(size)
    tracers = {
        name: PacketTracer(*scene(), traversal=name, packet_size=8)
        for name in ("ranged", "partition")
    }
    counts = {}
    for name, tracer in tracers.items():
        hits = tracer.intersect(origins, directions, size=size)
        pixels = np.flatnonzero(hits.geom_id == 0)
        points = origins[pixels] + hits.t[pixels, None] * directions[pixels]
        # A rough surface stands for the paper's complex scenes: reflections without coherence.
        normals = points + 0.7 * np.random.default_rng(1).normal(size=points.shape)
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        into = directions[pixels]
        mirrored = into - 2 * (into * normals).sum(axis=1, keepdims=True) * normals
        primary = tracer.statistics
        tracer.intersect(1.001 * points, mirrored, size=size, pixels=pixels)
        counts[name] = primary, tracer.statistics
    (ranged_1, ranged_2), (partition_1, partition_2) = counts["ranged"], counts["partition"]
    assert ranged_1.box_tests < partition_1.box_tests
    assert ranged_2.total_tests > partition_2.total_tests
    assert ranged_2.triangle_tests > 1.5 * partition_2.triangle_tests
    # Ranged's tests are deeper in the tree than Partition's.
    depths = np.arange(len(ranged_2.tests_by_depth))
    for ranged, partition in ((ranged_1, partition_1), (ranged_2, partition_2)):
        mean = [np.average(depths, weights=counts.tests_by_depth) for counts in (ranged, partition)]
        assert mean[0] > mean[1]


def test_sums_and_plain_objects():
    _, _, counts, _ = traced("reflection")
    plain = counts.to_dict()
    assert plain["total_tests"] == sum(plain["tests_by_depth"]) == counts.tests_by_depth.sum()
    assert plain["total_tests"] == plain["box_tests"] + plain["triangle_tests"]
    assert plain["rays"] == len(rays_of("reflection")[0])
    assert plain["triangles"] == len(scene()[1])
    assert all(isinstance(value, (int, list)) for value in plain.values())
    levels = PacketTracer(*scene()).bvh.num_levels
    assert all(len(value) == levels for value in plain.values() if isinstance(value, list))


def test_counts_do_not_change_from_run_to_run_nor_with_chunks(monkeypatch):
    first = traced("reflection")[2]
    assert_same_counts(traced.__wrapped__("reflection")[2], first)
    monkeypatch.setattr("raystream.baselines.packet.SIMD_RAYS_PER_CHUNK", 40)
    monkeypatch.setattr("raystream.baselines.packet.PAIRS_PER_CHUNK", 3)
    again = traced.__wrapped__("reflection")
    assert_same_counts(again[2], first)
    np.testing.assert_array_equal(again[0].t, exact("reflection").t)


def test_rays_that_cannot_hit_are_no_part_of_a_packet():
    origins, directions = camera_rays()
    tfar = np.where(np.arange(len(origins)) % SIZE[0] < 16, np.inf, -1)
    directions[: 16 * SIZE[0]] = 0
    tracer = PacketTracer(*scene(), packet_size=16)
    hits = tracer.intersect(origins, directions, tfar=tfar, size=SIZE)
    counts = tracer.statistics
    assert (counts.rays, counts.simd_rays, counts.packets) == (16 * 2, 8, 1)
    assert (hits.prim_id >= 0).any() and (hits.prim_id[tfar < 0] < 0).all()


@pytest.mark.parametrize(
    ("packet_size", "simd_rays", "packets"), [(2, 135, 135), (8, 135, 12), (32, 135, 1)]
)
def test_groups_on_the_screen(packet_size, simd_rays, packets):
    counts = traced("primary", "masked", packet_size)[2]
    assert (counts.rays, counts.simd_rays, counts.packets) == (522, simd_rays, packets)


def test_groups_in_order():
    counts = traced("primary in order", "masked", 16)[2]
    assert (counts.rays, counts.simd_rays, counts.packets) == (522, 131, 3)


def test_rays_of_one_pixel_are_in_packets_of_their_own():
    origins, directions = (np.repeat(array, 2, axis=0) for array in camera_rays())
    tracer = PacketTracer(*scene(), packet_size=8)
    pixels = np.repeat(np.arange(522), 2)
    hits = tracer.intersect(origins, directions, size=SIZE, pixels=pixels)
    assert (tracer.statistics.simd_rays, tracer.statistics.packets) == (270, 24)
    np.testing.assert_array_equal(hits.t[::2], exact("primary").t)
    np.testing.assert_array_equal(hits.t[1::2], exact("primary").t)


@pytest.mark.parametrize("traversal", TRAVERSALS)
def test_no_rays_and_no_triangles(traversal):
    none, origins = np.zeros((0, 3)), np.zeros((5, 3))
    tracer = PacketTracer(*scene(), traversal=traversal)
    assert len(tracer.intersect(none, none)) == 0
    assert tracer.occluded(none, none, size=(0, 0)).shape == (0,)
    assert tracer.intersect(origins, origins).prim_id.tolist() == [-1] * 5
    for vertices in (none, np.eye(3)):
        tracer = PacketTracer(vertices, np.zeros((0, 3), int), traversal=traversal)
        assert tracer.intersect(origins, origins + 1).prim_id.tolist() == [-1] * 5
        assert tracer.statistics.tests_by_depth.shape == (0,)
        assert tracer.statistics.rays == 5


def test_update_vertices():
    tracer = PacketTracer(*scene())
    origins, directions, keywords = rays_of("primary")
    tracer.update_vertices(scene()[0] + np.float32([0, 0, 0.5]))
    hits = tracer.intersect(origins + np.float32([0, 0, 0.5]), directions, **keywords)
    np.testing.assert_array_equal(hits.prim_id >= 0, exact("primary").prim_id >= 0)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"traversal": "sorted"}, "traversal: need one of masked, ranged, partition"),
        ({"packet_size": 3}, "packet_size: need one of"),
        ({"packet_size": "16"}, "packet_size: need one of"),
        ({"simd_width": 8}, "simd_width: need one of"),
        ({"simd_width": 16, "packet_size": 2}, "simd_width: need one of"),
        ({"precision": "half"}, "precision: need one of double, single"),
    ],
)
def test_refused_options(change, message):
    with pytest.raises(ValueError, match=message):
        PacketTracer(*scene(), **change)


@pytest.mark.parametrize(
    ("keywords", "message"),
    [
        ({"size": (4, 4)}, "size: 4 x 4 pixels but 522 rays"),
        ({"pixels": np.arange(522)}, "pixels: need size"),
        ({"size": SIZE, "pixels": np.arange(3)}, "pixels: need 522 integers"),
        ({"size": SIZE, "pixels": np.arange(522.0)}, "pixels: need 522 integers"),
        ({"size": SIZE, "pixels": np.arange(1, 523)}, "pixels: need values from 0 to 521"),
        ({"size": SIZE, "tnear": -1}, "tnear"),
    ],
)
def test_refused_rays(keywords, message):
    with pytest.raises(ValueError, match=message):
        PacketTracer(*scene()).intersect(*camera_rays(), **keywords)


@pytest.mark.parametrize("order", [[0, 1, 2, 3], [3, 1, 0, 2], [2, 3, 1, 0]])
def test_equal_distances_go_to_the_smaller_ids(order):
    faces = np.array([[0, 1, 2], [1, 2, 0], [2, 0, 1], [0, 2, 1]])[order]
    faces = np.concatenate([faces] * 10)
    tracer = PacketTracer(np.eye(3), faces, first_prims=[0, 0, 3, 40])
    hits = tracer.intersect([[0, 0, 0]], [[1, 2, 3]])
    assert (hits.geom_id, hits.prim_id) == ([1], [0])


@pytest.mark.parametrize("traversal", TRAVERSALS)
def test_distances_equal_in_float32_are_ties_between_leaves(traversal):
    """Both layers are hit at 2**24 in float32; the farther one has the smaller faces."""
    layers = np.repeat([0.5, 0.25], 10)
    vertices = np.tile([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]], (20, 1))
    vertices[:, 2] = layers.repeat(3)
    tracer = PacketTracer(vertices, np.arange(60).reshape(-1, 3), traversal=traversal)
    assert tracer.bvh.count[1:3].tolist() == [10, 10]
    hits = tracer.intersect([[0.25, 0.25, -(2.0**24)]], [[0, 0, 1]])
    assert (hits.t, hits.prim_id) == ([2.0**24], [0])


@pytest.mark.parametrize("traversal", TRAVERSALS)
@pytest.mark.parametrize("length", [1e-44, 1e-20, 1e38])
@pytest.mark.parametrize("scale", [1e-40, 1e-20, 1e20, 3e37])
def test_any_float32_scale(scale, length, traversal):
    rng = np.random.default_rng(2)
    vertices = (scale * (rng.normal(size=(90, 3)) + 1)).astype(np.float32)
    faces = np.arange(90).reshape(-1, 3)
    origins = (scale * rng.normal(size=(64, 3))).astype(np.float32)
    directions = (length * (0.3 * rng.normal(size=(64, 3)) + 1)).astype(np.float32)
    tracer = PacketTracer(vertices, faces, traversal=traversal, packet_size=8)
    hits = tracer.intersect(origins, directions, size=(8, 8))
    with np.errstate(over="ignore"):  # distances beyond float32
        reference = BruteForceTracer(vertices, faces).intersect(origins, directions)
    assert (hits.prim_id >= 0).sum() > 10
    for name in FIELDS:
        np.testing.assert_array_equal(getattr(hits, name), getattr(reference, name))


@st.composite
def packets_and_triangles(draw):
    """A packet of some kind and triangles around its rays, on a coarse grid or not."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    count = draw(st.sampled_from([1, 4, 15, 16, 64, 70]))
    kind = draw(st.sampled_from(["point", "near", "anywhere"]))
    spread = draw(st.sampled_from([0.0, 0.05, 0.5, 2.0]))
    scale = draw(st.sampled_from([1e-3, 1.0, 1e4]))
    origins = {"point": 0.0, "near": 0.2, "anywhere": 2.0}[kind] * rng.normal(size=(count, 3))
    origins += rng.normal(size=3)
    directions = rng.normal(size=3) + spread * rng.normal(size=(count, 3))
    centres = origins[rng.integers(count, size=30)]
    centres = centres + directions[rng.integers(count, size=30)] * rng.uniform(-1, 3, (30, 1))
    corners = centres[:, None] + rng.choice([0.05, 0.4]) * rng.normal(size=(30, 3, 3))
    if draw(st.booleans()):
        origins, directions, corners = (np.round(4 * a) / 4 for a in (origins, directions, corners))
    if draw(st.booleans()):
        directions[:, draw(st.integers(0, 2))] = 0
    return scale * corners.reshape(-1, 3), scale * origins, directions


@settings(max_examples=40, deadline=None)
@given(packets_and_triangles())
def test_culling_changes_no_hit(case):
    vertices, origins, directions = case
    faces = np.arange(len(vertices)).reshape(-1, 3)
    rays = origins.astype(np.float32), directions.astype(np.float32)
    exact_hits = BruteForceTracer(vertices, faces).intersect(*rays)
    for traversal in TRAVERSALS:
        culling, plain = (
            PacketTracer(vertices, faces, traversal=traversal, frustum_culling=on)
            for on in (True, False)
        )
        culled_hits, plain_hits = (tracer.intersect(*rays) for tracer in (culling, plain))
        for name in FIELDS:
            np.testing.assert_array_equal(getattr(culled_hits, name), getattr(plain_hits, name))
        np.testing.assert_array_equal(plain_hits.t, exact_hits.t)
        np.testing.assert_array_equal(plain_hits.prim_id, exact_hits.prim_id)
        np.testing.assert_array_equal(
            culling.statistics.visits_by_depth, plain.statistics.visits_by_depth
        )


def mirror_scene(max_transmission=0.0):
    """A glass and mirror ball over a floor, two lights."""
    vertices, faces, first_prims = scene()
    material = {
        "diffuse": (0.7, 0.6, 0.5),
        "specular": (0.2, 0.2, 0.2),
        "shininess": 20.0,
        "reflectivity": (0, 0, 0),
        "transmission": 0.0,
        "ior": 1.5,
        "emission": (0, 0, 0),
        "texture": None,
    }
    ball = {**material, "reflectivity": 0.6, "transmission": max_transmission}
    meshes = [
        SimpleNamespace(
            vertices=vertices,
            faces=faces[first:last],
            normals=None,
            uv=None,
            colors=None,
            material=SimpleNamespace(**kind),
        )
        for first, last, kind in zip(first_prims, first_prims[1:], (ball, material), strict=False)
    ]
    light = {"color": np.ones(3) * 8, "falloff": True}
    return SimpleNamespace(
        meshes=meshes,
        lights=[
            SimpleNamespace(position=LIGHT, **light),
            SimpleNamespace(direction=np.array([0.3, -1, -0.2]), color=np.ones(3) / 2),
        ],
        ambient=np.full(3, 0.1),
        background=np.array([0.2, 0.3, 0.4]),
        vertices=vertices,
        faces=faces,
        first_prims=first_prims,
        bounds=np.array([vertices.min(axis=0), vertices.max(axis=0)]),
    )


CAMERA = SimpleNamespace(
    eye=EYE,
    basis=(np.array([1.0, 0, 0]), np.array([0, 1.0, 0]), np.array([0, 0, -1.0])),
    fov_y=np.degrees(2 * np.arctan(0.6)),
)


@pytest.mark.parametrize("shadows", [True, False])
@pytest.mark.parametrize("transmission", [0.0, 0.7])
@pytest.mark.parametrize("packet_size", [2, 16])
def test_renderer_makes_the_reference_image(packet_size, transmission, shadows):
    world = mirror_scene(transmission)
    options = {"size": SIZE, "max_bounces": 3, "shadows": shadows}
    reference = render_reference(
        world, CAMERA, tracer=BruteForceTracer.from_scene(world), **options
    ).image
    tracer = PacketTracer.from_scene(world)
    tracer.packet_size = packet_size
    frame = render_packets(world, CAMERA, tracer=tracer, **options)
    np.testing.assert_allclose(frame.image, reference, rtol=1e-6, atol=1e-7)
    assert frame.image.shape == (*SIZE[::-1], 3) and np.ptp(frame.image) > 0.2
    kinds = frame.kinds
    assert kinds["primary"].rays == SIZE[0] * SIZE[1]
    assert kinds["reflection"].rays > 90
    assert (kinds["refraction"].rays > 100) == (transmission > 0)
    assert (kinds["shadow"].rays > 100) == shadows
    assert tracer.statistics.rays == 0


def test_renderer_groups_reflections_by_their_pixels():
    world = mirror_scene()
    frame = render_packets(world, CAMERA, size=SIZE, max_bounces=1, shadows=False)
    primary, reflection = frame.kinds["primary"], frame.kinds["reflection"]
    assert primary.packets == 2 * 2 and reflection.packets <= primary.packets
    pixels = np.flatnonzero(exact("primary").geom_id == 0)
    assert reflection.rays == len(pixels)
    y, x = np.divmod(pixels, SIZE[0])
    assert reflection.simd_rays == len(set(zip(x // 2, y // 2, strict=True)))


def test_renderer_by_default_takes_ranged_for_primary_and_partition_for_other_rays():
    world = mirror_scene()
    kinds = render_packets(world, CAMERA, size=SIZE).kinds
    partition = render_packets(world, CAMERA, size=SIZE, primary="partition").kinds
    active = kinds["primary"].active_by_depth.sum()
    assert active > kinds["primary"].alive_by_depth.sum()
    assert_same_counts(kinds["reflection"], partition["reflection"])
    other = partition["reflection"]
    np.testing.assert_array_equal(other.active_by_depth, other.alive_by_depth)


@pytest.mark.parametrize(
    "change", [{"size": (0, 4)}, {"max_bounces": -1}, {"primary": "sorted"}], ids=str
)
def test_renderer_refuses(change):
    with pytest.raises(ValueError, match=r"render_packets: need size|primary: need one of"):
        render_packets(mirror_scene(), CAMERA, **{"size": SIZE, **change})
