"""Comparisons as lines of text: times and checks, and what every method counted."""

from raystream.statistics import (
    COMPRESSION,
    DECOMPRESSION,
    FINAL_INTERSECTION,
    GEOMETRY,
    HIERARCHY_CREATION,
    RASTERISATION,
    RAY_CREATION,
    SHADING,
    SORTING,
    STREAM_REDUCTION,
    TRAVERSAL,
)

# The order of tables 5 to 7 of Reis et al. 2017; stages that are not here come after these.
_STAGES = (
    GEOMETRY,
    RASTERISATION,
    RAY_CREATION,
    COMPRESSION,
    SORTING,
    DECOMPRESSION,
    HIERARCHY_CREATION,
    TRAVERSAL,
    STREAM_REDUCTION,
    FINAL_INTERSECTION,
    SHADING,
)


def table(results):
    """The comparison as lines of text: one row per method, then one per kind of ray."""
    rows = [("method", "time", "rays/s", "tests", "SSIM", "PSNR")]
    for r in results:
        counts = r.frame.statistics
        rows.append(
            (
                r.method,
                f"{r.seconds * 1e3:.1f} ms",
                f"{counts.rays / r.seconds / 1e6:.2f} M",
                f"{counts.total_tests / 1e6:.2f} M" if counts.total_tests else "-",
                f"{r.ssim:.5f}",
                f"{r.psnr:.1f} dB",
            )
        )
    checks = [("method", "rays", "traced", "differ from Embree", "ties", "ours", "wrong")]
    for r in results:
        for kind, c in r.checks.items():
            checks.append((r.method, kind, c.rays, c.differing, c.ties, c.ours, c.wrong))
    lines = _aligned(rows)
    return lines + ([""] + _aligned(checks) if len(checks) > 1 else [])


def _aligned(rows):
    widths = [max(len(str(row[i])) for row in rows) for i in range(len(rows[0]))]
    return [
        "  ".join(
            str(cell).ljust(width) if i == 0 else str(cell).rjust(width)
            for i, (cell, width) in enumerate(zip(row, widths, strict=True))
        ).rstrip()
        for row in rows
    ]


def count_tables(results):
    """What was counted, as lines of text, after tables 1 to 7 of Reis et al. 2017.

    For each kind of ray what every method tested, level by level; then the sums of all methods
    beside each other; then the times of the stages. Methods that count nothing (Embree) are in
    the last table only.
    """
    counting = [r for r in results if r.frame.statistics.total_tests]
    kinds = dict.fromkeys(kind for r in counting for kind in r.frame.kinds)
    lines = []
    for kind in kinds:
        lines += [*_kind_table(kind, counting), ""]
    if counting:
        lines += [*_sum_table(counting), ""]
    return lines + _stage_table(results)


def _kind_table(kind, results):
    blocks = []
    for r in results:
        counts = r.frame.kinds.get(kind)
        if counts is not None:
            size = f"{counts.rays:,} rays x {counts.triangles:,} triangles"
            names = _level_names(r.frame.statistics)
            names = names[len(names) - len(counts.levels) :]  # a small stream has fewer levels
            blocks.append((f"{r.method}: {size}", _count_rows(counts, names)))
    return _in_blocks((f"{kind} rays", "nodes", "tests", "misses", "hits"), blocks)


def _level_names(statistics):
    """Names of the levels of a frame, top first; the last may be the rays themselves.

    Asked of the whole frame: in a small stream every node of the lowest level may hold one ray.
    """
    if not statistics.levels:
        return []
    rays_tested = statistics.levels[-1]["nodes"] == statistics.rays
    numbered = [f"level {n}" for n in range(len(statistics.levels) - rays_tested, 0, -1)]
    return numbered + ["rays"] * rays_tested


def _count_rows(counts, level_names):
    rows = [("mesh tests", "", f"{counts.mesh_tests:,}", "", "")] if counts.mesh_tests else []
    for name, level in zip(level_names, counts.levels, strict=True):
        rows.append((name, *(f"{level[key]:,}" for key in ("nodes", "tests", "misses", "hits"))))
    final = counts.final_tests, counts.final_tests - counts.final_hits, counts.final_hits
    return [
        *rows,
        ("final", "", *(f"{count:,}" for count in final)),
        ("total", "", f"{counts.total_tests:,}", "", ""),
        ("of brute force", "", _share_of_brute_force(counts), "", ""),
    ]


def _share_of_brute_force(counts):
    return f"{counts.total_tests / (counts.rays * counts.triangles):.2%}"


def _sum_table(results):
    first = results[0]
    rows = [("all rays", "rays", "tests", "of brute force", f"against {first.method}")]
    for r in results:
        counts = r.frame.statistics
        change = counts.total_tests / first.frame.statistics.total_tests - 1
        rows.append(
            (
                r.method,
                f"{counts.rays:,}",
                f"{counts.total_tests:,}",
                _share_of_brute_force(counts),
                "-" if r is first else f"{change:+.2%}",
            )
        )
    return _aligned(rows)


def _stage_table(results):
    blocks = []
    for r in results:
        wall = {stage: times["wall"] for stage, times in r.frame.statistics.stages.items()}
        total = sum(wall.values())
        in_order = [stage for stage in dict.fromkeys((*_STAGES, *wall)) if stage in wall]
        rows = [(s, f"{wall[s] * 1e3:.3f}", f"{wall[s] / total:.2%}") for s in in_order]
        blocks.append((f"{r.method}: {r.seconds * 1e3:.1f} ms a frame", rows))
    return _in_blocks(("stages", "ms", "share"), blocks)


def _in_blocks(header, blocks):
    """Rows in columns that all blocks share, each block below its own line of text."""
    lines = _aligned([header, *((f"  {row[0]}", *row[1:]) for _, rows in blocks for row in rows)])
    indented = iter(lines[1:])
    return lines[:1] + [
        line for title, rows in blocks for line in (title, *(next(indented) for _ in rows))
    ]
