"""How the time of tracing with `dual` grows with the triangles and with the rays; run as

    RAYSTREAM_SCENES=... python tests/bench/dual_growth.py

The same shape at several sizes, a scene that stands, every choice automatic, rays in device arrays;
medians. "ten times": the factor of ten times the triangles, from the smallest size to each.
"""

import os
import pathlib
import sys
import time

import numpy as np
from pyopencl.array import to_device

sys.path.insert(0, str(pathlib.Path(__file__).parent.parent))

from bench_dual import flat, rays_of
from real_scenes import COUNT_SCENES

import raystream as rs
from raystream import device

SIZES = {"bunny": (3851, 16301, 69451), "dragon": (11102, 47794, 871414)}
KINDS, COUNTS = ("primary", "mirror", "random"), (262_144, 1_048_576)
ROUNDS = 9


def milliseconds(scene, rays):
    """Median time of tracing; the first calls may still change the hierarchy."""
    queue = device.session().queue
    origins, directions, tfar = rays
    arrays, tracer = [to_device(queue, array) for array in (origins, directions)], rs.Tracer(scene)
    seconds = []
    for _ in range(ROUNDS + 3):
        start = time.perf_counter()
        tracer.intersect(*arrays, 0.0, tfar)
        seconds.append(time.perf_counter() - start)
    return 1e3 * float(np.median(seconds[3:]))


def main():
    folder = pathlib.Path(os.environ["RAYSTREAM_SCENES"])
    for shape, sizes in SIZES.items():
        real, first = COUNT_SCENES[shape], {}
        for size in sizes:
            scene = flat(rs.load_scene(folder / shape / f"{shape}-{size}.ply"))
            for kind in KINDS:
                times = [
                    milliseconds(scene, rays_of(kind, scene, real.camera, real.light, count))
                    for count in COUNTS
                ]
                smallest, least = first.setdefault(kind, (size, times[0]))
                line = f"{shape} {size} {kind}: {times[0]:.1f}, {times[1]:.1f} ms"
                line += f"; four times the rays {times[1] / times[0]:.2f}"
                if size != smallest:
                    exponent = np.log(times[0] / least) / np.log(size / smallest)
                    line += f"; ten times the triangles {10**exponent:.2f}"
                print(line, flush=True)


if __name__ == "__main__":
    main()
