"""How many intersection tests every configuration of the ray hierarchies needs, scene by scene.

    RAYSTREAM_SCENES=... python tests/bench/bench_counts.py [--scenes a,b] [-o FOLDER]
    RAYSTREAM_SCENES=... python tests/bench/bench_counts.py --pixels [-o FOLDER]

Prints the tables of Reis et al. (2017), section 4; -o writes counts.csv and counts.png. All
configurations trace the same rays and must give the same answers. With --pixels: how the tests
grow with the picture's size (Roger et al. 2007, section 5.2); -o writes pixels.png. With --memory:
a scene of 871,414 triangles within 256 MB of streams.
"""

import argparse
import csv
import dataclasses
import os
import pathlib
import sys
import time

import matplotlib

matplotlib.use("Agg")  # no display is needed
import matplotlib.pyplot as plt
import numpy as np
from tqdm import tqdm

sys.path.insert(0, str(pathlib.Path(__file__).parent.parent))

import raystream.data
from bench_rsh import frame_rays, reflection_rays
from real_scenes import BUNNY, COUNT_SCENES, PATIO

import raystream as rs
from raystream import device
from raystream.statistics import (
    COMPRESSION,
    DECOMPRESSION,
    RAY_CREATION,
    SORTING,
    Statistics,
)

_TWO_LEVELS = {"arity": 8, "levels": 2}  # as Reis et al. ran both methods
_PAPER = {**_TWO_LEVELS, "bound": "paper"}
SCAN_LINES = "rsh scan-lines"
# The first is what the others are held against: the published bounds, over screen tiles. With the
# rays in scan-lines it gives the paper's own counts for it, but flatters whatever is compared.
CONFIGURATIONS = {
    "rsh": ("rsh", _PAPER),
    SCAN_LINES: ("rsh", _PAPER),
    "rsh tight": ("rsh", {**_TWO_LEVELS, "bound": "tight"}),
    "rsh full": ("rsh", {}),
    "crsh paper": ("crsh", {**_PAPER, "hash": "paper"}),
    "crsh no hash": ("crsh", {"hash": None}),
    "crsh meshes": ("crsh", {"clusters": None}),
    "crsh two levels": ("crsh", {**_TWO_LEVELS, "clusters": 64}),
    "crsh": ("crsh", {}),
}
SHADOW, MIRROR = "shadow", "mirror"
CORNELL = "cornell"  # procedural, needs no file
# Of rays that are there already, ray creation is their hashing.
ORDER_STAGES = (RAY_CREATION, COMPRESSION, SORTING, DECOMPRESSION)
MEMORY_LIMIT = 1 << 30  # bytes of candidates: with rays and scenes well below 16 GB
LARGE_DRAGON, LITTLE_MEMORY = "dragon/dragon-871414.ply", 256 << 20
PIXEL_SIDES = (128, 256, 512, 1024)
MOST_GROWTH = 2.5  # tests for four times the pixels; about 2 in the paper


@dataclasses.dataclass
class Run:
    """What one configuration did with the rays of one kind; the counts summed over the streams."""

    configuration: str
    statistics: Statistics
    seconds: float


# --- The rays ---


def ray_streams(name, folder, size):
    """The scene, and its ray streams on the device by kind."""
    if name == CORNELL:
        scene = rs.scenes.cornell("mirrors")
        bounces, shadows = frame_rays(scene, scene.camera, size, max_bounces=2, shadows=True)
        return scene, {SHADOW: shadows, MIRROR: bounces}
    real = COUNT_SCENES[name]
    scene = real.load(folder)
    _, shadows = frame_rays(scene, real.camera, size, max_bounces=0, shadows=True)
    scene.mirror("*")
    bounces, _ = frame_rays(scene, real.camera, size, max_bounces=1, shadows=False)
    return scene, {SHADOW: shadows, MIRROR: bounces}


# --- Counting ---


def count(scene, kind, streams, repeats):
    """The runs of all configurations over the same streams, whose answers must be equal."""
    runs, expected = [], None
    for name, (method, options) in tqdm(CONFIGURATIONS.items(), kind, disable=None, leave=False):
        tracer = rs.Tracer(scene, method, memory_limit=MEMORY_LIMIT, **options)
        rays = in_scan_lines(streams) if name == SCAN_LINES else streams
        timed = [trace(tracer, kind, rays) for _ in range(repeats)]
        seconds, statistics, answers = min(timed, key=lambda run: run[0])
        expected = expected or answers
        if not all(np.array_equal(a, b) for a, b in zip(answers, expected, strict=True)):
            raise AssertionError(f"{name} gives other {kind} answers than {runs[0].configuration}")
        runs.append(Run(name, statistics, seconds))
    return runs


def in_scan_lines(streams):
    """The same rays, whose order the hierarchy then keeps."""
    return [dataclasses.replace(stream, size=None) for stream in streams]


def trace(tracer, kind, streams):
    """Seconds, counts and answers (arrays on the host) of a tracer over streams of one kind."""
    session = device.session()
    query = tracer.occluded_stream if kind == SHADOW else tracer.intersect_stream
    session.finish()
    statistics, results = Statistics(), []
    start = time.perf_counter()
    for stream in streams:
        results.append(query(session, stream))
        statistics.add(tracer.statistics)
    statistics.add(Statistics(stages=session.finish()))
    seconds = time.perf_counter() - start
    arrays = results if kind == SHADOW else [a for hits in results for a in (hits.triangle, hits.t)]
    return seconds, statistics, [array.get() for array in arrays]


def row(scene_name, kind, run, first):
    """A run as a line of the CSV file; `first` is the run it is held against."""
    counts = run.statistics
    total = counts.total_tests
    return {
        "scene": scene_name,
        "kind": kind,
        "configuration": run.configuration,
        "rays": counts.rays,
        "triangles": counts.triangles,
        "mesh tests": counts.mesh_tests,
        **level_tests(counts),
        "final tests": counts.final_tests,
        "total tests": total,
        "of brute force": total / (counts.rays * counts.triangles),
        "change": total / first.statistics.total_tests - 1,
        "final share": counts.final_tests / total,
        "seconds": run.seconds,
        **{f"{stage} ms": 1e3 * wall_seconds(counts, stage) for stage in ORDER_STAGES},
    }


def level_tests(counts):
    """Tests by level, top first; level 0 are the rays, which not every method tests by spheres."""
    lowest = 0 if counts.levels[-1]["nodes"] == counts.rays else 1
    top = lowest + len(counts.levels) - 1
    return {f"level {top - i}": level["tests"] for i, level in enumerate(counts.levels)}


def wall_seconds(counts, stage):
    return counts.stages.get(stage, {"wall": 0.0})["wall"]


# --- Printing, writing, drawing ---


def print_published(name, rows):
    """The change of `crsh` against `rsh` in the paper's set-up: in the paper, and in these rows."""
    published = published_totals(name)
    if not published:
        return
    ours = {method: sum(r["total tests"] - r["mesh tests"] for r in rows
                        if (r["kind"], r["configuration"]) in published_kinds(name, method))
            for method in ("rsh", "crsh")}  # fmt: skip
    print(f"\n{name}, the paper's set-up; totals without the tests of meshes, as in the paper")
    for place, totals in (("Reis et al.", published), ("here", ours)):
        change = totals["crsh"] / totals["rsh"] - 1
        print(f"  {place:<12} rsh {totals['rsh']:>13,}  crsh {totals['crsh']:>13,}  {change:+.1%}")


def published_totals(name):
    """Table 4 of Reis et al. for a scene: total tests by method; empty for other scenes."""
    with open(pathlib.Path(raystream.data.__file__).parent / "crsh17.csv", newline="") as file:
        table = [r for r in csv.DictReader(file) if (r["scene"], r["level"]) == (name, "total")]
    return {r["algorithm"]: int(r["tests"]) for r in table}


def published_kinds(name, method):
    """(kind, configuration) of the rows that the paper's table has for a scene."""
    kinds = (SHADOW, MIRROR) if name == CORNELL else (SHADOW,)
    return [(kind, {"rsh": "rsh", "crsh": "crsh paper"}[method]) for kind in kinds]


def columns(rows):
    """The keys of all rows in the order of a single one: levels differ from row to row."""
    keys = list(dict.fromkeys(key for r in rows for key in r))
    levels = [key for key in keys if key.startswith("level ")]
    levels.sort(key=lambda key: -int(key.split()[1]))
    others = [key for key in keys if key not in levels]
    place = others.index("mesh tests") + 1
    return others[:place] + levels + others[place:]


def print_table(rows):
    """The rows of one scene and kind as columns."""
    print(f"\n{rows[0]['scene']}, {rows[0]['kind']} rays")
    for key in columns(rows)[2:]:
        print(f"  {key:<16}" + "".join(f"{shown(key, r.get(key)):>15}" for r in rows))
    sys.stdout.flush()


def shown(key, value):
    """A value as text: counts, shares, times."""
    if value is None or isinstance(value, str):
        return value or ""
    if isinstance(value, int):
        return f"{value:,}"
    if key == "change":
        return f"{value:+.1%}"
    return f"{value:.2%}" if key in ("of brute force", "final share") else f"{value:.2f}"


def write_csv(path, rows):
    with open(path, "w", newline="") as file:
        writer = csv.DictWriter(file, columns(rows))
        writer.writeheader()
        writer.writerows(rows)


def draw_counts(path, rows):
    """Total tests as bars: a panel per kind of ray, a group per scene, a bar per configuration."""
    names = list(dict.fromkeys(r["configuration"] for r in rows))
    scenes = list(dict.fromkeys(r["scene"] for r in rows))
    width = 0.85 / len(names)
    inches = max(7, 1 + (0.13 * len(names) + 0.2) * len(scenes))
    figure, panels = plt.subplots(2, 1, figsize=(inches, 9), layout="constrained")
    for panel, kind in zip(panels, (SHADOW, MIRROR), strict=True):
        for i, name in enumerate(names):
            chosen = [r for r in rows if (r["kind"], r["configuration"]) == (kind, name)]
            places = [scenes.index(r["scene"]) + (i - (len(names) - 1) / 2) * width for r in chosen]
            panel.bar(places, [r["total tests"] for r in chosen], width, label=name)
        panel.set(title=f"{kind} rays", ylabel="intersection tests", yscale="log")
        panel.set_xticks(range(len(scenes)), scenes)
        panel.margins(x=0.01)
        panel.grid(axis="y", alpha=0.4)
        panel.set_axisbelow(True)
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=4)
    figure.savefig(path, dpi=120)
    plt.close(figure)


# --- Growth with the picture ---


def count_pixels(real, folder):
    """(node, triangle) tests of the mirror's rays by picture side, full depth of the paper."""
    tests = {}
    for side in tqdm(PIXEL_SIDES, real.name, disable=None, leave=False):
        scene, stream = reflection_rays(real, folder, (side, side))
        tracer = rs.Tracer(scene, "rsh", memory_limit=MEMORY_LIMIT, arity=4)
        _, counts, _ = trace(tracer, MIRROR, [stream])
        tests[side] = sum(level["tests"] for level in counts.levels)
    return tests


def print_pixels(name, tests):
    numbers = list(tests.values())
    growth = [after / before for before, after in zip(numbers, numbers[1:], strict=False)]
    print(f"\n{name}: (node, triangle) tests of reflection rays, rsh of arity 4")
    for side, number, times in zip(tests, numbers, [None, *growth], strict=True):
        print(f"  {side:>5} x {side:<5}{number:>16,}" + (f"{times:8.2f} times" if times else ""))
    print(
        f"  for four times the pixels: mean {np.prod(growth) ** (1 / len(growth)):.2f}, "
        f"largest {max(growth):.2f}, wanted at most {MOST_GROWTH}"
    )


def draw_pixels(path, tests_by_name):
    """Tests over pixels, both logarithmic, beside the growth of the paper."""
    figure, panel = plt.subplots(figsize=(7, 5), layout="constrained")
    pixels = np.array(PIXEL_SIDES) ** 2
    for name, tests in tests_by_name.items():
        numbers = list(tests.values())
        (line,) = panel.plot(pixels, numbers, marker="o", label=name)
        twice = numbers[0] * 2.0 ** np.arange(len(numbers))
        panel.plot(pixels, twice, "--", color=line.get_color(), alpha=0.5, label="twice a step")
    panel.set(xscale="log", yscale="log", xlabel="pixels", ylabel="(node, triangle) tests")
    panel.set_xticks(pixels, [f"{side} x {side}" for side in PIXEL_SIDES])
    panel.minorticks_off()
    panel.grid(alpha=0.4)
    panel.legend()
    figure.savefig(path, dpi=120)
    plt.close(figure)


# --- Memory ---


def memory_study(options):
    """The dragon of 871,414 triangles, all mirror, in little memory: answers as in much."""
    real = dataclasses.replace(BUNNY, path=LARGE_DRAGON, eye=(0, 0.12, 0.4), target=(0, 0.125, 0))
    scene = real.load(options.folder)
    bounces, shadows = frame_rays(scene, real.camera, options.size, max_bounces=1, shadows=True)
    for method in ("rsh", "crsh"):
        for kind, streams in ((SHADOW, shadows), (MIRROR, bounces)):
            runs = [trace(rs.Tracer(scene, method, memory_limit=limit), kind, streams)
                    for limit in (None, LITTLE_MEMORY)]  # fmt: skip
            (_, much, expected), (_, little, answers) = runs
            if not all(np.array_equal(a, b) for a, b in zip(answers, expected, strict=True)):
                raise AssertionError(f"{method} gives other {kind} answers in little memory")
            for counts in (much, little):
                streams_size = f"{counts.peak_stream_bytes / 2**20:.0f} MB of streams"
                print(f"{method}, {kind}: {counts.rays:,} rays, {counts.total_tests:,} tests, "
                      f"{counts.batches} batches, {streams_size}")  # fmt: skip
    return 0


# --- The command ---


def main():
    options = parse()
    if options.output:
        options.output.mkdir(parents=True, exist_ok=True)
    if options.pixels:
        return pixels_study(options)
    if options.memory:
        return memory_study(options)
    rows = []
    for name in tqdm(options.scenes, disable=None):
        scene, streams = ray_streams(name, options.folder, options.size)
        for kind, of_kind in streams.items():
            runs = count(scene, kind, of_kind, options.repeats)
            rows += [row(name, kind, run, runs[0]) for run in runs]
            print_table(rows[-len(runs) :])
        print_published(name, [r for r in rows if r["scene"] == name])
        device.session().trim()  # the next scene's streams are of other sizes
    if options.output:
        write_csv(options.output / "counts.csv", rows)
        draw_counts(options.output / "counts.png", rows)
    return 0


def parse():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("-o", "--output", type=pathlib.Path)
    parser.add_argument("--scenes", help="some of the scenes, by name", default="")
    parser.add_argument("--size", default="512x512")
    parser.add_argument("--repeats", type=int, default=3, help="runs of which the best is timed")
    parser.add_argument("--pixels", action="store_true", help="growth with the picture's size")
    parser.add_argument("--memory", action="store_true", help="a large scene in 256 MB")
    options = parser.parse_args()
    options.folder = os.environ.get("RAYSTREAM_SCENES")
    if not options.folder:
        parser.error("RAYSTREAM_SCENES does not name the folder of test scenes")
    known = [CORNELL, *COUNT_SCENES]
    options.scenes = options.scenes.split(",") if options.scenes else known
    for name in options.scenes:
        if name not in known:
            parser.error(f"no scene {name!r}; the scenes: {', '.join(known)}")
    options.size = tuple(int(x) for x in options.size.split("x"))
    return options


def pixels_study(options):
    tests = {}
    for name, real in (("mirror ball in sponza", PATIO), ("mirror bunny", BUNNY)):
        tests[name] = count_pixels(real, options.folder)
        print_pixels(name, tests[name])
    if options.output:
        draw_pixels(options.output / "pixels.png", tests)
    return 0


if __name__ == "__main__":
    sys.exit(main())
