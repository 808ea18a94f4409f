"""The page of questions quotes messages that the program prints."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PAGE = ROOT / "docs/reference/faq.md"
VALUE = "\0"  # where a message holds a value
ROW = re.compile(r"^\| `([^`]+)` \|.*\|$", re.M)
MESSAGES = ROW.findall(PAGE.read_text("utf-8"))


def literals(source: str) -> Iterator[str]:
    """Find the strings of a module but docstrings, with VALUE for each expression."""
    tree = ast.parse(source)
    nodes = list(ast.walk(tree))
    apart = {
        id(node.value) for node in nodes if isinstance(node, ast.Expr)
    }  # docstrings, and parts of f-strings
    for node in nodes:
        if isinstance(node, ast.JoinedStr):
            apart |= {id(part) for part in node.values}
    for node in nodes:
        if id(node) not in apart and isinstance(node, (ast.Constant, ast.JoinedStr)):
            yield from words(node)


def words(node: ast.Constant | ast.JoinedStr) -> Iterator[str]:
    if isinstance(node, ast.JoinedStr):
        yield "".join(
            str(part.value) if isinstance(part, ast.Constant) else VALUE
            for part in node.values
        )
    elif isinstance(node.value, str):
        yield node.value


def is_printed(message: str, strings: tuple[str, ...]) -> bool:
    """Tell whether one string has the fixed words of a message, in their order.

    Args:
        message: `...` is any text.
        strings: of :func:`literals`.
    """
    phrases = [phrase.strip(" :;,") for phrase in message.split("...")]
    pattern = re.compile(
        ".*".join(re.escape(phrase) for phrase in phrases if phrase), re.S
    )
    return any(pattern.search(string) for string in strings)


@cache
def printed() -> tuple[str, ...]:
    paths = sorted((ROOT / "mi_nerfattack").rglob("*.py"))
    return tuple(x for path in paths for x in literals(path.read_text("utf-8")))


def test_the_table_has_many_messages_each_once():
    rows = re.findall(r"^\| `", PAGE.read_text("utf-8"), re.M)
    assert len(rows) == len(MESSAGES) == len(set(MESSAGES)) >= 20


@pytest.mark.parametrize("message", MESSAGES)
def test_a_message_has_words_and_is_in_the_source(message):
    assert len(re.findall(r"[A-Za-z]{2,}", message)) >= 3
    assert is_printed(message, printed())


SOURCE = '''
"""The docstring is not printed."""
raise InputError(
    f"{path}: {count} rows, "
    "at least 2 are needed"
)
told = "no " f"file {name!r}"
'''


@pytest.mark.parametrize(
    ("message", "expected"),
    [
        ("...: ... rows, at least 2 are needed", True),
        ("... at least ... needed", True),
        ("no file ...", True),
        ("... at least 3 are needed", False),
        ("... needed ... rows", False),
        ("no file ... at least", False),
        ("The docstring is not printed.", False),
    ],
)
def test_messages_are_found_in_strings_that_expressions_interrupt(message, expected):
    assert is_printed(message, tuple(literals(SOURCE))) is expected
