"""A picture of what bench_dual.py printed: how fast `dual` is, by scene and kind of rays.

Usage: python tests/bench/dual_plot.py LOG PNG
"""

import pathlib
import re
import sys

import matplotlib

matplotlib.use("Agg")  # no display is needed
import matplotlib.pyplot as plt
import numpy as np

TITLES = {
    "frame": "a moving scene: new vertices to hits",
    "trace": "a scene that stands: tracing alone",
}
_CASE = re.compile(r"^(\S+) (\S+) (\d+): ")
_RATIO = re.compile(r"^  (frame|trace): .*; ratio (\S+)$")


def read(path):
    """(question, scene, kind) to ratio."""
    ratios, case = {}, None
    for line in path.read_text().splitlines():
        if (found := _CASE.match(line)) is not None:
            case = found[1], found[2]
        elif (found := _RATIO.match(line)) is not None:
            ratios[(found[1], *case)] = float(found[2])
    return ratios


def draw(ratios, path):
    scenes, kinds = (list(dict.fromkeys(key[k] for key in ratios)) for k in (1, 2))
    figure, panels = plt.subplots(
        1, 2, figsize=(3 + 1.7 * len(kinds), 1.5 + 0.4 * len(scenes)), layout="constrained"
    )
    for panel, (question, title) in zip(panels, TITLES.items(), strict=True):
        table = np.array([[ratios[question, s, k] for k in kinds] for s in scenes])
        panel.imshow(np.log2(table), cmap="RdYlGn", vmin=-3, vmax=3, aspect="auto")
        for (row, column), ratio in np.ndenumerate(table):
            panel.text(column, row, f"{ratio:.2f}", ha="center", va="center")
        mean = np.exp(np.log(table).mean())
        panel.set_title(f"{title}\ngeometric mean {mean:.2f}", fontsize=10)
        panel.set_xticks(range(len(kinds)), kinds)
        panel.set_yticks(range(len(scenes)), scenes)
    figure.suptitle("times as fast as the better of Open3D and Mitsuba", fontsize=11)
    figure.savefig(path, dpi=90)


if __name__ == "__main__":
    draw(read(pathlib.Path(sys.argv[1])), sys.argv[2])
