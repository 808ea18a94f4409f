"""``mi-nerfattack sweep``: what it foresees, does and tells."""

from __future__ import annotations

import json
from functools import partial
from pathlib import Path

import pytest
from support.worlds import attacks as attack_jobs

from mi_nerfattack import cli
from mi_nerfattack.commands.sweep import Sweep
from mi_nerfattack.errors import InputError
from mi_nerfattack.experiment.sweep import sweep as module
from mi_nerfattack.experiment.sweep.forecast import sentences
from mi_nerfattack.experiment.sweep.grid import load_cells
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
def grid_file(scenario_folder):
    """Return what writes a grid next to the scenario, and returns its file."""

    def write(text):
        path = scenario_folder / "grid.toml"
        path.write_text(text)
        return path

    return write


@pytest.fixture
def command(grid_file, tmp_path, capsys):
    """Return what runs the command on a grid: exit code, output, errors."""

    def run(text, *options, verb="sweep"):
        words = [verb, str(grid_file(text)), "-o", str(tmp_path / "out"), *options]
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
    monkeypatch.setattr(Sweep, "_workers", lambda self, cells: InThisProcess())
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


def test_who_does_the_cells(grid_file, monkeypatch):
    monkeypatch.setattr(workers, "cores", lambda: 8)
    grid = Path("grid.toml")
    cells = load_cells(grid_file(GRID))

    def crew(cells=cells, **options):
        return Sweep(grid, grid, **options)._workers(cells)

    counts = [crew(cores=cores).count for cores in (1, 3, 9)]
    assert counts == [8, 2, 1]  # as many as cores allow
    assert crew(workers=5, cores=3) == Processes(5, pieces_each=1)
    there = {"cores": 2, "memory_gb": 3.0}
    jobs = SlurmJobs(grid.resolve() / "slurm", "gpu", 2, 3.0, 240, 256)
    assert crew(submitit="gpu", **there) == jobs
    assert crew(ray="a:1", **there) == RayTasks("a:1", 2, 3.0)
    assert crew(ray="a:1", workers=4, **there) == RayTasks("a:1", 2, 3.0, count=4)
    with pytest.raises(InputError, match="--ray: .*--submitit"):
        Sweep(grid, grid, ray="a:1", submitit="gpu").run()
    with pytest.raises(InputError, match="--memory-gb: 0; "):
        Sweep(grid, grid, memory_gb=0).run()


def test_a_server_has_one_process(grid_file, tmp_path, monkeypatch):
    """CARLA's has one client; a policy's may keep a state, unless the user knows."""
    monkeypatch.setattr(workers, "cores", lambda: 8)
    served = GRID + '[[methods]]\nname = "random"\nset.attack.method.kind = "random"\n'
    carla = served + 'set.deployment = [{ kind = "carla" }]\n'
    own = '[policy]\nkind = "http"\nurl = "http://127.0.0.1:1"\n'
    changes = {'[policy]\nfile = "policy.safetensors"\n': own}
    scenario = attack_jobs.write_scenario(tmp_path, changes) / "scenario.toml"
    url = served.partition("[[methods]]")[0] + served[len(GRID) :]
    url = url.replace("scenario.toml", str(scenario))
    grid = Path("grid.toml")

    def crew(text, **options):
        return Sweep(grid, grid, **options)._workers(load_cells(grid_file(text)))

    assert crew(carla) == crew(carla, workers=1) == InThisProcess()
    assert crew(url) == Processes(1, pieces_each=1)
    assert crew(url, ray="a:1") == RayTasks("a:1", count=1)
    assert crew(url, workers=3) == Processes(3, pieces_each=1)
    for options in ({"workers": 2}, {"ray": "a:1"}, {"submitit": "gpu"}):
        with pytest.raises(InputError, match="CARLA, whose server one process steps"):
            crew(carla, **options)
    with pytest.raises(InputError, match="workers: 2 for a deployment in CARLA"):
        module.sweep(grid_file(carla), grid, workers=2)
