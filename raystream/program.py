"""Building OpenCL programs from the files of ``cl/``.

Includes are expanded here, not by the compiler: ``-I`` fails on a path with a space, and the
``#line`` directives keep the file and the line in every error message.
"""

import functools
import pathlib
import re

import pyopencl as cl

from raystream.errors import BuildError

_INCLUDE = re.compile(r'^\s*#include\s+"([^"]+)"\s*$')
_OPTIONS = ("-cl-std=CL1.2",)


def source_folder():
    """The folder of the OpenCL sources: in the installed package, beside it in a checkout."""
    package = pathlib.Path(__file__).parent
    inside = package / "cl"
    return inside if inside.is_dir() else package.parent / "cl"


@functools.lru_cache
def expand(name):
    """The source of ``cl/<name>`` with its includes in place, each header once.

    Raises
    ------
    FileNotFoundError
        A file does not exist; names the including file.
    """
    lines = []
    _expand_into(name, "raystream", set(), lines)
    return "\n".join(lines) + "\n"


def _expand_into(name, includer, seen, lines):
    path = source_folder() / name
    if not path.is_file():
        raise FileNotFoundError(f"{includer} includes {name!r}, which is not in the cl folder")
    seen.add(name)
    lines.append(f'#line 1 "{name}"')
    for number, line in enumerate(path.read_text().splitlines(), start=1):
        match = _INCLUDE.match(line)
        if match is None:
            lines.append(line)
        else:
            if match[1] not in seen:
                _expand_into(match[1], name, seen, lines)
            lines.append(f'#line {number + 1} "{name}"')


def build(context, name, defines=()):
    """Build ``cl/<name>`` and return its kernels by name.

    Parameters
    ----------
    context : pyopencl.Context
    name : str
        File name in ``cl/``.
    defines : tuple of (str, value)
        Build-time constants; each file's head says which it needs.

    Returns
    -------
    dict of str to pyopencl.Kernel
        A kernel object holds its arguments: use one set of kernels per thread.

    Raises
    ------
    BuildError
        The compiler's log, after one line that names the file and the options.
    """
    options = [*_OPTIONS, *(f"-D{key}={value}" for key, value in sorted(defines))]
    try:
        program = cl.Program(context, expand(name)).build(options)
    except cl.RuntimeError as error:
        raise BuildError(f"cl/{name} does not build with {' '.join(options)}:\n{error}") from None
    return {kernel.function_name: kernel for kernel in program.all_kernels()}
