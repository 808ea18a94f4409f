"""The base scenario with three seeds: of its rays, its starts, its random textures."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import rich.table

from bench.study import jobs, rows
from bench.study.tables import markdown, mean_m
from mi_nerfattack.io import files
from mi_nerfattack.scenario.deployment import SURROGATE
from mi_nerfattack.scenes import bundled

SEEDS = (0, 1, 2)


def keys() -> list[rows.Row]:
    """Return what tells one row from another."""
    return [{"seed": seed} for seed in SEEDS]


def attack_row(key: rows.Key) -> rows.Row:
    """Attack by the base scenario of the studies."""
    return jobs.run(lambda folder: write(folder, key["seed"]))


def write(folder: Path, seed: int) -> Path:
    """Write the base scenario with another seed, and return the file."""
    text = files.read_text(bundled("base.toml"))
    path = folder / "base.toml"
    path.write_text(re.sub(r"(?m)^seed = \d+$", f"seed = {seed}", text), "utf-8")
    return path


def table(found: Sequence[rows.Row]) -> rich.table.Table:
    """List mean errors and their ratios to random textures and to the best of them."""
    header = ["seed"]
    for name in ("surrogate", "deployment"):
        header += [f"{name}: attack, m", "to random", "to best random", "drives out"]
    lines = []
    for row in found:
        line: list[str | float] = [str(row["seed"])]
        for name in (SURROGATE, "deployment"):
            attack = mean_m(row, name)
            others = [attack / mean_m(row, name, c) for c in ("random", "best_random")]
            figures = row["environments"][name]["attack"]
            line += [attack, *others]
            line += [f"{figures['drives_departed']} of {figures['n']}"]
        lines.append(line)
    return markdown(header, lines)
