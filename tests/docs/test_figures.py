"""Measured figures of the pages: each has rows, or is counted, and equals its rows."""

from __future__ import annotations

import json
from collections import Counter
from pathlib import Path

import pytest

from mi_nerfattack.io import files

ROOT = Path(__file__).parents[2]
FIGURES = files.read_toml(ROOT / "bench/figures.toml")
BENCH = (ROOT / "docs/results/bench.md").read_text("utf-8")
# Figures that only their page has, by page; a count may only fall.
PENDING = {
    "README.md": 1,
    "docs/howto/resume.md": 1,
    "docs/reference/checks.md": 1,
    "docs/reference/run_folder.md": 2,
    "docs/results/bench.md": 17,
    "docs/reference/mujoco.md": 1,
    "docs/reference/roadside.md": 1,
    "docs/results/fields.md": 5,
    "docs/howto/retrain.md": 4,
    "docs/car/index.md": 3,
    "docs/reference/room.md": 1,
    "docs/howto/training.md": 4,
    "docs/howto/transfer.md": 1,
    "docs/explain/environments.md": 1,
}


@pytest.mark.parametrize("page", FIGURES)
def test_the_words_are_on_the_page_and_their_rows_exist(page):
    text = " ".join((ROOT / page).read_text("utf-8").split())
    for words, rows in FIGURES[page].items():
        assert words in text, f"bench/figures.toml: {words!r} is not on {page}"
        assert (ROOT / rows).exists(), f"bench/figures.toml: {rows}"


def test_figures_without_rows_are_counted():
    without = Counter(
        page
        for page, figures in FIGURES.items()
        for rows in figures.values()
        if not rows
    )
    assert without == PENDING


def results(name: str) -> dict:
    (path,) = (ROOT / "bench/results").glob(f"*-cores-{name}.json")
    return json.loads(path.read_text("utf-8"))


def test_the_table_of_rendering_equals_its_file():
    for size, row in results("render")["sizes"].items():
        for name, key in (
            ("forward", "forward"),
            ("backward", "backward"),
            ("both", "forward_and_backward"),
        ):
            ours, peer = (row[f"{p}{key}_samples_per_s"] for p in ("", "torch_tuned_"))
            figures = f"{ours / 1e6:.3f} | {peer / 1e6:.3f} | {ours / peer:.1f}"
            assert f"| {size} {name} | {figures} |" in BENCH


def test_the_table_of_fits_equals_its_file():
    for row in results("fit")["steps"]:
        ours, peer = (row[f"{p}seconds_per_step"] for p in ("", "torch_tuned_"))
        figures = f"{1e3 * ours:.0f} | {1e3 * peer:.0f} | {peer / ours:.1f}"
        assert f"| {row['network']}, {row['stage']} | {figures} |" in BENCH


def test_the_table_of_attacks_equals_its_file():
    for name, key in (
        ("a drive alone", "{rollout_ms:.0f}"),
        (
            "iteration, `kept_backgrounds`",
            "{iteration_ms:.0f}, {iteration_over_rollout:.2f} drives",
        ),
        (
            "iteration, `replay`",
            "{replay_iteration_ms:.0f}, {replay_over_rollout:.2f} drives",
        ),
        (
            "PyTorch",
            "{torch_tuned_iteration_ms:.0f}, {torch_tuned_time_ratio:.1f} times",
        ),
    ):
        rows = [results("attack")[size] for size in ("200x66", "366x188")]
        assert f"| {name} | {' | '.join(key.format(**row) for row in rows)} |" in BENCH


def test_the_table_of_scaling_equals_its_file():
    rows = results("scaling")["rows"]
    keys = (
        "iteration_ms",
        "iteration_mb",
        "replay_iteration_ms",
        "replay_iteration_mb",
    )
    for row in rows:
        assert f"| {' | '.join(f'{row[key]:.0f}' for key in keys)} |" in BENCH
