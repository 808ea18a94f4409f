"""One way of ``--json``: every command with figures, and standard output alone."""

from __future__ import annotations

import ctypes
import dataclasses
import json
import math
import sys
from collections.abc import Callable
from dataclasses import dataclass
from typing import get_type_hints

import mitsuba as mi
import pytest

from bench import __main__ as bench
from mi_nerfattack import cli
from mi_nerfattack.commands import COMMANDS, Command, each
from mi_nerfattack.commands.shared.result import Result

WITHOUT_FIGURES = {
    "car monitor": "serves a page until Ctrl-C, and tells its address",
    "view": "serves a page until Ctrl-C, or writes it; tells its address, or its path",
    "bench quality": "runs other commands, and shows what they print",
    "bench matrix": "runs another command, writes a page from it, and tells its path",
    "bench table2": "writes a page from a sweep's table, and tells its path",
    "bench methods": "writes a page from a sweep's table, and tells its path",
}
ALL = {" ".join(words): one for words, one in each(COMMANDS)}
ALL |= {f"bench {name}": one for name, one in bench.COMMANDS.items()}


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
