"""What the terminal shows of names that look like rich's markup."""

from __future__ import annotations

from pathlib import Path

import pytest
from rich.table import Table

from mi_nerfattack.commands.shared.progress import StageBars
from mi_nerfattack.commands.shared.run_scenario import _print_files
from mi_nerfattack.commands.shared.terminal import console

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
    told, progress = capsys.readouterr()
    assert f"Run folder: {tmp_path / name}" in told.replace("\n", "")
    assert told.count(name) == 4 and progress.count(name) == 3
