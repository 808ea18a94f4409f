"""Progress where there is no terminal: lines now and then, with the time left."""

from __future__ import annotations

import builtins
import re
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from rich.table import Table

import mi_nerfattack as nf
from mi_nerfattack.commands.attack import _print_files
from mi_nerfattack.commands.shared import progress
from mi_nerfattack.commands.shared.progress import StageBars
from mi_nerfattack.commands.shared.terminal import console
from mi_nerfattack.fit.options import FitProgress


def test_lines_tell_the_time_left_by_what_was_done_here(capsys, monkeypatch):
    monkeypatch.setattr(progress, "_PLAIN_EVERY_S", 0.0)
    with StageBars() as bars:
        bars.show("frames", 100, 104, "100/104", True)
        show = bars.counter("frames")
        for done in range(101, 105):
            show(done, 104)
    lines = capsys.readouterr().err.splitlines()
    assert [" left" in line for line in lines] == [False, True, True, True, False]
    assert re.search(r"s  frames: 101/104  \d+:\d\d:\d\d left$", lines[1])
    monkeypatch.undo()
    with StageBars() as bars:
        for done in range(1, 50):
            bars.show("frames", done, 49, f"{done}/49")
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) <= 2 and "49/49" in lines[-1]  # not one for each call


def call(bar):
    """Call a bar as the functions of the package do."""
    for step in (2, 1, 0):  # a gradient counts downwards
        bar(step)
    bar(1, 2)
    bar(2, 2)
    for stage in ("drives", "<attack>"):
        bar(stage, 1, 2, "best 0.3 m")
        bar(stage, 2, 2, "")
    bar(FitProgress(50, None, 0.5, 0.01, 30.25, 9.0, 0.2))


def test_a_bar_writes_lines_to_a_file(capsys):
    call(nf.progress(3, "drive"))
    out, err = capsys.readouterr()
    assert not out and "\r" not in err
    assert re.findall(r"s  (\S+: \d/\d)", err) == [
        *("drive: 1/3", "drive: 3/3", "drive: 1/2", "drive: 2/2"),
        *("drives: 1/2", "drives: 2/2", "<attack>: 1/2", "<attack>: 2/2"),
    ]


def test_a_bar_updates_an_element_of_a_notebook(capsys, monkeypatch):
    shown: list[list[str]] = []

    def display(element, display_id):
        assert display_id
        shown.append([element])
        return SimpleNamespace(update=shown[-1].append)

    ipython = SimpleNamespace(display=display, HTML=str)
    shell = type("ZMQInteractiveShell", (), {})
    monkeypatch.setattr(builtins, "get_ipython", shell, raising=False)
    monkeypatch.setitem(sys.modules, "IPython.display", ipython)
    monkeypatch.setattr(progress, "_EVERY_S", 0.0)
    call(nf.progress(3, "drive"))
    assert [len(elements) for elements in shown] == [3, 2, 2, 2, 1]
    assert 'value="0.3333"' in shown[0][0] and 'value="1.0000"' in shown[0][-1]
    assert "&lt;attack&gt;" in shown[3][0]
    assert capsys.readouterr() == ("", "")


@pytest.mark.parametrize(
    ("period_s", "done", "expected"),
    [
        # the first hundred were kept
        (10.0, range(100, 104), ["0:00", "0:30 left", "0:20 left", "0:10 left"]),
        (0.0625, range(32), 8),  # every 0.25 s of two seconds
    ],
)
def test_a_bar_tells_the_time_left_now_and_then(
    capsys, monkeypatch, period_s, done, expected
):
    monkeypatch.setenv("TTY_COMPATIBLE", "1")
    monkeypatch.setenv("COLUMNS", "60")
    now = iter(np.arange(0, 1e3, period_s))
    monkeypatch.setattr(progress.time, "perf_counter", lambda: next(now))
    bar = nf.progress()
    for count in done:
        bar("drives", count, 104, "kept " * 20)
    _, *lines = capsys.readouterr().err.split("\r")
    assert all(len(line) == 59 for line in lines)
    clocks = [line.split("  ")[1] for line in lines]
    assert expected in (clocks, len(lines))


def test_a_bar_refuses_what_nothing_reports():
    with pytest.raises(TypeError, match="3 arguments"):
        nf.progress()(1, 2, 3)  # pyright: ignore[reportCallIssue]


COST = {"wall_s": 1.0, "renders": 2, "peak_memory_mb": 3.0}


@pytest.mark.parametrize("name", ["x[/b]", "tr[best]", "[red]a[/red]"])
def test_brackets_in_names_stay(capsys, monkeypatch, tmp_path, name):
    monkeypatch.chdir(tmp_path)
    out = console()
    _print_files(out, Path(name), {"cost": COST}, None)
    table = Table(title=name)
    table.add_column(name)
    table.add_row(name)
    out.print(table)
    with StageBars() as bars:
        bars.show(name, 1, 1, name)
        bars.say(name)
    printed, progress = capsys.readouterr()
    assert f"Run folder: {tmp_path / name}" in printed.replace("\n", "")
    assert printed.count(name) == 4 and progress.count(name) == 3
