"""``mi-nerfattack sweep``: what it foresees, does and tells."""

from __future__ import annotations

import json
from functools import partial
from pathlib import Path

import pytest
from helpers.faults import full_disk

from mi_nerfattack import cli
from mi_nerfattack.commands.sweep import Sweep
from mi_nerfattack.errors import InputError
from mi_nerfattack.experiment.sweep import sweep as module
from mi_nerfattack.experiment.sweep.forecast import sentences
from mi_nerfattack.io import locks
from mi_nerfattack.system import workers
from mi_nerfattack.system.ray_tasks import RayTasks
from mi_nerfattack.system.slurm import SlurmJobs
from mi_nerfattack.system.workers import InThisProcess, Processes
from tests.experiment.sweep.conftest import finish

pytest.importorskip(
    "pyarrow", reason="needs the extra 'sweep': pyarrow writes the table"
)
pytestmark = pytest.mark.usefixtures("variant")

GRID = """\
scenario = "scenario.toml"
seeds = [3, 4, 5]
budgets = [30]
backward_multiple = 1.5
[[routes]]
name = "line"
set.baseline.textures = 2
[[methods]]
name = "gradient"
[[methods]]
name = "blocks"
set.attack.method = "blocks"
"""
ONE = """\
scenario = "scenario.toml"
anyway = true
[[methods]]
name = "gradient"
set.attack.max_iterations = 2
set.baseline.textures = 1
"""
ALOFT = """\
[[objects]]
name = "aloft"
[[objects.set.objects]]
id = "ball"
field = "object.safetensors"
position_m = [7.0, 4.2, 4.6]
"""


@pytest.fixture
def command(scenario_folder, tmp_path, capsys):
    """Return what runs the command on a grid: exit code, output, errors."""

    def run(text, *options):
        path = scenario_folder / "grid.toml"
        path.write_text(text)
        words = ["sweep", str(path), "-o", str(tmp_path / "out"), *options]
        code = cli.main(words)
        out, err = capsys.readouterr()
        return code, out, err

    return run


def test_what_is_foreseen(command):
    """Frames as `check` tells of one attack; seeds cost the same.

    Gradient, 3 iterations: see `test_check`; blocks: 8 drives of 4 periods, without a
    second frame for a way back.
    """
    code, out, _ = command(GRID, "--check", "--json")
    document = json.loads(out)
    assert code == 0 and not any(document["refused"].values())
    assert (document["cells"], document["complete"]) == (6, 0)
    costs = document["costs"]
    assert [cost["frames"] for cost in costs.values()] == [140, 136]
    assert document["frames"] == 3 * (140 + 136)
    each = [cost["wall_s"] for cost in costs.values()]
    assert document["wall_s"] == pytest.approx(3 * sum(each))
    first, multiple, *_ = sentences(document, 2)
    assert first.startswith("6 cells: 828 frames, ") and " for 2 at a time" in first
    assert multiple.startswith("line ball gradient 30: a pass back costs ")


def test_what_would_be_refused(command, tmp_path):
    code, out, _ = command(GRID + ALOFT, "--check", "--no-drives")
    assert code == 1
    first, *rest = out.splitlines()
    assert first == "6 cells; not all of them could be timed"
    assert "refused: line aloft: ball is in the air of deployment.xml" in rest[0]
    assert not (tmp_path / "out").exists()
    code, out, _ = command("anyway = true\n" + GRID + ALOFT, "--check", "--no-drives")
    assert code == 0 and "look at: line aloft: ball is in the air" in out


def test_cells_are_done_and_failures_told(command, tmp_path, monkeypatch):
    def task(cell, folder, on_step):
        if cell.seed == 4:
            raise ValueError("a mistake\nin two lines")
        finish(cell, folder)

    monkeypatch.setattr(module, "Cells", partial(module.Cells, task=task))
    monkeypatch.setattr(Sweep, "_workers", lambda self: InThisProcess())
    code, out, err = command(GRID)
    told, table, *failed = out.splitlines()[-4:]
    assert code == 1 and "cells: 0/6, 0 control periods" in err
    assert not told.strip() and "line blocks 30 " in out
    assert "all routes" not in out  # there is one
    [row, *_] = [line.split() for line in out.splitlines() if "attack " in line][1:]
    assert row[:3] == ["attack", "0.400", "0.141"] and row[5:7] == ["2/2", "2/2"]
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert [failed["seed"] for failed in summary["failed"]] == [4, 4]
    assert table == f"4 of 6 cells: {tmp_path / 'out' / 'results.parquet'}"
    assert [line.split("-")[2] for line in failed] == ["gradient", "blocks"]
    assert all(line.endswith(": in two lines") for line in failed)
    rest = GRID.replace("4, ", "")
    code, out, _ = command(rest, "--json")
    found = json.loads(out)
    assert code == 0 and found["complete"] == found["cells"] == 4
    assert not found["failed"]
    code, out, _ = command(rest, "--check", "--no-drives")
    assert out.splitlines()[0] == "4 cells, 4 complete"


def test_what_a_full_disk_left_goes_on(command, tmp_path, monkeypatch):
    """Full while the attack goes on, while its cell is finished, and for the table."""
    monkeypatch.setattr(Sweep, "_workers", lambda self: InThisProcess())
    out, before = tmp_path / "out", {}
    for name in ("checkpoint", "metrics", "results", "summary"):
        with full_disk(name, at=2 if name == "results" else 1):
            code, _, err = command(ONE)
        assert code == 2 and "no space left on the disk" in err
        assert not any(locks.is_partial(path) for path in out.rglob(".*"))
        kept = {p: p.stat().st_mtime_ns for p in out.rglob("drives/*")}
        assert kept.items() >= before.items()
        before = kept
    code, told, _ = command(ONE, "--json")
    found = json.loads(told)
    assert code == 0 and found["complete"] == 1 and not found["failed"]
    assert {p: p.stat().st_mtime_ns for p in out.rglob("drives/*")} == before


def test_as_many_workers_as_cores_allow(monkeypatch):
    monkeypatch.setattr(workers, "cores", lambda: 8)
    grid = Path("grid.toml")
    counts = [Sweep(grid, grid, cores=cores)._count() for cores in (1, 3, 9)]
    assert counts == [8, 2, 1]
    assert Sweep(grid, grid, workers=5, cores=3)._count() == 5


def test_who_does_the_cells():
    grid = Path("grid.toml")
    there = {"cores": 2, "memory_gb": 3.0}
    assert Sweep(grid, grid, workers=3)._workers() == Processes(3, pieces_each=1)
    jobs = SlurmJobs(grid.resolve() / "slurm", "gpu", 2, 3.0, 240, 256)
    assert Sweep(grid, grid, submitit="gpu", **there)._workers() == jobs
    assert Sweep(grid, grid, ray="a:1", **there)._workers() == RayTasks("a:1", 2, 3.0)
    with pytest.raises(InputError, match="--ray: stands beside --submitit"):
        Sweep(grid, grid, ray="a:1", submitit="gpu")._workers()
    with pytest.raises(InputError, match="--memory-gb: 0; more than 0"):
        Sweep(grid, grid, memory_gb=0).run()
