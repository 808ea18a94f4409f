"""What holds for the options of all commands, and for --json."""

from __future__ import annotations

import contextlib
import ctypes
import dataclasses
import io
import json
import math
import re
import sys
import types
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Union, get_args, get_origin, get_type_hints

import mitsuba as mi
import pytest
import tyro

from mi_nerfattack import cli
from mi_nerfattack.cli import main
from mi_nerfattack.commands import COMMANDS, Command, each
from mi_nerfattack.commands.shared.terminal import Result

WORDS = {" ".join(words): kind for words, kind in each(COMMANDS)}
MOST_LINES = 60
COLUMNS = 80


@pytest.mark.parametrize("words", WORDS)
def test_the_help_of_a_command_is_short_and_its_output_is_called_o(words, monkeypatch):
    monkeypatch.setenv("COLUMNS", str(COLUMNS))
    with contextlib.redirect_stdout(io.StringIO()) as out:
        assert main([*words.split(), "--help"]) == 0
    help_text = out.getvalue()
    assert f"usage: mi-nerfattack {words}" in help_text
    lines = [max(1, -(-len(line) // COLUMNS)) for line in help_text.splitlines()]
    assert sum(lines) <= MOST_LINES
    assert "default: None" not in help_text and "None}" not in help_text
    titles = re.findall(r"(?m)^[ ╭─│]*([a-z]+) options", help_text)
    assert not {"where", "options", "against"} & set(titles)
    hints = get_type_hints(WORDS[words], include_extras=True)
    if "output" in hints:
        assert hints["output"] in (Path, Path | None)
        assert re.search(r"-o \S+, --output ", help_text)


def options(kind: type) -> Iterator[tuple[str, Any]]:
    """Yield name and type of each option of a command; None does not count."""
    hints = get_type_hints(kind, include_extras=True)
    for item in dataclasses.fields(kind):
        hint, name = hints[item.name], item.name
        notes: list[Any] = []
        while get_origin(hint) is Annotated:
            hint, *metadata = get_args(hint)
            notes += metadata
        if tyro.conf.Positional in notes:
            continue
        if dataclasses.is_dataclass(hint):
            yield from options(hint)
            continue
        for note in notes:
            name = getattr(note, "name", None) or name
        if get_origin(hint) in (Union, types.UnionType):
            members = [one for one in get_args(hint) if one is not type(None)]
            hint = members[0] if len(members) == 1 else tuple(members)
        yield name, hint


def test_one_word_has_one_type():
    hints_by_name: dict[str, dict[str, list[str]]] = {}
    for words, kind in WORDS.items():
        for name, hint in options(kind):
            hints_by_name.setdefault(name, {}).setdefault(str(hint), []).append(words)
    assert len(hints_by_name) > 100
    assert not {name: kinds for name, kinds in hints_by_name.items() if len(kinds) > 1}


def test_flags_say_what_they_do_when_they_are_given():
    """A flag that is on by default would be told by what its absence does."""
    flags = [x.default for kind in WORDS.values() for x in dataclasses.fields(kind)]
    assert True not in [x for x in flags if isinstance(x, bool)]
    assert flags.count(False) > 20


WITHOUT_FIGURES = {
    "car monitor": "serves a page until Ctrl-C, and tells its address",
    "upgrade": "rewrites a file, and tells whether it did",
    "view": "serves a page until Ctrl-C, or writes it; tells its address, or its path",
}
ALL = {" ".join(words): one for words, one in each(COMMANDS)}


@pytest.mark.parametrize("name", ALL)
def test_a_command_with_figures_takes_json(name):
    command = ALL[name]
    has_figures = get_type_hints(command.run)["return"] is Result
    names = {item.name for item in dataclasses.fields(command)}  # pyright: ignore
    assert has_figures == ("json" in names)
    assert has_figures == (name not in WITHOUT_FIGURES), WITHOUT_FIGURES.get(name)


def by_python() -> None:
    print("noise")


def by_c() -> None:
    ctypes.pythonapi.printf(b"noise\n")


def by_mitsuba() -> None:
    mi.Log(mi.LogLevel.Warn, "noise")


@pytest.fixture
def call(monkeypatch, capfd) -> Callable[..., tuple[int, str, str]]:
    """Run a command that makes noise, and returns figures."""

    def run(make_noise, share: float, *words: str) -> tuple[int, str, str]:
        @dataclass(frozen=True)
        class Tell:
            """Tell."""

            json: bool = False
            """As JSON."""

            def run(self) -> Result:
                """Tell."""
                make_noise()
                return Result({"share": share}, lambda: print("a half"), 1)

        commands: dict[str, type[Command]] = {"tell": Tell, "doctor": Tell}
        code = cli.main(["tell", *words], {"": commands})
        sys.stdout.flush()
        return code, *capfd.readouterr()

    return run


@pytest.mark.skipif(sys.platform == "win32", reason="printf of the process itself")
@pytest.mark.parametrize("make_noise", [by_python, by_c, by_mitsuba])
def test_json_has_standard_output_to_itself(call, variant, make_noise):
    code, out, err = call(make_noise, 0.5, "--json")
    assert (code, json.loads(out)) == (1, {"share": 0.5})
    assert out.count("\n") == 1 and "noise" in err


def test_people_read_the_same_without_it(call):
    assert call(by_python, 0.5) == (1, "noise\na half\n", "")


def test_numbers_that_json_has_not_are_a_mistake_of_ours(call):
    with pytest.raises(ValueError, match="JSON compliant"):
        call(by_python, math.nan, "--json")
