"""Measure a closed-loop gradient by each way and policy, and compare the gradients."""

from __future__ import annotations

import itertools
import statistics
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import rich.table

from bench.render.run import Progress, Worker
from bench.study.tables import markdown
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
class Settings:
    """What to measure.

    Attributes:
        size: width and height of the image, pixels.
        frames: of the drive.
        repeats: gradients that are timed; the median counts.
    """

    size: tuple[Count, Count] = (120, 60)
    frames: Count = 200
    repeats: Count = 1


def run(settings: Settings, progress: Progress) -> dict[str, Any]:
    """Measure each way with each policy in a process of its own, and compare.

    Args:
        settings: what.
        progress: called with stage, rows done, all rows, and a remark.

    Returns:
        the document: `rows`, and the largest relative differences of two rows'
        gradients (``gradient_difference``: sum of absolute differences over the larger
        sum of absolute values) and costs (``loss_difference``).
    """
    pairs = list(itertools.product(WAYS, POLICIES))
    rows, gradients = [], []
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "gradient.npy"
        for done, (way, policy) in enumerate(pairs):
            remark = f"{WAYS[way]}, {POLICIES[policy]}".replace("`", "")
            progress("closed-loop gradient", done, len(pairs), remark)
            rows.append({"way": way, "policy": policy})
            rows[-1] |= _measure(settings, way, policy, path)
            gradients.append(np.load(path).astype(np.float64))
    progress("closed-loop gradient", len(pairs), len(pairs), "")
    return {
        "size": list(settings.size),
        "frames": settings.frames,
        "repeats": settings.repeats,
        "rows": rows,
        "gradient_difference": _largest_difference(gradients),
        "loss_difference": _largest_difference([np.array(r["loss"]) for r in rows]),
    }


def table(document: dict[str, Any]) -> rich.table.Table:
    """Make the table of a document of :func:`run`, in Markdown."""
    header = ("way", "policy", "CPU s", "wall s", "peak memory, MB")
    return markdown(
        header,
        (
            (
                WAYS[row["way"]],
                POLICIES[row["policy"]],
                f"{row['cpu_seconds']:.1f}",
                f"{row['seconds']:.1f}",
                f"{row['peak_memory_mb']:.0f}",
            )
            for row in document["rows"]
        ),
    )


def remark(document: dict[str, Any]) -> str:
    """Return the sentence below the table."""
    return (
        f"Largest relative difference of two rows: gradient "
        f"{document['gradient_difference']:.1e}, cost {document['loss_difference']:.1e}"
    )


def _measure(settings: Settings, way: str, policy: str, path: Path) -> dict[str, float]:
    """Time one way in a process that compiles no kernel; write its gradient to path.

    The first process compiles the kernels, because compiling takes time and memory.
    """
    arguments = ("loop", way, policy, *map(str, settings.size))
    with Worker(*arguments) as worker:
        worker.ask("gradient", WARM_UP)
    with Worker(*arguments) as worker:
        worker.ask("gradient", WARM_UP)
        first = worker.ask("gradient", settings.frames)
        memory = worker.ask("memory")
        more = range(settings.repeats - 1)
        times = [first, *(worker.ask("gradient", settings.frames) for _ in more)]
        worker.ask("write", str(path))
    median = {key: statistics.median(time[key] for time in times) for key in first}
    return median | memory


def _largest_difference(values: list[np.ndarray]) -> float:
    """Compare all pairs: sum of differences over the larger sum of the values."""
    return max(
        float(abs(a - b).sum() / max(abs(a).sum(), abs(b).sum()))
        for a, b in itertools.combinations(values, 2)
    )
