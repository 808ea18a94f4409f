"""Checks of options as they were given."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from mi_nerfattack.errors import InputError


def given(options: object, names: Iterable[str]) -> str | None:
    """Return the first of some options that has another value than by default.

    Args:
        options: a dataclass of arguments, which all have defaults.
        names: of its fields.

    Returns:
        the option as it is written (``--long-edge``); None if there is none.
    """
    usual = type(options)()
    for name in names:
        if getattr(options, name) != getattr(usual, name):
            return _option(name)
    return None


def check_empty(path: Path) -> None:
    """Raise `InputError` unless a folder can be made, or is there and empty."""
    from mi_nerfattack.io import files

    files.check_folder(path)
    if path.is_dir() and any(path.iterdir()):
        raise InputError(f"-o: {path}; is not an empty folder, choose another")


def check_positive(options: object, *names: str) -> None:
    """Raise `InputError` unless some options are more than 0."""
    for name in names:
        if not getattr(options, name) > 0:
            raise InputError(f"{_option(name)}: {getattr(options, name)}; more than 0")


def _option(name: str) -> str:
    return "--" + name.replace("_", "-")
