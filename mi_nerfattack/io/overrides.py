"""Keys of a TOML document that the command line sets: ``--set KEY=VALUE``."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from typing import Any

import tomlkit

from mi_nerfattack.errors import InputError
from mi_nerfattack.io.strict import parse_toml

_KEY = re.compile(r"[\w-]+(?:\.[\w-]+)*")
_WORD = re.compile(r"[A-Za-z./~][^\s\"']*")  # a string that needs no quotes


def split_setting(setting: str) -> tuple[str, str]:
    """Return key and value of ``KEY=VALUE``.

    Raises:
        InputError: one of them is missing.
    """
    key, equals, value = setting.partition("=")
    if not _KEY.fullmatch(key) or not equals:
        raise InputError(f"--set {setting}: needs KEY=VALUE, as in seed=1")
    return key, value


def set_keys(name: str, text: str, settings: Sequence[str]) -> str:
    """Set keys of a TOML document.

    Args:
        name: of the document, for messages.
        text: the document.
        settings: each ``KEY=VALUE``. The key's parts are joined by dots; a number is an
            index of an array, from 0. The value is TOML; a word that TOML cannot read,
            such as ``policy.pt``, is a string.

    Returns:
        the document with the keys, in which comments are kept.

    Raises:
        InputError: the document is no TOML; or a setting, which it names, cannot be
            read, is there twice, or leads through a value that has no keys.
    """
    if not settings:
        return text
    parse_toml(name, text)  # its messages name the line
    document = tomlkit.parse(text)
    keys: set[str] = set()
    for setting in settings:
        key, raw = split_setting(setting)
        if key in keys:
            raise InputError(f"--set {setting}: {key} is set twice; set it once")
        keys.add(key)
        *way, last = _parts(key)
        table: Any = document
        for part in way:
            if isinstance(part, str) and isinstance(table, dict):
                table = table.setdefault(part, tomlkit.table())
            else:
                table = _item(table, part, name, setting)
        if not isinstance(table, dict):
            _item(table, last, name, setting)  # only elements that are there are set
        elif isinstance(last, int):
            raise InputError(f"--set {setting}: {last} is no key; name one")
        table[last] = _value(setting, raw)
    return tomlkit.dumps(document)


def find_setting(settings: Sequence[str], location: Sequence[str | int]) -> str | None:
    """Return the setting that gave a value, or a part of it; None if none did.

    Args:
        settings: of `set_keys`.
        location: keys that lead to the value.
    """
    for setting in settings:
        parts = [*_parts(split_setting(setting)[0])]
        if parts == [*location][: len(parts)]:
            return setting
    return None


def _parts(key: str) -> Iterator[str | int]:
    for part in key.split("."):
        yield int(part) if part.isdigit() else part


def _item(values: Any, part: str | int, name: str, setting: str) -> Any:
    if isinstance(values, list) and isinstance(part, int) and part < len(values):
        return values[part]
    raise InputError(f"--set {setting}: {name} has no {part!r} there; check the key")


def _value(setting: str, raw: str) -> Any:
    if "\n" in raw:
        raise InputError(f"--set {setting}: give a value of one line, valid TOML")
    try:
        return parse_toml(f"--set {setting}", f"value = {raw}\n")["value"]
    except InputError:
        if not _WORD.fullmatch(raw):
            raise
        return raw
