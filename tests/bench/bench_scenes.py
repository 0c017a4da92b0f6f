"""Every ray of eight real scenes against Embree, and the pictures against the reference renderer.

    RAYSTREAM_SCENES=... python tests/bench/bench_scenes.py [-o FOLDER] [--methods rsh,brute]

Prints a table per scene; writes side-by-side pictures with -o.
"""

import argparse
import os
import pathlib
import sys

sys.path.insert(0, str(pathlib.Path(__file__).parent.parent))

from real_scenes import REAL_SCENES
from tqdm import tqdm

from raystream import compare, tables
from raystream import image as images


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("-o", "--output", type=pathlib.Path)
    parser.add_argument("--methods", default="rsh,brute")
    parser.add_argument("--size", default="512x512")
    parser.add_argument("--only", help="a scene's name")
    options = parser.parse_args()
    folder = os.environ.get("RAYSTREAM_SCENES")
    if not folder:
        parser.error("RAYSTREAM_SCENES does not name the folder of test scenes")
    size = tuple(int(x) for x in options.size.split("x"))
    chosen = [s for s in REAL_SCENES if options.only in (None, s.name)]
    failed = []
    for real in tqdm(chosen, disable=None):
        scene = real.load(folder)
        names = options.methods.split(",")
        results, reference = compare.compare(scene, names, real.camera, size)
        print(f"\n{real.name}: {scene.num_triangles} triangles")
        print("\n".join(tables.table(results)), flush=True)
        failed += [f"{real.name}/{r.method}" for r in results if not r.ok]
        if options.output:
            options.output.mkdir(parents=True, exist_ok=True)
            picture = compare.side_by_side(results, reference)
            images.save(options.output / f"{real.name}.png", picture)
    print(f"\nnot within the rules: {', '.join(failed) if failed else 'none'}")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
