"""Building programs: includes, errors."""

import pytest

from raystream import program
from raystream.errors import BuildError


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.setattr(program, "source_folder", lambda: tmp_path)
    program.expand.cache_clear()
    yield tmp_path
    program.expand.cache_clear()


def test_each_header_is_expanded_once_and_lines_keep_their_numbers(folder):
    (folder / "a.h").write_text("int a;\n")
    (folder / "b.h").write_text('#include "a.h"\nint b;\n')
    (folder / "c.cl").write_text('#include "b.h"\n#include "a.h"\nint c;\n')
    source = program.expand("c.cl")
    assert source.count("int a;") == 1
    lines = source.splitlines()
    assert lines[lines.index("int c;") - 1] == '#line 3 "c.cl"'


def test_a_missing_include_names_the_including_file(folder):
    (folder / "c.cl").write_text('#include "gone.h"\n')
    with pytest.raises(FileNotFoundError, match=r"c\.cl includes 'gone\.h'"):
        program.expand("c.cl")


def test_a_build_error_names_file_line_and_options(folder, session):
    (folder / "bad.cl").write_text("\nkernel void k(global int *x) { *x = nowhere; }\n")
    with pytest.raises(BuildError, match=r"(?s)cl/bad\.cl does not build.*-DN=3.*bad\.cl:2:"):
        program.build(session.context, "bad.cl", (("N", 3),))
