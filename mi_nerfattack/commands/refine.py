"""``mi-nerfattack refine``: finish a found attack by a few drives in deployment."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

import tyro

from mi_nerfattack.commands.shared.result import Result

if TYPE_CHECKING:
    from collections.abc import Iterator

    from mi_nerfattack.experiment.refine.refine import Refinement


@dataclass(frozen=True)
class Refine:
    """Search around a found attack by a few drives in a deployment environment.

    Bayesian optimisation over few low-frequency changes of the attacked texture, around
    what the surrogate says of each (P-BO). What was best is then driven from starts
    that neither saw, beside the attack as it was found. Unlike all other commands, this
    one searches in the environment that it reports: it tells what an attacker with some
    drives there gains. The folder gets refine.json, objects and drives; the same
    command continues after Ctrl-C, and more --drives go on.
    """

    continues: ClassVar[bool] = True

    run_folder: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="RUN")]
    """Folder of a finished run of attack."""
    output: Annotated[Path, tyro.conf.arg(aliases=["-o"])]
    """Folder for results."""
    environment: str = "mitsuba"
    """mitsuba, mujoco, mujoco_gl, or one of these with _built_in."""
    drives: int = 32
    """Drives of the search in the environment."""
    prior: Literal["surrogate", "none"] = "surrogate"
    """What the search expects before it drives; none: nothing, to compare with."""
    candidates: int = 16
    """Textures that the surrogate judges before each proposal, a drive each."""
    coefficients: int = 64
    """Of all objects, at most; 64 at most."""
    reach: float = 0.25
    """Largest change of a colour from the attack's, sRGB in 0 to 1."""
    starts: int = 8
    """Drives at the end, in each environment: past either attack, without objects."""
    spp: int = 16
    """Samples per pixel of path-traced images."""
    seed: int = 0
    """Of the search."""
    workers: int | None = None
    """Processes of the drives at the end; one a core by default."""
    json: bool = False
    """Print refine.json in place of the summary."""

    def run(self) -> Result:
        """Check, search, drive, print and write."""
        from mi_nerfattack import variant
        from mi_nerfattack.commands.shared.progress import StageBars
        from mi_nerfattack.experiment.refine.refine import refine
        from mi_nerfattack.io import files
        from mi_nerfattack.scenario.policy import HttpSection
        from mi_nerfattack.system.workers import chosen_workers

        files.check_folder(self.output)
        variant.ensure()
        task = self._task()
        alone = isinstance(task.found.scenario.policy, HttpSection)
        workers = chosen_workers(self.workers, alone)
        with StageBars() as bars:
            document = refine(task, self.output, workers, bars.counter)
        told = [*_summary(document), f"Written: {self.output.resolve()}"]
        return Result(document, lambda: print(*told, sep="\n"))

    def _task(self) -> Refinement:
        """Check everything that can be checked before the first drive."""
        from mi_nerfattack.experiment.refine.refine import Refinement
        from mi_nerfattack.experiment.transfer.columns import make_columns
        from mi_nerfattack.experiment.transfer.found import read_found

        [column] = make_columns((self.environment,), ("day",), self.spp)
        [found] = read_found([self.run_folder])
        return Refinement(
            found,
            column,
            self.drives,
            self.starts,
            self.prior == "surrogate",
            self.candidates,
            self.coefficients,
            self.reach,
            self.seed,
        )


def _summary(document: dict[str, Any]) -> Iterator[str]:
    """Yield what the search found, and what it is worth from unseen starts."""
    means = document["curve"]["cross_track_mean_m"]
    yield (
        f"{document['environment']}: mean distance from the lane centre "
        f"{means[0]:.3f} m past the attack as found, {means[-1]:.3f} m at best, in "
        f"{document['drives']} drives ({document['surrogate_drives']} in the surrogate)"
    )
    yield "From unseen starts, metres:"
    for row in document["unseen"]:
        interval, count = row["difference_ci95_m"], row["found"]["n"]
        within = "" if interval is None else " [{:+.3f}, {:+.3f}]".format(*interval)
        clean, found, refined = (
            f"{row[case]['cross_track_mean_m']:.3f}"
            for case in ("no_object", "found", "refined")
        )
        yield (
            f"  {row['environment']}: no object {clean}, found {found}, refined "
            f"{refined}; {row['difference_m']:+.3f}{within} (n = {count})"
        )
