"""`ldc` beside the paper (Buerger et al. 2007), Embree and the reference renderer.

    RAYSTREAM_SCENES=... python tests/bench/bench_ldc.py --pictures FOLDER
    RAYSTREAM_SCENES=... python tests/bench/bench_ldc.py --tolerance FOLDER
    RAYSTREAM_SCENES=... python tests/bench/bench_ldc.py --gaps
    RAYSTREAM_SCENES=... python tests/bench/bench_ldc.py --exact
    RAYSTREAM_SCENES=... python tests/bench/bench_ldc.py --table
    RAYSTREAM_SCENES=... python tests/bench/bench_ldc.py --growth FOLDER
    RAYSTREAM_SCENES=... python tests/bench/bench_ldc.py --embree-build
    RAYSTREAM_SCENES=... python tests/bench/bench_ldc.py --blocks

Several parts may be given. `--scenes bunny,maple` takes some of a part's scenes: those of
ldc_scenes.py, and for `--exact` and `--blocks` those of real_scenes.py, too.
"""

import argparse
import os
import pathlib
import sys

import numpy as np
import pytest

sys.path.insert(0, str(pathlib.Path(__file__).parent.parent))

from cube_map import CubeMap, render_cube_map
from ldc_gaps import find_gaps
from ldc_pictures import ANSWERS, AS_TRACED, REASONS, judge
from ldc_scenes import SCENES
from ldc_times import (
    MODES,
    PLANES,
    PUBLISHED,
    RESOLUTIONS,
    VIEWPORT,
    Builder,
    embree_build,
    frame_traversals,
    growth,
    in_turn,
    published,
    rays_into,
    table_row,
)
from raystream.baselines import EmbreeTracer, render_reference
from raystream.baselines.reference import primary_rays
from raystream.baselines.tolerance import MAX_SHARE, VERDICTS, differing, differing_occlusion
from real_scenes import BUNNY, COUNT_SCENES
from soup import triangle_soup
from tqdm import tqdm

import raystream as rs
from raystream import device
from raystream import image as images

PICTURE_SIZES = (512, 1024)
MIN_SSIM = 0.95
TOLERANCES = (0.0, 1 / 16, 1 / 8, 1 / 4, 1 / 2, 1.0, 2.0)  # in texels
_REAL = (COUNT_SCENES[name] for name in ("bunny", "sponza", "office", "kitchen", "gears"))
EXACT_SCENES = {real.name: real for real in _REAL}
SOUPS = {"soup-1k": (1000, 0.3), "soup-20k": (20_000, 0.1), "soup-200k": (200_000, 0.03)}
MODELS = {
    "bunny": [f"bunny/bunny-{count}.ply" for count in (948, 3851, 16301, 69451)],
    "dragon": [f"dragon/dragon-{count}.ply" for count in (11102, 47794, 871414)],
}
MIN_GAIN = 3  # of tracing by the coarse level


# ---- samples as published and as planes: pictures ----


def pictures(options):
    """SSIM and wrong hits; side by side: by cube maps, as published, by planes, by Embree."""
    scores = " | ".join(["ssim", *(f"ssim, {answer}" for answer in ANSWERS[1:])])
    wrong = f"rays wrong: {', '.join(REASONS)} | shadow rays: {', '.join(REASONS[:2])}"
    print(f"| scene | triangles | size | samples | {scores} | {wrong} |")
    low = {PUBLISHED: [], PLANES: []}
    for name in tqdm(chosen(options, SCENES), disable=None):
        scene = SCENES[name](options.folder)
        for size in PICTURE_SIZES:
            reference = render_reference(scene, scene.camera, (size, size)).image
            row = [render_cube_map(scene, scene.camera, (size, size))]
            for mode, names in low.items():
                judgement = judge(scene, size, reference, **MODES[mode])
                print_judgement(f"{name} | {scene.num_triangles} | {size} | {mode}", judgement)
                if size == PICTURE_SIZES[-1] and judgement.ssim[AS_TRACED] < MIN_SSIM:
                    names.append(name)
                row.append(judgement.image)
            row = np.concatenate([*row, reference], axis=1)
            images.save(folder(options.pictures) / f"{name}-{size}.png", row)
    what = f"SSIM below {MIN_SSIM} at {PICTURE_SIZES[-1]}"
    return max(verdict(f"{mode}: {what}", names) for mode, names in low.items())


def print_judgement(label, judgement):
    scores = " | ".join(f"{judgement.ssim[answer]:.4f}" for answer in ANSWERS)
    wrong = f"{shares(judgement.closest, REASONS)} | {shares(judgement.shadow, REASONS[:2])}"
    print(f"| {label} | {scores} | {wrong} |", flush=True)


def shares(wrong, reasons):
    parts = ", ".join(f"{getattr(wrong, r) / max(1, wrong.rays):.2%}" for r in reasons)
    return f"{wrong.share:.2%} of {wrong.rays}: {parts}"


def tolerances(options):
    """SSIM in both sizes by tolerance and by planes, as a table and a plot."""
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(1, len(PICTURE_SIZES), figsize=(9, 3.6), sharey=True)
    heads = " | ".join(f"{texels:g}" for texels in TOLERANCES)
    print(f"| scene | size | tolerance in texels: {heads} | planes |")
    for name in tqdm(chosen(options, SCENES), disable=None):
        scene = SCENES[name](options.folder)
        for size, ax in zip(PICTURE_SIZES, axes, strict=True):
            *scores, planes = scores_by_tolerance(scene, size)
            row = " | ".join(f"{score:.4f}" for score in (*scores, planes))
            print(f"| {name} | {size} | {row} |", flush=True)
            (line,) = ax.plot(TOLERANCES, scores, "o-", label=name, markersize=3)
            ax.axhline(planes, color=line.get_color(), linestyle="--", linewidth=1)
            ax.set(title=f"{size} x {size}", xlabel="tolerance, texels")
            ax.set_xscale("symlog", base=2, linthresh=TOLERANCES[1])
            ax.axhline(MIN_SSIM, color="grey", linewidth=0.5)
    axes[0].set_ylabel("SSIM against the reference; dashed: planes")
    axes[0].legend(fontsize=7)
    save(figure, folder(options.tolerance) / "ldc-tolerance.png")
    return 0


def scores_by_tolerance(scene, size):
    """SSIM by each of TOLERANCES, and by planes."""
    reference = render_reference(scene, scene.camera, (size, size)).image
    texel = np.ptp(scene.bounds, axis=0).max() / size / scene.diagonal
    tolerances = [*(texels * texel for texels in TOLERANCES), None]
    return [
        judge(scene, size, reference, (AS_TRACED,), tolerance=tolerance).ssim[AS_TRACED]
        for tolerance in tolerances
    ]


def gaps(options):
    """Where `options.rays` rays from around each scene slip between planes, at 512."""
    print("| scene | hits | slip through | of them near an edge | at a turn | of all hits |")
    for name in tqdm(chosen(options, SCENES), disable=None):
        scene, rng = SCENES[name](options.folder), np.random.default_rng(2007)
        found = find_gaps(scene, *rays_into(scene, rng, options.rays), **MODES[PLANES])
        print(f"| {name} | {found.hits} | {found.slipped} | {found.near_edge:.0%} "
              f"| {found.at_turn:.0%} | {found.hits_at_turn:.0%} |", flush=True)  # fmt: skip
    return 0


# ---- the exact mode: rays against Embree ----


def exact(options):
    """Closest and any hits of `options.rays` rays of each kind, by the rules of tolerance.py."""
    heads = " | ".join(VERDICTS)
    print(f"| scene | triangles | rays | query | hit | differ | verdicts: {heads} |")
    failed = []
    for name in tqdm(chosen(options, [*EXACT_SCENES, *SOUPS]), disable=None):
        scene, rng = exact_scene(name, options.folder), np.random.default_rng(2007)
        triangles = scene.vertices, scene.faces, scene.first_prims
        ldc, embree = rs.Tracer(scene, "ldc", exact=True), EmbreeTracer.from_scene(scene)
        for kind, rays in ray_kinds(scene, rng, options.rays).items():
            ours, theirs = ldc.intersect(*rays), embree.intersect(*rays)
            agreements = {"closest": differing(ours, theirs, *triangles, *rays)}
            segments = *rays, 0.0, 1.0
            blocked, expected = ldc.occluded(*segments), embree.occluded(*segments)
            agreements["any"] = differing_occlusion(blocked, expected, *triangles, *segments)
            for query, agreement in agreements.items():
                hit = np.mean(ours.prim_id >= 0 if query == "closest" else blocked)
                counts = " | ".join(str(agreement.count(verdict)) for verdict in VERDICTS)
                differ = f"{len(agreement.rays)} of {agreement.num_rays}"
                print(f"| {name} | {scene.num_triangles} | {kind} | {query} | {hit:.0%} "
                      f"| {differ} | {counts} |", flush=True)  # fmt: skip
                failed += [] if agreement.ok else [f"{name}/{kind}/{query}"]
    return verdict(f"more than {MAX_SHARE:g} of the rays wrong", failed)


def exact_scene(name, files):
    if name in SOUPS:
        return triangle_soup(np.random.default_rng(1), *SOUPS[name])
    return EXACT_SCENES[name].load(files)


def ray_kinds(scene, rng, count):
    """Rays of any direction from inside the box; and from 0.6 to 10 diagonals away into it."""
    low, high = scene.bounds
    inside = low + (high - low) * rng.random((count, 3))
    directions = rng.normal(size=(count, 3))
    directions *= scene.diagonal * rng.random((count, 1)) / np.linalg.norm(
        directions, axis=1, keepdims=True
    )  # so that some segments end before they hit
    parts = [rays_into(scene, rng, count // 4, distance) for distance in (0.6, 1.0, 3.0, 10.0)]
    outside = tuple(np.concatenate(column) for column in zip(*parts, strict=True))
    return {"from inside": (inside, directions), "from outside": outside}


# ---- times ----


def table(options):
    """Table 1 for our scenes, and the paper's."""
    print("| scene | triangles | layers | resolution | samples | A, ms | B, ms | of it traversal | "
          f"as published | secondary rays | times at {VIEWPORT[0]} x {VIEWPORT[1]} |")  # fmt: skip
    ratios = {}
    for name in tqdm(chosen(options, SCENES), disable=None):
        scene = SCENES[name](options.folder)
        rows = [table_row(scene, resolution) for resolution in RESOLUTIONS]
        for resolution, row in zip(RESOLUTIONS, rows, strict=True):
            layers = "/".join(map(str, row.layers))
            print(f"| {name} | {row.triangles} | {layers} | {resolution} | {row.samples} "
                  f"| {1e3 * row.construction:.1f} | {1e3 * row.tracing:.0f} "
                  f"| {1e3 * row.traversal:.0f} | {1e3 * row.traversal_published:.0f} "
                  f"| {row.rays} |", flush=True)  # fmt: skip
        ratios[name] = [getattr(rows[1], key) / getattr(rows[0], key)
                        for key in ("construction", "tracing")]  # fmt: skip
        device.session().trim()
    rows = published()
    for (scene, resolution), row in rows.items():
        print(f"| paper: {scene} | {row['triangles']} | {row['layers']} | {resolution} | "
              f"| {row['construction_ms']} | {row['tracing_ms']} | | | |")  # fmt: skip
    for scene in dict.fromkeys(scene for scene, _ in rows):
        ratios[f"paper: {scene}"] = [
            int(rows[scene, RESOLUTIONS[1]][key]) / int(rows[scene, RESOLUTIONS[0]][key])
            for key in ("construction_ms", "tracing_ms")
        ]
    print(f"{RESOLUTIONS[1]} against {RESOLUTIONS[0]}, A and B:")
    for name, (construction, tracing) in ratios.items():
        print(f"  {name}: {construction:.2f}, {tracing:.2f}")
    return 0


def growths(options):
    """Construction and tracing by number of triangles, as a table and a plot."""
    from matplotlib import pyplot

    figure, (build, trace) = pyplot.subplots(1, 2, figsize=(9, 3.6))
    print("| model | resolution | triangles | construction, ms | tracing, ns a ray |")
    for (model, paths), colour in zip(MODELS.items(), ("tab:blue", "tab:orange"), strict=True):
        scenes = [rs.load_scene(pathlib.Path(options.folder) / path) for path in paths]
        triangles = [scene.num_triangles for scene in scenes]
        for resolution, style in zip(RESOLUTIONS, ("o--", "o-"), strict=True):
            construction, tracing = growth(scenes, resolution)
            for row in zip(triangles, construction, tracing, strict=True):
                print(f"| {model} | {resolution} | {row[0]} | {1e3 * row[1]:.1f} "
                      f"| {1e9 * row[2]:.0f} |", flush=True)  # fmt: skip
            look = {"color": colour, "label": f"{model}, {resolution}", "markersize": 4}
            build.loglog(triangles, 1e3 * np.array(construction), style, **look)
            trace.semilogx(triangles, 1e9 * np.array(tracing), style, **look)
    build.set(xlabel="triangles", ylabel="construction, ms", ylim=(1, None))
    trace.set(xlabel="triangles", ylabel="tracing, ns a ray", ylim=(0, None))
    trace.legend(fontsize=7)
    save(figure, folder(options.growth) / "ldc-growth.png")
    return 0


def build_beside_embree(options):
    """Construction at 512 and Embree's build of the same mesh, in turn in one run."""
    scene = rs.load_scene(pathlib.Path(options.folder) / BUNNY.path)
    cube, conservative = Builder(scene), Builder(scene, exact=True)

    def from_vertices():
        cube.upload()
        cube.build()

    runs = {
        "Embree's build": lambda: embree_build(scene),
        "cube": cube.build,
        "vertices uploaded, then cube": from_vertices,
        "exact cube": conservative.build,
    }
    times = in_turn(*runs.values(), rounds=21)
    print(f"{scene.num_triangles} triangles, resolution {cube.cube.resolution}")
    for name, mine in zip(runs, times, strict=True):
        ratio = np.median(mine / times[0])
        print(f"{name}: median {1e3 * np.median(mine):.2f} ms, least {1e3 * mine.min():.2f}, "
              f"{ratio:.2f} of Embree's (median of {len(mine)} ratios)")  # fmt: skip
    return verdict("slower than Embree", ["cube"] if np.median(times[1] / times[0]) > 1 else [])


def blocks(options):
    """Traversal of a frame's rays with the coarse level and without, in turn."""
    gains = {mode: {} for mode in MODES}
    for name in tqdm(chosen(options, [*SCENES, *EXACT_SCENES]), disable=None):
        real = EXACT_SCENES.get(name)
        scene = real.load(options.folder) if real else SCENES[name](options.folder)
        camera = real.camera if real else scene.camera
        for mode in gains:
            times = frame_traversals(scene, camera, options.size, **MODES[mode])
            gains[mode][name] = float(np.median(times[:, 1] / times[:, 0]))
            level, none = (f"{1e3 * t:.1f} ms" for t in np.median(times, axis=0))
            gain = f"{gains[mode][name]:.2f} times"
            print(f"{name}, {mode}: {level}, without blocks {none}, {gain}", flush=True)
    low = []
    for mode, of_mode in gains.items():
        mean = np.exp(np.mean(np.log(list(of_mode.values()))))
        print(f"{mode}: geometric mean of {len(of_mode)} scenes {mean:.2f}")
        low += [] if mean >= MIN_GAIN else [mode]
    return verdict(f"gain below {MIN_GAIN}", low)


# ---- under pytest (`make bench`) ----


@pytest.mark.parametrize("exact", [False, True])
def test_construction_of_the_bunny(benchmark, scene_folder, exact):
    benchmark(Builder(rs.load_scene(scene_folder / BUNNY.path), exact=exact).build)


@pytest.mark.parametrize("mode", MODES)
def test_frame_of_the_mirroring_bunny(benchmark, scene_folder, mode):
    benchmark(rs.Renderer(SCENES["bunny"](scene_folder), "ldc", **MODES[mode]).render)


def test_a_cube_map_shows_what_a_camera_sees_from_its_centre():
    scene, centre = rs.scenes.cornell(), np.array([270.0, 400.0, 150.0])
    cubes = CubeMap(scene, centre, size=256)
    camera = rs.Camera.look_at(centre, centre + [0.7, -1.0, 0.4], fov_y=80.0)
    rays = primary_rays(camera, (96, 96), (0.5, 0.5))
    seen = cubes.look_up(rays.directions).reshape(96, 96, 3)
    expected = render_reference(scene, camera, (96, 96), max_bounces=0).image
    assert np.median(np.abs(seen - expected)) < 1e-3  # but for edges and rims of shadows
    assert np.mean(np.abs(seen - expected).max(axis=2) > 0.02) < 0.05


# ---- the command ----


def chosen(options, known):
    return [name for name in known if not options.scenes or name in options.scenes]


def folder(path):
    path.mkdir(parents=True, exist_ok=True)
    return path


def save(figure, path):
    figure.tight_layout()
    figure.savefig(path, dpi=100)


def verdict(what, names):
    """Print which of them are not as wanted; the part's exit code."""
    print(f"{what}: {', '.join(names) if names else 'none'}", flush=True)
    return 1 if names else 0


PARTS = {
    "pictures": pictures,
    "tolerance": tolerances,
    "gaps": gaps,
    "exact": exact,
    "table": table,
    "growth": growths,
    "embree_build": build_beside_embree,
    "blocks": blocks,
}


def parse():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    for part, run in PARTS.items():
        kind = {"action": "store_true"}
        if part in ("pictures", "tolerance", "growth"):
            kind = {"type": pathlib.Path, "metavar": "FOLDER"}
        parser.add_argument(f"--{part.replace('_', '-')}", help=run.__doc__.split("\n")[0], **kind)
    parser.add_argument("--scenes", help="some of the scenes, by name", default="")
    parser.add_argument("--rays", type=int, default=100_000, help="of --gaps, each kind of --exact")
    parser.add_argument("--size", default="512x512", help="of the frames of --blocks")
    options = parser.parse_args()
    options.folder = os.environ.get("RAYSTREAM_SCENES")
    if not options.folder:
        parser.error("RAYSTREAM_SCENES does not name the folder of test scenes")
    known = {*SCENES, *EXACT_SCENES, *SOUPS}
    options.scenes = options.scenes.split(",") if options.scenes else []
    for name in options.scenes:
        if name not in known:
            parser.error(f"no scene {name!r}; the scenes: {', '.join(sorted(known))}")
    if not any(getattr(options, part) for part in PARTS):
        parser.error(f"choose a part: {', '.join(PARTS)}")
    options.size = tuple(int(x) for x in options.size.split("x"))
    return options


def main():
    options = parse()
    return max(run(options) for part, run in PARTS.items() if getattr(options, part))


if __name__ == "__main__":
    sys.exit(main())
