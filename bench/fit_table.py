"""The table that `mi-nerfattack bench fit` prints."""

from __future__ import annotations

from typing import Any

import rich.box
import rich.table

SIDES = (("ours", ""), ("PyTorch", "torch_"), ("PyTorch, tuned", "torch_tuned_"))
MOST_APART = 0.05  # of samples a step, before the comparison is called unfair


def ratio_table(document: dict[str, Any]) -> rich.table.Table:
    """Make the table of a document of :func:`mi_nerfattack.bench.fit.run`."""
    table = rich.table.Table(box=rich.box.SIMPLE_HEAD)
    for name in ("network", "stage", "side"):
        table.add_column(name)
    for name in (
        "PyTorch's time / ours",
        "ms a step",
        "samples a step",
        "µs a sample",
        "loss, first",
        "last",
        "peak MB",
    ):
        table.add_column(name, justify="right")
    for row in document["steps"]:
        for side, prefix in SIDES:
            table.add_row(
                row["network"] if not prefix else "",
                row["stage"] if not prefix else "",
                side,
                f"{row[f'{prefix}ratio']:.2f}" if prefix else "",
                f"{1e3 * row[f'{prefix}seconds_per_step']:.1f}",
                f"{row[f'{prefix}samples_per_step']:.0f}",
                f"{row[f'{prefix}us_per_sample']:.2f}",
                f"{row[f'{prefix}loss_first']:.4f}",
                f"{row[f'{prefix}loss_last']:.4f}",
                f"{row[f'{prefix}peak_memory_mb']:.0f}",
            )
        table.add_section()
    return table


def remarks(document: dict[str, Any]) -> list[str]:
    """Return the lines around the table; the first one states the ratio."""
    lines = [
        f"A training step takes PyTorch {document['ratio']:.2f} times as long as us, "
        f"or longer; with the tuned encoding {document['tuned_ratio']:.2f} times.",
        f"fitted to {document['data']}",
    ]
    for row in document["steps"]:
        name = f"{row['network']}, {row['stage']}"
        apart = row["torch_samples_per_step"] / row["samples_per_step"] - 1
        if abs(apart) > MOST_APART:
            lines.append(
                f"{name}: samples of the two sides differ by {apart:+.1%}; "
                "do not quote this ratio"
            )
        for prefix, side in (("", "ours"), ("torch_", "PyTorch")):
            if row["stage"] == "early" and not (
                row[f"{prefix}loss_last"] < row[f"{prefix}loss_first"]
            ):
                lines.append(f"{name}: {side} did not learn; do not quote this ratio")
        lines.append(f"{name}: {_parts(row['breakdown'])}")
    return lines


def _parts(breakdown: dict[str, float]) -> str:
    """Say where the time of our step goes."""
    parts = [f"{name} {value:.2f}" for name, value in breakdown.items()]
    return "our step in µs a sample: " + ", ".join(parts)
