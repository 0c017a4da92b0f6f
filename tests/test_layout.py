"""The rules of CONTRIBUTING.md about files and imports, checked by reading the sources."""

import ast
import pathlib
import re

import pytest

ROOT = pathlib.Path(__file__).parent.parent
PACKAGE = sorted((ROOT / "raystream").glob("*.py"))
BASELINES = sorted((ROOT / "baselines").glob("*.py"))
KERNEL_FILES = sorted((ROOT / "cl").glob("*.cl"))

# Lower tiers first; a module imports only from lower tiers.
TIERS = (
    {"_version", "errors", "checks"},
    {"pocl", "program", "statistics"},
    {"device"},
    {"camera", "light", "material", "image"},
    {"gltf", "shapes"},
    {"mesh", "plants"},
    {"scene"},
    {"spd", "packet_scenes", "rays", "geometry", "bvh", "scan", "reduce", "sort", "groups"},
    {"scenes", "pairs", "hash", "compress"},
    {"objects", "order", "intersect", "rasterize", "shade", "stream", "sah"},
    {"hierarchy", "cube", "tree"},
    {"traverse"},
    {"brute", "rsh", "ldc", "packet", "dual"},
    {"crsh"},
    {"tracer", "host_tracer"},
    {"renderer"},
    {"compare", "tables", "__init__"},
    {"__main__"},
)


# The three traversals that raystream/dual.py chooses between.
TRAVERSALS_OF_DUAL = {"single", "bundle", "ray_stream"}


def imports(path):
    """Names of the modules that a file imports, at any depth of its code."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            module = "raystream." + (node.module or "") if node.level else node.module
            module = module.rstrip(".")
            yield module
            yield from (f"{module}.{alias.name}" for alias in node.names)


def tier_of(name):
    return next(level for level, modules in enumerate(TIERS) if name in modules)


def test_every_module_has_a_tier():
    assert {path.stem for path in PACKAGE} == set().union(*TIERS)


@pytest.mark.parametrize("path", PACKAGE, ids=lambda p: p.stem)
def test_imports_go_down(path):
    own = {module for tier in TIERS for module in tier}
    used = {name.split(".")[1] for name in imports(path) if name.startswith("raystream.")}
    for name in used & own - {"__init__"}:
        assert tier_of(name) < tier_of(path.stem), f"{path.stem} imports {name}"


def test_only_the_mesh_loader_imports_trimesh():
    users = {p.stem for p in PACKAGE if any(n.split(".")[0] == "trimesh" for n in imports(p))}
    assert users == {"mesh"}


def test_only_comparisons_import_the_baselines():
    uses = {p.stem: any(n.startswith("raystream.baselines") for n in imports(p)) for p in PACKAGE}
    users = {name for name, used in uses.items() if used}
    assert users == {"compare"}


@pytest.mark.parametrize("path", BASELINES, ids=lambda p: p.stem)
def test_baselines_import_nothing_from_raystream(path):
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and not node.level:
            assert not node.module.startswith("raystream")
        if isinstance(node, ast.Import):
            assert not any(alias.name.startswith("raystream") for alias in node.names)


def test_every_kernel_file_has_its_module():
    modules = {path.stem for path in PACKAGE}
    assert {path.stem for path in KERNEL_FILES} - TRAVERSALS_OF_DUAL <= modules


def test_every_kernel_is_launched_by_name():
    host = "\n".join(path.read_text() for path in PACKAGE)
    for path in KERNEL_FILES:
        kernels = re.findall(r"^\s*kernel void (\w+)\(", path.read_text(), re.MULTILINE)
        kernels += re.findall(r"^DEFINE_INTERSECT_PAIRS\((\w+),", path.read_text(), re.MULTILINE)
        for kernel in set(kernels) - {"NAME"}:
            assert f'"{kernel}"' in host, f"{path.name}: {kernel} is never launched"
