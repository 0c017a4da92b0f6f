"""Figures 5 to 7 of Overbeck et al. (2008) from rows of bench_packet.py, whose values are text."""

import matplotlib

matplotlib.use("Agg")  # no display is needed
import matplotlib.pyplot as plt

_COLOURS = {"masked": "#d9a400", "ranged": "#1f3b99", "partition": "#c2279d"}


def draw_sizes(path, rows):
    """Figure 5: time over packet size, scenes to the right, kinds of ray downward."""
    lines = {name: ("seconds", {"traversal": name}, color, "-") for name, color in _COLOURS.items()}
    _draw_panels(path, rows, lines)


def draw_culling(path, rows):
    """Figure 7: as figure 5, Partition with and without frusta, in the paper's set-up and ours."""
    lines = {
        f"{setup}, {frusta} frusta": (f"{setup}, {frusta} frusta", {}, color, style)
        for setup, color in (("paper", "#444444"), ("default", _COLOURS["partition"]))
        for frusta, style in (("with", "-"), ("without", "--"))
    }
    _draw_panels(path, rows, lines)


def _draw_panels(path, rows, lines):
    """`lines`: label to the column that is drawn, what its rows have, colour and style."""
    scenes, kinds = (list(dict.fromkeys(r[key] for r in rows)) for key in ("scene", "kind"))
    figure, panels = plt.subplots(
        len(kinds), len(scenes), squeeze=False, layout="constrained",
        figsize=(1.2 + 2.4 * len(scenes), 0.8 + 1.8 * len(kinds)),
    )  # fmt: skip
    for i, kind in enumerate(kinds):
        for j, scene in enumerate(scenes):
            chosen = [r for r in rows if (r["scene"], r["kind"]) == (scene, kind)]
            _draw_lines(panels[i, j], chosen, lines)
            if i == 0:
                panels[i, j].set_title(scene)
        panels[i, 0].set_ylabel(f"{kind}\nms")
    for panel in panels[-1]:
        panel.set_xlabel("packet size")
    handles = panels[0, 0].get_legend_handles_labels()
    figure.legend(*handles, loc="outside lower center", ncols=min(len(lines), 1 + len(scenes)))
    figure.savefig(path, dpi=90)
    plt.close(figure)


def _draw_lines(panel, rows, lines):
    sizes = list(dict.fromkeys(r["packet size"] for r in rows))
    highest = {}
    for label, (column, wanted, color, style) in lines.items():
        chosen = [r for r in rows if all(r[key] == value for key, value in wanted.items())]
        times = [1e3 * float(r[column]) for r in chosen]
        panel.plot(range(len(sizes)), times, style, color=color, marker=".", label=label)
        highest[label] = max(times)
    if "masked" in highest:  # its times grow so far that no difference of the others is seen
        others = max(value for label, value in highest.items() if label != "masked")
        panel.set_ylim(0, min(1.08 * max(highest.values()), 1.6 * others))
    panel.set_ylim(bottom=0)
    panel.set_xticks(range(len(sizes)), sizes)
    panel.grid(alpha=0.4)


def draw_depths(path, rows):
    """Figure 6: tests against boxes by depth above, all tests of boxes and of triangles below."""
    kinds, traversals = (list(dict.fromkeys(r[key] for r in rows)) for key in ("kind", "traversal"))
    figure, panels = plt.subplots(
        2, len(kinds), squeeze=False, figsize=(4.2 * len(kinds), 6), layout="constrained"
    )
    for column, kind in zip(panels.T, kinds, strict=True):
        for place, traversal in enumerate(traversals):
            chosen = [r for r in rows if (r["kind"], r["traversal"]) == (kind, traversal)]
            color = _COLOURS[traversal]
            boxes, triangles = (
                [int(r[name]) / 1e6 for r in chosen] for name in ("box tests", "triangle tests")
            )
            column[0].step(range(len(boxes)), boxes, where="mid", color=color, label=traversal)
            totals = [sum(boxes), sum(triangles)]
            column[1].bar([k + 0.36 * (place - 0.5) for k in range(2)], totals, 0.34, color=color)
        column[0].set(title=f"{kind} rays", xlabel="depth in the tree", ylabel="box tests, million")
        column[1].set_xticks(range(2), ["boxes", "triangles"])
        column[1].set_ylabel("tests, million")
        for panel in column:
            panel.grid(alpha=0.4)
    panels[0, 0].legend()
    figure.savefig(path, dpi=90)
    plt.close(figure)
