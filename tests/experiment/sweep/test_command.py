"""``mi-nerfattack sweep``: what it foresees, does and tells."""

from __future__ import annotations

import json
from functools import partial
from pathlib import Path

import pytest

from mi_nerfattack import cli
from mi_nerfattack.commands.sweep import Sweep
from mi_nerfattack.errors import InputError
from mi_nerfattack.experiment.sweep import sweep as module
from mi_nerfattack.experiment.sweep.forecast import sentences
from mi_nerfattack.system import workers
from mi_nerfattack.system.ray_tasks import RayTasks
from mi_nerfattack.system.slurm import SlurmJobs
from mi_nerfattack.system.workers import InThisProcess, Processes
from tests.experiment.sweep.conftest import finish

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
set.attack.method.kind = "blocks"
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

    def run(text, *options, verb="sweep"):
        path = scenario_folder / "grid.toml"
        path.write_text(text)
        words = [verb, str(path), "-o", str(tmp_path / "out"), *options]
        code = cli.main(words)
        out, err = capsys.readouterr()
        return code, out, err

    return run


def test_what_is_foreseen(command):
    """Frames as `check` tells of one attack; seeds cost the same.

    Gradient, 3 iterations: see `test_checks`; blocks: 8 drives of 4 periods, without a
    second frame for a way back.
    """
    code, out, _ = command(GRID, "--json", verb="check")
    document = json.loads(out)
    assert code == 0 and not any(document["refused"].values())
    assert (document["cells"], document["complete"]) == (6, 0)
    costs = document["costs"]
    assert [cost["frames"] for cost in costs.values()] == [140, 136]
    assert document["frames"] == 3 * (140 + 136)
    each = [cost["wall_s"] for cost in costs.values()]
    assert document["wall_s"] == pytest.approx(3 * sum(each))
    assert "6 cells: 828 frames, " in next(iter(sentences(document, 2)))


def test_what_would_be_refused(command, tmp_path):
    for text, code, message in (
        (GRID + ALOFT, 1, "refused: line aloft: ball is in the air"),
        (
            "anyway = true\n" + GRID + ALOFT,
            0,
            "look at: line aloft: ball is in the air",
        ),
    ):
        completed = command(text, "--no-drives", verb="check")
        assert completed[0] == code and message in completed[1]
        assert not (tmp_path / "out").exists()


def test_cells_are_done_and_failures_told(command, tmp_path, monkeypatch):
    def task(cell, folder, on_step):
        if cell.seed == 4:
            raise ValueError("a mistake\nin two lines")
        finish(cell, folder)

    monkeypatch.setattr(module, "Cells", partial(module.Cells, task=task))
    monkeypatch.setattr(Sweep, "_workers", lambda self: InThisProcess())
    code, out, _ = command(GRID)
    assert code == 1
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert [failed["seed"] for failed in summary["failed"]] == [4, 4]
    [row, *_] = [line.split() for line in out.splitlines() if "attack " in line][1:]
    assert row == ["attack", "0.400", "0.141", "2/2", "2/2"]  # no interval of two
    table, *failed = out.splitlines()[-3:]
    assert "4 of 6" in table and str(tmp_path / "out" / "results.csv") in table
    assert [line.split("-")[2] for line in failed] == ["gradient", "blocks"]
    assert all(line.endswith(": in two lines") for line in failed)
    code, out, _ = command(GRID.replace("4, ", ""), "--json")
    document = json.loads(out)
    assert code == 0 and document["complete"] == document["cells"] == 4
    assert not document["failed"]


def test_who_does_the_cells(monkeypatch):
    monkeypatch.setattr(workers, "cores", lambda: 8)
    grid = Path("grid.toml")
    counts = [Sweep(grid, grid, cores=cores)._count() for cores in (1, 3, 9)]
    assert counts == [8, 2, 1]  # as many as cores allow
    assert Sweep(grid, grid, workers=5, cores=3)._count() == 5
    there = {"cores": 2, "memory_gb": 3.0}
    assert Sweep(grid, grid, workers=3)._workers() == Processes(3, pieces_each=1)
    jobs = SlurmJobs(grid.resolve() / "slurm", "gpu", 2, 3.0, 240, 256)
    assert Sweep(grid, grid, submitit="gpu", **there)._workers() == jobs
    assert Sweep(grid, grid, ray="a:1", **there)._workers() == RayTasks("a:1", 2, 3.0)
    with pytest.raises(InputError, match="--ray: .*--submitit"):
        Sweep(grid, grid, ray="a:1", submitit="gpu")._workers()
    with pytest.raises(InputError, match="--memory-gb: 0; "):
        Sweep(grid, grid, memory_gb=0).run()
