"""`bench memory`: the peak of an attack iteration by poses and horizon."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from bench import results
from bench.attack.drive import Job
from bench.render.run import Progress, Worker
from mi_nerfattack.errors import InputError
from mi_nerfattack.io import files
from mi_nerfattack.ranges import Count, checked

WANTED = 0.01  # largest change of the peak over the horizons
WAY = "replay"  # the adjoint whose memory is constant


@dataclass(frozen=True)
@checked()
class Settings:
    """What to measure.

    Attributes:
        size: width and height of the image, pixels.
        poses: vehicles in the batch.
        horizons: control periods.
    """

    size: tuple[int, int] = (366, 188)
    poses: tuple[Count, ...] = (1, 4)
    horizons: tuple[Count, ...] = (25, 100, 400)

    def jobs(self) -> list[Job]:
        """Return what is driven, short drives first."""
        return [Job(*self.size, n, h) for h in self.horizons for n in self.poses]


def run(
    settings: Settings, path: Path, command: list[str], progress: Progress
) -> dict[str, Any]:
    """Measure the rows that a file lacks, each in a process of its own.

    Args:
        settings: what.
        path: JSON document, written after each row; rows that are there count.
        command: that makes the document.
        progress: called with stage, periods driven by all vehicles, all of them, and a
            remark.

    Returns:
        the document: `rows`, and by poses their `change`, largest over least less 1.

    Raises:
        InputError: the file was made by another command, machine or version.
    """
    document = begin(path, command)
    document["change"] = _change(document["rows"])
    done = {(row["poses"], row["horizon"]) for row in document["rows"]}
    left = [job for job in settings.jobs() if (job.poses, job.horizon) not in done]
    work, total = 0, sum(job.poses * job.horizon for job in left)
    for job in left:
        progress("memory", work, total, f"{job.poses} poses, {job.horizon} periods")
        row = {"poses": job.poses, "horizon": job.horizon}
        document["rows"].append(row | {"peak_memory_mb": _peak_mb(job)})
        document["change"] = _change(document["rows"])
        files.write_json(path, document)
        work += job.poses * job.horizon
    progress("memory", work, total, "")
    return document


def begin(path: Path, command: list[str]) -> dict[str, Any]:
    """Return a stamped document with the `rows` that a file has, if it is there.

    Raises:
        InputError: the file was made by another command, machine or version.
    """
    document = results.stamp({"rows": []}, command)
    if path.exists():
        found = files.read_json(path)
        for key in ("command", "machine", "versions"):
            if found.get(key) != document[key]:
                raise InputError(
                    f"{path}: {key} {found.get(key)} there, {document[key]} here; name "
                    "another file"
                )
        document["rows"] = found["rows"]
    return document


@contextmanager
def warm_worker(job: Job, way: str) -> Iterator[Worker]:
    """Open a process that has done an iteration, and was not the first to compile it.

    Compiling takes memory.
    """
    with Worker("attack", "ours", *job.arguments()) as worker:
        worker.ask("compile", way)
    with Worker("attack", "ours", *job.arguments()) as worker:
        worker.ask("iterate", way)
        yield worker


def _peak_mb(job: Job) -> float:
    with warm_worker(job, WAY) as worker:
        return worker.ask("memory")["peak_memory_mb"]


def _change(rows: list[dict[str, Any]]) -> dict[str, float]:
    """Compare the largest peak of each number of poses with the least."""
    peaks: dict[int, list[float]] = {}
    for row in rows:
        peaks.setdefault(row["poses"], []).append(row["peak_memory_mb"])
    return {str(poses): max(some) / min(some) - 1 for poses, some in peaks.items()}
