"""`dual` against Open3D, Mitsuba and embreex; run as

    RAYSTREAM_SCENES=... python tests/bench/bench_dual.py [--threads 1,2] [--rays 262144,1048576]
                                          [--scenes ...] [--kinds ...]
                                          [--builder auto] [--amplitude 0.01]

Two questions, each asked of all in turn in every round, medians of the rounds:

frame   new vertices in numpy to hits in numpy: upload, build, trace, download; the vertices are
        those of a wave of 1 % of the scene's size that travels through it, eight frames long
trace   tracing alone: rays in each one's own arrays to hits in its own, the scene stands; our
        sorting of rays and choice of a traversal count

Hits are compared before times are printed: ours with Embree's by baselines/tolerance.py, where the
scene stands and after the wave's frames, those of the others by the share of rays that agree. Times
are milliseconds; a ratio is the time of the best of Open3D and Mitsuba over ours. embreex traces on
one thread, one ray at a time, whatever is asked for. With a builder named, or a wave of half the
scene's size (--amplitude 0.5), no tree of ours fits the next frame: each frame has a new one.
"""

import argparse
import os
import pathlib
import subprocess
import sys
import time

import numpy as np
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene
from pyopencl.array import to_device

sys.path.insert(0, str(pathlib.Path(__file__).parent.parent))

from raystream.baselines import EmbreeTracer
from raystream.baselines.tolerance import differing, differing_occlusion
from real_scenes import COUNT_SCENES

import raystream as rs
from raystream import device
from raystream.dual import TRAVERSALS

SCENES = ("bunny", "soup", "sponza", "conference", "office", "kitchen", "maple", "munich")
KINDS = ("primary", "mirror", "bumpy", "shadow", "random")
OPPONENTS = ("open3d", "mitsuba")  # the ratio is to the better of these
ROUNDS = 5
_PAUSE = 0.2  # seconds until the threads of the one before have stopped looking for work
_WARM = 0.06  # seconds until a processor that has paused is as fast as it gets
_BUMPINESS = 0.35  # of a normal of length 1
_OFF_SURFACE = 1e-4  # of the scene's size: where secondary rays start
_POSES, _WAVES = 8, 2  # of a wave that travels through the scene


# ---- scenes and rays ----


def soup():
    """100,000 small triangles in the unit cube, a camera and a light."""
    rng = np.random.default_rng(5)
    corners = rng.random((100_000, 1, 3)) + 0.02 * (rng.random((100_000, 3, 3)) - 0.5)
    faces = np.arange(300_000, dtype=np.int32).reshape(-1, 3)
    mesh = rs.Mesh(corners.reshape(-1, 3).astype(np.float32), faces, name="soup")
    camera = rs.Camera.look_at((0.5, 0.5, 2.2), (0.5, 0.5, 0.5), fov_y=45.0)
    return rs.Scene([mesh]), camera, (0.5, 3.0, 2.0)


def load(name, folder):
    """The scene, its camera and its light."""
    if name == "soup":
        return soup()
    real = COUNT_SCENES[name]
    return real.load(folder), real.camera, real.light


def visible_points(scene, camera, count):
    """`count` points that the camera sees, row by row: points, unit normals, unit directions."""
    embree, side = EmbreeTracer(scene.vertices, scene.faces), int(count**0.5)
    origins, directions = camera.rays((side, side))
    seen = (embree.intersect(origins[::7], directions[::7]).prim_id >= 0).mean()
    origins, directions = camera.rays((int(np.ceil(1.02 * side / seen**0.5)),) * 2)
    hits = embree.intersect(origins, directions)
    hit = np.flatnonzero(hits.prim_id >= 0)
    hit = hit[np.arange(count) * len(hit) // count]
    v0, v1, v2 = np.moveaxis(scene.vertices[scene.faces[hits.prim_id[hit]]].astype(float), 1, 0)
    directions = directions[hit].astype(float)
    points = origins[hit] + hits.t[hit, None] * directions
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    normals = np.cross(v1 - v0, v2 - v0)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)
    normals *= np.where(_dot(normals, directions) > 0, -1, 1)
    return points, normals, directions


def _dot(a, b):
    return (a * b).sum(axis=1, keepdims=True)


def _reflected(directions, normals):
    return directions - 2 * _dot(directions, normals) * normals


def rays_of(kind, scene, camera, light, count):
    """(origins, directions, tfar) of one of KINDS, `count` a square number."""
    rng = np.random.default_rng(7)
    if kind == "primary":
        return *camera.rays((int(count**0.5),) * 2), np.inf
    low, high = scene.vertices.min(axis=0), scene.vertices.max(axis=0)
    if kind == "random":
        return _float32(low + (high - low) * rng.random((count, 3)), rng.normal(size=(count, 3)))
    points, normals, directions = visible_points(scene, camera, count)
    starts = points + _OFF_SURFACE * (high - low).max() * normals
    if kind == "shadow":
        lights = np.tile(np.float64(light), (count, 1))
        return _float32(lights, starts - lights, tfar=1.0)
    if kind == "bumpy":
        bumpy = normals + _BUMPINESS * rng.normal(size=normals.shape)
        bumpy /= np.linalg.norm(bumpy, axis=1, keepdims=True)
        out = _reflected(directions, bumpy)
        return _float32(starts, np.where(_dot(out, normals) < 0, _reflected(out, normals), out))
    return _float32(starts, _reflected(directions, normals))


def _float32(origins, directions, tfar=np.inf):
    return origins.astype(np.float32), directions.astype(np.float32), tfar


def poses(vertices, amplitude=0.01):
    """The vertices in each frame of a wave: each coordinate swings along the next one."""
    low, size = vertices.min(axis=0), np.ptp(vertices, axis=0).max()
    along = np.roll((vertices - low) / size, -1, axis=1) * _WAVES
    phases = 2 * np.pi * (along + np.arange(_POSES)[:, None, None] / _POSES)
    return (vertices + amplitude * size * np.sin(phases)).astype(np.float32)


# ---- those who run ----


class Dual:
    """This library, every choice automatic, but for the builder where one is named."""

    builder = "auto"

    def __init__(self, scene, threads):
        self.tracer = rs.Tracer(scene, "dual", builder=self.builder)
        self._queue = device.session().queue

    def update(self, vertices):
        self.tracer.update_vertices(vertices)

    def prepare(self, origins, directions, tfar):
        return (*(to_device(self._queue, array) for array in (origins, directions)), 0.0, tfar)

    def trace(self, rays, any_hit):
        return self.tracer.occluded(*rays) if any_hit else self.tracer.intersect(*rays)

    def answer(self, hits, any_hit):
        fields = (hits,) if any_hit else (hits.t, hits.prim_id)
        return tuple(field if isinstance(field, np.ndarray) else field.get() for field in fields)

    def frame(self, vertices, origins, directions, tfar, any_hit):
        self.update(vertices)
        return self.trace((origins, directions, 0.0, tfar), any_hit)


class _Prepared:
    """A frame is a new scene, and rays and hits that pass through numpy."""

    def frame(self, vertices, origins, directions, tfar, any_hit):
        self.update(vertices)
        rays = self.prepare(origins, directions, tfar)
        return self.answer(self.trace(rays, any_hit), any_hit)


class Open3D(_Prepared):
    def __init__(self, scene, threads):
        import open3d

        self._module, self._threads = open3d, threads
        self._faces = scene.faces.astype(np.uint32)
        self.update(scene.vertices)

    def update(self, vertices):
        self._scene = self._module.t.geometry.RaycastingScene(nthreads=self._threads)
        self._scene.add_triangles(
            self._module.core.Tensor(vertices), self._module.core.Tensor(self._faces)
        )

    def prepare(self, origins, directions, tfar):
        rays = np.concatenate((origins, directions), axis=1)
        return self._module.core.Tensor(rays), tfar

    def trace(self, rays, any_hit):
        rays, tfar = rays
        if any_hit:
            return self._scene.test_occlusions(rays, tfar=tfar, nthreads=self._threads)
        return self._scene.cast_rays(rays, nthreads=self._threads)

    def answer(self, hits, any_hit):
        if any_hit:
            return (hits.numpy(),)
        return hits["t_hit"].numpy(), hits["primitive_ids"].numpy().view(np.int32)


class Mitsuba(_Prepared):
    """The llvm variant, which calls Embree with packets of rays."""

    def __init__(self, scene, threads):
        import drjit
        import mitsuba

        mitsuba.set_variant("llvm_ad_rgb")
        drjit.set_thread_count(threads)
        self._dr, self._mi = drjit, mitsuba
        mesh = mitsuba.Mesh("scene", len(scene.vertices), len(scene.faces))
        params = mitsuba.traverse(mesh)
        params["vertex_positions"] = scene.vertices.ravel()
        params["faces"] = scene.faces.astype(np.uint32).ravel()
        params.update()
        self._scene = mitsuba.load_dict({"type": "scene", "mesh": mesh})
        self._params = mitsuba.traverse(self._scene)
        names = [name for name, _ in self._params.items()]
        (self._key,) = (name for name in names if name.endswith("vertex_positions"))

    def update(self, vertices):
        self._params[self._key] = self._mi.Float(vertices.ravel())
        self._params.update()

    def prepare(self, origins, directions, tfar):
        mi = self._mi
        rays = mi.Ray3f(
            mi.Point3f(np.ascontiguousarray(origins.T)),
            mi.Vector3f(np.ascontiguousarray(directions.T)),
        )
        rays.maxt = tfar
        self._dr.eval(rays)
        return rays

    def trace(self, rays, any_hit):
        if any_hit:
            hits = self._scene.ray_test(rays)
            self._dr.eval(hits)
        else:
            hits = self._scene.ray_intersect_preliminary(rays)
            self._dr.eval(hits.t, hits.prim_index, hits.prim_uv)
        self._dr.sync_thread()
        return hits

    def answer(self, hits, any_hit):
        if any_hit:
            return (hits.numpy(),)
        t = hits.t.numpy()
        return t, np.where(np.isfinite(t), hits.prim_index.numpy().view(np.int32), -1)


class Embreex(_Prepared):
    def __init__(self, scene, threads):
        self._faces = scene.faces
        self.update(scene.vertices)

    def update(self, vertices):
        self._scene = EmbreeScene()
        TriangleMesh(self._scene, vertices, self._faces)

    def prepare(self, origins, directions, tfar):
        return origins, directions, tfar

    def trace(self, rays, any_hit):
        origins, directions, tfar = rays
        reach = np.full(len(origins), tfar, np.float32)
        if any_hit:
            return self._scene.run(origins, directions, dists=reach, query="OCCLUDED")
        return self._scene.run(origins, directions, dists=reach, output=1)

    def answer(self, hits, any_hit):
        return (np.asarray(hits) >= 0,) if any_hit else (hits["tfar"], hits["primID"])


RUNNERS = {"dual": Dual, "open3d": Open3D, "mitsuba": Mitsuba, "embreex": Embreex}


# ---- measuring ----


def compare_hits(scene, rays, any_hit, answers):
    """Our differences from Embree, judged, and the share of rays in which others agree with us."""
    origins, directions, tfar = rays
    arguments = (scene.vertices, scene.faces, None, origins, directions, 0.0, tfar)
    embree = EmbreeTracer(scene.vertices, scene.faces)
    ours = answers.pop("dual")
    if any_hit:
        expected = embree.occluded(origins, directions, 0.0, tfar)
        agreement = differing_occlusion(ours[0], expected, *arguments)
    else:
        expected = embree.intersect(origins, directions, 0.0, tfar)
        agreement = differing(_Answer(*ours), expected, *arguments)
    return agreement, {name: (a[-1] == ours[-1]).mean() for name, a in answers.items()}


class _Answer:
    def __init__(self, t, prim_id):
        self.t, self.prim_id = t, prim_id
        self.geom_id = np.where(prim_id >= 0, 0, -1)


def in_turn(runners, call, rounds=ROUNDS):
    """Median seconds of `call(name, step)` for each, one after the other in every round.

    Each runs for a while and then once more, which is timed, as in a loop over frames: sleeping
    threads, a slow clock and caches full of another's data are not what is compared.
    """
    seconds = {name: [] for name in runners}
    for _ in range(rounds):
        for name in runners:
            time.sleep(_PAUSE)
            step, begin = 0, time.perf_counter()
            while step == 0 or time.perf_counter() - begin < _WARM:
                call(name, step)
                step += 1
            start = time.perf_counter()
            call(name, step)
            seconds[name].append(time.perf_counter() - start)
    return {name: float(np.median(s)) for name, s in seconds.items()}


def flat(scene):
    """One mesh of all, so that triangle numbers are those of the scene."""
    return rs.Scene([rs.Mesh(scene.vertices, scene.faces, name="all")])


def measure(name, folder, kinds, counts, threads, amplitude):
    """Print a line for each kind and count; yields (question, kind, ratio)."""
    scene, camera, light = load(name, folder)
    scene = flat(scene)
    runners = {key: runner(scene, threads) for key, runner in RUNNERS.items()}
    frames = poses(scene.vertices, amplitude)
    last = rs.Scene([rs.Mesh(frames[-1], scene.faces, name="last")])
    for count in counts:
        for kind in kinds:
            rays = rays_of(kind, scene, camera, light, count)
            any_hit = kind == "shadow"
            answers, prepared = {}, {}
            for key, runner in runners.items():
                runner.update(scene.vertices)
                prepared[key] = runner.prepare(*rays)
                answers[key] = runner.answer(runner.trace(prepared[key], any_hit), any_hit)
            agreement, shares = compare_hits(scene, rays, any_hit, answers)
            agreeing = ", ".join(f"{key} {share:.5f}" for key, share in shares.items())
            print(f"{name} {kind} {count}: {agreement}; equal: {agreeing}")
            dual = runners["dual"]
            for pose in frames:
                moved = dual.answer(dual.frame(pose, *rays, any_hit), any_hit)
            agreement, _ = compare_hits(last, rays, any_hit, {"dual": moved})
            print(f"  after {_POSES} frames: {agreement}")

            def frame(key, step, rays=rays, any_hit=any_hit):
                runners[key].frame(frames[step % _POSES], *rays, any_hit)

            def trace(key, step, prepared=prepared, any_hit=any_hit):
                runners[key].trace(prepared[key], any_hit)

            for question, call in (("frame", frame), ("trace", trace)):
                for runner in runners.values():
                    runner.update(scene.vertices)
                seconds = in_turn(runners, call)
                ratio = min(seconds[key] for key in OPPONENTS) / seconds["dual"]
                times = ", ".join(f"{key} {s * 1e3:.1f}" for key, s in seconds.items())
                print(f"  {question}: {times} ms; ratio {ratio:.2f}", flush=True)
                yield question, f"{name} {kind} {count}", ratio


def missed_edges(count=1_000_000):
    """Rays from inside a sphere at vertices, middles of edges and on edges: how many miss it."""
    rng, scene = np.random.default_rng(3), rs.scenes.mirror_ball((0.0, 0.0, 0.0), 5.0)
    weights = np.eye(3)[rng.integers(0, 3, count)]
    weights[::3] = (1 - weights[::3]) / 2
    share = rng.random(len(weights[1::3]))
    weights[1::3] = np.stack((share, 1 - share, 0 * share), axis=1)
    corners = scene.vertices[scene.faces[rng.integers(0, len(scene.faces), count)]]
    aim = np.einsum("ij,ijk->ik", weights, corners.astype(float))
    origins = np.tile(np.float32([0.1, 0.2, 0.3]), (count, 1))
    rays = origins, (aim - origins).astype(np.float32)
    tracers = (rs.Tracer(scene, "dual", traversal=t) for t in TRAVERSALS)
    return sum(int((tracer.intersect(*rays).prim_id < 0).sum()) for tracer in tracers)


def summarise(ratios):
    """Geometric mean and worst of each question."""
    for question in ("frame", "trace"):
        found = {case: ratio for asked, case, ratio in ratios if asked == question}
        if found:
            mean = float(np.exp(np.mean(np.log(list(found.values())))))
            worst = min(found, key=found.get)
            print(f"{question}: geometric mean {mean:.2f}, worst {found[worst]:.2f} ({worst})")


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("--threads", default="1,2")
    parser.add_argument("--rays", default="262144,1048576")
    parser.add_argument("--scenes", default=",".join(SCENES))
    parser.add_argument("--kinds", default=",".join(KINDS))
    parser.add_argument("--builder", default=Dual.builder)
    parser.add_argument("--amplitude", type=float, default=0.01)
    arguments = parser.parse_args()
    Dual.builder = arguments.builder
    folder = os.environ.get("RAYSTREAM_SCENES")
    if not folder:
        sys.exit("RAYSTREAM_SCENES does not name the folder of test scenes")
    threads = [int(n) for n in arguments.threads.split(",")]
    if len(threads) > 1:  # PoCL's number of threads stands for a process
        for count in threads:
            print(f"---- {count} threads", flush=True)
            command = [sys.executable, *sys.argv, "--threads", str(count)]
            environment = {**os.environ, "POCL_MAX_PTHREAD_COUNT": str(count)}
            subprocess.run(command, env=environment, check=True)
        return
    os.environ["POCL_MAX_PTHREAD_COUNT"] = str(threads[0])
    counts = [int(n) for n in arguments.rays.split(",")]
    kinds, ratios = arguments.kinds.split(","), []
    print(f"10^6 rays at edges and vertices, every traversal: {missed_edges()} miss", flush=True)
    for name in arguments.scenes.split(","):
        ratios += measure(name, folder, kinds, counts, threads[0], arguments.amplitude)
    summarise(ratios)


if __name__ == "__main__":
    main()
