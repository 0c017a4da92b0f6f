"""Comparisons as text: the tables of what was counted."""

import re

import pytest

import raystream as rs
from raystream import compare, tables
from raystream.statistics import Statistics

EIGHT, FOUR, BRUTE = "rsh:arity=8:levels=2", "rsh", "brute"
SIZE = (48, 48)
ROW = re.compile(r"  (.+?)(?:  |$)")


@pytest.fixture(scope="module")
def results():
    """A scene with shadows and mirrors, by two kinds of hierarchy and two methods without."""
    scene = rs.scenes.cornell("mirrors")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(compare, "TIMED_FRAMES", 1)
        return compare.compare(scene, [EIGHT, FOUR, BRUTE, compare.EMBREE], size=SIZE)[0]


def blocks(lines):
    """The tables as {title of the table: {title of the block: {row: cells}}}."""
    found, table, block = {}, None, None
    for line in lines:
        if not line:
            table = None
        elif table is None:
            table = found[re.split("  +", line)[0]] = {}
        elif line.startswith("  "):
            name = ROW.match(line).group(1)
            block[name] = line[2 + len(name) :].split()
        else:
            block = table[line] = {}
    return found


def numbers(cells):
    return [int(cell.replace(",", "")) for cell in cells]


@pytest.mark.parametrize("kind", ["shadow", "reflection"])
@pytest.mark.parametrize("method", [EIGHT, FOUR, BRUTE])
def test_the_tables_print_the_statistics(results, kind, method):
    (result,) = (r for r in results if r.method == method)
    counts = result.frame.kinds[kind]
    table = blocks(tables.count_tables(results))[f"{kind} rays"]
    rows = table[f"{method}: {counts.rays:,} rays x {counts.triangles} triangles"]
    names = {EIGHT: ["level 2", "level 1"], BRUTE: [],
             FOUR: ["level 6", "level 5", "level 4", "level 3", "level 2", "level 1", "rays"]}
    assert list(rows) == [*names[method], "final", "total", "of brute force"]
    for name, level in zip(names[method], counts.levels, strict=True):
        assert numbers(rows[name]) == [level[k] for k in ("nodes", "tests", "misses", "hits")]
        assert level["tests"] == level["misses"] + level["hits"]
    tests, misses, hits = numbers(rows["final"])
    assert (tests, hits) == (counts.final_tests, counts.final_hits) and tests == misses + hits
    tested = [numbers(rows[name])[1] for name in names[method]] + [tests]
    assert numbers(rows["total"]) == [sum(tested)] == [counts.total_tests]
    share = 100 * counts.total_tests / (counts.rays * counts.triangles)
    assert rows["of brute force"] == [f"{share:.2f}%"]
    assert (method == BRUTE) == (rows["of brute force"] == ["100.00%"])


def test_the_sums_are_held_against_the_first_method(results):
    lines = tables.count_tables(results)
    (start,) = (i for i, line in enumerate(lines) if line.startswith("all rays"))
    assert lines[start].endswith(f"against {EIGHT}")
    sums = {line.split()[0]: line.split()[1:] for line in lines[start + 1 : start + 4]}
    assert list(sums) == [EIGHT, FOUR, BRUTE] and lines[start + 4] == ""
    tests = {r.method: r.frame.statistics.total_tests for r in results}
    brute = tests[BRUTE]
    for method, (rays, tested, share, change) in sums.items():
        assert numbers([rays, tested]) == [results[0].frame.statistics.rays, tests[method]]
        assert share == f"{100 * tests[method] / brute:.2f}%"
        expected = 100 * (tests[method] - tests[EIGHT]) / tests[EIGHT]
        assert change == ("-" if method == EIGHT else f"{expected:+.2f}%")
    by_kind = blocks(lines)
    totals = [rows["total"] for kind in ("shadow rays", "reflection rays")
              for title, rows in by_kind[kind].items() if title.startswith(f"{EIGHT}:")]
    assert sum(numbers(cells)[0] for cells in totals) == tests[EIGHT]


def test_the_stages_of_every_method(results):
    table = blocks(tables.count_tables(results))["stages"]
    assert [title.rpartition(": ")[0] for title in table] == [r.method for r in results]
    for result, rows in zip(results, table.values(), strict=True):
        stages = result.frame.statistics.stages
        assert set(rows) == set(stages)
        for stage, (milliseconds, _) in rows.items():
            assert milliseconds == f"{1e3 * stages[stage]['wall']:.3f}"
        assert sum(float(share[:-1]) for _, share in rows.values()) == pytest.approx(100, abs=0.1)
    in_order = list(table[next(title for title in table if title.startswith(EIGHT))])
    assert in_order.index("hierarchy creation") < in_order.index("traversal")
    assert in_order[-2:] == ["final intersection", "shading"]


def test_a_method_that_counts_nothing_is_in_the_stages_only(results):
    lines = tables.count_tables(results)
    assert sum(compare.EMBREE in line for line in lines) == 1
    alone = tables.count_tables([r for r in results if r.method == compare.EMBREE])
    assert alone[0].startswith("stages")


def made_up(kinds, **frame):
    """A result with such statistics by kind; those of the frame are their sum."""
    total = Statistics(**frame)
    for counts in kinds.values():
        total.add(counts)
    picture = rs.Frame(None, None, None, None, total, kinds)
    return compare.Comparison("crsh", 1.0, picture, {}, 1.0, 99.0)


def level(nodes, tests, hits):
    return {"nodes": nodes, "tests": tests, "hits": hits, "misses": tests - hits}


def test_mesh_tests_stand_above_the_levels():
    counts = Statistics([level(2, 20, 5), level(9, 40, 10)], 12, 80, 30, rays=16, triangles=10)
    stages = {"stages": {"traversal": {"wall": 0.5, "device": 0.25}}}
    lines = tables.count_tables([made_up({"refraction": counts}, **stages)])
    rows = blocks(lines)["refraction rays"]["crsh: 16 rays x 10 triangles"]
    assert list(rows.items())[:2] == [("mesh tests", ["12"]), ("level 2", ["2", "20", "15", "5"])]
    assert rows["total"] == ["152"] and rows["of brute force"] == ["95.00%"]


def test_levels_are_named_by_the_whole_frame():
    """In the small stream every node of level 1 holds one ray; it has a level less, too."""
    large = Statistics([level(2, 20, 5), level(9, 40, 10)], 0, 80, 30, rays=16, triangles=10)
    small = Statistics([level(3, 30, 9)], 0, 27, 1, rays=3, triangles=10)
    stages = {"stages": {"traversal": {"wall": 0.5, "device": 0.25}}}
    lines = tables.count_tables([made_up({"shadow": large, "reflection": small}, **stages)])
    kinds = blocks(lines)
    (rows,) = kinds["shadow rays"].values()
    assert list(rows)[:3] == ["level 2", "level 1", "final"]
    (rows,) = kinds["reflection rays"].values()
    assert list(rows)[:2] == ["level 1", "final"]
