"""The command line: what it writes, prints and refuses."""

import numpy as np
import pytest

import raystream as rs
from raystream import __main__ as cli


def run(capsys, *arguments):
    """Exit code, output and error lines of one run."""
    try:
        code = cli.main([str(a) for a in arguments])
    except SystemExit as error:  # argparse
        code = error.code
    captured = capsys.readouterr()
    return code, captured.out, captured.err


def test_render_writes_a_picture(capsys, tmp_path):
    path = tmp_path / "a.npy"
    code, out, err = run(
        capsys, "render", "cornell", "-o", path, "--size", "20x10", "--eye", "278,273,-800",
        "--target", "278,273,0", "--fov", 40, "--light", "278,400,100", "--mirror", "back*",
        "--samples", 2, "--bounces", 1, "--method", "brute",
    )  # fmt: skip
    assert (code, err) == (0, "")
    assert np.load(path).shape == (10, 20, 3)
    assert str(path) in out and "secondary rays" in out


def test_render_traces_primary_rays_where_asked(capsys, tmp_path):
    code, out, err = run(
        capsys, "render", "cornell", "-o", tmp_path / "a.npy", "--size", "20x10", "--bounces", 0,
        "--method", "packet:traversal=ranged", "--primary", "trace",
    )  # fmt: skip
    assert (code, err) == (0, "")
    frame = rs.render(rs.scenes.cornell(), size=(20, 10), max_bounces=0, primary="trace")
    assert f"{frame.statistics.rays} rays, packet" in out


def test_vectors_may_begin_with_a_minus(capsys, tmp_path):
    code, _, err = run(
        capsys, "render", "cornell", "-o", tmp_path / "a.png", "--size", "4x4",
        "--eye", "-1,2,-3", "--light", "-.5,1,1",
    )  # fmt: skip
    assert (code, err) == (0, "")


def test_verify_checks_the_picture(capsys, tmp_path):
    code, out, _ = run(
        capsys, "render", "demo", "-o", tmp_path / "a.png", "--size", "48x32", "--verify"
    )
    assert code == 0
    assert "differ from Embree" in out and "SSIM" in out


def test_compare_prints_the_table_and_writes_pictures(capsys, tmp_path):
    code, out, _ = run(
        capsys, "compare", "cornell:mirrors", "--methods", "rsh,brute,embree", "--size", "32x32",
        "-o", tmp_path / "pictures",
    )  # fmt: skip
    assert code == 0
    names = {path.name for path in (tmp_path / "pictures").iterdir()}
    assert {"rsh.png", "rsh-difference.png", "reference.png", "side-by-side.png"} <= names
    rows = {line.split()[0] for line in out.splitlines() if line}
    assert {"rsh", "brute", "embree"} <= rows


def test_methods_take_options(capsys, tmp_path):
    code, out, _ = run(
        capsys, "compare", "cornell:mirrors", "--methods", "rsh:arity=8:levels=2, rsh", "--size",
        "24x24", "-o", tmp_path,
    )  # fmt: skip
    assert code == 0
    assert {line.split()[0] for line in out.splitlines() if line} >= {"rsh:arity=8:levels=2", "rsh"}
    assert {path.name for path in tmp_path.iterdir()} == {
        "rsh-arity-8-levels-2.png", "rsh-arity-8-levels-2-difference.png", "rsh.png",
        "rsh-difference.png", "reference.png", "side-by-side.png",
    }  # fmt: skip


def test_render_takes_options_of_the_method(capsys, tmp_path):
    code, out, _ = run(
        capsys, "render", "cornell", "-o", tmp_path / "a.png", "--size", "16x16", "--method",
        "rsh:arity=8", "--verify",
    )  # fmt: skip
    assert code == 0
    assert "rays, rsh:arity=8" in out.splitlines()[0]
    assert sum(line.startswith("rsh:arity=8 ") for line in out.splitlines()) == 1 + 3


def test_counts_are_printed_where_asked(capsys):
    arguments = ("compare", "cornell", "--methods", "rsh:arity=8:levels=2,rsh", "--size", "48x48")
    plain, counted = run(capsys, *arguments), run(capsys, *arguments, "--counts")
    assert plain[0] == counted[0] == 0
    frame = rs.render(rs.scenes.cornell(), size=(48, 48), method="rsh", arity=8, levels=2)
    lines, shadows = counted[1].splitlines(), frame.kinds["shadow"]
    assert f"rsh:arity=8:levels=2: {shadows.rays:,} rays x 32 triangles" in lines
    top = shadows.levels[0]
    row = ["level", "2", *(f"{top[key]:,}" for key in ("nodes", "tests", "misses", "hits"))]
    assert row in [line.split() for line in lines]
    assert "shadow rays" not in plain[1] and "level 2" not in plain[1]
    assert len(lines) > len(plain[1].splitlines())


def test_a_failed_check_is_exit_code_1(capsys, monkeypatch):
    from raystream import compare

    monkeypatch.setattr(compare, "MIN_PSNR", 1000.0)
    code, _, err = run(capsys, "compare", "cornell", "--methods", "rsh", "--size", "8x8")
    assert code == 1 and "not within the rules: rsh" in err


def test_a_scene_with_mirror_ball_and_procedural_argument(capsys, tmp_path):
    code, _, _ = run(
        capsys, "render", "rings:1", "-o", tmp_path / "a.png", "--size", "16x16",
        "--mirror-ball", "-1,0,0.5,0.4", "--glass", "*",
    )  # fmt: skip
    assert code == 0


def test_devices_marks_the_default(capsys):
    code, out, _ = run(capsys, "devices")
    assert code == 0
    assert sum(line.startswith("*") for line in out.splitlines()) == 1


@pytest.mark.parametrize(("arguments", "message"), [
    (["render", "gone.obj", "-o", "a.png"], "gone.obj"),
    (["render", "cornell", "-o", "a.gif"], "a.gif: need a file name that ends in"),
    (["render", "cornell", "-o", "a.png", "--method", "bvh"], "method: need one of"),
    (["render", "cornell", "-o", "a.png", "--mirror", "nothing*"], "nothing*"),
    (["render", "cornell", "-o", "a.png", "--bounces", "-1"], "max_bounces"),
    (["render", "cornell", "-o", "a.png", "--samples", "0"], "samples"),
    (["render", "cornell", "-o", "a.png", "--primary", "rays"], "invalid choice: 'rays'"),
    (["render", "cornell:heavy", "-o", "a.png"], "variant"),
    (["render", "rings:0", "-o", "a.png"], "size"),
    (["render", "cornell", "-o", "a.png", "--method", "rsh:arity"], "need key=value"),
    (["render", "cornell", "-o", "a.png", "--method", "rsh:arity=5"], "arity: need one of 4, 8"),
    (["render", "cornell", "-o", "a.png", "--method", "rsh:leaf=2"], "its options: arity, levels"),
    (["compare", "cornell", "--methods", "rsh,fast"], "'embree', got 'fast'"),
    (["compare", "cornell", "--methods", "rsh:arity"], "need key=value"),
    (["compare", "cornell", "--methods", "brute:arity=8"], "its options: none"),
    (["compare", "cornell", "--methods", "embree:arity=8"], "'embree' has no options, got arity"),
    (["compare", "cornell", "--methods", ","], "--methods: need some of"),
    (["render", "demo:3", "-o", "a.png"], "scene 'demo' takes no argument"),
    (["render", "demo", "-o", "gone/a.png"], "no such folder"),
    (["render", "cornell", "-o", "a.png", "--size", "4by4"], "need WIDTHxHEIGHT, got '4by4'"),
    (["render", "cornell", "-o", "a.png", "--eye", "1,2"], "need 3 numbers with commas"),
])  # fmt: skip
def test_bad_input_is_exit_code_2_and_one_line(capsys, tmp_path, monkeypatch, arguments, message):
    monkeypatch.chdir(tmp_path)
    code, _, err = run(capsys, *arguments)
    assert code == 2
    assert message in err and len(err.splitlines()) == 1
    assert not list(tmp_path.iterdir())


def test_every_command_has_examples(capsys):
    for command in ("render", "compare"):
        code, out, _ = run(capsys, command, "--help")
        assert code == 0 and f"raystream {command} " in out and "examples:" in out
    assert "--counts" in out.split("examples:")[1]
