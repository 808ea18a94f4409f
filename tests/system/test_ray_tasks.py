"""Tasks on a Ray cluster of this machine."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from types import SimpleNamespace

import pytest

from mi_nerfattack.system.ray_tasks import RayTasks

SCRIPT = """
import json
import os

from mi_nerfattack.errors import InputError
from mi_nerfattack.system.ray_tasks import RayTasks
from test_slurm import Pieces

if __name__ == "__main__":
    ended = {}
    tasks = RayTasks("local", memory_gb=0.5, count=1)
    tasks.run(Pieces(), range(4), print, ended.__setitem__)
    told = {i: [type(error).__name__, str(error)] for i, error in ended.items()}
    told["usage"] = os.environ["RAY_USAGE_STATS_ENABLED"]
    try:
        RayTasks("local", cores=2, count=1, memory_gb=1e4).run(Pieces(), [3], print)
    except InputError as error:
        told["refused"] = str(error)
    print(json.dumps(told))
"""


@pytest.mark.parametrize(("count", "most"), [(2, 2), (None, 5)])
def test_no_more_tasks_than_chosen_are_submitted(monkeypatch, count, most):
    """Against a double of Ray that keeps tasks until it is asked for one."""
    waiting, lengths, ended = [], [], []

    def wait(tasks, num_returns):
        lengths.append(len(tasks))
        return [waiting.pop(0)], []

    def submit(work, piece):
        waiting.append(piece)
        return piece

    double = SimpleNamespace(
        nodes=lambda: [{"Alive": True, "Resources": {"CPU": 9, "memory": 1e12}}],
        remote=lambda **options: lambda function: SimpleNamespace(remote=submit),
        wait=wait,
        get=lambda task: ("done", ""),
        shutdown=lambda: None,
        exceptions=SimpleNamespace(RayError=KeyError),
    )
    monkeypatch.setattr(RayTasks, "_connect", lambda self: double)
    RayTasks("a:1", count=count).run(None, range(5), print, lambda *e: ended.append(e))
    assert max(lengths) == most and len(lengths) == 5
    assert ended == [(piece, None) for piece in range(5)]


@pytest.mark.slow
def test_tasks_tell_what_became_of_them(tmp_path):
    """In a process of its own: Ray leaves threads and files behind."""
    pytest.importorskip("ray", reason="needs the extra 'ray', which runs tasks")
    (tmp_path / "run.py").write_text(SCRIPT)
    folder = os.path.dirname(__file__)
    paths = os.pathsep.join([folder, *sys.path])
    result = subprocess.run(
        [sys.executable, str(tmp_path / "run.py")],
        env={**os.environ, "PYTHONPATH": paths},
        capture_output=True,
        text=True,
        timeout=600,
    )
    assert result.returncode == 0, result.stderr
    outcomes = json.loads(result.stdout.splitlines()[-1])
    assert outcomes["3"] == ["NoneType", "None"] and outcomes["usage"] == "0"
    assert outcomes["0"][0] == "RuntimeError" and "IndexError" in outcomes["0"][1]
    assert outcomes["1"] == ["InputError", "piece one: is wrong; take another"]
    assert outcomes["2"][0] == "InputError" and "in piece 2" in outcomes["2"][1]
    assert "no machine has 2 cores and 10000 GB for a task" in outcomes["refused"]
