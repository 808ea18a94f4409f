"""Progress where there is no terminal: lines now and then, with the time left."""

from __future__ import annotations

import builtins
import re
import sys
from types import SimpleNamespace

import numpy as np
import pytest

import mi_nerfattack as nf
from mi_nerfattack.commands.shared import progress
from mi_nerfattack.commands.shared.progress import StageBars
from mi_nerfattack.fit.options import FitProgress


def test_bars_print_plain_lines_where_there_is_no_terminal(capsys):
    with StageBars() as bars:
        for done in range(1, 5):
            bars.show("frames", done, 4, f"{done}/4")
    lines = capsys.readouterr().err.splitlines()
    assert "frames: 4/4" in lines[-1]
    assert len(lines) <= 2  # not one for each call


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


class TestReadyBar:
    """`mi_nerfattack.progress` in a log file, a terminal and a notebook."""

    def calls(self, bar):
        """Call a bar as the functions of the package do."""
        for step in (2, 1, 0):  # a gradient counts downwards
            bar(step)
        bar(1, 2)
        bar(2, 2)
        for stage in ("drives", "<attack>"):
            bar(stage, 1, 2, "best 0.3 m")
            bar(stage, 2, 2, "")
        bar(FitProgress(50, None, 0.5, 0.01, 30.25, 9.0, 0.2))

    def test_it_writes_lines_to_a_file(self, capsys):
        self.calls(nf.progress(3, "drive"))
        out, err = capsys.readouterr()
        assert not out and "\r" not in err
        found = re.findall(r"s  (\S+: \d/\d)", err)
        assert found == [
            *("drive: 1/3", "drive: 3/3", "drive: 1/2", "drive: 2/2"),
            *("drives: 1/2", "drives: 2/2", "<attack>: 1/2", "<attack>: 2/2"),
        ]

    def test_it_draws_one_line_a_stage_in_a_terminal(self, capsys, monkeypatch):
        monkeypatch.setenv("TTY_COMPATIBLE", "1")
        monkeypatch.setattr(progress, "_EVERY_S", 0.0)
        self.calls(nf.progress(3, "drive"))
        lines = capsys.readouterr().err.split("\n")
        assert [line.count("\r") for line in lines] == [3, 2, 2, 2, 1]
        last = lines[0].split("\r")[-1]
        assert last.startswith(f"drive [{'#' * 24}] 3/3")
        assert "1/3" in lines[0] and " left" in lines[0]
        assert f"[{'#' * 12}{'.' * 12}] 1/2  0:00  best 0.3 m" in lines[2]
        assert "PSNR 30.25 dB" in lines[-1]

    def test_it_updates_an_element_of_a_notebook(self, capsys, monkeypatch):
        shown: list[list[str]] = []

        class Handle:
            def update(self, element):
                shown[-1].append(element)

        def display(element, display_id):
            assert display_id
            shown.append([element])
            return Handle()

        ipython = SimpleNamespace(display=display, HTML=str)
        shell = type("ZMQInteractiveShell", (), {})
        monkeypatch.setattr(builtins, "get_ipython", shell, raising=False)
        monkeypatch.setitem(sys.modules, "IPython.display", ipython)
        monkeypatch.setattr(progress, "_EVERY_S", 0.0)
        self.calls(nf.progress(3, "drive"))
        assert [len(elements) for elements in shown] == [3, 2, 2, 2, 1]
        assert 'value="0.3333"' in shown[0][0] and "1/3" in shown[0][0]
        assert 'value="1.0000"' in shown[0][-1]
        assert "&lt;attack&gt;" in shown[3][0]
        assert capsys.readouterr() == ("", "")

    def test_it_tells_the_time_left_by_what_was_done_here(self, capsys, monkeypatch):
        monkeypatch.setenv("TTY_COMPATIBLE", "1")
        monkeypatch.setenv("COLUMNS", "60")
        now = iter(np.arange(0, 1e3, 10.0))
        monkeypatch.setattr(progress.time, "perf_counter", lambda: next(now))
        bar = nf.progress()
        for done in (100, 101, 102, 103):  # the first hundred were kept
            bar("drives", done, 104, "kept " * 20)
        _, *lines = capsys.readouterr().err.split("\r")
        clocks = [line.split("  ")[1] for line in lines]
        assert clocks == ["0:00", "0:30 left", "0:20 left", "0:10 left"]
        assert all(len(line) == 59 for line in lines)

    def test_it_draws_at_most_five_times_a_second(self, capsys, monkeypatch):
        monkeypatch.setenv("TTY_COMPATIBLE", "1")
        now = iter(np.arange(0, 1e3, 0.0625))
        monkeypatch.setattr(progress.time, "perf_counter", lambda: next(now))
        bar = nf.progress(32)
        for step in range(32):  # two seconds
            bar(step)
        assert capsys.readouterr().err.count("\r") == 9

    def test_it_refuses_what_nothing_reports(self):
        with pytest.raises(TypeError, match="3 arguments"):
            nf.progress()(1, 2, 3)  # pyright: ignore[reportCallIssue]
