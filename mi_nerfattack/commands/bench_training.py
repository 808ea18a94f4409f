"""``mi-nerfattack bench dagger`` and ``bench collect``: figures of training."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro


@dataclass(frozen=True)
class BenchDagger:
    """Compare DAgger with plain cloning on as many frames and gradient steps.

    Both start from the same frames and weights of three seeds; mean cross-track errors
    of drives from random starts in the path-traced intersection. Takes about half an
    hour on two cores; stopped, the same command continues from DATA.
    """

    data: Path
    """Folder of frames, checkpoints and results; made if missing."""
    output: Annotated[Path, tyro.conf.arg(aliases=["-o"])] = Path("dagger.png")
    """Figure to write (.png); the numbers go beside it (.json)."""
    workers: int | None = None
    """Processes that collect and drive; one a core by default."""
    quick: bool = False
    """Take the smallest sizes: to see that it works, not for figures."""

    def run(self) -> int:
        """Collect, train, drive and draw."""
        from mi_nerfattack import files, variant

        files.check_writable(self.output)
        variant.ensure()
        from mi_nerfattack.bench import (  # pyright: ignore[reportMissingImports]
            dagger,
            results,
        )
        from mi_nerfattack.commands.bars import StageBars
        from mi_nerfattack.policy.workers import Processes, available_cores

        settings = dagger.Settings.quick() if self.quick else dagger.Settings()
        workers = Processes(available_cores() if self.workers is None else self.workers)
        with StageBars() as bars:
            document = dagger.run(
                settings,
                self.data,
                workers,
                lambda stage, done, total: bars.show(
                    stage, done, total, f"{done}/{total}"
                ),
            )
        command = ["mi-nerfattack", "bench", "dagger", *["--quick"] * self.quick]
        document = results.stamp(document, command)
        dagger.write_figure(self.output, document)
        files.write_json(self.output.with_suffix(".json"), document)
        _print(document)
        print(f"figure written to {self.output}", file=sys.stderr)
        return 0


def _print(document: dict[str, Any]) -> None:
    import rich.box
    import rich.table
    from rich.console import Console

    table = rich.table.Table(
        box=rich.box.SIMPLE_HEAD,
        title=f"{document['frames']} frames, {document['gradient_steps']} steps each",
    )
    table.add_column("")
    for name in ("mean error, m", "standard error, m", "departures"):
        table.add_column(name, justify="right")
    for arm, found in document["arms"].items():
        table.add_row(
            arm,
            f"{found['mean_m']:.4f}",
            f"{found['standard_error_m']:.4f}",
            str(found["departures"]),
        )
    Console().print(table)
