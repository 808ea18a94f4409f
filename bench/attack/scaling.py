"""``python -m bench scaling``: time and memory of an attack iteration by its size."""

from __future__ import annotations

import statistics
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import astuple, dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro

from bench import results
from bench.attack.drive import Job
from bench.tables import markdown
from bench.worker import Worker
from mi_nerfattack.commands.shared.terminal import Result
from mi_nerfattack.errors import InputError
from mi_nerfattack.io import files
from mi_nerfattack.ranges import Count, checked

#: By the way: its time, its memory.
WAYS = {"kept_backgrounds": "iteration", "replay": "replay_iteration"}
Row = dict[str, Any]


@dataclass(frozen=True)
@checked()
class BenchScaling:
    """Measure time and memory of attack iterations as one part of them grows.

    The drive of `bench attack`; the other parts stay at their first value. Takes a
    quarter of an hour on two cores; stopped, the same command continues from OUTPUT.
    Keep the machine otherwise idle.
    """

    sizes: tuple[str, ...] = ("200x66", "283x93", "400x132", "566x187")
    """Widths and heights of the camera's image, pixels."""
    poses: tuple[Count, ...] = (1, 2, 4, 8)
    """Vehicles in the batch."""
    objects: tuple[Count, ...] = (1, 2, 4, 8)
    """Objects that are attacked."""
    horizons: tuple[Count, ...] = (25, 50, 100, 200, 400)
    """Control periods of the same 2.5 seconds."""
    repeats: Count = 3
    """Iterations that are timed; the median counts."""
    output: Annotated[Path, tyro.conf.arg(aliases=["-o"])] = Path("scaling.json")
    """File to write, row by row (.json)."""
    json: bool = False
    """Print one line of JSON in place of the table."""

    def run(self) -> Result:
        """Measure, write and print."""
        axes = self.axes()
        if len(axes["pixels"]) < len(self.sizes):
            raise InputError("--sizes: two of as many pixels; name one of them")
        document = self._begin()
        rows = {Job(*row["job"]): row for row in document["rows"]}
        jobs = list(dict.fromkeys(job for own in axes.values() for job in own.values()))
        with results.progress() as show:
            for count, job in enumerate(jobs):
                show("scaling", count, len(jobs), " ".join(map(str, astuple(job))))
                if job not in rows:
                    rows[job] = {"job": astuple(job), **cost(job, self.repeats)}
                    document["rows"] = list(rows.values())
                    files.write_json(self.output, document)
            show("scaling", len(jobs), len(jobs), "")
        document["exponents"] = exponents(axes, rows)
        files.write_json(self.output, document)
        print(f"written to {self.output}", file=sys.stderr)
        table = scaling_table(axes, rows, document["exponents"])
        return Result(document, lambda: print(table))

    def _begin(self) -> dict[str, Any]:
        """Return a stamped document with the `rows` that the file has, if it is there.

        Raises:
            InputError: the file was made by another command, machine or version.
        """
        files.check_writable(self.output)
        begun = results.stamp({"rows": []}, results.command_of("scaling", self))
        if self.output.exists():
            stored = files.read_json(self.output)
            for key in ("command", "machine", "versions"):
                if stored.get(key) != begun[key]:
                    raise InputError(
                        f"{self.output}: {key} {stored.get(key)} there, {begun[key]} "
                        "here; name another file"
                    )
            begun["rows"] = stored["rows"]
        return begun

    def axes(self) -> dict[str, dict[int, Job]]:
        """Return the drives of each axis, by their size along it."""
        sizes = results.read_sizes(self.sizes)
        base = Job(*sizes[0], self.poses[0], self.horizons[0], self.objects[0])
        return {
            "pixels": {w * h: replace(base, width=w, height=h) for w, h in sizes},
            "poses": {n: replace(base, poses=n) for n in self.poses},
            "objects": {n: replace(base, objects=n) for n in self.objects},
            "horizon": {n: replace(base, horizon=n) for n in self.horizons},
        }


@contextmanager
def warm_worker(job: Job, way: str) -> Iterator[Worker]:
    """Open a process that has done an iteration, and was not the first to compile it.

    Compiling takes memory.
    """
    with Worker("attack.ours", "OurAttack", *astuple(job)) as worker:
        worker.ask("compile", way)
    with Worker("attack.ours", "OurAttack", *astuple(job)) as worker:
        worker.ask("iterate", way)
        yield worker


def cost(job: Job, repeats: int) -> Row:
    """Time iterations, and take the peak of a process that compiles nothing."""
    row: Row = {}
    for way, name in WAYS.items():
        with warm_worker(job, way) as worker:
            times = [worker.ask("iterate", way)["seconds"] for _ in range(repeats)]
            row[f"{name}_ms"] = 1e3 * statistics.median(times)
            row[f"{name}_mb"] = worker.ask("memory")["peak_memory_mb"]
    return row


def exponents(
    axes: Mapping[str, Mapping[int, Job]], rows: Mapping[Job, Row]
) -> dict[str, dict[str, float]]:
    """Fit powers of the size along each axis, by least squares of logarithms.

    Args:
        axes: from :meth:`BenchScaling.axes`; those with one size are left out.
        rows: by drive.

    Returns:
        by axis and key of the rows.
    """
    powers: dict[str, dict[str, float]] = {}
    for axis, jobs in axes.items():
        if len(jobs) > 1:
            some, sizes = [rows[job] for job in jobs.values()], np.log(list(jobs))
            powers[axis] = {
                key: float(np.polyfit(sizes, np.log([row[key] for row in some]), 1)[0])
                for key in some[0].keys() - {"job"}
            }
    return powers


def scaling_table(
    axes: Mapping[str, Mapping[int, Job]],
    rows: Mapping[Job, Row],
    powers: Mapping[str, Mapping[str, float]],
) -> str:
    """Return a row for each size along each axis, then the exponent."""
    keys = [f"{name}_{unit}" for name in WAYS.values() for unit in ("ms", "mb")]
    lines = []
    for axis, jobs in axes.items():
        for size, job in jobs.items():
            cells = (f"{rows[job][key]:.0f}" for key in keys)
            lines.append((axis, str(size), *cells))
        if axis in powers:
            cells = (f"**{powers[axis][key]:.2f}**" for key in keys)
            lines.append((axis, "**exponent**", *cells))
    header = ("axis", "size", "`kept_backgrounds`, ms", "MB", "`replay`, ms", "MB")
    return markdown(header, lines)
