"""``python -m bench memory``: memory of an attack by the length of its drives."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro

from mi_nerfattack.commands.shared.result import Result


@dataclass(frozen=True)
class BenchMemory:
    """Measure the peak memory of attack iterations by poses and horizon.

    The drive of `bench attack` with the adjoint `replay`, each row in a process of its
    own. Takes half an hour on two cores; stopped, the same command continues from
    OUTPUT. Exit code 1 where a peak changes by more than 1 % over the horizons.
    """

    size: str = "366x188"
    """Width and height of the camera's image, pixels."""
    poses: tuple[int, ...] = (1, 4)
    """Vehicles in the batch."""
    horizons: tuple[int, ...] = (25, 100, 400)
    """Control periods of the same 2.5 seconds."""
    output: Annotated[Path, tyro.conf.arg(aliases=["-o"])] = Path("memory.json")
    """File to write, row by row (.json)."""
    json: bool = False
    """Print one line of JSON in place of the table."""

    def run(self) -> Result:
        """Measure, write and print."""
        from bench.attack import memory
        from bench.commands.speed import measure, read_sizes
        from mi_nerfattack.io import files

        (size,) = read_sizes((self.size,))
        settings = memory.Settings(size, self.poses, self.horizons)
        files.check_writable(self.output)
        document = measure(memory.run, settings, self.output, self._command())
        print(f"written to {self.output}", file=sys.stderr)
        code = int(max(document["change"].values()) > memory.WANTED)
        return Result(document, lambda: _print(document), code)

    def _command(self) -> list[str]:
        command = ["python", "-m", "bench", "memory", "--size", self.size]
        command += ["--poses", *map(str, self.poses)]
        return [*command, "--horizons", *map(str, self.horizons)]


def _print(document: dict[str, Any]) -> None:
    import rich.box
    import rich.table
    from rich.console import Console

    table = rich.table.Table(
        box=rich.box.SIMPLE_HEAD, title="largest resident size of the process, MB"
    )
    horizons = sorted({row["horizon"] for row in document["rows"]})
    for name in ("poses", *(f"{horizon} periods" for horizon in horizons), "change"):
        table.add_column(name, justify="right")
    for poses, change in document["change"].items():
        peaks = {
            row["horizon"]: row["peak_memory_mb"]
            for row in document["rows"]
            if str(row["poses"]) == poses
        }
        cells = [f"{peaks[horizon]:.1f}" for horizon in horizons]
        table.add_row(poses, *cells, f"{change:.2%}")
    Console().print(table)
