"""The page of faults names tests that are there and collected."""

from __future__ import annotations

import ast
import re
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
NAMED = re.findall(r"`(tests/[^`]*)`", (ROOT / "docs/faults.md").read_text("utf-8"))
TESTS = sorted({name for name in NAMED if "::" in name})


@cache
def collected(path: Path) -> set[str]:
    """The functions and methods of a file that pytest takes for tests."""
    found = set()
    for node in ast.parse(path.read_text("utf-8")).body:
        if isinstance(node, ast.ClassDef) and node.name.startswith("Test"):
            methods = (item for item in node.body if isinstance(item, ast.FunctionDef))
            found |= {f"{node.name}::{item.name}" for item in methods}
        elif isinstance(node, ast.FunctionDef):
            found.add(node.name)
    return {name for name in found if name.rpartition("::")[2].startswith("test_")}


@pytest.mark.parametrize("name", TESTS)
def test_a_named_test_is_there(name):
    file, _, test = name.partition("::")
    assert Path(file).name.startswith("test_")
    assert test in collected(ROOT / file)


def test_every_row_names_a_test():
    rows = re.findall(r"^\|(.*)\|$", (ROOT / "docs/faults.md").read_text("utf-8"), re.M)
    promises = [row for row in rows if not re.fullmatch(r"[-|]+|.* shown by ", row)]
    assert len(promises) > 30
    assert all(any(name in row for name in TESTS) for row in promises)
