"""``python -m bench dagger`` and ``bench collect``: figures of training."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro

from mi_nerfattack.commands.shared.result import Result


@dataclass(frozen=True)
class BenchCollect:
    """Measure the collection of training frames by several processes against one.

    Both sides in turns, medians count. Keep the machine otherwise idle. Takes some
    minutes; exit code 1 where two workers render less than 1.7 times as fast as one.
    """

    environment: str = "mitsuba"
    """What is rendered."""
    workers: int = 2
    """Processes of the side that is compared with one."""
    repeats: int = 3
    """Turns of each side."""
    quick: bool = False
    """Take few frames: to see that it works, not for figures."""
    output: Annotated[Path | None, tyro.conf.arg(aliases=["-o"])] = None
    """Also write the result with machine, versions and date: a .json file, or a folder
    in which it is named by date and machine."""
    json: bool = False
    """Print one line of JSON in place of the table."""

    def run(self) -> Result:
        """Measure, print and write."""
        from mi_nerfattack import variant

        variant.ensure()
        from bench import results
        from bench.driving import collect
        from mi_nerfattack.commands.shared.progress import StageBars

        sizes = {"frames": 24, "warm": 8, "shard": 4, "spp": 1} if self.quick else {}
        settings = collect.Settings(
            self.environment, workers=self.workers, repeats=self.repeats, **sizes
        )
        with StageBars() as bars:

            def show(stage: str, done: int, total: int, remark: str) -> None:
                bars.show(stage, done, total, f"{done}/{total} {remark}")

            document = collect.run(settings, show)
        document = results.stamp(document, self._command())
        if self.output is not None:
            path = results.write(self.output, "collect", document)
            print(f"written to {path}", file=sys.stderr)
        enough = self.quick or document["ratio"] >= collect.WANTED

        def tell() -> None:
            for count, rate in document["median"].items():
                print(f"{count} workers: {rate:.2f} frames/s")
            print(f"ratio: {document['ratio']:.2f} (wanted {collect.WANTED})")

        return Result(document, tell, 0 if enough or self.workers != 2 else 1)

    def _command(self) -> list[str]:
        command = ["python", "-m", "bench", "collect"]
        command += ["--environment", self.environment]
        command += ["--workers", str(self.workers), "--repeats", str(self.repeats)]
        return [*command, "--quick"] if self.quick else command


@dataclass(frozen=True)
class BenchDagger:
    """Compare DAgger with plain cloning on as many frames and gradient steps.

    Both start from the same frames and weights of three seeds; mean cross-track errors
    of drives from random starts at the bundled intersection. Takes half an hour
    on two cores; stopped, the same command continues from DATA.
    """

    data: Path
    """Folder of frames, checkpoints and results; made if missing."""
    output: Annotated[Path, tyro.conf.arg(aliases=["-o"])] = Path("dagger.png")
    """Figure to write (.png); the numbers go beside it (.json)."""
    environment: str = "mitsuba"
    """Where frames are taken and policies drive: mitsuba, mujoco, mujoco_gl, ..."""
    workers: int | None = None
    """Processes that collect and drive; one a core by default."""
    quick: bool = False
    """Take the smallest sizes: to see that it works, not for figures."""
    json: bool = False
    """Print one line of JSON in place of the table."""

    def run(self) -> Result:
        """Collect, train, drive and draw."""
        from dataclasses import replace

        from mi_nerfattack import variant
        from mi_nerfattack.io import files

        files.check_writable(self.output)
        variant.ensure()
        from bench import results
        from bench.driving import dagger
        from mi_nerfattack.commands.shared.progress import StageBars
        from mi_nerfattack.system.workers import Processes, available_cores

        settings = dagger.Settings.quick() if self.quick else dagger.Settings()
        settings = replace(settings, environment=self.environment)
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
        command = ["python", "-m", "bench", "dagger", *["--quick"] * self.quick]
        command += ["--environment", self.environment]
        document = results.stamp(document, command)
        dagger.write_figure(self.output, document)
        files.write_json(self.output.with_suffix(".json"), document)
        print(f"figure written to {self.output}", file=sys.stderr)
        return Result(document, lambda: _print(document))


def _print(document: dict[str, Any]) -> None:
    import rich.box
    import rich.table
    from rich.console import Console

    table = rich.table.Table(
        box=rich.box.SIMPLE_HEAD,
        title=f"{document['frames']} frames, {document['gradient_steps']} steps each",
    )
    table.add_column("")
    for name in ("mean error, m", "standard error, m", "drives departed"):
        table.add_column(name, justify="right")
    for arm, found in document["arms"].items():
        table.add_row(
            arm,
            f"{found['mean_m']:.4f}",
            f"{found['standard_error_m']:.4f}",
            str(found["drives_departed"]),
        )
    Console().print(table)
