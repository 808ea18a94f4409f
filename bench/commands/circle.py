"""``python -m bench circle``: the MuJoCo car against the bicycle model."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro

from mi_nerfattack.commands.shared.result import Result


@dataclass(frozen=True)
class BenchCircle:
    """Drive circles in MuJoCo and compare their radii with the bicycle model's.

    Both cars at three steering angles and two speeds, and once faster than the tyres'
    friction allows. Exit code 1 where a circle that friction allows is off by more
    than 5 %.
    """

    output: Annotated[Path, tyro.conf.arg(aliases=["-o"])] = Path("circle.png")
    """Figure to write (.png)."""
    json: bool = False
    """Print one line of JSON in place of the table."""

    def run(self) -> Result:
        """Drive, print and draw."""
        from mi_nerfattack.io import files

        files.check_writable(self.output)
        from bench.driving import circle
        from mi_nerfattack.commands.shared.progress import StageBars

        with StageBars() as bars:
            circles = circle.run(bars.counter("circles"))
        circle.write_figure(self.output, circles)
        document = circle.to_document(circles)
        print(f"figure written to {self.output}", file=sys.stderr)
        code = int(not circle.within_limit(circles))
        return Result(document, lambda: _print(document), code)


def _print(document: dict[str, Any]) -> None:
    import rich.box
    import rich.table
    from rich.console import Console

    table = rich.table.Table(
        box=rich.box.SIMPLE_HEAD, title="MuJoCo's car on circles of the bicycle model"
    )
    table.add_column("car")
    for name in (
        "steer\n(rad)",
        "speed\n(m/s)",
        "friction\nneeded",
        "radius of\nthe model (m)",
        "driven\n(m)",
        "error\n(%)",
    ):
        table.add_column(name, justify="right")
    for row in document["circles"]:
        table.add_row(
            row["car"],
            f"{row['steer']:g}",
            f"{row['speed_ms']:g}",
            f"{100 * row['friction_demand']:.0f} %",
            f"{row['expected_m']:.3f}",
            f"{row['radius_m']:.3f}",
            f"{100 * row['error']:+.2f}",
        )
    Console().print(table)
