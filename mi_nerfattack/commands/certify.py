"""``mi-nerfattack certify``: bounds on departures, and the truth of gradients."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, ClassVar

import tyro
from rich.console import RenderableType

from mi_nerfattack.commands.shared.options import Settings
from mi_nerfattack.commands.shared.progress import StageBars
from mi_nerfattack.commands.shared.terminal import Result, console


@dataclass(frozen=True)
class CertifyRobustness:
    """Bound the chance of a departure for all small changes of the objects' textures.

    Drives past random changes of the textures' low frequencies. The share of departures
    gives a bound for every change within a radius, for drives under this noise. The
    table also shows the best attack that a search finds within the radius. Choose the
    number of --runs before the first result, because the confidence holds for a fixed
    number. Finished drives are kept, so the same command continues after Ctrl-C. More
    radii add drives, and the bounds of all radii hold together.
    """

    continues: ClassVar[bool] = True

    scenario: tyro.conf.Positional[Path]
    """Scenario file (TOML)."""
    output: Path
    """Folder for the table, the chart and the drives; one of an earlier certificate
    goes on."""
    settings: Settings = ()
    """Set a key of the scenario: seed=1, drive.lateral_sd_m=0.2."""
    environment: str = "surrogate"
    """Environment of the scenario."""
    runs: int = 1000
    """Drives under noise, which the bound follows from."""
    sd: float = 0.5
    """Standard deviation of the noise in each coefficient, sRGB values of 1."""
    radii: tuple[float, ...] = (0.25, 0.5, 1.0)
    """Radii of changes: the root of the sum of squares over all coefficients."""
    coefficients: int = 24
    """Numbers that describe the changes of all objects' colours, at most."""
    confidence: float = 0.999
    """Of the bound, and of the attacks' intervals."""
    proposals: int = 40
    """Points that the search judges for each radius."""
    judged_by: int = 4
    """Drives of each judgement."""
    attacked: int = 200
    """Drives under noise past the best attack of each radius."""
    workers: int | None = None
    """Processes that drive; by default one per core, 1 for a policy behind a URL."""
    json: bool = False
    """End with one line of JSON, the content of certificate.json."""

    def run(self) -> Result:
        """Drive, search, bound, write and print."""
        from mi_nerfattack import variant
        from mi_nerfattack.experiment.cases import scenario_workers
        from mi_nerfattack.experiment.certify.robustness import (
            RobustnessSettings,
            certify_robustness,
        )
        from mi_nerfattack.io import files
        from mi_nerfattack.report.certificate import robustness_table
        from mi_nerfattack.scenario.scenario import load_scenario

        files.check_folder(self.output)
        settings = RobustnessSettings(
            environment=self.environment,
            runs=self.runs,
            sd=self.sd,
            radii=self.radii,
            coefficients=self.coefficients,
            confidence=self.confidence,
            proposals=self.proposals,
            judged_by=self.judged_by,
            attacked=self.attacked,
        )
        scenario, _ = load_scenario(self.scenario, settings=self.settings)
        variant.ensure()
        workers = scenario_workers([scenario], self.workers, self.environment)
        with StageBars() as bars:
            document = certify_robustness(
                scenario,
                self.output,
                settings,
                workers=workers,
                on_stage=partial(_show, bars),
            )
        lines = [f"flag: {line}" for line in document["flags"]]
        return _result(document, robustness_table(document), lines, output=self.output)


@dataclass(frozen=True)
class CertifyGradient:
    """Compare the gradient at the end of an attack to differences of whole drives.

    Changes the attack's parameters a little in random directions and along the
    gradient, to both sides. Prints the slope of the real change by the predicted one,
    the cosine between gradient and differences, and up to which horizon the gradient
    predicts.
    """

    continues: ClassVar[bool] = True

    run_folder: tyro.conf.Positional[Path]
    """Folder of a finished run of attack, by a gradient."""
    output: Path
    """Folder for the table, the chart and the differences; one of an earlier
    certificate goes on."""
    directions: int = 32
    """Random directions; along the gradient comes another one."""
    step: float = 0.1
    """Standard deviation of the random changes of raw colours, before the sigmoid; of
    poses, as a share of their learning rate."""
    workers: int | None = None
    """Processes that drive; by default one per core."""
    json: bool = False
    """End with one line of JSON, the content of certificate.json."""

    def run(self) -> Result:
        """Drive, compare, write and print."""
        from mi_nerfattack import variant
        from mi_nerfattack.experiment.certify.gradient import (
            certify_gradient,
            sentences,
        )
        from mi_nerfattack.io import files
        from mi_nerfattack.report.certificate import gradient_table
        from mi_nerfattack.system.workers import chosen_workers

        files.check_folder(self.output)
        variant.ensure()
        workers = chosen_workers(self.workers, alone=False)
        with StageBars() as bars:
            document = certify_gradient(
                self.run_folder,
                self.output,
                directions=self.directions,
                step=self.step,
                workers=workers,
                on_stage=partial(_show, bars),
            )
        table = gradient_table(document)
        return _result(document, table, sentences(document), output=self.output)


def _show(bars: StageBars, stage: str, done: int, total: int) -> None:
    bars.counter(stage)(done, total)


def _result(
    document: dict[str, Any], table: RenderableType, lines: Sequence[str], output: Path
) -> Result:
    """Return a document with what a terminal shows of it: a table, then lines."""

    def tell() -> None:
        out = console()
        out.print(table)
        for line in lines:
            out.print(line, highlight=False)
        out.print(f"Written: {output.resolve()}", soft_wrap=True)

    return Result(document, tell)
