"""Names say what they hold, and a call shows which argument is which."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
FOLDERS = ("mi_nerfattack", "plugins", "scenes", "bench", "tests", "docs")
VAGUE = set(
    "found given seen kept wanted told here rest parts more how about whole".split()
)
#: Names that users write, or that stand in files.
TIED = {
    "mi_nerfattack/commands/retrain.py": {"more"},
    "mi_nerfattack/commands/train.py": {"more"},
    "bench/studies/plan.py": {"wanted"},
    "docs/examples/two_cameras.py": {"rest", "seen"},
}


def sources() -> Iterator[Path]:
    for folder in FOLDERS:
        for path in sorted((ROOT / folder).rglob("*.py")):
            name = path.relative_to(ROOT).as_posix()
            # links to the folders of the same names
            if not name.startswith(("mi_nerfattack/scenes/", "mi_nerfattack/plugins/")):
                yield path


def defined(tree: ast.AST) -> Iterator[str]:
    """Yield the names of variables, parameters, attributes, functions and classes."""
    for node in ast.walk(tree):
        match node:
            case ast.Name(id=name, ctx=ast.Store()):
                yield name
            case ast.Attribute(attr=name, ctx=ast.Store()):
                yield name
            case ast.arg(arg=name) | ast.alias(asname=str(name)):
                yield name
            case ast.FunctionDef(name=name) | ast.ClassDef(name=name):
                yield name


def assigned(target: ast.AST, value: ast.AST) -> Iterator[tuple[ast.AST, ast.AST]]:
    """Yield what gets which value, also inside of ``a, b = x, y``."""
    yield target, value
    if isinstance(target, ast.Tuple) and isinstance(value, ast.Tuple):
        for one, part in zip(target.elts, value.elts, strict=False):
            yield from assigned(one, part)


def splatted(tree: ast.AST) -> Iterator[str]:
    """Yield calls ``f(*name)`` of a tuple that the same function has built."""
    for function in ast.walk(tree):
        if isinstance(function, ast.FunctionDef):
            nodes = list(ast.walk(function))
            pairs = [
                pair
                for node in nodes
                if isinstance(node, ast.Assign)
                for pair in assigned(node.targets[0], node.value)
            ]
            tuples = {
                target.id
                for target, value in pairs
                if isinstance(target, ast.Name) and isinstance(value, ast.Tuple)
            }
            for call in nodes:
                for argument in call.args if isinstance(call, ast.Call) else ():
                    match argument:
                        case ast.Starred(value=ast.Name(id=name)) if name in tuples:
                            yield ast.unparse(call)


def vague(path: Path) -> set[str]:
    names = {name for name in defined(ast.parse(path.read_text("utf-8")))}
    return {name for name in names if name.strip("_").lower() in VAGUE}


def test_no_name_is_vague():
    tied = {ROOT / name: names for name, names in TIED.items()}
    unexpected = {str(path): vague(path) - tied.get(path, set()) for path in sources()}
    assert {path: names for path, names in unexpected.items() if names} == {}
    assert {path: vague(path) for path in tied} == tied


def test_no_tuple_is_built_to_be_splatted():
    splats = {
        f"{path}: {call}"
        for path in sources()
        if "tests" not in path.relative_to(ROOT).parts
        for call in splatted(ast.parse(path.read_text("utf-8")))
    }
    assert splats == set()


@pytest.mark.parametrize(
    ("source", "names"),
    [
        ("found = 1", {"found"}),
        ("def f(_kept): pass", {"_kept"}),
        ("self.seen = 1", {"seen"}),
        ("class Told: pass", {"Told"}),
        ("for rest, (more, x) in y: pass", {"rest", "more"}),
        ("import a as parts", {"parts"}),
        ("seen_cells = found_at", set()),
    ],
)
def test_the_walk_sees(source, names, tmp_path):
    path = tmp_path / "source.py"
    path.write_text(source)
    assert vague(path) == names


def test_the_walk_sees_splats():
    source = "def f():\n    pair, n = (1, 2), 3\n    g(*pair, n)\n    h(*others)"
    assert list(splatted(ast.parse(source))) == ["g(*pair, n)"]
    assert list(splatted(ast.parse(source.replace(", n = (1, 2), 3", " = 1, 2"))))
