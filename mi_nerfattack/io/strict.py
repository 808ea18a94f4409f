"""What files may not hold: keys twice, numbers and positions that lose digits."""

from __future__ import annotations

import json
import math
import re
import sys
from collections import Counter
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from mi_nerfattack.errors import InputError

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

#: From here on, single precision loses a millimetre.
FAR_M = 10_000.0


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
            text,
            object_pairs_hook=_unique_keys,
            parse_constant=_refuse,
            parse_float=lambda literal: _number(float(literal), literal),
            parse_int=lambda literal: _number(_integer(literal), literal),
        )
    except json.JSONDecodeError as err:
        raise InputError(
            f"{path}: line {err.lineno}, column {err.colno}: {err.msg}; "
            "the file must be valid JSON"
        ) from err
    except _NumberError as err:
        raise InputError(
            f"{path}: {_key_of_number(text)}: {err} is not a JSON number; write a "
            "finite number, a whole one below 2^63"
        ) from err
    except (ValueError, RecursionError) as err:
        raise InputError(f"{path}: {err}; the file must be valid JSON") from err


def finite(value: Any) -> Any:
    """Replace infinite and undefined numbers, which JSON has not, by null."""
    if isinstance(value, Mapping):
        return {key: finite(item) for key, item in value.items()}
    if isinstance(value, list):
        return [finite(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def _unique_keys(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    result = dict(pairs)
    if len(result) < len(pairs):
        (twice, _), *_ = Counter(name for name, _ in pairs).most_common(1)
        raise ValueError(f"key {twice!r} twice in one object")
    return result


class _NumberError(ValueError):
    """NaN, infinity or a number that 64 bits do not hold, in JSON."""


def _refuse(literal: str) -> None:
    short = (
        literal
        if len(literal) < 40
        else f"{literal[:30]}... ({len(literal)} characters)"
    )
    raise _NumberError(short)


def _number(value: float, literal: str) -> float:
    if not math.isfinite(value):
        _refuse(literal)
    return value


def _integer(literal: str) -> float:
    """Return an integer, or infinity where 64 bits do not hold it."""
    value = int(literal) if len(literal) <= 20 else math.inf
    return value if -(1 << 63) <= value < 1 << 63 else math.inf


def _key_of_number(text: str) -> str:
    """Return where such a number is, as `frames[1].transform_matrix[0][3]`."""

    def find(value: Any) -> str | None:
        if isinstance(value, float) and not math.isfinite(value):
            return ""
        items: Iterable[tuple[Any, Any]] = ()
        if isinstance(value, dict):
            items = value.items()
        elif isinstance(value, list):
            items = enumerate(value)
        for key, item in items:
            if (inner := find(item)) is not None:
                return (f"[{key}]" if isinstance(value, list) else f".{key}") + inner
        return None

    try:
        location = find(json.loads(text, parse_int=_integer)) or ""
        return location.lstrip(".") or "a value"
    except (ValueError, RecursionError):
        return "a value"  # what follows is damaged too


_PART = r"""(?:[\w-]+|"[^"\n]*"|'[^'\n]*')[ \t]*\.[ \t]*"""
# the parser takes the square of the number of parts
_DOTTED = re.compile(rf"(?<![\w-])(?:{_PART}){{100}}")


def parse_toml(path: str | Path, text: str) -> dict[str, Any]:
    """Parse TOML.

    Args:
        path: where the text is from, for messages.
        text: the TOML.

    Raises:
        InputError: naming the line, the column or the key.
    """
    if _DOTTED.search(text):
        raise InputError(f"{path}: 100 names joined by dots; use tables")
    try:
        table = tomllib.loads(text)
    except (ValueError, RecursionError) as err:
        raise InputError(f"{path}: {err}; the file must be valid TOML") from err
    left: list[tuple[Any, Any]] = list(table.items())
    while left:
        key, value = left.pop()
        if isinstance(value, dict):
            left += value.items()
        elif isinstance(value, list):
            left += ((key, item) for item in value)
        elif isinstance(value, int) and not -(1 << 63) <= value < 1 << 63:
            raise InputError(
                f"{path}: {key}: a whole number of {value.bit_length()} bits; TOML's "
                "have 64"
            )
    return table


def require_near(
    where: str | Path, positions: np.ndarray, extents: float = 2.0
) -> None:
    """Refuse positions that are far from the origin, as those of maps are.

    Rays and states are computed in single precision, which loses centimetres there.
    The outermost twentieths do not count: they may be outliers.

    Args:
        where: what holds the positions, for the message.
        positions: (n, k), n >= 1, metres, finite.
        extents: how many of the positions' own extents away they may be.

    Raises:
        InputError: the middle of the positions is farther from the origin than `FAR_M`
            and than `extents`; the message has the shift to subtract.
    """
    low, high = np.percentile(np.asarray(positions, np.float64), [5, 95], axis=0)
    middle, extent = low / 2 + high / 2, float((high / 2 - low / 2).max()) * 2
    if np.abs(middle).max() > max(FAR_M, extents * extent):
        shift = ", ".join(f"{value:.0f}" for value in middle)
        raise InputError(
            f"{where}: positions around ({shift}) m, as of a map; single precision "
            f"loses centimetres there: subtract ({shift}) from all positions, also "
            "from those of other files of this place"
        )
