"""The wall clock, which may be set at any time, measures nothing."""

from __future__ import annotations

import re
from pathlib import Path

import mi_nerfattack

PACKAGE = Path(mi_nerfattack.__file__).parent
WALL = (
    r"\btime\.(time|time_ns|localtime|gmtime|strftime)\("
    r"|\b(datetime|date)\.(now|today|utcnow)\("
)
#: Where the date is meant, and where a clock that was set is noticed.
MEANT = {
    "commands/demo.py",
    "commands/drive.py",
    "props/openscenario.py",
    "car/tracker/vicon.py",
}


def test_the_wall_clock_is_read_where_the_date_is_meant():
    paths = {
        path.relative_to(PACKAGE).as_posix()
        for path in PACKAGE.rglob("*.py")
        if re.search(WALL, path.read_text("utf-8"))
    }
    assert paths == MEANT
