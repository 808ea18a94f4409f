"""``python -m bench loop``: a closed-loop gradient by the rollout and `mi.render`."""

from __future__ import annotations

import itertools
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro

from bench.results import progress, publish, read_sizes
from bench.tables import markdown
from bench.worker import Worker, medians
from mi_nerfattack.commands.shared.terminal import Result
from mi_nerfattack.ranges import Count, checked

WAYS = {
    "replay": "`Rollout`, `Replay`",
    "kept_backgrounds": "`Rollout`, `KeptBackgrounds`",
    "plain": "loop over `mi.render`",
}
POLICIES = {"torch": "PyTorch", "drjit": "Dr.Jit"}
WARM_UP = 8  # frames; both of them fill the batches in which the rollout goes back
AGREED = 1e-3  # largest relative difference of two gradients


@dataclass(frozen=True)
@checked()
class BenchLoop:
    """Measure a closed-loop gradient by the rollout and by a loop over `mi.render`.

    Both ways drive past the bundled hydrant, once with a policy in PyTorch and once
    with the same policy in Dr.Jit, and differentiate the cost by the hydrant's texture.
    Each of them runs in a process of its own. Times leave out imports, loading and the
    first 8 frames; another process compiled the kernels before. Takes about 8 minutes.
    Exit code 1 where two gradients differ by more than 0.1 %.
    """

    frames: Count = 200
    """Frames of the drive."""
    size: str = "120x60"
    """Width and height of the image, pixels."""
    repeats: Count = 1
    """Gradients to time; the median counts."""
    output: Annotated[Path | None, tyro.conf.arg(aliases=["-o"])] = None
    """Also write the result: a .json file, or a folder in which it gets a name."""
    json: bool = False
    """Print one line of JSON instead of the table."""

    def run(self) -> Result:
        """Measure, compare and print."""
        (size,) = read_sizes((self.size,))
        pairs = list(itertools.product(WAYS, POLICIES))
        rows, gradients = [], []
        with tempfile.TemporaryDirectory() as folder, progress() as show:
            path = Path(folder) / "gradient.npy"
            for done, (way, policy) in enumerate(pairs):
                remark = f"{WAYS[way]}, {POLICIES[policy]}".replace("`", "")
                show("closed-loop gradient", done, len(pairs), remark)
                figures = measure(self, size, way, policy=policy, path=path)
                rows.append({"way": way, "policy": policy, **figures})
                gradients.append(np.load(path).astype(np.float64))
        document = {
            "size": list(size),
            "frames": self.frames,
            "repeats": self.repeats,
            "rows": rows,
            "gradient_difference": _largest_difference(gradients),
            "loss_difference": _largest_difference([np.array(r["loss"]) for r in rows]),
        }
        document = publish("loop", self, document)
        code = int(document["gradient_difference"] > AGREED)
        return Result(document, lambda: print(*lines(document), sep="\n"), code)


def measure(
    options: BenchLoop, size: tuple[int, int], way: str, policy: str, path: Path
) -> dict[str, float]:
    """Time one way in a process that compiles no kernel; write its gradient to path.

    The first process compiles the kernels, because compiling takes time and memory.
    """

    def side() -> Worker:
        width, height = size
        if way == "plain":
            return Worker("loop.ways", "PlainLoop", policy, width, height)
        return Worker("loop.ways", "RolloutLoop", way, policy, width, height)

    with side() as worker:
        worker.ask("gradient", WARM_UP)
    with side() as worker:
        worker.ask("gradient", WARM_UP)
        turns = [worker.ask("gradient", options.frames)]
        memory = worker.ask("memory")
        for _ in range(options.repeats - 1):
            turns.append(worker.ask("gradient", options.frames))
        worker.ask("write", str(path))
    return medians(turns) | memory


def _largest_difference(values: list[np.ndarray]) -> float:
    """Compare all pairs: sum of differences over the larger sum of the values."""
    return max(
        float(abs(a - b).sum() / max(abs(a).sum(), abs(b).sum()))
        for a, b in itertools.combinations(values, 2)
    )


def lines(document: dict[str, Any]) -> list[str]:
    """Return the table, and how far the gradients are apart."""
    rows = (
        (
            WAYS[row["way"]],
            POLICIES[row["policy"]],
            f"{row['cpu_seconds']:.1f}",
            f"{row['seconds']:.1f}",
            f"{row['peak_memory_mb']:.0f}",
        )
        for row in document["rows"]
    )
    header = ("way", "policy", "CPU s", "wall s", "peak memory, MB")
    gradient, loss = (
        f"{document[f'{k}_difference']:.1e}" for k in ("gradient", "loss")
    )
    summary = (
        f"Largest relative difference of two rows: gradient {gradient}, cost {loss}"
    )
    return [markdown(header, rows), summary]
