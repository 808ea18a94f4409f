"""Routes files: a JSON object with one entry per route."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from mi_nerfattack.errors import InputError
from mi_nerfattack.io import files

_NEEDED = {"goal", "points_m", "lane_width_m", "speed_ms"}


def read_table(path: str | Path) -> dict[str, Any]:
    """Read all entries of a routes file, unchecked.

    Raises:
        InputError: unreadable, or no object with at least one key.
    """
    table = files.read_json(path)
    if not isinstance(table, dict) or not table:
        raise InputError(f"{path}: not an object with one key per route")
    return table


def read_entry(path: str | Path, name: str) -> dict[str, Any]:
    """Read one entry of a routes file, values unchecked.

    Returns:
        Entries "goal", "points_m", "lane_width_m", "speed_ms" and "closed".

    Raises:
        InputError: unreadable file, missing route or key.
    """
    table = read_table(path)
    if name not in table:
        known = ", ".join(map(repr, table))
        raise InputError(f"{path}: no route {name!r}; it has {known}")
    entry = table[name]
    if not isinstance(entry, dict) or not set(entry) >= _NEEDED:
        raise InputError(f"{path}: route {name!r} needs {sorted(_NEEDED)}")
    return {"closed": False, **entry}
