"""``python -m bench``: measure speed and memory beside a peer, and accuracy."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from mi_nerfattack.commands.shared.result import Result


@dataclass(frozen=True)
class BenchRender:
    """Measure rendering and its derivative against the same field in PyTorch.

    Both sides run in turns, in processes of their own, on all cores; medians count.
    Keep the machine otherwise idle. Takes some minutes.
    """

    sizes: tuple[str, ...] = ("200x66", "366x188")
    """Widths and heights of the image, pixels."""
    repeats: int = 5
    """Repetitions of each measurement."""
    quick: bool = False
    """Take the bundled field as it is, and the given sizes for all images: to see that
    it works, not for figures."""
    output: Annotated[Path | None, tyro.conf.arg(aliases=["-o"])] = None
    """Also write the result with machine, versions and date: a .json file, or a folder
    in which it is named by date and machine."""
    json: bool = False
    """Print one line of JSON in place of the table."""

    def run(self) -> Result:
        """Measure, print and write."""
        from bench.render import run as render

        sizes = read_sizes(self.sizes)
        _check_repeats(self.repeats)
        if self.quick:
            settings = render.Settings.quick(sizes, self.repeats)
        else:
            settings = render.Settings(sizes, sizes[-1], repeats=self.repeats)
        document = measure(render.run, settings)
        document = _publish("render", document, self._command(), self.output)
        return Result(document, lambda: _print(document))

    def _command(self) -> list[str]:
        command = ["python", "-m", "bench", "render", "--sizes", *self.sizes]
        command += ["--repeats", str(self.repeats)]
        return [*command, "--quick"] if self.quick else command


@dataclass(frozen=True)
class BenchComposite:
    """Tell how far the `depth` composite is from the exact, interleaved one.

    Renders the bundled intersection with the hydrant above, on and in the road.
    """

    output: Annotated[Path, tyro.conf.arg(aliases=["-o"])] = Path("composite.png")
    """Figure to write (.png)."""
    size: str = "366x188"
    """Width and height of the image, pixels."""
    json: bool = False
    """Print one line of JSON in place of the table."""

    def run(self) -> Result:
        """Render, print and draw."""
        from mi_nerfattack import variant
        from mi_nerfattack.io import files

        (size,) = read_sizes((self.size,))
        files.check_writable(self.output)
        variant.ensure()
        from bench.driving import composite
        from mi_nerfattack.commands.shared.progress import StageBars

        with StageBars() as bars:
            results, pictures = composite.run(size, bars.counter("heights"))
        composite.write_figure(self.output, results, pictures)
        print(f"figure written to {self.output}", file=sys.stderr)
        document = composite.to_document(results, size)
        return Result(document, lambda: _print_composite(results))


@dataclass(frozen=True)
class BenchSteps:
    """Measure what the marching step and the end of rays cost, and leave wrong.

    Bundled fields, near and far, against the finest step; times are medians.
    """

    size: str = "200x66"
    """Width and height of the image, pixels."""
    repeats: int = 5
    """Repetitions of each measurement."""
    json: bool = False
    """Print one line of JSON in place of the table."""

    def run(self) -> Result:
        """March, measure and print."""
        from mi_nerfattack import variant

        (size,) = read_sizes((self.size,))
        _check_repeats(self.repeats)
        variant.ensure()
        from bench.render import steps
        from mi_nerfattack.commands.shared.progress import StageBars

        with StageBars() as bars:
            rows = steps.run(size, self.repeats, bars.counter("rows"))
        return Result(steps.to_document(rows, size), lambda: _print_steps(rows))


@dataclass(frozen=True)
class BenchFit:
    """Measure a training step of a fit against the same step in PyTorch.

    The same network, rays, occupancy and marching step, both sides from the same
    state and in turns, in processes of their own, on all cores; medians count. Keep the
    machine otherwise idle. Takes about ten minutes.
    """

    folder: Path | None = None
    """Folder of posed images; without it, views of the bundled intersection."""
    long_edge: int | None = None
    """Reduce the folder's images to this longer edge, pixels."""
    repeats: int = 5
    """Turns of each side."""
    quick: bool = False
    """Take a tiny network and few rays: to see that it works, not for figures."""
    output: Annotated[Path | None, tyro.conf.arg(aliases=["-o"])] = None
    """Also write the result with machine, versions and date: a .json file, or a folder
    in which it is named by date and machine."""
    json: bool = False
    """Print one line of JSON in place of the table."""

    def run(self) -> Result:
        """Measure, print and write."""
        import dataclasses

        from bench.fit import run as fit

        _check_repeats(self.repeats)
        settings = fit.Settings(repeats=self.repeats)
        if self.quick:
            settings = fit.Settings.quick(self.repeats)
        settings = dataclasses.replace(
            settings, folder=self.folder, long_edge=self.long_edge
        )
        document = measure(fit.run, settings)
        document = _publish("fit", document, self._command(), self.output)
        return Result(document, lambda: _print_fit(document))

    def _command(self) -> list[str]:
        command = ["python", "-m", "bench", "fit", "--repeats", str(self.repeats)]
        if self.folder is not None:
            command += ["--folder", self.folder.resolve().name]
        if self.long_edge is not None:
            command += ["--long-edge", str(self.long_edge)]
        return [*command, "--quick"] if self.quick else command


@dataclass(frozen=True)
class BenchAttack:
    """Measure an attack iteration against a rollout and against the loop in PyTorch.

    One drive past the bundled hydrant, both sides in turns, in processes of their own,
    on all cores; medians count. Keep the machine otherwise idle. Takes about half an
    hour; each part of it, at each size, can be measured alone.
    """

    sizes: tuple[str, ...] = ("200x66", "366x188")
    """Widths and heights of the camera's image, pixels."""
    parts: tuple[Literal["time", "memory"], ...] = ("time", "memory")
    """What to measure."""
    repeats: int = 3
    """Turns of each side."""
    quick: bool = False
    """Drive two steps: to see that it works, not for figures."""
    output: Annotated[Path | None, tyro.conf.arg(aliases=["-o"])] = None
    """Also write the result with machine, versions and date: a .json file, or a folder
    in which it is named by date and machine."""
    json: bool = False
    """Print one line of JSON in place of the tables."""

    def run(self) -> Result:
        """Measure, print and write."""
        from bench.attack import run as attack

        sizes = read_sizes(self.sizes)
        _check_repeats(self.repeats)
        settings = attack.Settings(sizes, self.parts, repeats=self.repeats)
        if self.quick:
            settings = attack.Settings.quick(sizes, self.parts, self.repeats)
        document = measure(attack.run, settings)
        document = _publish("attack", document, self._command(), self.output)
        return Result(document, lambda: _print_attack(document))

    def _command(self) -> list[str]:
        command = ["python", "-m", "bench", "attack", "--sizes", *self.sizes]
        command += ["--parts", *self.parts, "--repeats", str(self.repeats)]
        return [*command, "--quick"] if self.quick else command


def measure(run: Callable[..., dict[str, Any]], *settings: Any) -> dict[str, Any]:
    """Run a benchmark, and show how far it is."""
    from mi_nerfattack.commands.shared.progress import StageBars

    with StageBars() as bars:

        def show(stage: str, done: int, total: int, remark: str) -> None:
            bars.show(stage, done, total, f"{done}/{total} {remark}")

        return run(*settings, show)


def _publish(
    kind: str, document: dict[str, Any], command: list[str], output: Path | None
) -> dict[str, Any]:
    """Return a result with machine, versions and date, and write it if asked to."""
    from bench import results

    document = results.stamp(document, command)
    if output is not None:
        path = results.write(output, kind, document)
        print(f"written to {path}", file=sys.stderr)
    return document


def read_sizes(texts: tuple[str, ...]) -> tuple[tuple[int, int], ...]:
    """Read widths and heights as in 200x66."""
    from mi_nerfattack.errors import InputError

    sizes = []
    for text in texts:
        width, cross, height = text.partition("x")
        if not (cross and width.isdecimal() and height.isdecimal()):
            raise InputError(f"--sizes: {text!r}; expected WIDTHxHEIGHT as in 200x66")
        if not (8 <= int(width) <= 4096 and 8 <= int(height) <= 4096):
            raise InputError(f"--sizes: {text!r}; allowed are 8 to 4096 pixels")
        sizes.append((int(width), int(height)))
    if not sizes:
        raise InputError("--sizes: none given; expected WIDTHxHEIGHT as in 200x66")
    return tuple(sizes)


def _check_repeats(repeats: int) -> None:
    from mi_nerfattack.errors import InputError

    if not 1 <= repeats <= 1000:
        raise InputError(f"--repeats: {repeats}; allowed are 1 to 1000")


def _print(document: dict[str, Any]) -> None:
    from rich.console import Console

    from bench.render import table

    console = Console()
    console.print(table.render_table(document))
    for line in table.remarks(document):
        console.print(line, highlight=False, soft_wrap=True)


def _print_fit(document: dict[str, Any]) -> None:
    from rich.console import Console

    from bench.fit import table as fit_table

    console = Console()
    first, *others = fit_table.remarks(document)
    console.print(first, highlight=False, soft_wrap=True)
    console.print(fit_table.ratio_table(document))
    for line in others:
        console.print(line, highlight=False, soft_wrap=True)


def _print_attack(document: dict[str, Any]) -> None:
    from rich.console import Console

    from bench.attack import table as attack_table

    console = Console()
    for table in attack_table.time_table(document), attack_table.memory_table(document):
        if table.row_count:
            console.print(table)
    for line in attack_table.remarks(document):
        console.print(line, highlight=False, soft_wrap=True)


def _print_composite(results: list[Any]) -> None:
    import rich.box
    import rich.table
    from rich.console import Console

    table = rich.table.Table(
        box=rich.box.SIMPLE_HEAD,
        title="depth composite against interleaved, in the object's pixels",
    )
    for name in (
        "foot above the road, m",
        "mean, sRGB / 255",
        "largest, sRGB / 255",
        "pixels off by more than 1/255",
        "mean of depth, m",
    ):
        table.add_column(name, justify="right")
    for result in results:
        table.add_row(
            f"{result.height_m:+.2f}",
            f"{255 * result.mean:.3f}",
            f"{255 * result.largest:.1f}",
            f"{100 * result.above_1_255:.1f} %",
            f"{result.depth_mean_m:.4f}",
        )
    Console().print(table)


def _print_steps(rows: list[Any]) -> None:
    import rich.box
    import rich.table
    from rich.console import Console

    table = rich.table.Table(
        box=rich.box.SIMPLE_HEAD, title="against the finest step; times are medians"
    )
    table.add_column("view")
    for name in (
        "step",
        "stop",
        "PSNR, dB",
        "largest, sRGB / 255",
        "mean of depth, mm",
        "march, ms",
        "derivative, ms",
    ):
        table.add_column(name, justify="right")
    for row in rows:
        table.add_row(
            row.view,
            f"1/{1 / row.factor:.0f}",
            f"{row.stop:g}",
            f"{row.psnr_db:.1f}",
            f"{255 * row.largest:.1f}",
            f"{1000 * row.depth_m:.2f}",
            f"{1000 * row.forward_s:.1f}",
            f"{1000 * row.derivative_s:.1f}",
        )
    Console().print(table)
