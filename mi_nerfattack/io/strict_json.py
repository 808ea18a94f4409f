"""Strict JSON: no NaN or infinity, no key twice in one object."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from mi_nerfattack.errors import InputError


def parse_json(path: str | Path, text: str) -> Any:
    """Parse strict JSON.

    Args:
        path: where the text is from, for messages.
        text: the JSON.

    Raises:
        InputError: naming the line, the column or the key.
    """
    try:
        return json.loads(
            text, object_pairs_hook=_unique_keys, parse_constant=_refuse_constant
        )
    except json.JSONDecodeError as err:
        raise InputError(
            f"{path}: line {err.lineno}, column {err.colno}: {err.msg}; "
            "the file must be valid JSON"
        ) from err
    except _ConstantError as err:
        raise InputError(
            f"{path}: {_key_of_constant(text)}: {err} is not a JSON number; write a "
            "finite number"
        ) from err
    except (ValueError, RecursionError) as err:
        raise InputError(f"{path}: {err}; the file must be valid JSON") from err


def _unique_keys(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    result = dict(pairs)
    if len(result) < len(pairs):
        names = [name for name, _ in pairs]
        twice = next(name for name in names if names.count(name) > 1)
        raise ValueError(f"key {twice!r} twice in one object")
    return result


class _ConstantError(ValueError):
    """NaN or infinity in JSON."""


def _refuse_constant(name: str) -> None:
    raise _ConstantError(name)


def _key_of_constant(text: str) -> str:
    """Return where NaN or infinity is, as `frames[1].transform_matrix[0][3]`."""

    def find(value: Any, keys: str) -> str:
        if isinstance(value, float) and not math.isfinite(value):
            return keys
        items: Iterable[tuple[str, Any]] = ()
        if isinstance(value, dict):
            items = ((f"{keys}.{key}", item) for key, item in value.items())
        elif isinstance(value, list):
            items = ((f"{keys}[{i}]", item) for i, item in enumerate(value))
        return next(filter(None, (find(item, at) for at, item in items)), "")

    try:
        return find(json.loads(text), "").lstrip(".") or "a value"
    except (ValueError, RecursionError):
        return "a value"  # what follows is damaged too
