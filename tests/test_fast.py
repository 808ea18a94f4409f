"""`make test-fast` runs tests that are there, and that use every folder of the package.

A test uses a folder if it names something that its file imports from a module of the
folder. For example, `from mi_nerfattack.deploy import Roadside` counts for
`deploy/roadside`, which the stub of `deploy` names. Imports of `support` do not count.
"""

from __future__ import annotations

import ast
from functools import cache
from pathlib import Path

from mi_nerfattack.io import files

ROOT = Path(__file__).parents[1]
LISTED = (ROOT / "tests/fast.txt").read_text("utf-8").split()
TOML = files.read_toml(ROOT / "pyproject.toml")
FOLDERS: list[str] = TOML["tool"]["setuptools"]["packages"]


@cache
def parsed(path: Path) -> list[ast.stmt]:
    return ast.parse(path.read_text("utf-8")).body


def folder_of(module: str, name: str) -> str:
    """Return the folder that defines the name which a test imports from a module."""
    if f"{module}.{name}" in FOLDERS:
        return f"{module}.{name}"
    if module not in FOLDERS:
        return module.rpartition(".")[0]
    stub = ROOT.joinpath(*module.split("."), "__init__.pyi")
    for node in parsed(stub) if stub.exists() else ():
        if isinstance(node, ast.ImportFrom) and name in [x.name for x in node.names]:
            return f"{module}.{node.module}".rpartition(".")[0]
    return module


def is_test(node: ast.stmt) -> bool:
    kinds = ast.FunctionDef | ast.ClassDef
    return isinstance(node, kinds) and node.name.lower().startswith("test")


def quick_tests(body: list[ast.stmt], name: str = "") -> list[ast.stmt]:
    """Return the tests of a file, or the named one, that no mark makes slow."""
    marks = [ast.unparse(node) for node in body if isinstance(node, ast.Assign)]
    if any(mark.startswith("pytestmark") and "mark.slow" in mark for mark in marks):
        return []
    return [
        node
        for node in body
        if is_test(node)
        and name in ("", node.name)
        and "pytest.mark.slow" not in map(ast.unparse, node.decorator_list)
    ]


def used_folders(body: list[ast.stmt], name: str = "") -> set[str]:
    """Return the folders of what quick tests and the helpers of their file name."""
    tests = quick_tests(body, name)
    used = [node for node in body if not is_test(node) or node in tests]
    nodes = [node for top in used for node in ast.walk(top)]
    words = {node.id for node in nodes if isinstance(node, ast.Name)}
    return {
        folder_of(node.module, alias.name)
        for node in nodes
        if isinstance(node, ast.ImportFrom) and node.module is not None
        for alias in node.names
        if node.module.split(".")[0] == "mi_nerfattack"
        and (alias.asname or alias.name) in words
    }


def split(listed: str) -> tuple[list[ast.stmt], str]:
    file, _, name = listed.partition("[")[0].partition("::")
    return parsed(ROOT / file), name


def test_each_line_is_new_and_names_a_quick_test():
    assert len(set(LISTED)) == len(LISTED)
    modules = {line for line in LISTED if "::" not in line}
    assert not [x for x in LISTED if "::" in x and x.partition("::")[0] in modules]
    assert not [listed for listed in LISTED if not quick_tests(*split(listed))]


def test_the_list_uses_every_folder_of_the_package():
    used = {folder for listed in LISTED for folder in used_folders(*split(listed))}
    assert not set(FOLDERS) - used


SOURCE = """
from mi_nerfattack.deploy import Roadside, Surroundings as Around
from mi_nerfattack.io import files
from mi_nerfattack.vehicle.route.route import Route

def test_rule(): Roadside()

@pytest.mark.slow
def test_route(): Route()
"""


def test_only_names_that_a_quick_test_uses_count():
    body = ast.parse(SOURCE).body
    assert used_folders(body) == {"mi_nerfattack.deploy.roadside"}
    assert used_folders(body, "test_route") == set()
