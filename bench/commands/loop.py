"""``python -m bench loop``: a closed-loop gradient, two ways."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from mi_nerfattack.commands.shared.result import Result


@dataclass(frozen=True)
class BenchLoop:
    """Measure a closed-loop gradient by the rollout and by a loop over `mi.render`.

    Both ways drive past the bundled hydrant, once with a policy in PyTorch and once
    with the same policy in Dr.Jit, and differentiate the cost by the hydrant's texture.
    Each of them runs in a process of its own. Times leave out imports, loading and the
    first 8 frames; another process compiled the kernels before. Takes about 8 minutes.
    Exit code 1 where two gradients differ by more than 0.1 %.
    """

    frames: int = 200
    """Frames of the drive."""
    size: str = "120x60"
    """Width and height of the image, pixels."""
    repeats: int = 1
    """Gradients to time; the median counts."""
    json: bool = False
    """Print one line of JSON instead of the table."""

    def run(self) -> Result:
        """Measure and print."""
        from bench import results
        from bench.commands.speed import measure, read_sizes
        from bench.loop import run as loop

        (size,) = read_sizes((self.size,))
        settings = loop.Settings(size, self.frames, self.repeats)
        document = results.stamp(measure(loop.run, settings), self._command())
        code = int(document["gradient_difference"] > loop.AGREED)
        return Result(document, lambda: _print(document), code)

    def _command(self) -> list[str]:
        command = ["python", "-m", "bench", "loop", "--frames", str(self.frames)]
        return [*command, "--size", self.size, "--repeats", str(self.repeats)]


def _print(document: dict[str, Any]) -> None:
    from rich.console import Console

    from bench.loop.run import remark, table

    Console().print(table(document))
    print(remark(document))
