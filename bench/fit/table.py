"""The table that `python -m bench fit` prints."""

from __future__ import annotations

from typing import Any

import rich.box
import rich.table

SIDES = {"ours": "", "PyTorch": "torch_", "PyTorch, tuned": "torch_tuned_"}
MOST_APART = 0.05  # of samples a step, before the comparison is called unfair


def ratio_table(document: dict[str, Any]) -> rich.table.Table:
    """Make the table of a document of :func:`bench.fit.run.run`."""
    table = rich.table.Table(
        box=rich.box.SIMPLE_HEAD, title="ms per training step, and times ours"
    )
    for name in ("network", "stage"):
        table.add_column(name)
    for name in ("ours", "PyTorch", "ratio", "PyTorch, tuned", "ratio"):
        table.add_column(name, justify="right")
    for row in document["steps"]:
        cells = [f"{1e3 * row['seconds_per_step']:.1f}"]
        for prefix in ("torch_", "torch_tuned_"):
            cells.append(f"{1e3 * row[f'{prefix}seconds_per_step']:.1f}")
            cells.append(f"{row[f'{prefix}ratio']:.2f}")
        table.add_row(row["network"], row["stage"], *cells)
    return table


def remarks(document: dict[str, Any]) -> list[str]:
    """Return the lines around the table; the first one states the ratio."""
    lines = [
        f"A training step takes PyTorch {document['ratio']:.2f} times as long as us, "
        f"or longer; with the tuned encoding {document['tuned_ratio']:.2f} times.",
        f"fitted to {document['data']}",
    ]
    for row in document["steps"]:
        lines += ["", f"{row['network']}, {row['stage']}, {row['rays']} rays a step"]
        lines += [_side(row, *side) for side in SIDES.items()]
        lines.append(
            f"  ratio of CPU time, in which waiting threads count: "
            f"{row['torch_cpu_ratio']:.2f}, to tuned {row['torch_tuned_cpu_ratio']:.2f}"
        )
        lines += [_parts(row["breakdown"]), *_complaints(row)]
    return lines


def _side(row: dict[str, Any], side: str, prefix: str) -> str:
    """Say what else is known of a side."""
    return (
        f"  {side}: {row[f'{prefix}samples_per_step']:.0f} samples a step, "
        f"{row[f'{prefix}us_per_sample']:.2f} µs each; loss "
        f"{row[f'{prefix}loss_first']:.4f}, then {row[f'{prefix}loss_last']:.4f}; "
        f"peak memory {row[f'{prefix}peak_memory_mb']:.0f} MB"
    )


def _parts(breakdown: dict[str, float]) -> str:
    """Say where the time of our step goes."""
    parts = [f"{name} {value:.2f}" for name, value in breakdown.items()]
    return "  of ours, µs a sample: " + ", ".join(parts)


def _complaints(row: dict[str, Any]) -> list[str]:
    """Say what makes a comparison unfair."""
    lines = []
    apart = row["torch_samples_per_step"] / row["samples_per_step"] - 1
    if abs(apart) > MOST_APART:
        lines.append(f"samples of PyTorch differ from ours by {apart:+.1%}")
    for side, prefix in SIDES.items():
        first, last = row[f"{prefix}loss_first"], row[f"{prefix}loss_last"]
        if row["stage"] == "early" and not last < first:
            lines.append(f"{side} did not learn")
    return [f"  {line}: do not quote this ratio" for line in lines]
