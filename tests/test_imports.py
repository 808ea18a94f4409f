"""The arrows between the parts, read off the source without running it."""

from __future__ import annotations

import ast
import importlib
import sys
from collections.abc import Iterator
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

from mi_nerfattack import files

ROOT = Path(__file__).parents[1]
PACKAGE = "mi_nerfattack"
FOLDERS = {
    PACKAGE: ROOT / PACKAGE,
    f"{PACKAGE}.bench": ROOT / "bench",
    f"{PACKAGE}.plugins": ROOT / "plugins",
    f"{PACKAGE}.scenes": ROOT / "scenes",
}
# An earlier part of a chain never imports a later one.
CHAINS = [
    ("errors", "files", "fields", "render", "plugins", "bench", "commands", "cli"),
    ("errors", "vehicle", "rollout", "attack", "scale", "commands", "cli"),
]
FORBIDDEN = [
    ("rollout", "policy"),
    ("deploy", "attack"),
    ("robot", "attack"),
    ("vehicle", "render"),
]
TORCH_PARTS = {"policy", "bridge", "bench"}  # bench: the peer is in torch


def modules() -> Iterator[tuple[str, Path]]:
    """Yield the name and file of every module of the source tree."""
    for prefix, folder in FOLDERS.items():
        for path in sorted(folder.rglob("*.py")):
            parts = path.relative_to(folder).with_suffix("").parts
            if parts[-1] == "__init__":
                parts = parts[:-1]
            yield ".".join((prefix, *parts)), path


SOURCES = dict(modules())


def imported(name: str) -> Iterator[str]:
    """Yield the full names that a module imports, anywhere in its source."""
    path = SOURCES[name]
    package = name if path.name == "__init__.py" else name.rpartition(".")[0]
    for node in walk(ast.parse(path.read_text("utf-8"), str(path))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = node.module or ""
            if node.level:
                up = package.split(".")[: len(package.split(".")) - node.level + 1]
                base = ".".join([*up, base] if base else up)
            for alias in node.names:
                full = f"{base}.{alias.name}"
                yield full if full in SOURCES else base


def walk(tree: ast.AST) -> Iterator[ast.AST]:
    """Yield the nodes of a tree but for what only a type checker sees."""
    if isinstance(tree, ast.If) and ast.unparse(tree.test) == "TYPE_CHECKING":
        return
    yield tree
    for child in ast.iter_child_nodes(tree):
        yield from walk(child)


def part(name: str) -> str:
    """Return the part that a module belongs to: the second component."""
    return (name.split(".") + [""])[1]


def own_imports() -> dict[str, set[str]]:
    """Return the modules of ours that each of our modules imports."""
    return {
        name: {item for item in imported(name) if item in SOURCES and item != name}
        for name in SOURCES
    }


OWN = own_imports()


@pytest.mark.parametrize("chain", CHAINS, ids="-".join)
def test_imports_point_down(chain):
    for name, targets in OWN.items():
        if part(name) in chain:
            above = chain[chain.index(part(name)) + 1 :]
            wrong = {target for target in targets if part(target) in above}
            assert not wrong, f"{name} imports {wrong}"


@pytest.mark.parametrize(("source", "target"), FORBIDDEN)
def test_part_does_not_know_the_other(source, target):
    for name, targets in OWN.items():
        if part(name) == source:
            assert target not in {part(item) for item in targets}, name


def test_no_two_modules_import_each_other():
    # A package's __init__ re-exports its modules, which is no dependency on them.
    graph = {
        name: targets
        for name, targets in OWN.items()
        if SOURCES[name].name != "__init__.py"
    }
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as err:
        pytest.fail(f"modules import each other: {err.args[1]}")


def test_only_policy_and_bench_import_torch():
    for name in SOURCES:
        roots = {item.split(".")[0] for item in imported(name)}
        if part(name) not in TORCH_PARTS:
            assert "torch" not in roots, name


def test_nothing_unpickles():
    for name in SOURCES:
        roots = {item.split(".")[0] for item in imported(name)}
        assert not roots & {"pickle", "dill", "cloudpickle", "shelve"}, name


def test_only_files_opens_files():
    for name, path in SOURCES.items():
        if name == f"{PACKAGE}.files" or part(name) == "scenes":
            continue
        for node in ast.walk(ast.parse(path.read_text("utf-8"))):
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Name):
                assert node.func.id != "open", f"{name}, line {node.lineno}"


def test_every_folder_is_packaged():
    table = files.read_toml(ROOT / "pyproject.toml")["tool"]["setuptools"]
    present = {
        name if path.name == "__init__.py" else name.rpartition(".")[0]
        for name, path in SOURCES.items()
    }
    assert present == set(table["packages"])


@pytest.mark.parametrize("name", ["bench", "plugins", "scenes"])
def test_outer_folders_import_under_the_package(name):
    if not (ROOT / name / "__init__.py").is_file():
        pytest.skip(f"{name} is no package")
    module = importlib.import_module(f"{PACKAGE}.{name}")
    assert module.__name__ in sys.modules
    assert module.__file__ is not None


def test_the_package_takes_its_arrows_seriously():
    """Guard the test itself: the walk sees imports inside functions."""
    assert f"{PACKAGE}.doctor" in OWN[f"{PACKAGE}.commands.doctor"]
    assert f"{PACKAGE}.errors" in OWN[f"{PACKAGE}.files"]
