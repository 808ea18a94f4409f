"""Progress where there is no terminal: lines now and then, with the time left."""

from __future__ import annotations

import re

from mi_nerfattack.commands.shared import progress
from mi_nerfattack.commands.shared.progress import StageBars


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
