"""``mi-nerfattack transfer``: found attacks in every environment and condition."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, ClassVar

import tyro

from mi_nerfattack.commands.shared.terminal import Result, console

if TYPE_CHECKING:
    from mi_nerfattack.experiment.transfer.work import TransferDrives


@dataclass(frozen=True)
class Transfer:
    """Drive past found attacks, unchanged, in every environment and condition.

    Drives start where no attack was optimised or evaluated. Each start has one drive
    without objects, and drives past the objects with their original textures, with the
    best random texture of the run and with its attack. The folder gets a table
    (transfer.json), which grows row by row, and a picture. Finished drives are kept:
    the same command continues after Ctrl-C, and more runs, environments, conditions or
    starts add to them.
    """

    continues: ClassVar[bool] = True

    run_folders: Annotated[
        tyro.conf.Positional[tuple[Path, ...]], tyro.conf.arg(metavar="RUN...")
    ]
    """Folders of finished runs of attack; with --best, those of sweeps, too."""
    output: Path
    """Folder for table, picture and drives; one of an earlier transfer goes on."""
    best: int | None = None
    """Attacks of each route of the sweeps, those with the largest errors in the
    surrogate; of a method at a place the better one alone."""
    environments: tuple[str, ...] = (
        "surrogate",
        "mitsuba",
        "mitsuba_built_in",
        "mujoco",
        "mujoco_gl",
    )
    """Environments: surrogate, mitsuba, mujoco, mujoco_gl, which paste objects, and
    mitsuba_built_in, mujoco_built_in, mujoco_gl_built_in."""
    conditions: tuple[str, ...] = (
        "day",
        "morning",
        "noon",
        "evening",
        "overcast",
        "exposure:-1",
        "exposure:+1",
        "noise:0.03",
        "blur:1",
        "dropped:0.2",
        "late:1",
        "latency:1",
        "placement:0.1",
        "turn:10",
        "pitch:1",
    )
    """Times of day. Of the camera: exposure (powers of two), noise (sRGB, of 1), blur
    (pixels), dropped (share of frames), late (control periods) and pitch (error in
    degrees). Of the car: latency of controls (control periods). Errors of objects:
    placement (metres) and turn (degrees). Several at once with commas:
    evening,noise:0.03."""
    cases: tuple[str, ...] = ("no_object", "own", "best_random", "attack")
    """What objects show."""
    runs: int = 4
    """Drives of each case, environment and condition."""
    seed: int = 1
    """Of starts, images and errors."""
    spp: int = 16
    """Samples per pixel of path-traced images."""
    workers: int | None = None
    """Processes that drive; one a core by default, 1 for policies behind a URL. 1
    drives in this process."""
    json: bool = False
    """Print transfer.json instead of the table."""

    def run(self) -> Result:
        """Drive, summarise, print and write."""
        from mi_nerfattack import variant
        from mi_nerfattack.commands.shared.progress import StageBars
        from mi_nerfattack.experiment.transfer.figures import check_output, run_transfer
        from mi_nerfattack.io import files
        from mi_nerfattack.report.plots.transfer import quality_condition
        from mi_nerfattack.report.table import quality_table, transfer_table
        from mi_nerfattack.system.workers import chosen_workers

        files.check_folder(self.output)
        variant.ensure()
        work = self._work()
        alone = any(attack.scenario.policy.is_remote for attack in work.attacks)
        workers = chosen_workers(self.workers, alone)
        check_output(self.output)
        with StageBars() as bars:
            count = self.runs * len(work.batches)
            bars.say(
                f"{len(work.rows)} rows, {count} drives, kept in {work.store.folder}"
            )
            progress = bars.counter("driving", "step ")
            document = run_transfer(work, self.output, workers, progress=progress)

        def show() -> None:
            out = console()
            out.print(transfer_table(document))
            if document["surrogates"]:
                condition = quality_condition(document)
                out.print(quality_table(document, condition))
            out.print(f"Written: {self.output.resolve()}", soft_wrap=True)

        return Result(document, show)

    def _work(self) -> TransferDrives:
        """Check everything that can be checked before the first drive."""
        from mi_nerfattack.drives.store import Store
        from mi_nerfattack.experiment.transfer.best import chosen_runs
        from mi_nerfattack.experiment.transfer.columns import make_columns
        from mi_nerfattack.experiment.transfer.figures import DRIVES
        from mi_nerfattack.experiment.transfer.found import read_found
        from mi_nerfattack.experiment.transfer.work import TransferDrives

        columns = make_columns(self.environments, self.conditions, self.spp)
        runs = chosen_runs(self.run_folders, self.best)
        attacks, store = read_found(runs), Store(self.output / DRIVES)
        return TransferDrives(
            store,
            attacks,
            columns,
            cases=self.cases,
            starts=self.runs,
            seed=self.seed,
        )
