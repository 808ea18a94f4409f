"""Draw small changes of code that tests should notice.

Changed are operators, comparisons, signs, numbers, conditions and calls whose result
nobody uses. Texts, annotations and what is raised stay as they are.
"""

from __future__ import annotations

import ast
import copy
import random
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

_SWAPPED = [(ast.Add, ast.Sub), (ast.Mult, ast.Div), (ast.BitAnd, ast.BitOr)]
_OPERATORS: dict[type[ast.operator], type[ast.operator]] = {
    **{a: b for pair in _SWAPPED for a, b in (pair, pair[::-1])},
    **{ast.FloorDiv: ast.Div, ast.Mod: ast.Mult, ast.Pow: ast.Mult},
}
_ORDERS = [(ast.Lt, ast.LtE), (ast.Gt, ast.GtE), (ast.Eq, ast.NotEq)]
_COMPARISONS: dict[type[ast.cmpop], type[ast.cmpop]] = {
    a: b
    for pair in [*_ORDERS, (ast.Is, ast.IsNot), (ast.In, ast.NotIn)]
    for a, b in (pair, pair[::-1])
}


_Node = ast.expr | ast.stmt


@dataclass(frozen=True)
class Change:
    """Replace one expression or statement of a file: its bytes from start to end."""

    path: str
    line: int
    kind: str
    start: int
    end: int
    before: str
    after: str

    def applied(self, source: str) -> str:
        data = source.encode()
        return (data[: self.start] + self.after.encode() + data[self.end :]).decode()


def draw(root: Path, folders: Sequence[str], count: int, seed: int) -> list[Change]:
    """Draw changes of files under some folders, each as likely as any other."""
    candidates: list[Change] = []
    for folder in folders:
        base = root / folder
        for path in sorted(base.rglob("*.py")) if base.is_dir() else [base]:
            candidates += changes(path.relative_to(root).as_posix(), path.read_text())
    return random.Random(seed).sample(candidates, min(count, len(candidates)))


def changes(path: str, source: str) -> list[Change]:
    starts = [0]
    for text in source.encode().splitlines(keepends=True):
        starts.append(starts[-1] + len(text))
    candidates: list[Change] = []
    for node, kind, after in _nodes(ast.parse(source)):
        assert node.end_lineno is not None and node.end_col_offset is not None
        start = starts[node.lineno - 1] + node.col_offset
        end = starts[node.end_lineno - 1] + node.end_col_offset
        before = source.encode()[start:end].decode()
        candidates.append(Change(path, node.lineno, kind, start, end, before, after))
    return candidates


def _nodes(node: ast.AST) -> Iterator[tuple[_Node, str, str]]:
    """Yield what can be changed under a node: the node, the kind, its new source."""
    yield from _changed(node)
    for name, value in ast.iter_fields(node):
        if name in ("annotation", "returns", "decorator_list", "type_params"):
            continue
        for child in value if isinstance(value, list) else [value]:
            skipped = ast.JoinedStr | ast.Raise | ast.Import | ast.ImportFrom
            if isinstance(child, ast.AST) and not isinstance(child, skipped):
                if not _is_for_types(child):
                    yield from _nodes(child)


def _is_for_types(node: ast.AST) -> bool:
    return isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING"


def _changed(node: ast.AST) -> Iterator[tuple[_Node, str, str]]:
    match node:
        case ast.BinOp(op=op) | ast.AugAssign(op=op) if type(op) in _OPERATORS:
            yield node, "operator", _with(node, op=_OPERATORS[type(op)]())
        case ast.Compare(ops=[op]):
            yield node, "comparison", _with(node, ops=[_COMPARISONS[type(op)]()])
        case ast.BoolOp(op=op):
            other = ast.Or() if isinstance(op, ast.And) else ast.And()
            yield node, "logic", _with(node, op=other)
        case ast.UnaryOp(op=ast.USub(), operand=operand):
            yield node, "sign", f"({ast.unparse(operand)})"
        case ast.UnaryOp(op=ast.Not(), operand=operand):
            yield node, "logic", f"({ast.unparse(operand)})"
        case ast.Constant(value=bool(value)):
            yield node, "number", str(not value)
        case ast.Constant(value=int(value) | float(value)):
            other = value + 1 if isinstance(value, int) else 2 * value or 1.0
            yield node, "number", repr(other)
        case ast.Expr(value=ast.Call()):
            yield node, "call", "pass"
    test = getattr(node, "test", None)
    if isinstance(node, ast.If | ast.IfExp) and test is not None:
        yield test, "condition", f"(not ({ast.unparse(test)}))"
    if isinstance(node, ast.comprehension):
        for test in node.ifs:
            yield test, "condition", f"(not ({ast.unparse(test)}))"


def _with(node: ast.AST, **fields: object) -> str:
    changed = copy.copy(node)
    for name, value in fields.items():
        setattr(changed, name, value)
    text = ast.unparse(changed)
    return text if isinstance(node, ast.AugAssign) else f"({text})"
