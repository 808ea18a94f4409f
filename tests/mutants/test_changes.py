"""Each kind of change, on code small enough to read."""

from __future__ import annotations

import ast

import pytest
from mutants.changes import changes, draw
from mutants.run import FOLDERS, PACKAGE, ROOT


@pytest.mark.parametrize(
    ("source", "expected"),
    [
        ("x = a + b", ["x = (a - b)"]),
        ("x *= a", ["x /= a"]),
        ("x = a < b", ["x = (a <= b)"]),
        ("x = a is None", ["x = (a is not None)"]),
        ("x = a and b", ["x = (a or b)"]),
        ("x = -a", ["x = (a)"]),
        ("x = not a", ["x = (a)"]),
        ("x = 2.0", ["x = 4.0"]),
        ("x = 0.0", ["x = 1.0"]),
        ("x = True", ["x = False"]),
        ("f(a)", ["pass"]),
        ("if a:\n    x = b", ["if (not (a)):\n    x = b"]),
        ("x = [a for a in b if a]", ["x = [a for a in b if (not (a))]"]),
        ("x = 'é', a - b", ["x = 'é', (a + b)"]),
        ("x: Literal[1] = a", []),
        ("raise E(1 + a)", []),
        ("x = f'{a + b}'", []),
        ("'text'", []),
    ],
)
def test_what_is_changed(source, expected):
    assert [change.applied(source) for change in changes("a.py", source)] == expected


def test_every_change_of_the_package_is_code_and_no_other_line_differs():
    first, again, other = (
        draw(ROOT / PACKAGE, FOLDERS, 200, seed) for seed in (0, 0, 1)
    )
    assert first == again != other
    for change in first:
        source = (ROOT / PACKAGE / change.path).read_text()
        applied, index = change.applied(source), change.line - 1
        assert ast.unparse(ast.parse(applied)) != ast.unparse(ast.parse(source))
        assert applied.splitlines()[:index] == source.splitlines()[:index]
