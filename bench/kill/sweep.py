"""Kill a sweep's workers and its driver, and check that its table is the same.

``python -m bench.kill.sweep --executors ray submitit`` makes 24 tiny attacks by the
processes of this machine, then the same by other executors, while it kills (SIGKILL)
the process of a cell three times and the driver once; the driver is started again as
often as it takes. All tables must be equal to the last bit.
"""

from __future__ import annotations

import json
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any, Literal

import tyro

from mi_nerfattack.system.processes import module_command

Executor = Literal["processes", "submitit", "ray"]

_GRID = """\
scenario = "scenario.toml"
seeds = [0, 1, 2, 3, 4, 5]
budgets = [48]
backward_multiple = 1.0
anyway = true
[[routes]]
name = "near"
[[routes]]
name = "far"
set.drive.start_m = 4.0
[[methods]]
name = "gradient"
[[methods]]
name = "blocks"
set.attack.method = "blocks"
"""
_WORKERS = 2
_LIFE_S = 3600.0  # after which a sweep is taken to hang


def drive(scenario: Path, output: Path, executor: Executor) -> int:
    """Do the sweep, or what is left of it; exit code 1 if cells failed."""
    from mi_nerfattack import variant
    from mi_nerfattack.experiment.sweep.grid import load_cells
    from mi_nerfattack.experiment.sweep.sweep import Cells, Sweep
    from mi_nerfattack.system.ray_tasks import LOCAL, RayTasks
    from mi_nerfattack.system.slurm import SlurmJobs
    from mi_nerfattack.system.workers import Processes

    variant.ensure()
    sweep = Sweep(Cells(tuple(load_cells(scenario / "grid.toml")), output))
    workers = {
        "processes": Processes(_WORKERS, pieces_each=1),
        "submitit": SlurmJobs(output / "slurm", None, count=_WORKERS),
        "ray": RayTasks(LOCAL, memory_gb=1.0, count=_WORKERS),
    }
    sweep.run(workers[executor])
    for index, error in sweep.errors.items():
        print(f"{sweep.work.cells[index].id}: {error}", file=sys.stderr)
    return int(bool(sweep.errors))


def start(scenario: Path, output: Path, executor: Executor) -> subprocess.Popen[bytes]:
    """Start the driver in a process of its own."""
    options = "--scenario", scenario, "--output", output, "--executors", executor
    command = [*module_command("bench.kill.sweep"), *map(str, options)]
    return subprocess.Popen(command)


def at_work(output: Path) -> dict[int, str]:
    """Return the processes that hold a cell's folder open, with the cell's name."""
    found, cells = {}, output.resolve() / "cells"
    for entry in Path("/proc").glob("[0-9]*/fd/*"):
        try:
            held = entry.readlink()
        except OSError:  # it has ended, or is not ours
            continue
        if held.parent == cells:
            found[int(entry.parts[2])] = held.name
    return found


def _kill(pid: int, of_what: str) -> None:
    os.kill(pid, signal.SIGKILL)
    print(f"killed {of_what}", file=sys.stderr, flush=True)


def disturbed(scenario: Path, output: Path, executor: Executor, seed: int) -> int:
    """Do the sweep while killing; return how often the driver was started."""
    draw, due = random.Random(seed), ["worker", "worker", "driver", "worker"]
    driver, starts = start(scenario, output, executor), 1
    end, calm = time.monotonic() + _LIFE_S, 0.0
    while driver.poll() != 0:
        if time.monotonic() > end:
            _kill(driver.pid, "the driver, which hangs")
            raise TimeoutError(f"{output}: not done after {_LIFE_S:.0f} s")
        if driver.poll() is not None:  # killed, or cells failed
            driver, starts = start(scenario, output, executor), starts + 1
        working = sorted(at_work(output).items())
        if due and working and time.monotonic() > calm:
            time.sleep(draw.uniform(0, 3))
            pid, cell = draw.choice(working)
            if due[0] == "driver":
                _kill(driver.pid, "the driver")
                driver.wait()
                due.pop(0)
            elif pid in at_work(output):  # it may have ended by itself
                _kill(pid, f"the process of {cell}")
                due.pop(0)
            calm = time.monotonic() + draw.uniform(3, 12)
        time.sleep(0.1)
    if due:
        raise RuntimeError(f"{output}: done before it was killed: {due} are left")
    return starts


def compare(one: Path, other: Path) -> list[str]:
    """Return what differs between two tables, row by row."""
    import pyarrow.parquet

    tables = [pyarrow.parquet.read_table(path) for path in (one, other)]
    if tables[0].equals(tables[1]):
        return []
    rows = [table.to_pylist() for table in tables]
    wrong = [f"{len(rows[0])} rows and {len(rows[1])}"]
    return wrong + [f"{a} != {b}" for a, b in zip(*rows, strict=False) if a != b]


def main(
    executors: tuple[Executor, ...] = ("ray", "submitit"),
    seed: int = 0,
    output: Path | None = None,
    scenario: Path | None = None,
) -> int:
    """Kill sweeps; exit code 1 if a table is another one.

    Args:
        executors: that are killed, one after the other.
        seed: of the moments.
        output: with a scenario: be the driver of a sweep to this folder.
        scenario: folder of the grid.
    """
    if scenario is not None and output is not None:
        return drive(scenario, output, executors[0])
    from bench.kill.scenario import make_scenario

    with tempfile.TemporaryDirectory(prefix="sweep-") as name:
        folder, found = Path(name), []
        make_scenario(folder / "scenario")
        (folder / "scenario" / "grid.toml").write_text(_GRID, encoding="utf-8")
        began = time.monotonic()
        if start(folder / "scenario", folder / "whole", "processes").wait():
            raise RuntimeError("the sweep that nothing disturbs failed, see above")
        document: dict[str, Any] = {
            "cells": len(list((folder / "whole" / "cells").iterdir())),
            "undisturbed_s": round(time.monotonic() - began, 1),
        }
        for executor in executors:
            began, output = time.monotonic(), folder / executor
            starts = disturbed(folder / "scenario", output, executor, seed)
            tables = [part / "results.parquet" for part in (folder / "whole", output)]
            document[executor] = {
                "driver_started": starts,
                "seconds": round(time.monotonic() - began, 1),
                "failures": compare(*tables),
            }
            found += document[executor]["failures"]
    print(json.dumps(document, indent=2))
    return int(bool(found))


if __name__ == "__main__":
    sys.exit(tyro.cli(main))
