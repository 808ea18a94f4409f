"""A command as it was given, to be written beside its result."""

from __future__ import annotations

import shlex
from collections.abc import Mapping
from dataclasses import MISSING, fields, is_dataclass
from pathlib import Path
from typing import Any


def command_line(name: str, options: Any) -> str:
    """Write a command anew from what differs from its defaults.

    Args:
        name: of the sub-command.
        options: the dataclass of its arguments; `policy` and `run_folders` are
            positional. Of absolute paths, which tell about the machine alone, the last
            part is written.
    """
    return " ".join(["mi-nerfattack", name, *_words(options)])


def _words(options: Any) -> list[str]:
    found: list[str] = []
    for item in fields(options):
        value = getattr(options, item.name)
        if is_dataclass(value):
            found += _words(value)
        elif item.default is not MISSING and value == item.default:
            continue
        elif item.name in ("policy", "run_folders"):
            found[:0] = map(_word, _parts(value))
        else:
            found.append("--" + item.name.replace("_", "-"))
            found += [_word(part) for part in _parts(value) if part is not True]
    return found


def _parts(value: Any) -> list[Any]:
    if isinstance(value, Mapping):
        return [part for pair in value.items() for part in pair]
    return list(value) if isinstance(value, tuple) else [value]


def _word(value: Any) -> str:
    text = str(value)
    return shlex.quote(Path(text).name if Path(text).is_absolute() else text)
