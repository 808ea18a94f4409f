"""Strict TOML: whole numbers of 64 bits, and no key that takes long to read."""

from __future__ import annotations

import re
import sys
from pathlib import Path
from typing import Any

from mi_nerfattack.errors import InputError

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

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
