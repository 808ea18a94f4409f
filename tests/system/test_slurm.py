"""Jobs by submitit's executor for one machine, which stands for a cluster here."""

from __future__ import annotations

import os
import shutil
import signal
from dataclasses import dataclass

import pytest

from mi_nerfattack.errors import InputError, SetupError
from mi_nerfattack.system.slurm import SlurmJobs
from mi_nerfattack.system.workers import AbstractWork

pytest.importorskip("submitit", reason="needs the extra 'submitit', submits jobs")


@dataclass(frozen=True)
class Pieces(AbstractWork):
    """A mistake in piece 0, an error in piece 1, death in piece 2, none in piece 3."""

    def open(self):
        return "opened"

    def do(self, opened, index, report):
        report(1)
        assert opened == "opened"
        if index == 1:
            raise InputError("piece one: is wrong; take another")
        if index == 2:
            os.kill(os.getpid(), signal.SIGKILL)
        [0][0 if index == 3 else 1]

    def close(self, opened):
        pass


@pytest.mark.slow
def test_jobs_tell_what_became_of_them(tmp_path, monkeypatch):
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(["tests", "."]))
    ended = {}
    jobs = SlurmJobs(tmp_path, None, count=2)
    jobs.run(Pieces(), range(4), lambda units: None, ended.__setitem__)
    assert ended.pop(3) is None
    bug, error, death = (ended[index] for index in range(3))
    assert isinstance(bug, RuntimeError) and "IndexError" in str(bug)
    assert str(error) == "piece one: is wrong; take another"
    assert isinstance(death, InputError) and "ended in piece 2" in str(death)
    with pytest.raises(InputError, match="piece one"):
        jobs.run(Pieces(), [1], lambda units: None)


@pytest.mark.skipif(shutil.which("srun") is not None, reason="there is a cluster")
def test_a_machine_without_slurm(tmp_path):
    jobs = SlurmJobs(tmp_path / "none", "gpu")
    jobs.run(Pieces(), [], print)
    assert not (tmp_path / "none").exists()
    with pytest.raises(SetupError, match="sbatch"):
        jobs.run(Pieces(), [0], print)
