"""Options as they were given: checks of values, and the command written out again."""

from __future__ import annotations

import shlex
from collections.abc import Mapping
from dataclasses import MISSING, fields, is_dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro

from mi_nerfattack.errors import InputError

Settings = Annotated[
    tyro.conf.UseAppendAction[tuple[str, ...]],
    tyro.conf.arg(name="set", metavar="KEY=VALUE"),
]
"""``--set``, which may be repeated; see `overrides.set_keys`."""


def check_empty(path: Path) -> None:
    """Raise `InputError` unless a folder can be made, or is there and empty."""
    from mi_nerfattack.io import files

    files.check_folder(path)
    if path.is_dir() and any(path.iterdir()):
        raise InputError(f"-o: {path}; is not an empty folder, choose another")


def check_suffix(path: Path, *suffixes: str) -> None:
    """Raise InputError unless a file to write has one of some suffixes."""
    if path.suffix.lower() not in suffixes:
        raise InputError(
            f"-o: {path}; give a file that ends in {' or '.join(suffixes)}"
        )


def check_positive(options: object, *names: str) -> None:
    """Raise `InputError` unless some options are more than 0."""
    for name in names:
        if not getattr(options, name) > 0:
            raise InputError(f"{_option(name)}: {getattr(options, name)}; more than 0")


def _option(name: str) -> str:
    return "--" + name.replace("_", "-")


def command_line(name: str, options: Any) -> str:
    """Write the command line of a command, without options at their defaults.

    Args:
        name: of the sub-command.
        options: the dataclass of its arguments; `policy` and `run_folders` are
            positional. Of an absolute path only the last part is written, because the
            folders say nothing outside of this machine.
    """
    return " ".join(["mi-nerfattack", name, *_words(options)])


def _words(options: Any) -> list[str]:
    words: list[str] = []
    for item in fields(options):
        value = getattr(options, item.name)
        if is_dataclass(value):
            words += _words(value)
        elif item.default is not MISSING and value == item.default:
            continue
        elif item.name in ("policy", "run_folders"):
            words[:0] = map(_word, _operands(value))
        elif item.name == "settings":
            words += [part for one in value for part in ("--set", _word(one))]
        else:
            words.append("--" + item.name.replace("_", "-"))
            words += [_word(part) for part in _operands(value) if part is not True]
    return words


def _operands(value: Any) -> list[Any]:
    if isinstance(value, Mapping):
        return [part for pair in value.items() for part in pair]
    return list(value) if isinstance(value, tuple) else [value]


def _word(value: Any) -> str:
    text = str(value)
    return shlex.quote(Path(text).name if Path(text).is_absolute() else text)
