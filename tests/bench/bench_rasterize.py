"""Primary visibility against Embree's primary rays, in turns within one run.

Usage: RAYSTREAM_SCENES=folder python tests/bench/bench_rasterize.py [name ...]

Prints the shortest time of a frame (binning and drawing from raw triangles; Embree: traversal only,
its tree is built before), the pixels where the two differ, and device milliseconds by kernel.
"""

import os
import pathlib
import sys
import time

import numpy as np
import trimesh
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene

from raystream import device
from raystream.camera import Camera
from raystream.rasterize import Rasterizer

REPEATS = 7


def mesh_corners(file):
    mesh = trimesh.load(
        pathlib.Path(os.environ["RAYSTREAM_SCENES"], file), process=False, force="mesh"
    )
    return np.float32(mesh.vertices)[mesh.faces]


def fitted(file, distance=1.0):
    """Corners of a model and a camera that sees it whole, `distance` times farther than needed."""
    corners = mesh_corners(file)
    camera = Camera.fit([corners.min(axis=(0, 1)), corners.max(axis=(0, 1))])
    eye = camera.target + distance * (camera.eye - camera.target)
    return corners, Camera.look_at(eye, camera.target)


def sponza():
    eye = np.array([-12.0, 4.0, 0.0])
    return mesh_corners("sponza/sponza-dabrovic.obj"), Camera.look_at(
        eye, eye + [1, -0.05, 0.1], fov_y=60
    )


def huge():
    corners = np.random.default_rng(1).normal(size=(20, 3, 3)) * 10
    return np.float32(corners), Camera.look_at((0, 0, 30), (0, 0, 0))


def crowded():
    """All triangles within one tile."""
    rng = np.random.default_rng(2)
    corners = rng.normal(size=(50_000, 1, 3)) * 0.03 + rng.normal(size=(50_000, 3, 3)) * 0.03
    return np.float32(corners), Camera.look_at((0, 0, 10), (0, 0, 0))


SCENES = {
    "bunny": (lambda: fitted("bunny/bunny-69451.ply"), (512, 512)),
    "dragon": (lambda: fitted("dragon/dragon-871414.ply"), (512, 512)),
    "dragon-far": (lambda: fitted("dragon/dragon-871414.ply", 20), (512, 512)),
    "sponza": (sponza, (512, 512)),
    "sponza-hd": (sponza, (1920, 1080)),
    "huge": (huge, (1920, 1080)),
    "crowded": (crowded, (512, 512)),
}


def seconds(function):
    begin = time.perf_counter()
    result = function()
    return time.perf_counter() - begin, result


def kernel_times(session, frame):
    """Device milliseconds of a frame by kernel: each launch's stage is renamed to its kernel."""
    launch = session.launch
    session.launch = lambda stage, kernel, *args, **options: launch(
        kernel.function_name, kernel, *args, **options
    )
    frame()
    del session.launch
    times = session.finish()
    return {name: round(1e3 * stage["device"], 2) for name, stage in times.items()}


def compare(name, session, rasterizer):
    make, size = SCENES[name]
    corners, camera = make()
    packed = np.pad(corners, ((0, 0), (0, 0), (0, 1))).reshape(-1, 12)
    triangles = session.upload("bench", packed)
    scene = EmbreeScene(robust=True)
    TriangleMesh(scene, corners)
    origins, directions = camera.rays(size)
    scene.run(origins[:1], directions[:1], output=1)  # builds the tree

    def frame():
        hits = rasterizer.render(triangles, camera, size)
        session.finish()
        return hits

    ours, theirs = np.inf, np.inf
    for _ in range(REPEATS):
        time_ours, hits = seconds(frame)
        time_theirs, embree = seconds(lambda: scene.run(origins, directions, output=1))
        ours, theirs = min(ours, time_ours), min(theirs, time_theirs)
    differ = np.count_nonzero(hits.prim.get().astype(np.int32) != embree["primID"])
    print(
        f"{name:10} {size[0]}x{size[1]} {len(corners):7} triangles: {1e3 * ours:6.2f} ms, "
        f"Embree {1e3 * theirs:6.2f} ms, {differ} pixels differ"
    )
    print(f"           {kernel_times(session, lambda: rasterizer.render(triangles, camera, size))}")


def main(names):
    session = device.session()
    rasterizer = Rasterizer(session)
    for name in names or SCENES:
        compare(name, session, rasterizer)


if __name__ == "__main__":
    main(sys.argv[1:])
