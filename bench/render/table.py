"""The table that `python -m bench render` prints."""

from __future__ import annotations

from typing import Any

import rich.box
import rich.table

ROWS = (
    ("forward", "million samples/s", "forward_samples_per_s", 1e-6),
    ("backward", "million samples/s", "backward_samples_per_s", 1e-6),
    ("both", "million samples/s", "forward_and_backward_samples_per_s", 1e-6),
    ("frame", "ms", "frame_ms", 1.0),
    ("gradient", "ms", "backward_ms", 1.0),
    ("samples", "thousand", "samples", 1e-3),
    ("peak memory", "MB", "peak_memory_mb", 1.0),
)


def render_table(document: dict[str, Any]) -> rich.table.Table:
    """Make the table of a document of :func:`bench.render.run.run`."""
    table = rich.table.Table(box=rich.box.SIMPLE_HEAD)
    for name in ("size", "what", "unit"):
        table.add_column(name)
    for name in ("ours", "PyTorch", "ratio", "PyTorch, tuned", "ratio"):
        table.add_column(name, justify="right")
    for size, row in document["sizes"].items():
        for what, unit, key, factor in ROWS:
            peers = []
            for prefix in ("torch_", "torch_tuned_"):
                peers += [
                    _number(row[prefix + key] * factor),
                    _ratio(row, prefix, key),
                ]
            table.add_row(size, what, unit, _number(row[key] * factor), *peers)
        table.add_section()
    return table


def remarks(document: dict[str, Any]) -> list[str]:
    """Return the lines below the table."""
    grid = document["object_grid"]
    memory = document["memory_by_samples_per_ray"]
    lines = [document["field"]]
    for size, row in document["sizes"].items():
        plain, tuned = row["torch_backward_ratio"], row["torch_tuned_backward_ratio"]
        lines.append(
            f"{size}: backward ratio, the least favourable to us of derivative alone "
            f"and forward with derivative: {plain:.2f}, to tuned {tuned:.2f}"
        )
    lines.append(
        f"object grid at {grid['size']}: forward {grid['forward_ms']:.0f} ms, backward "
        f"{grid['backward_ms']:.0f} ms, {grid['ratio']:.2f} times the forward pass"
    )
    names = {"peak_memory_mb": "resident", "drjit_peak_memory_mb": "Dr.Jit's"}
    for key, name in names.items():
        few, many, change = (part[key] for part in memory.values())
        lines.append(
            "peak memory of a backward pass with 64 and 1024 samples per ray, "
            f"{name}: {few:.0f} and {many:.0f} MB ({change:+.1%})"
        )
    compiled = document["kernels_compiled_after_warmup"]
    return [*lines, f"kernels compiled after the warm-up: {compiled}"]


def _number(value: float) -> str:
    return f"{value:.0f}" if value >= 100 else f"{value:.3g}"


def _ratio(row: dict[str, Any], prefix: str, key: str) -> str:
    """Return how many times better ours is; nothing where that has no meaning."""
    if key in ("samples", "peak_memory_mb"):
        return ""
    ratio = row[key] / row[prefix + key]
    return f"{ratio if key.endswith('per_s') else 1 / ratio:.2f}"
