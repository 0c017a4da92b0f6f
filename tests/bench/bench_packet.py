"""The study of Overbeck et al. (2008) on the device: its figures 5 to 7 and its table 2.

    RAYSTREAM_SCENES=... python tests/bench/bench_packet.py --sizes --scenes room,toys -o FOLDER
    RAYSTREAM_SCENES=... python tests/bench/bench_packet.py --verify

--sizes    figure 5: time against packet size, by traversal, scene and kind of ray
--depths   figure 6: tests by depth in the tree, the device's equal to the numpy version's
--culling  figure 7: time with and without frusta
--table    table 2: whole frames by packets of 16 x 16 against 2 x 2, and the benefit of frusta
--open3d   mirror rays by packets against Open3D's RaycastingScene (python -m pip install open3d)
--verify   every traversal, packet size and kind of ray, with and without frusta, against Embree

Numbers go to FOLDER as CSV, one file for each part, and a plot beside it; rows of scenes measured
earlier stay, so that scenes can be measured one after another. Times are the best of a few runs,
taken in turn.
"""

import argparse
import csv
import itertools
import os
import pathlib
import statistics as mean
import sys
import time

import numpy as np
from tqdm import tqdm

sys.path.insert(0, str(pathlib.Path(__file__).parent.parent))

import packet_plots
import raystream.data
from packet_rays import (
    ART_KEYS,
    KINDS,
    MUSEUM,
    PRIMARY,
    REFLECTION,
    SHADOW,
    STUDIED,
    TABLE,
    live_rays,
    load,
    ray_kinds,
)
from raystream.baselines import EmbreeTracer, PacketTracer
from raystream.baselines.tolerance import MAX_SHARE, differing, differing_occlusion

import raystream as rs
from raystream import device
from raystream.packet import PACKET_SIZES, TRAVERSALS
from raystream.statistics import TRAVERSAL

STUDY_SIZE, DEPTHS_SIZE, RAYS_SIZE, VERIFY_SIZE = (1024, 1024), (512, 512), (512, 512), (256, 256)
MUSEUMS = tuple(f"{MUSEUM} {key}" for key in ART_KEYS)
OPEN3D_SCENES = ("bunny", "sponza", "conference")
VERIFY_SCENES = (*STUDIED, "bunny", "sponza", *MUSEUMS)
DEPTHS_SCENES = ("meadow",)
# The paper's own: SIMD rays of 2 x 2, the frustum asked of every box.
PAPER = {"simd_width": 4, "least_active": 1}
THREADS = 2
MOST_SECONDS = 5.0  # no further runs of some tracers after so long


# --- Timing ---


def trace(tracer, kind, streams):
    """Seconds and answers of a tracer over streams of one kind, which stay on the device."""
    session = device.session()
    query = tracer.occluded_stream if kind == SHADOW else tracer.intersect_stream
    session.finish()
    start = time.perf_counter()
    answers = [query(session, stream) for stream in streams]
    session.finish()
    return time.perf_counter() - start, answers


def best_in_turn(tracers, kind, streams, repeats):
    """The best seconds of each of several tracers, which run one after another."""
    for tracer in tracers:
        trace(tracer, kind, streams[:1])  # builds the hierarchy
    seconds = [[] for _ in tracers]
    for _ in range(repeats):
        for tracer, times in zip(tracers, seconds, strict=True):
            times.append(trace(tracer, kind, streams)[0])
        if sum(map(sum, seconds)) > MOST_SECONDS:
            break
    return [min(times) for times in seconds]


def number_of_rays(tracer, kind, streams):
    """Active rays of some streams."""
    total = 0
    for stream in streams:
        trace(tracer, kind, [stream])
        total += tracer.statistics.rays
    return total


# --- Figures 5 and 7 ---


def sizes_study(name, options):
    """Seconds by kind of ray, packet size and traversal."""
    scene = load(name, options.folder)
    for kind, streams in ray_kinds(scene, options.size).items():
        for size in tqdm(PACKET_SIZES, f"{name}, {kind}", disable=None, leave=False):
            tracers = [rs.Tracer(scene, "packet", traversal=t, packet_size=size)
                       for t in TRAVERSALS]  # fmt: skip
            seconds = best_in_turn(tracers, kind, streams, options.repeats)
            count = number_of_rays(tracers[-1], kind, streams)
            for traversal, best in zip(TRAVERSALS, seconds, strict=True):
                yield {"scene": name, "kind": kind, "packet size": size, "traversal": traversal,
                       "rays": count, "seconds": best}  # fmt: skip


def culling_study(name, options):
    """Seconds of Partition with and without frusta: in the paper's set-up, and in the default."""
    scene = load(name, options.folder)
    columns = [(setup, culling) for setup in ("paper", "default") for culling in (True, False)]
    for kind, streams in ray_kinds(scene, options.size).items():
        for size in tqdm(PACKET_SIZES[1:], f"{name}, {kind}", disable=None, leave=False):
            tracers = [rs.Tracer(scene, "packet", traversal="partition", packet_size=size,
                                 frustum_culling=culling, **(PAPER if setup == "paper" else {}))
                       for setup, culling in columns]  # fmt: skip
            seconds = best_in_turn(tracers, kind, streams, options.repeats)
            row = {"scene": name, "kind": kind, "packet size": size}
            for (setup, culling), best in zip(columns, seconds, strict=True):
                row[f"{setup}, {'with' if culling else 'without'} frusta"] = best
            row["paper, benefit"] = seconds[1] / seconds[0]
            row["default, benefit"] = seconds[3] / seconds[2]
            yield row


# --- Figure 6 ---


def depths_study(name, options):
    """Box and triangle tests by depth, on the device; the numpy version must count the same."""
    scene = load(name, options.folder)
    kinds = ray_kinds(scene, options.size, depth=1)
    for kind, traversal in itertools.product((PRIMARY, REFLECTION), ("ranged", "partition")):
        (stream,) = kinds[kind]
        choice = {"traversal": traversal, "packet_size": 16, **PAPER}
        tracer = rs.Tracer(scene, "packet", **choice)
        trace(tracer, kind, [stream])
        by_depth = tracer.statistics.by_depth
        if not options.device_only:
            check_numpy_counts(scene, stream, choice, by_depth)
        for depth, tests in enumerate(zip(by_depth["box_tests"], by_depth["triangle_tests"],
                                          strict=True)):  # fmt: skip
            yield {"scene": name, "kind": kind, "traversal": traversal, "depth": depth,
                   "box tests": tests[0], "triangle tests": tests[1]}  # fmt: skip


def check_numpy_counts(scene, stream, choice, by_depth):
    """Trace the same rays in numpy and compare every counter, depth by depth."""
    tracer = PacketTracer(scene.vertices, scene.faces, precision="single", **choice)
    active, rays = live_rays(stream)
    tracer.intersect(*rays, size=stream.size, pixels=np.flatnonzero(active))
    for counter, counts in by_depth.items():
        expected = getattr(tracer.statistics, f"{counter}_by_depth").tolist()
        if counts != expected:
            raise AssertionError(f"{counter} by depth: device {counts}, numpy {expected}")


# --- Table 2 ---

_PACKETS = {
    "2x2": {"packet_size": 2, "traversal": "partition"},
    "16x16": {"packet_size": 16, "traversal": "auto"},
    "16x16 no frusta": {"packet_size": 16, "traversal": "auto", "frustum_culling": False},
    "16x16 of 2x2": {"packet_size": 16, "traversal": "auto", "simd_width": 4},
}


def table_study(name, options):
    """Frames by packets of 16 x 16 and of 2 x 2: whole frames, and their tracing alone."""
    scene, (bounces, lights) = load(name, options.folder), TABLE[name]
    scene.set_lights(scene.lights[: max(lights, 1)])
    renderers = {key: rs.Renderer(scene, "packet", **given) for key, given in _PACKETS.items()}
    frame, tracing = ({key: [] for key in renderers} for _ in range(2))
    for _ in tqdm(range(1 + options.repeats), name, disable=None, leave=False):
        for key, renderer in renderers.items():
            start = time.perf_counter()
            result = renderer.render(size=options.size, max_bounces=bounces, shadows=lights > 0,
                                     primary="trace")  # fmt: skip
            frame[key].append(time.perf_counter() - start)
            tracing[key].append(result.statistics.stages[TRAVERSAL]["wall"])
    rays = {kind: counts.rays for kind, counts in result.kinds.items()}
    row = {"scene": name, "triangles": scene.num_triangles, "bounces": bounces}
    row.update({f"{kind} rays": rays.get(kind, 0) for kind in KINDS})
    for what, seconds in (("frame", frame), ("tracing", tracing)):
        best = {key: min(times[1:]) for key, times in seconds.items()}
        row.update({f"{what} {key} ms": 1e3 * value for key, value in best.items()})
        row[f"{what} benefit"] = best["2x2"] / best["16x16"]
        row[f"{what} benefit of packets alone"] = best["2x2"] / best["16x16 of 2x2"]
        row[f"{what} benefit of frusta"] = best["16x16 no frusta"] / best["16x16"]
    if options.output:
        result.save(options.output / f"table-{name}.png")
    yield row


def print_published():
    """The paper's table 2."""
    path = pathlib.Path(raystream.data.__file__).parent / "packets08.csv"
    with open(path, newline="") as file:
        table = [r for r in csv.DictReader(file) if r["place"] == "table 2"]
    print("\nOverbeck et al., table 2")
    for scene, rows in itertools.groupby(table, key=lambda r: r["scene"]):
        print(f"  {scene:<14}" + ", ".join(f"{r['quantity']} {r['value']}" for r in rows))


# --- Open3D ---


def open3d_study(name, options):
    """Mirror rays by Partition of 16 x 16 and by Open3D's Embree, in turn, on THREADS threads."""
    scene = load(name, options.folder)
    camera = scene.camera
    if name == "bunny":  # so near that every ray of the camera meets it
        camera = rs.Camera.look_at((-0.02, 0.1, 0.16), (-0.02, 0.1, 0), fov_y=25)
    (stream,) = ray_kinds(scene, options.size, depth=1, camera=camera)[REFLECTION]
    active, rays = live_rays(stream)
    tracer = rs.Tracer(scene, "packet", traversal="partition", packet_size=16)
    theirs = Open3dScene(scene, rays)
    _, (hits,) = trace(tracer, REFLECTION, [stream])
    check_same_hits(scene, hits, active, theirs.hits(), rays)
    seconds = {"raystream": [], "open3d": []}
    for _ in tqdm(range(4 * options.repeats), name, disable=None, leave=False):
        seconds["raystream"].append(trace(tracer, REFLECTION, [stream])[0])
        seconds["open3d"].append(theirs.seconds())
    ratios = [b / a for a, b in zip(*seconds.values(), strict=True)]
    rate = {who: len(rays[0]) / min(times) / 1e6 for who, times in seconds.items()}
    yield {"scene": name, "triangles": scene.num_triangles, "rays": len(rays[0]),
           "traversal of us, M rays/s": device_rate(tracer, stream, len(rays[0])),
           **{f"{who}, M rays/s": value for who, value in rate.items()},
           "median of ratios": mean.median(ratios)}  # fmt: skip


def device_rate(tracer, stream, count):
    """Million rays per second of the traversal kernel alone, best of five."""
    session, seconds = device.session(), []
    for _ in range(5):
        session.finish()
        tracer.intersect_stream(session, stream)
        seconds.append(session.finish()[TRAVERSAL]["device"])
    return count / min(seconds) / 1e6


class Open3dScene:
    """A static scene of Open3D and the rays to cast at it."""

    def __init__(self, scene, rays):
        import open3d  # needed by this part only

        core = open3d.core
        origins, directions, tnear, _ = rays
        assert not tnear.any()  # Open3D knows no tnear
        self._scene = open3d.t.geometry.RaycastingScene(nthreads=THREADS)
        self._scene.add_triangles(
            core.Tensor(scene.vertices), core.Tensor(scene.faces.astype(np.uint32))
        )
        self._rays = core.Tensor(np.concatenate([origins, directions], axis=1))

    def hits(self):
        """Distances and flat triangle numbers, -1 where missed."""
        found = self._scene.cast_rays(self._rays, nthreads=THREADS)
        prims = found["primitive_ids"].numpy().astype(np.int64)
        t = found["t_hit"].numpy()
        return t, np.where(np.isfinite(t), prims, -1)

    def seconds(self):
        """Of one call."""
        start = time.perf_counter()
        self._scene.cast_rays(self._rays, nthreads=THREADS)
        return time.perf_counter() - start


class FlatHits:
    """Hits of a scene that is one mesh to the rules of tolerance.py."""

    def __init__(self, t, triangle):
        self.t, self.prim_id = t, triangle
        self.geom_id = np.where(triangle >= 0, 0, -1)


def flat_hits(hits, active, num_triangles):
    """A HitStream of active rays, on the host."""
    triangle = hits.triangle.get()[active].astype(np.int64)
    return FlatHits(hits.t.get()[active], np.where(triangle < num_triangles, triangle, -1))


def check_same_hits(scene, hits, active, theirs, rays):
    """No times are printed of tracers that see different things."""
    ours, theirs = flat_hits(hits, active, scene.num_triangles), FlatHits(*theirs)
    firsts = np.array([0, scene.num_triangles])
    agreement = differing(ours, theirs, scene.vertices, scene.faces, firsts, *rays)
    print(f"{scene.name}: {agreement}")
    if not agreement.ok:
        raise AssertionError(f"{scene.name}: hits differ from Open3D's: {agreement}")


# --- Verification ---


def verify_study(name, options):
    """All ways to trace each kind of ray; every answer against Embree's."""
    scene = load(name, options.folder)
    embree = EmbreeTracer(scene.vertices, scene.faces)
    choices = list(itertools.product(TRAVERSALS, PACKET_SIZES, (True, False)))
    for kind, streams in ray_kinds(scene, options.size).items():
        counts = {"scene": name, "kind": kind, "configurations": len(choices), "rays": 0,
                  "differ": 0, "ties": 0, "ours": 0, "wrong": 0, "worst": 0}  # fmt: skip
        for stream in tqdm(streams, f"{name}, {kind}", disable=None, leave=False):
            active, rays = live_rays(stream)
            judge = Judge(scene, kind, embree, active, rays)
            for traversal, size, culling in choices:
                tracer = rs.Tracer(scene, "packet", traversal=traversal, packet_size=size,
                                   frustum_culling=culling)  # fmt: skip
                _, (answer,) = trace(tracer, kind, [stream])
                agreement = judge(answer)
                counts["rays"] += agreement.num_rays
                counts["differ"] += len(agreement.rays)
                counts["ties"] += agreement.count("tie")
                counts["ours"] += agreement.count("ours")
                counts["wrong"] += agreement.num_wrong
                counts["worst"] = max(counts["worst"], agreement.share)
        if counts["worst"] > MAX_SHARE:
            raise AssertionError(f"{name}, {kind}: {counts['worst']:.2g} of the rays are wrong")
        yield counts


class Judge:
    """Holds answers to one stream against Embree's; equal answers are judged once."""

    def __init__(self, scene, kind, embree, active, rays):
        self._scene, self._kind, self._active, self._rays = scene, kind, active, rays
        query = embree.occluded if kind == SHADOW else embree.intersect
        self._reference = query(*rays)
        self._judged = {}

    def __call__(self, answer):
        if self._kind == SHADOW:
            ours, compare = answer.get()[self._active].astype(bool), differing_occlusion
            key = ours.tobytes()
        else:
            ours, compare = flat_hits(answer, self._active, self._scene.num_triangles), differing
            key = ours.t.tobytes() + ours.prim_id.tobytes()
        if key not in self._judged:
            firsts = np.array([0, self._scene.num_triangles])
            triangles = self._scene.vertices, self._scene.faces, firsts
            self._judged[key] = compare(ours, self._reference, *triangles, *self._rays)
        return self._judged[key]


# --- The command ---

# part: study, scenes, size of the picture, plot
PARTS = {
    "sizes": (sizes_study, tuple(STUDIED), STUDY_SIZE, packet_plots.draw_sizes),
    "depths": (depths_study, DEPTHS_SCENES, DEPTHS_SIZE, packet_plots.draw_depths),
    "culling": (culling_study, tuple(STUDIED), STUDY_SIZE, packet_plots.draw_culling),
    "table": (table_study, tuple(TABLE), STUDY_SIZE, None),
    "open3d": (open3d_study, OPEN3D_SCENES, RAYS_SIZE, None),
    "verify": (verify_study, VERIFY_SCENES, VERIFY_SIZE, None),
}


def main():
    options = parse()
    study, known, size, draw = PARTS[options.part]
    options.size = options.size or size
    if options.output:
        options.output.mkdir(parents=True, exist_ok=True)
    if options.part == "table":
        print_published()
    measured = []
    for name in options.scenes or known:
        rows = []
        for row in study(name, options):
            rows.append(row)
            print("  ".join(f"{key} {shown(value)}" for key, value in row.items()), flush=True)
        measured += rows
        device.session().trim()  # the next scene's streams are of other sizes
        if options.output:
            table = merge(options.output / f"{options.part}.csv", name, rows, known)
            if draw:
                draw(options.output / f"{options.part}.png", table)
    return 0


def shown(value):
    if isinstance(value, float):
        return f"{value:.3g}"
    return f"{value:,}" if isinstance(value, int) else value


def merge(path, name, rows, order):
    """Put the rows of one scene into a CSV file in place of its old ones; returns all of it."""
    table = []
    if path.exists():
        with open(path, newline="") as file:
            table = [row for row in csv.DictReader(file) if row["scene"] != name]
    table += [{key: str(value) for key, value in row.items()} for row in rows]
    table.sort(key=lambda row: order.index(row["scene"]))
    with open(path, "w", newline="") as file:
        writer = csv.DictWriter(file, list(table[0]))
        writer.writeheader()
        writer.writerows(table)
    return table


def parse():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parts = parser.add_mutually_exclusive_group(required=True)
    for part in PARTS:
        parts.add_argument(f"--{part}", dest="part", action="store_const", const=part)
    parser.add_argument("-o", "--output", type=pathlib.Path)
    parser.add_argument("--scenes", help="some of the scenes, by name", default="")
    parser.add_argument("--size", help="of the picture, WIDTHxHEIGHT; default: the paper's")
    parser.add_argument("--repeats", type=int, default=3, help="runs of which the best is taken")
    parser.add_argument("--device-only", action="store_true",
                        help="with --depths: do not count in numpy, too")  # fmt: skip
    options = parser.parse_args()
    options.folder = os.environ.get("RAYSTREAM_SCENES")
    known = PARTS[options.part][1]
    options.scenes = options.scenes.split(",") if options.scenes else []
    for name in options.scenes:
        if name not in known:
            parser.error(f"no scene {name!r}; the scenes: {', '.join(known)}")
    if not options.folder and not set(options.scenes or known) <= set(STUDIED):
        parser.error("RAYSTREAM_SCENES does not name the folder of test scenes")
    if options.size:
        options.size = tuple(int(x) for x in options.size.split("x"))
    return options


if __name__ == "__main__":
    sys.exit(main())
