"""`make test-fast` runs tests that are there, and that use every folder of the package.

A test uses a folder if it names something that its file imports from a module of the
folder. For example, `from mi_nerfattack.deploy import Roadside` counts for
`deploy/roadside`, which the stub of `deploy` names. Imports of helpers do not count.
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


def imported(body: list[ast.stmt]) -> dict[str, str]:
    """Return the folder of each name that a file imports from the package."""
    nodes = [node for top in body for node in ast.walk(top)]
    return {
        alias.asname or alias.name: folder_of(node.module, alias.name)
        for node in nodes
        if isinstance(node, ast.ImportFrom)
        and node.module is not None
        and node.module.split(".")[0] == "mi_nerfattack"
        for alias in node.names
    }


def definitions(body: list[ast.stmt]) -> dict[str, ast.stmt]:
    """Return the statement of a file that defines each of its names."""
    found: dict[str, ast.stmt] = {}
    for node in body:
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            found[node.name] = node
        elif isinstance(node, ast.Assign | ast.AnnAssign):
            stored = [item for item in ast.walk(node) if isinstance(item, ast.Name)]
            found |= {x.id: node for x in stored if isinstance(x.ctx, ast.Store)}
    return found


def quick_tests(body: list[ast.stmt], name: str = "") -> list[str]:
    """Return the tests of a file, or the named one, that no mark makes slow."""
    known = definitions(body)
    if "pytestmark" in known and "mark.slow" in ast.unparse(known["pytestmark"]):
        return []
    return [
        word
        for word, node in known.items()
        if isinstance(node, ast.FunctionDef | ast.ClassDef)
        and (word == name or not name and word.lower().startswith("test"))
        and "pytest.mark.slow" not in map(ast.unparse, node.decorator_list)
    ]


def used_folders(body: list[ast.stmt], name: str = "") -> set[str]:
    """Follow the names in tests, and in what they call or ask for in the same file."""
    known, folders = definitions(body), imported(body)
    pending, seen = quick_tests(body, name), set[str]()
    while pending:
        word = pending.pop()
        if word in seen:
            continue
        seen.add(word)
        for node in ast.walk(known[word]) if word in known else ():
            if isinstance(node, ast.Name):
                pending.append(node.id)
            elif isinstance(node, ast.arg):  # the name of a fixture
                pending.append(node.arg)
    return {folders[word] for word in seen & set(folders)}


def split(listed: str) -> tuple[list[ast.stmt], str]:
    file, _, name = listed.partition("[")[0].partition("::")
    return parsed(ROOT / file), name


def test_each_line_is_new():
    assert len(set(LISTED)) == len(LISTED)
    whole = {line for line in LISTED if "::" not in line}
    assert not [x for x in LISTED if "::" in x and x.partition("::")[0] in whole]


def test_listed_tests_are_there_and_are_not_slow():
    assert not [listed for listed in LISTED if not quick_tests(*split(listed))]


def test_the_list_uses_every_folder_of_the_package():
    used = {folder for listed in LISTED for folder in used_folders(*split(listed))}
    assert not set(FOLDERS) - used


SOURCE = """
import pytest
from mi_nerfattack.deploy import Roadside, Surroundings as Around
from mi_nerfattack.io import files
from mi_nerfattack.render.camera.pose import Pose
from mi_nerfattack.vehicle.route.route import Route

@pytest.fixture
def rule():
    return Roadside()

def helper():
    return POSE

POSE = Pose()

def test_rule(rule):
    helper()

@pytest.mark.slow
def test_route():
    Route()
"""


def test_only_names_that_a_quick_test_uses_count():
    body = ast.parse(SOURCE).body
    rule = {"mi_nerfattack.deploy.roadside", "mi_nerfattack.render.camera"}
    assert used_folders(body) == used_folders(body, "test_rule") == rule
    assert used_folders(body, "test_route") == set()
    assert quick_tests(body) == ["test_rule"]
