"""The record that a training leaves beside its policy."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from mi_nerfattack.io import files


def read_record(path: Path) -> dict[str, Any] | None:
    """Read what training writes beside a policy; None for JSON of something else.

    Raises:
        InputError: unreadable, or no JSON.
    """
    found = files.read_json(path)
    ours = (
        isinstance(found, dict)
        and type(found.get("schema")) is int
        and isinstance(found.get("training"), list)
        and all(_is_history(rows) for rows in found["training"])
    )
    return found if ours else None


def _is_history(rows: Any) -> bool:
    return isinstance(rows, list) and all(isinstance(row, dict) for row in rows)
