"""`bench scaling`: what an attack iteration costs, by the size of each of its parts."""

from __future__ import annotations

import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from bench.attack.drive import Job
from bench.attack.memory import begin, warm_worker
from bench.render.run import Progress
from mi_nerfattack.io import files
from mi_nerfattack.ranges import Count, checked

#: By the way: its time, its memory.
WAYS = {"kept_backgrounds": "iteration", "replay": "replay_iteration"}


@dataclass(frozen=True)
@checked()
class Settings:
    """What to measure: one part grows, the others stay at their first value.

    Attributes:
        sizes: widths and heights of the image, pixels.
        poses: vehicles in the batch.
        objects: that are attacked.
        horizons: control periods of the same 2.5 seconds.
        repeats: iterations that are timed; the median counts.
    """

    sizes: tuple[tuple[int, int], ...] = ((200, 66), (283, 93), (400, 132), (566, 187))
    poses: tuple[Count, ...] = (1, 2, 4, 8)
    objects: tuple[Count, ...] = (1, 2, 4, 8)
    horizons: tuple[Count, ...] = (25, 50, 100, 200)
    repeats: Count = 3

    def axes(self) -> dict[str, dict[float, Job]]:
        """Return the drives of each axis, by their size along it."""
        base = Job(*self.sizes[0], self.poses[0], self.horizons[0], self.objects[0])
        return {
            "pixels": {w * h: replace(base, width=w, height=h) for w, h in self.sizes},
            "poses": {n: replace(base, poses=n) for n in self.poses},
            "objects": {n: replace(base, objects=n) for n in self.objects},
            "horizon": {n: replace(base, horizon=n) for n in self.horizons},
        }


def run(
    settings: Settings, path: Path, command: list[str], progress: Progress
) -> dict[str, Any]:
    """Measure the drives that a file lacks, each way in a process of its own.

    Args:
        settings: what.
        path: JSON document, written after each row; rows that are there count.
        command: that makes the document.
        progress: called with stage, rows done, all of them, and a remark.

    Returns:
        the document: `rows`, and `exponents` of each axis by the rows' keys.

    Raises:
        InputError: the file was made by another command, machine or version.
    """
    document = begin(path, command)
    axes = settings.axes()
    jobs = list(dict.fromkeys(job for axis in axes.values() for job in axis.values()))
    done = {tuple(row["job"]) for row in document["rows"]}
    for count, job in enumerate(jobs):
        if tuple(job.arguments()) not in done:
            progress("scaling", count, len(jobs), " ".join(job.arguments()))
            document["rows"].append(_measure(job, settings.repeats))
            files.write_json(path, document)
    progress("scaling", len(jobs), len(jobs), "")
    document["exponents"] = exponents(axes, document["rows"])
    files.write_json(path, document)
    return document


def exponents(
    axes: Mapping[str, Mapping[float, Job]], rows: Sequence[Mapping[str, Any]]
) -> dict[str, dict[str, float]]:
    """Fit powers of the size along each axis, by least squares of logarithms.

    Args:
        axes: from :meth:`Settings.axes`.
        rows: of :func:`run`.

    Returns:
        by axis and key of the rows; of axes with two sizes or more.
    """
    by_job = {tuple(row["job"]): row for row in rows}
    found: dict[str, dict[str, float]] = {}
    for axis, jobs in axes.items():
        if len(jobs) > 1:
            some = [by_job[tuple(job.arguments())] for job in jobs.values()]
            sizes = np.log(list(jobs))
            found[axis] = {
                key: float(np.polyfit(sizes, np.log([row[key] for row in some]), 1)[0])
                for key in some[0]
                if key != "job"
            }
    return found


def _measure(job: Job, repeats: int) -> dict[str, Any]:
    """Time iterations, and take the peak of a process that compiles nothing."""
    row: dict[str, Any] = {"job": job.arguments()}
    for way, name in WAYS.items():
        with warm_worker(job, way) as worker:
            times = [worker.ask("iterate", way)["seconds"] for _ in range(repeats)]
            row[f"{name}_ms"] = 1e3 * statistics.median(times)
            row[f"{name}_mb"] = worker.ask("memory")["peak_memory_mb"]
    return row
