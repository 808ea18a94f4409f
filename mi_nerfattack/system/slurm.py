"""Pieces of work as jobs of SLURM, through submitit."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mi_nerfattack.errors import InputError, SetupError
from mi_nerfattack.extras import load_extra
from mi_nerfattack.system.workers import (
    MOST,
    AbstractWork,
    AbstractWorkers,
    OnEnd,
    OnUnits,
    Outcome,
    do_alone,
    failure,
)

_POLL_S = 0.5


@dataclass(frozen=True)
class SlurmJobs(AbstractWorkers):
    """One job for each piece; a preempted or timed out job is submitted again.

    When this process is interrupted, it cancels the jobs that are queued or running.
    When it is killed, the jobs go on. Units of work are not reported.

    Args:
        folder: for scripts and logs; on a disk that all machines share.
        partition: of the cluster; None: processes of this machine instead.
        cores: of each job.
        memory_gb: of each job.
        minutes: after which a job is stopped, and submitted again, up to three times.
        count: most jobs at a time, queued ones included.
    """

    folder: Path
    partition: str | None
    cores: int = 1
    memory_gb: float = 4.0
    minutes: int = 240
    count: int = MOST

    def _do(
        self, work: AbstractWork, pieces: Sequence[int], report: OnUnits, on_end: OnEnd
    ) -> None:
        executor, errors = self._executor()
        left: list[int] = list(reversed(pieces))
        jobs: dict[int, Any] = {}
        try:
            while left or jobs:
                while left and len(jobs) < self.count:
                    piece = left.pop()
                    try:
                        jobs[piece] = executor.submit(_Piece(work, piece))
                    except errors.FailedJobError as err:
                        raise InputError(f"SLURM takes no job: {err}") from err
                time.sleep(_POLL_S)
                for piece in [piece for piece, job in jobs.items() if job.done()]:
                    on_end(piece, _error(piece, jobs.pop(piece), errors))
        finally:
            for job in jobs.values():
                job.cancel()

    def _executor(self) -> tuple[Any, Any]:
        """Return what submits, and the module of its errors."""
        submitit, errors = (
            load_extra(f"submitit{name}", "SLURM") for name in ("", ".core.utils")
        )
        cluster = "local" if self.partition is None else "slurm"
        try:
            executor = submitit.AutoExecutor(self.folder, cluster=cluster)
        except RuntimeError as err:
            raise SetupError(f"SLURM: {err}; run this where sbatch works") from err
        executor.update_parameters(
            name="mi-nerfattack",
            timeout_min=self.minutes,
            mem_gb=self.memory_gb,
            cpus_per_task=self.cores,
            slurm_partition=self.partition,
        )
        return executor, errors


def _error(piece: int, job: Any, errors: Any) -> Exception | None:
    """Return why a job that has ended did not do its piece."""
    try:
        return failure(piece, job.result())
    except errors.UncompletedJobError as err:
        message = str(err).splitlines()[-1]
        return InputError(
            f"job {job.job_id} ended in piece {piece}, {job.state}: {message}; see "
            f"{job.paths.stderr}, and give more memory if it ran out of it"
        )


@dataclass(frozen=True)
class _Piece:
    """A piece, as a job does it."""

    work: AbstractWork
    index: int

    def __call__(self) -> Outcome:
        return do_alone(self.work, self.index)

    def checkpoint(self) -> Any:
        """Return what is submitted again; the piece itself knows what is left."""
        helpers = load_extra("submitit.helpers", "SLURM")
        return helpers.DelayedSubmission(self)
