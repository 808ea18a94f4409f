"""The table that `python -m bench attack` prints."""

from __future__ import annotations

import re
from typing import Any

import rich.box
import rich.table

WHO = {
    "rollout alone": "rollout_",
    "iteration, backgrounds kept": "kept_backgrounds_",
    "iteration, replay": "replay_",
    "iteration, bricks": "baked_",
    "PyTorch": "torch_",
    "PyTorch, tuned": "torch_tuned_",
    "PyTorch, bricks": "torch_baked_",
}


def time_table(document: dict[str, Any]) -> rich.table.Table:
    """Make the table of times of a document of :func:`bench.attack.run.run`.

    Ratios are to our iteration that keeps backgrounds.
    """
    table = rich.table.Table(box=rich.box.SIMPLE_HEAD, title="time, one vehicle")
    for name in ("size", "what"):
        table.add_column(name)
    for name in ("seconds", "CPU seconds", "ratio", "ratio of CPU"):
        table.add_column(name, justify="right")
    for size, row in _sizes(document, "iteration_over_rollout"):
        ours = [row[f"kept_backgrounds_{unit}"] for unit in ("seconds", "cpu_seconds")]
        for who, prefix in WHO.items():
            times = [row[f"{prefix}{unit}"] for unit in ("seconds", "cpu_seconds")]
            ratios = [time / own for time, own in zip(times, ours, strict=True)]
            cells = [f"{value:.2f}" for value in (*times, *ratios)]
            table.add_row(size, who, *cells)
        table.add_section()
    return table


def memory_table(document: dict[str, Any]) -> rich.table.Table:
    """Make the table of peaks of memory."""
    table = rich.table.Table(
        box=rich.box.SIMPLE_HEAD, title="largest resident size of the process, MB"
    )
    for name in ("size", "what"):
        table.add_column(name)
    for name in ("horizon", "MB", "PyTorch over replay"):
        table.add_column(name, justify="right")
    for size, row in _sizes(document, "peak_memory_mb_by_horizon"):
        ratios = row["torch_memory_ratio_by_horizon"]
        kept = row["kept_backgrounds"]["peak_memory_mb_by_horizon"]
        for horizon, peak in row["peak_memory_mb_by_horizon"].items():
            table.add_row(size, "replay", horizon, f"{peak:.0f}", "")
        for horizon, peak in kept.items():
            table.add_row(size, "backgrounds kept", horizon, f"{peak:.0f}", "")
        for horizon, peak in row["torch_peak_memory_mb_by_horizon"].items():
            measured = horizon in row["torch_measured_horizons"]
            who = "PyTorch" if measured else "PyTorch, extrapolated"
            ratio = f"{ratios[horizon]:.1f}" if horizon in ratios else ""
            table.add_row(size, who, horizon, f"{peak:.0f}", ratio)
        table.add_section()
    return table


def remarks(document: dict[str, Any]) -> list[str]:
    """Return the lines below the tables."""
    lines = []
    for size, row in _sizes(document, "iteration_over_rollout"):
        facts, launches = row["settings"]["ours"], row["launches_per_step"]
        lines += [
            f"{size}: an iteration costs {row['iteration_over_rollout']:.2f} rollouts "
            f"with kept backgrounds, {row['replay_over_rollout']:.2f} with replay; the "
            f"object fills {facts['object_share_mean']:.1%} of the frame on average, "
            f"{facts['object_share_max']:.1%} at most",
            f"{size}: launches a control period: "
            + ", ".join(
                f"{way} {some['iteration']:.1f} (rollout {some['rollout']:.1f}, of "
                f"them {some['rollout_over_pixels']:.1f} over all pixels)"
                for way, some in launches.items()
            )
            + f"; compiled after the warm-up: {row['kernels_compiled_after_warmup']}",
        ]
    for size, row in _sizes(document, "batch"):
        batch = row["batch"]
        lines.append(
            f"{size}: {batch['poses']} poses cost {batch['iteration']:.2f} single ones "
            f"(CPU {batch['iteration_cpu']:.2f}; rollout {batch['rollout']:.2f}), "
            f"in {batch['launches_per_step']['rollout_over_pixels']:.1f} launches a "
            "period over all pixels of all poses"
        )
    for size, row in _sizes(document, "peak_memory_mb_by_horizon"):
        kept = row["kept_backgrounds"]
        lines.append(
            f"{size}, {row['memory_poses']} poses: replay's peak changes by "
            f"{row['peak_memory_change']:+.2%}; kept backgrounds state "
            f"{kept['stated_mb_per_step']:.3f} MB a period and take "
            f"{kept['measured_mb_per_step']:.3f}; PyTorch's tape takes "
            f"{row['torch_tape_mb_per_step']:.1f}"
        )
    return lines


def _sizes(document: dict[str, Any], key: str) -> list[tuple[str, dict[str, Any]]]:
    """Return the rows of a document, which lie beside its stamp, that have a key."""
    found = ((k, v) for k, v in document.items() if re.fullmatch(r"\d+x\d+", k))
    return [(size, row) for size, row in found if key in row]
