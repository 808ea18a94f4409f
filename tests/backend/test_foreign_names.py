"""What is used of Dr.Jit and Mitsuba is there in the installed versions.

Types cannot tell: our stub of Dr.Jit takes every name, and what is private or
undocumented may go with any release.
"""

from __future__ import annotations

import ast
from collections.abc import Iterator
from functools import cache, reduce
from pathlib import Path

import drjit as dr
import mitsuba as mi
import pytest
import trimesh
from drjit import nn
from drjit.hashgrid import HashGridEncoding

ROOT = Path(__file__).parents[2]
# Private to their owners.
PRIVATE = {
    "_cache": trimesh.Trimesh(),
    "_level_scale": HashGridEncoding,
    "_resolution": HashGridEncoding,
}
# Of PyTrees, and left out of Dr.Jit's own stubs.
FIELDS = {"data": HashGridEncoding, "layers": nn.Sequential, "weights": nn.Linear}
DETAIL = {
    "drjit.detail.collect_indices",
    "drjit.detail.llvm_version",
    "drjit.detail.malloc_clear_statistics",
    "drjit.detail.malloc_watermark",
    "mitsuba.detail.add_variant_callback",
}
PYTHON = {"_exit"}  # documented under these names
ROOTS = {"dr": dr, "drjit": dr, "mi": mi, "mitsuba": mi}


@cache
def nodes() -> list[tuple[Path, ast.AST]]:
    folders = ("mi_nerfattack", "plugins", "scenes", "bench")
    return [
        (path.relative_to(ROOT), node)
        for folder in folders
        for path in (ROOT / folder).rglob("*.py")
        for node in ast.walk(ast.parse(path.read_text("utf-8")))
    ]


def dotted(node: ast.AST) -> list[str]:
    if isinstance(node, ast.Name):
        return [node.id]
    before = dotted(node.value) if isinstance(node, ast.Attribute) else []
    return [*before, node.attr] if before else []


def foreign() -> Iterator[tuple[str, list[str]]]:
    """Yield where a name of Dr.Jit or Mitsuba stands, and its parts."""
    for path, node in nodes():
        identifiers = dotted(node) if isinstance(node, ast.Attribute) else []
        if identifiers and identifiers[0] in ROOTS:
            yield f"{path}:{node.lineno}", identifiers


def test_private_names_of_others():
    used, own = set(), set()
    for _, node in nodes():
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            own.add(node.name)
        elif isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
            own.add(node.target.id)
        elif isinstance(node, ast.Attribute):
            kind = used if isinstance(node.ctx, ast.Load) else own
            kind.add(node.attr)
    private = {name for name in used - own if name[0] == "_" and name[-2:] != "__"}
    assert private == PRIVATE.keys() | PYTHON


def test_modules_of_details():
    roots = {name: module.__name__ for name, module in ROOTS.items()}
    used = {
        ".".join([roots[identifiers[0]], *identifiers[1:]])
        for _, identifiers in foreign()
    }
    assert {name for name in used if ".detail." in name} == DETAIL


def test_private_names_and_fields_are_there():
    assert all(hasattr(owner, name) for name, owner in PRIVATE.items())
    assert all(name in owner.DRJIT_STRUCT for name, owner in FIELDS.items())


@pytest.mark.usefixtures("spectral")  # it has what RGB has
def test_every_name_is_there():
    missing = set()
    for place, (root, *attributes) in foreign():
        try:
            reduce(getattr, attributes, ROOTS[root])
        except AttributeError as error:
            missing.add(f"{place}: {error}")
    assert not missing, "\n".join(sorted(missing))
