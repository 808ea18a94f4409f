"""A table that grows by one line of JSON a row, and goes on where it was stopped."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

from mi_nerfattack.errors import InputError
from mi_nerfattack.io import files

Row = dict[str, Any]
Key = Mapping[str, Any]


def read(path: Path) -> list[Row]:
    """Return the rows of a table, none where there is no file.

    Raises:
        InputError: a line is no JSON.
    """
    if not path.is_file():
        return []
    rows = []
    for number, line in enumerate(files.read_text(path).splitlines(), start=1):
        try:
            rows.append(json.loads(line))
        except ValueError as err:
            raise InputError(f"{path}:{number}: {err}; delete the line") from err
    return rows


def fill(
    path: Path,
    keys: Iterable[Key],
    work: Callable[[Key], Row],
    on_row: Callable[[int, int, str], None],
) -> list[Row]:
    """Add the rows that are missing.

    Args:
        path: of the table.
        keys: what tells one row from another; entries of each row.
        work: makes the rest of a row.
        on_row: told before each row: how many are done, how many there are, its key.

    Returns:
        the rows of `keys`, in their order.
    """
    wanted = [dict(key) for key in keys]
    found = read(path)
    for key in wanted:
        if _find(found, key) is None:
            done = sum(_find(found, k) is not None for k in wanted)
            on_row(done, len(wanted), ", ".join(map(str, key.values())))
            row = {**key, **work(key)}
            with path.open("a", encoding="utf-8") as table:
                table.write(json.dumps(row, allow_nan=False) + "\n")
            found.append(row)
    return pick(found, wanted)


def pick(rows: list[Row], keys: Iterable[Key]) -> list[Row]:
    """Return the rows of keys, in their order; not those that there are none of."""
    found = [_find(rows, key) for key in keys]
    return [row for row in found if row is not None]


def _find(rows: list[Row], key: Key) -> Row | None:
    return next((row for row in rows if key.items() <= row.items()), None)
