"""What ``attack`` and ``demo`` share: progress on the terminal and the final table."""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import Any


def run_scenario(path: Path, output: Path, resume: bool, as_json: bool) -> int:
    """Run a scenario with a progress bar on stderr, and print its table."""
    from rich.console import Console

    from mi_nerfattack import variant
    from mi_nerfattack.attack.job import Job
    from mi_nerfattack.policy.adapter import TorchPolicy
    from mi_nerfattack.policy.pilotnet import PilotNet
    from mi_nerfattack.report.table import metrics_table
    from mi_nerfattack.scenario import load_scenario, resolve

    scenario, text = load_scenario(path)
    variant.ensure()
    policy = TorchPolicy(PilotNet.load(resolve(scenario.policy.file, path.parent)))
    with StageBars() as bars:
        job = Job(scenario, text, path.parent, policy, output, bars.update)
        document = job.run(resume)
    if as_json:
        print(json.dumps(document, allow_nan=False))
        return 0
    console = Console()
    console.print(metrics_table(document))
    _print_files(console, output, document)
    return 0


def _print_files(console: Any, output: Path, document: dict[str, Any]) -> None:
    cost = document["cost"]
    console.print(
        f"{cost['wall_s']:.0f} s, {cost['renders']} frames, "
        f"{cost['peak_memory_mb']:.0f} MB at most"
    )
    console.print(f"Run folder: {output.resolve()}", soft_wrap=True)
    for name, meaning in (
        ("report.html", "everything on one page"),
        ("overhead.png", "all drives from above"),
        ("strip.png", "what the policy sees"),
        ("metrics.json, steps.csv", "the numbers"),
        ("objects/", "the attacked fields"),
        ("frames/", "EXR frames with layers"),
    ):
        console.print(f"  {name:24s} {meaning}")


class StageBars:
    """One progress bar a stage, with rate and remaining time, on stderr."""

    def __init__(self) -> None:
        from rich.console import Console
        from rich.progress import (
            BarColumn,
            MofNCompleteColumn,
            Progress,
            TextColumn,
            TimeElapsedColumn,
            TimeRemainingColumn,
        )

        self._console = Console(stderr=True)
        self._progress = Progress(
            TextColumn("{task.description:28s}"),
            BarColumn(bar_width=20),
            MofNCompleteColumn(),
            TimeElapsedColumn(),
            TimeRemainingColumn(),
            TextColumn("{task.fields[remark]}"),
            console=self._console,
            disable=not self._console.is_terminal,
        )
        self._tasks: dict[str, Any] = {}
        self._last_line = 0.0

    def __enter__(self) -> StageBars:
        self._progress.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._progress.stop()

    def update(self, stage: str, done: int, total: int, remark: str) -> None:
        """Show where a stage is; without a terminal, a line every ten seconds."""
        if stage not in self._tasks:
            self._tasks[stage] = self._progress.add_task(stage, total=total, remark="")
        self._progress.update(self._tasks[stage], completed=done, remark=remark)
        due = done == total or time.monotonic() - self._last_line > 10
        if not self._console.is_terminal and due:
            self._last_line = time.monotonic()
            self._console.print(f"{stage}: {done}/{total} {remark}", soft_wrap=True)
