"""``python -m bench scaling``: time and memory of an attack by its size."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro

from mi_nerfattack.commands.shared.result import Result


@dataclass(frozen=True)
class BenchScaling:
    """Measure time and memory of attack iterations as one part of them grows.

    The drive of `bench attack`; the other parts stay at their first value. Takes a
    quarter of an hour on two cores; stopped, the same command continues from OUTPUT.
    Keep the machine otherwise idle.
    """

    sizes: tuple[str, ...] = ("200x66", "283x93", "400x132", "566x187")
    """Widths and heights of the camera's image, pixels."""
    poses: tuple[int, ...] = (1, 2, 4, 8)
    """Vehicles in the batch."""
    objects: tuple[int, ...] = (1, 2, 4, 8)
    """Objects that are attacked."""
    horizons: tuple[int, ...] = (25, 50, 100, 200)
    """Control periods of the same 2.5 seconds."""
    repeats: int = 3
    """Iterations that are timed; the median counts."""
    output: Annotated[Path, tyro.conf.arg(aliases=["-o"])] = Path("scaling.json")
    """File to write, row by row (.json)."""
    json: bool = False
    """Print one line of JSON in place of the table."""

    def run(self) -> Result:
        """Measure, write and print."""
        from bench.attack import scaling
        from bench.commands.speed import measure, read_sizes
        from mi_nerfattack.errors import InputError
        from mi_nerfattack.io import files

        sizes = read_sizes(self.sizes)
        if len({width * height for width, height in sizes}) < len(sizes):
            raise InputError("--sizes: two of as many pixels; name one of them")
        parts = sizes, self.poses, self.objects, self.horizons
        settings = scaling.Settings(*parts, self.repeats)
        files.check_writable(self.output)
        document = measure(scaling.run, settings, self.output, self._command())
        print(f"written to {self.output}", file=sys.stderr)
        return Result(document, lambda: _print(document, settings.axes()))

    def _command(self) -> list[str]:
        command = ["python", "-m", "bench", "scaling", "--sizes", *self.sizes]
        for name in ("poses", "objects", "horizons"):
            command += [f"--{name}", *map(str, getattr(self, name))]
        return [*command, "--repeats", str(self.repeats)]


def _print(document: dict[str, Any], axes: dict[str, dict[float, Any]]) -> None:
    import rich.box
    import rich.table
    from rich.console import Console

    rows = {tuple(row["job"]): row for row in document["rows"]}
    columns = {"iteration_ms": "kept, ms", "iteration_mb": "MB"}
    columns |= {"replay_iteration_ms": "replay, ms", "replay_iteration_mb": "MB"}
    table = rich.table.Table(box=rich.box.MARKDOWN)
    for name in ("axis", "size", *columns.values()):
        table.add_column(name, justify="right")
    for axis, jobs in axes.items():
        for size, job in jobs.items():
            row = rows[tuple(job.arguments())]
            table.add_row(axis, f"{size}", *(f"{row[key]:.0f}" for key in columns))
        if powers := document["exponents"].get(axis):
            table.add_row(axis, "exponent", *(f"{powers[key]:.2f}" for key in columns))
    Console().print(table)
