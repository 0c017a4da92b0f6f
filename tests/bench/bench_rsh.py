"""`rsh` against `brute` and where its time goes; run with `make bench`.

pytest-benchmark prints the times; ratios and shares are printed by

    RAYSTREAM_SCENES=... python tests/bench/bench_rsh.py
"""

import os
import pathlib
import statistics as mean
import sys
import time

import numpy as np
import pytest

sys.path.insert(0, str(pathlib.Path(__file__).parent.parent))

from real_scenes import BUNNY, PATIO

import raystream as rs
from raystream import device
from raystream.pairs import REDUCTIONS
from raystream.statistics import (
    FINAL_INTERSECTION,
    GEOMETRY,
    RASTERISATION,
    STREAM_REDUCTION,
    TRAVERSAL,
)

SIZE = (512, 512)


class _Recorder(rs.Tracer):
    """Keeps the ray streams of a frame."""

    def __init__(self, scene):
        super().__init__(scene)
        self.bounces, self.shadows = [], []

    def intersect_stream(self, session, stream):
        self.bounces.append(stream)
        return super().intersect_stream(session, stream)

    def occluded_stream(self, session, stream):
        self.shadows.append(stream)
        return super().occluded_stream(session, stream)


def frame_rays(scene, camera, size, max_bounces, shadows):
    """The streams of a frame, on the device: those of its bounces and its shadow rays."""
    recorder = _Recorder(scene)
    rs.Renderer(scene, recorder).render(camera, size, max_bounces, shadows)
    return recorder.bounces, recorder.shadows


def reflection_rays(real, folder, size=SIZE):
    """The scene, and the first bounce of its mirror, on the device."""
    scene = real.load(folder)
    bounces, _ = frame_rays(scene, real.camera, size, max_bounces=1, shadows=False)
    return scene, bounces[0]


@pytest.fixture(params=[BUNNY, PATIO], ids=lambda real: real.name)
def reflections(request, scene_folder):
    return reflection_rays(request.param, scene_folder)


def trace(tracer, stream):
    """One call, in seconds, and its counts."""
    session = device.session()
    session.finish()
    start = time.perf_counter()
    tracer.intersect_stream(session, stream)
    stages = session.finish()
    return time.perf_counter() - start, tracer.statistics, stages


def test_reflections_by_rsh(benchmark, reflections):
    scene, stream = reflections
    tracer = rs.Tracer(scene, "rsh")
    benchmark(trace, tracer, stream)


def test_frame_of_the_demo_scene(benchmark):
    renderer = rs.Renderer(rs.scenes.demo(), "rsh")
    renderer.render(size=SIZE)
    benchmark(renderer.render, size=SIZE)


def in_turn(first, second, stream, rounds=5):
    """Seconds of both tracers, one after the other in every round: the machine's speed drifts."""
    for tracer in (first, second):
        trace(tracer, stream)
    pairs = [
        (mean.median(trace(first, stream)[0] for _ in range(3)), trace(second, stream)[0])
        for _ in range(rounds)
    ]
    return [list(column) for column in zip(*pairs, strict=True)]


def main():
    folder = os.environ.get("RAYSTREAM_SCENES")
    if not folder:
        sys.exit("RAYSTREAM_SCENES does not name the folder of test scenes")
    for real in (BUNNY, PATIO):
        scene, stream = reflection_rays(real, folder)
        tracer = rs.Tracer(scene, "rsh")
        rsh, brute = in_turn(tracer, rs.Tracer(scene, "brute"), stream)
        _, counts, stages = trace(tracer, stream)
        print(f"{real.name}: {counts.rays} reflection rays, {scene.num_triangles} triangles")
        ratio = mean.median(b / r for r, b in zip(rsh, brute, strict=True))
        times = f"rsh {mean.median(rsh) * 1e3:.1f} ms, brute {mean.median(brute) * 1e3:.0f} ms"
        print(f"  {times}; median of {len(rsh)} ratios, in turn: {ratio:.1f}")
        left = counts.final_tests / counts.rays
        print(f"  triangles left per ray after the last level: {left:.2f}")
        total = sum(s["wall"] for s in stages.values())
        for stage, seconds in stages.items():
            print(f"  {stage}: {seconds['wall'] * 1e3:.1f} ms, {seconds['wall'] / total:.1%}")
    frame_times()
    for name, scene, camera in frames_of_reductions(folder):
        compare_reductions(name, scene, camera)


def frames_of_reductions(folder):
    """The scenes whose whole frames show what a stream reduction of its own costs."""
    yield "mirror ball in sponza", PATIO.load(folder), PATIO.camera
    bumpy = rs.scenes.bumpy_mirror(3)
    yield "bumpy mirror, n = 3", bumpy, bumpy.camera


def compare_reductions(name, scene, camera):
    """Frame time and stage times of every reduction, and their ratio to the fused one."""
    print(f"{name}: frame at 512 x 512 by reduction")
    fused = None
    for reduction in REDUCTIONS:
        renderer = rs.Renderer(scene, "rsh", reduction=reduction)
        renderer.render(camera, SIZE)
        runs = 1 if reduction == "horn" else 3
        frames = [timed_frame(renderer, camera) for _ in range(runs)]
        seconds, frame = min(frames, key=lambda pair: pair[0])
        fused = fused or seconds
        stages = frame.statistics.stages
        parts = (TRAVERSAL, STREAM_REDUCTION, FINAL_INTERSECTION)
        shares = ", ".join(f"{stage} {stages[stage]['wall'] * 1e3:.0f} ms" for stage in parts)
        print(f"  {reduction}: {seconds * 1e3:.0f} ms, {seconds / fused:.2f} of fused; {shares}")


def timed_frame(renderer, camera):
    start = time.perf_counter()
    frame = renderer.render(camera, SIZE)
    return time.perf_counter() - start, frame


def frame_times():
    renderer = rs.Renderer(rs.scenes.demo(), "rsh")
    renderer.render(size=SIZE)
    seconds = []
    for _ in range(7):
        start = time.perf_counter()
        frame = renderer.render(size=SIZE)
        seconds.append(time.perf_counter() - start)
    print(f"demo at 512 x 512: {np.median(seconds) * 1e3:.0f} ms a frame after the first")
    for stage, times in frame.statistics.stages.items():
        if stage not in (GEOMETRY, RASTERISATION):
            print(f"  {stage}: {times['wall'] * 1e3:.1f} ms")


if __name__ == "__main__":
    main()
