"""Scenarios and grids of the first form, written in the form of today.

In the first form the keys of all choices stood in one table: ``[attack]`` had
``method``, ``parameters`` and ``adjoint``, and the keys that belong to each of them.
"""

from __future__ import annotations

import difflib
import re
from collections.abc import Callable, Iterator, Mapping
from functools import partial, reduce
from operator import getitem
from pathlib import Path
from typing import Any

import tomlkit

from mi_nerfattack.errors import InputError
from mi_nerfattack.io.strict import parse_toml


def _to(table: str, keys: str) -> dict[str, str]:
    return {key: f"{table}.{key}" for key in keys.split()}


_TERM = {"at": "weights.kind", "weights": "weights.kind"}
_TERM |= _to("weights", "last_s discount_per_s listed_weights")
#: Where the keys of a table stand today, from that table.
_MOVES: dict[str, dict[str, str]] = {
    "attack": {"method": "method.kind", "parameters": "freedom.kind"}
    | {"adjoint": "adjoint.kind", "segment": "adjoint.segment"}
    | _to("method", "max_iterations final_rate frame frames texture_kind first_block")
    | _to("method", "variant coefficients spread population")
    | _to("freedom", "learning_rate resolution smoothing linf l2 lowest highest gamut")
    | _to("freedom", "fixed_m total_variation pose_learning_rate pose_axes")
    | _to("freedom", "pose_limit_m pose_limit_deg")
    | _to("vary", "exposure_ev_sd blur_px_sd noise_sd"),
    "policy": {"goal": "goal.kind", "goals": "goal.count"},
    "vehicle": {"model": "kind"},
    "deployment": {"environment": "kind"},
    "objective": {"reduction": "reduction.kind", "cvar_fraction": "reduction.fraction"},
}
#: Once keys of [objective], of its first term.
_FIRST = (
    *"kind weight rounding_m rounding_deg limit_m softness_m target".split(),
    *("target_route", "function", "trust_code", *_TERM),
)
_AXES = ("routes", "objects", "methods")  # of a grid, whose choices have `set`
_PART = r"""(?:[\w-]+|"[^"]*"|'[^']*')"""
_KEYS = re.compile(rf"\s*({_PART}(?:\s*\.\s*{_PART})*)\s*=")


def upgraded(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return the values of a scenario or a grid in the form of today."""

    def change(name: str, table: dict[str, Any]) -> dict[str, Any]:
        if name in _AXES:
            return {k: _each(upgraded, v, k == "set") for k, v in table.items()}
        if name != "objective":
            return _moved(table, _MOVES[name])
        first = {key: value for key, value in table.items() if key in _FIRST}
        objective = {key: value for key, value in table.items() if key not in _FIRST}
        terms = objective.pop("terms", [])
        if not isinstance(terms, list) or not all(isinstance(t, dict) for t in terms):
            return table
        if first or terms:
            objective["term"] = [_moved(term, _TERM) for term in (first, *terms)]
        return _moved(objective, _MOVES[name])

    return {
        name: _each(partial(change, name), value, name in (*_AXES, *_MOVES))
        for name, value in values.items()
    }


def upgraded_environment(name: str, scenario: Mapping[str, Any]) -> str:
    """Return the name of today of an environment in results of an older version.

    An only environment without a name was "deployment" there, whatever its kind.

    Args:
        name: in the results.
        scenario: the values of their scenario.
    """
    deployment = upgraded(scenario).get("deployment", {})
    [section, *others] = deployment if isinstance(deployment, list) else [deployment]
    if name != "deployment" or others:
        return name
    return section.get("name") or section.get("kind", "mitsuba")


def _each(change: Callable[[Any], Any], value: Any, is_one: bool) -> Any:
    """Change a table, or each of an array of tables."""
    if is_one and isinstance(value, list):
        return [_each(change, item, True) for item in value]
    return change(value) if is_one and isinstance(value, dict) else value


def _moved(table: Mapping[str, Any], moves: Mapping[str, str]) -> dict[str, Any]:
    moved: dict[str, Any] = {}
    for key, value in table.items():
        if isinstance(value, dict):
            moved[key] = moved.get(key, {}) | value
        elif (key, value) != ("at", "all_times"):  # the weights say so
            inner = moved
            *way, last = moves.get(key, key).split(".")
            for part in way:
                inner = inner.setdefault(part, {})
            inner[last] = value
    return moved


def upgraded_text(path: str | Path, text: str) -> str:
    """Return the text of a scenario or a grid in the form of today, comments kept.

    Raises:
        InputError: it is no TOML, or a shape that is not rewritten; with what it must
            say.
    """
    values = parse_toml(path, text)
    upgraded_values = upgraded(values)
    if upgraded_values == values:
        return text
    result = "".join(_rewritten(text))
    try:
        if parse_toml(path, result) == upgraded_values:
            return result
    except InputError:
        pass  # such as a table that is there twice
    raise InputError(
        f"{path}: is of an older form, which only you can rewrite; it must say:\n"
        f"{tomlkit.dumps(upgraded_values)}"
    )


def new_lines(path: str | Path, text: str) -> str | None:
    """Say how a file of the first form is brought to that of today; None if it is."""
    if (result := upgraded_text(path, text)) == text:
        return None
    lines = difflib.unified_diff(
        text.splitlines(), result.splitlines(), n=0, lineterm=""
    )
    _, _, *shown = lines
    does = "\n".join([f"'mi-nerfattack upgrade {path}' does:", *shown])
    return f"{path}: is of an older form; {does}"


def _rewritten(text: str) -> Iterator[str]:
    table = _Table("", "", ())
    for comments, statement in _statements(text):
        if statement and not statement.lstrip().startswith("["):
            table.add(comments, statement)
            continue
        yield table.text()
        if table.moved and statement and not comments.startswith("\n"):
            comments = f"\n{comments}"
        way = _way(parse_toml("", statement))
        if way[-2:] == ("objective", "terms"):
            statement, way = statement.replace("terms", "term", 1), (*way[:-1], "term")
        table = _Table(comments, statement, way)
    yield table.text()


class _Table:
    """A header with the keys in it and the comments above, and statements below it."""

    def __init__(self, comments: str, header: str, way: tuple[str, ...]) -> None:
        self.comments, self.header, self.way, self.own = comments, header, way, ""
        self.moved: dict[str, str] = {}  # statements by the table where they stand now

    def text(self) -> str:
        """Return the table, and those that its statements stand in now."""
        is_gone = self.moved and not self.own and "#" not in self.header
        blocks = [] if is_gone else [self.header + self.own]
        for name, statements in self.moved.items():
            header = ".".join([*self.way, name])
            header = f"[[{header}]]" if name == "term" else f"[{header}]"
            blocks.append(f"{header}\n{statements}")
        return self.comments + "\n".join(blocks)

    def add(self, comments: str, statement: str) -> None:
        """Add a statement and the comments above it."""
        if (match := _KEYS.match(statement)) is None:  # quotes in a key
            self.own += comments + statement
            return
        name, after = match[1], statement[match.end(1) :]
        keys = _way(parse_toml("", f"{name} = 0"))
        value: Any = reduce(getitem, keys, parse_toml("", statement))
        way, inside = (*self.way, *keys), ""
        base = 2 if way[0] in _AXES and way[1:2] == ("set",) else 0
        old = way[base:]
        new = old if isinstance(value, dict) else _today(old)
        if len(old) <= 1 and isinstance(value, dict | list):
            nested: Any = {old[0]: value} if old else value
            if (changed := upgraded(nested)) != nested:
                value = changed[old[0]] if old else changed
                item: Any = reduce(getitem, keys, tomlkit.parse(statement))
                after = f" = {_inline(value)} {item.trivia.comment}".rstrip() + "\n"
        elif new[-2:] == ("weights", "kind") and value == "all_times":
            return  # which the weights say
        elif new != old:
            *tables, name = (*way[:base], *new)[len(self.way) :]
            if len(self.way) > base:
                inside = ".".join(tables)
            else:
                name = ".".join([*tables, name])
        if not inside:
            self.own += f"{comments}{name}{after}"
            return
        if inside.startswith("term"):
            self.moved.setdefault("term", "")
        self.moved[inside] = self.moved.get(inside, "") + f"{comments}{name}{after}"


def _today(way: tuple[str, ...]) -> tuple[str, ...]:
    """Return the keys that lead to a value today."""
    match way:
        case ("objective", "term", key):
            return "objective", "term", *_TERM.get(key, key).split(".")
        case ("objective", key) if key in _FIRST:
            return "objective", "term", *_TERM.get(key, key).split(".")
        case (section, key):
            return section, *_MOVES.get(section, {}).get(key, key).split(".")
    return way


def _way(values: Any) -> tuple[str, ...]:
    """Return the keys of nested tables, each of which has one."""
    if isinstance(values, list):
        return _way(values[0])
    if not isinstance(values, dict) or not values:
        return ()
    [(key, inner)] = values.items()
    return key, *_way(inner)


def _statements(text: str) -> Iterator[tuple[str, str]]:
    """Yield the headers and values of a file, each after the comments above it."""
    comments = statement = ""
    for line in re.findall(r".*\n", text if text.endswith("\n") else f"{text}\n"):
        if not statement and re.fullmatch(r"\s*(#.*)?", line.rstrip()):
            comments += line
            continue
        statement += line
        try:
            parse_toml("", statement)
        except InputError:
            continue  # the value goes on in the next line
        yield comments, statement
        comments = statement = ""
    yield comments, ""


def _inline(value: Any) -> str:
    if isinstance(value, dict):
        pairs = ", ".join(f"{key} = {_inline(item)}" for key, item in value.items())
        return f"{{ {pairs} }}"
    if isinstance(value, list):
        return f"[{', '.join(map(_inline, value))}]"
    return tomlkit.item(value).as_string()
