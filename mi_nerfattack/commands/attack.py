"""``mi-nerfattack attack``: attack a policy and measure the transfer."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal

import tyro

from mi_nerfattack.commands.shared.options import Settings
from mi_nerfattack.commands.shared.terminal import Result, console

if TYPE_CHECKING:
    from mi_nerfattack.experiment.finished import Frames


def run_scenario(
    path: Path,
    output: Path,
    object_field: Callable[[], Path | None] = lambda: None,
    force: bool = False,
    anyway: bool = False,
    frames: Frames | None = 3,
    workers: int | None = None,
    settings: Sequence[str] = (),
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
        workers: processes that drive; None for one a core.
        settings: keys that replace those of the file.
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
                workers=workers,
                settings=settings,
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
    _print_files(out, output, document, frames=frames)


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
        "triptych.png": "original, attacked and transferred, over the ground",
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


@dataclass(frozen=True)
class Attack:
    """Optimise the textures of a scenario's objects until the policy leaves its lane.

    Drives without objects, and drives past the objects with their original textures,
    with random textures, with the best random texture and with the attack. The random
    textures together cost as much as the attack. All drives are made in the surrogate
    and in the deployment environments that the scenario names. The run folder gets
    everything.
    """

    continues: ClassVar[bool] = True

    scenario: tyro.conf.Positional[Path]
    """Scenario file (TOML)."""
    output: Path
    """Run folder: new, or of the same attack, which then goes on."""
    settings: Settings = ()
    """Set a key of the scenario: seed=1, drive.runs=4, policy.file=mine.pt2."""
    force: bool = False
    """Go on although scenario, files or versions have changed."""
    anyway: bool = False
    """Attack although the checks find that it would prove nothing, for example because
    an object is not in view. metrics.json keeps the findings as flags."""
    pictures: Literal["none", "worst", "all"] | int = 3
    """Frames of each case to write: all (with videos), worst (of the second that ends
    where the drive is farthest from the lane's centre) or a number, equally spaced.
    none: no plots, attribution and page either."""
    workers: int | None = None
    """Processes that drive; by default one per core, 1 for a policy behind a URL."""
    json: bool = False
    """End with one line of JSON, the content of metrics.json."""

    def run(self) -> Result:
        """Run the job and print the table."""
        from mi_nerfattack.commands.attack import run_scenario
        from mi_nerfattack.errors import InputError

        if isinstance(self.pictures, int) and self.pictures < 1:
            raise InputError(
                f"--pictures: {self.pictures}; none, worst, all, or at least 1"
            )
        return run_scenario(
            self.scenario,
            self.output,
            force=self.force,
            anyway=self.anyway,
            frames=None if self.pictures == "none" else self.pictures,
            workers=self.workers,
            settings=self.settings,
        )
