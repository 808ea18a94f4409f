"""``python -m bench experts``: how well the experts follow the routes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from mi_nerfattack.commands.shared.result import Result


@dataclass(frozen=True)
class BenchExperts:
    """Drive each expert on each bundled route in each environment.

    No images are rendered. Each expert is told the lag of its vehicle, and then that
    of labels for all vehicles. Takes about a minute; exit code 1 where an expert leaves
    the lane centre by more than 0.1 m.
    """

    json: bool = False
    """Print one line of JSON in place of the table."""

    def run(self) -> Result:
        """Drive and print."""
        from mi_nerfattack import variant

        variant.ensure()
        from bench.driving import experts
        from mi_nerfattack.commands.shared.progress import StageBars

        with StageBars() as bars:
            results = experts.run(bars.counter("drives"))
        document = experts.to_document(results)
        code = int(not experts.within_limit(results))
        return Result(document, lambda: _print(document), code)


def _print(document: dict[str, Any]) -> None:
    import rich.box
    import rich.table
    from rich.console import Console

    table = rich.table.Table(
        box=rich.box.SIMPLE_HEAD,
        title=f"experts: cross-track error (limit {document['limit_m']} m)",
    )
    for name in ("environment", "route", "expert"):
        table.add_column(name)
    for name in ("lag\n(s)", "told\n(s)", "max\n(m)", "mean\n(m)", "back\n(s)"):
        table.add_column(name, justify="right")
    for row in document["drives"]:
        time = row["recovered_s"]
        table.add_row(
            row["environment"],
            row["route"],
            row["expert"],
            f"{row['lag_s']:.2f}",
            f"{row['told_s']:.2f}",
            f"{row['max_m']:.3f}",
            f"{row['mean_m']:.3f}",
            "never" if time is None else f"{time:.1f}",
        )
    Console().print(table)
