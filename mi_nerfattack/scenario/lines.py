"""Where the keys of a TOML file stand in it."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import tomlkit
from tomlkit.container import OutOfOrderTableProxy
from tomlkit.items import AoT, Table

from mi_nerfattack.scenario.section import Location

_MARK = "a line that no file has"
_MOST_PROBLEMS = 8  # that are told


def tell(path: str | Path, text: str, found: Iterable[tuple[Location, str]]) -> str:
    """Tell problems of a file, each with its line and key; of many, the first.

    Args:
        path: the file.
        text: its content, valid TOML.
        found: keys that lead to each problem, and what is wrong.
    """
    found, lines = list(found), []
    for location, problem in found[:_MOST_PROBLEMS]:
        line = _line_of(text, location)
        where = f"{path}:{line}" if line else f"{path}"
        key = ".".join(map(str, location))
        lines.append(f"{where}: {key}: {problem}")
    if more := len(found) - len(lines):
        lines.append(f"{path}: and {more} more")
    return "\n".join(lines)


def _line_of(text: str, location: Location) -> int | None:
    """Find the line of a key, or of the table that lacks it; 1-based.

    Of a table without a header, such as dotted keys make, it is that of its first key.
    """
    document = tomlkit.parse(text)
    item: Any = document
    holder: Any = None
    key: Any = None
    for part in location:
        inner = item.get(part) if isinstance(part, str) else item[part]
        if inner is None:
            break
        holder, key, item = item, part, inner
        if not isinstance(inner, Table | AoT | OutOfOrderTableProxy):
            break  # a value, or an inline table
    if holder is None:
        return None
    while isinstance(item, AoT | OutOfOrderTableProxy) or (
        isinstance(item, Table) and item.is_super_table()
    ):
        holder, key = item, 0 if isinstance(item, AoT) else next(iter(item))
        item = holder[key]
    if isinstance(item, Table):
        item.comment(_MARK)
    else:
        holder[key] = _MARK
    return tomlkit.dumps(document).partition(_MARK)[0].count("\n") + 1
