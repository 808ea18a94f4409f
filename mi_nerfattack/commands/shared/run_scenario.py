"""What ``attack`` and ``demo`` share: running a scenario, and the final table."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mi_nerfattack.commands.shared.result import Result
from mi_nerfattack.commands.shared.terminal import console

if TYPE_CHECKING:
    from mi_nerfattack.experiment.finished import Frames


def run_scenario(
    path: Path,
    output: Path,
    object_field: Callable[[], Path | None] = lambda: None,
    force: bool = False,
    anyway: bool = False,
    frames: Frames | None = 3,
) -> Result:
    """Run a scenario with a progress bar on stderr; return its metrics and table.

    Args:
        path: the scenario file.
        output: the run folder.
        object_field: makes, or names, the grid field that replaces the one of every
            object; None leaves them.
        force: go on although something has changed.
        anyway: attack although it would prove nothing.
        frames: of each case; None writes no plots, attribution and page, either.
    """
    started = time.perf_counter()
    from mi_nerfattack.commands.shared.progress import StageBars
    from mi_nerfattack.experiment.claim import claimed

    with claimed(output):
        # seconds, with torch: not before the folder is found to be free
        from mi_nerfattack.experiment.job import attack_claimed

        field = object_field()  # it shows bars of its own
        with StageBars(started) as bars:

            def show(stage: str, done: int, total: int, remark: str) -> None:
                bars.show(stage, done, total, f"{done}/{total} {remark}")

            document = attack_claimed(
                path,
                output,
                object_field=field,
                started=started,
                frames=frames,
                on_progress=show,
                on_notice=bars.say,
                force=force,
                anyway=anyway,
            )
    return Result(document, lambda: _show(document, output, frames))


def _show(document: dict[str, Any], output: Path, frames: Frames | None) -> None:
    from mi_nerfattack.report.table import metrics_table

    out = console()
    for flag in document["flags"]:
        out.print(f"flag: {flag}", style="bold", highlight=False)
    for sentence in document["verdict"]:
        out.print(sentence, highlight=False)
    out.print(metrics_table(document))
    _print_files(out, output, document, frames)


def _print_files(
    out: Any, output: Path, document: dict[str, Any], frames: Frames | None
) -> None:
    cost = document["cost"]
    out.print(
        f"{cost['wall_s']:.0f} s by the clock, {cost['renders']} frames, "
        f"{cost['peak_memory_mb']:.0f} MB at most"
    )
    out.print(f"Run folder: {output.resolve()}", soft_wrap=True)
    shown = {
        "report.html": "everything on one page",
        "overhead.png": "all drives from above",
        "triptych.png": "unperturbed, attacked and transferred, over the ground",
        "strip.png": "what the policy sees",
        "attribution*.png": "when and where the failure is made",
        "frames/": "EXR frames with layers, and as recordings for replay",
        **({"videos/": "all cases side by side"} if frames == "all" else {}),
    }
    numbers = {
        "metrics.json, *.csv": "the numbers",
        "objects/": "the fields, as the attack leaves them",
    }
    for name, meaning in ({**shown, **numbers} if frames else numbers).items():
        out.print(f"  {name:24s} {meaning}")
