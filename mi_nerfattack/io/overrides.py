"""Keys of a TOML document: those that ``--set KEY=VALUE`` sets, and those at fault."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import tomlkit
from tomlkit.container import OutOfOrderTableProxy
from tomlkit.items import AoT, Table

from mi_nerfattack.errors import InputError
from mi_nerfattack.io.strict import parse_toml

_MARK = "a line that no file has"
_MOST_PROBLEMS = 8  # that are told
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
        *way, last = _keys(key)
        table: Any = document
        for part in way:
            if isinstance(part, str) and isinstance(table, dict):
                table = table.setdefault(part, tomlkit.table())
            else:
                table = _item(table, part, name, setting=setting)
        if not isinstance(table, dict):
            _item(
                table, last, name, setting=setting
            )  # only elements that are there are set
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
        keys = [*_keys(split_setting(setting)[0])]
        if keys == [*location][: len(keys)]:
            return setting
    return None


def tell(
    path: str | Path,
    text: str,
    problems: Iterable[tuple[Sequence[str | int], str]],
    settings: Sequence[str] = (),
) -> str:
    """Describe the problems of a file, each with its line and key; of many, the first.

    Args:
        path: the file.
        text: its content, valid TOML.
        problems: keys that lead to each problem, and what is wrong.
        settings: of the command line, see :func:`set_keys`; the description of a
            problem with a setting names the setting instead of a line.
    """
    problems, lines = list(problems), []
    for location, problem in problems[:_MOST_PROBLEMS]:
        if setting := find_setting(settings, location):
            where = f"--set {setting}"
        else:
            line = _line_of(text, location)
            where = f"{path}:{line}" if line else f"{path}"
        key = ".".join(map(str, location))
        lines.append(f"{where}: {key}: {problem}")
    if omitted := len(problems) - len(lines):
        lines.append(f"{path}: and {omitted} more")
    return "\n".join(lines)


def _line_of(text: str, location: Sequence[str | int]) -> int | None:
    """Find the line of a key, or of the table that lacks it; 1-based.

    Of a table without a header, such as dotted keys make, it is that of its first key.
    """
    document = tomlkit.parse(text)
    item: Any = document
    holder: Any = None
    key: Any = None
    for part in location:
        inner = item.get(part) if isinstance(part, str) else item[part]
        if inner is None:
            break
        holder, key, item = item, part, inner
        if not isinstance(inner, Table | AoT | OutOfOrderTableProxy):
            break  # a value, or an inline table
    if holder is None:
        return None
    while isinstance(item, AoT | OutOfOrderTableProxy) or (
        isinstance(item, Table) and item.is_super_table()
    ):
        holder, key = item, 0 if isinstance(item, AoT) else next(iter(item))
        item = holder[key]
    if isinstance(item, Table):
        item.comment(_MARK)
    else:
        holder[key] = _MARK
    return tomlkit.dumps(document).partition(_MARK)[0].count("\n") + 1


def _keys(key: str) -> Iterator[str | int]:
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
