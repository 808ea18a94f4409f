"""The page of a policy: Markdown, its numbers as JSON, and a figure."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from markupsafe import Markup

from mi_nerfattack.io import files
from mi_nerfattack.report.columns import Column, Table
from mi_nerfattack.report.pages.sections import Block, Picture, code, markdown
from mi_nerfattack.report.plots.drives import NamedDrives, errors
from mi_nerfattack.report.table import card_rows
from mi_nerfattack.system.machine import machine
from mi_nerfattack.training.record import TrainingRecord
from mi_nerfattack.training.validation import ERROR, Epoch

SCHEMA = 1
#: Written where the training says nothing about something.
NOT_RECORDED = "not recorded"
#: Labels of what a page shows of a training before its settings.
_SHOWN = {
    "command": "command",
    "data": "frames",
    "augmentation": "augmentation",
    "seed": "seed",
    "checksums": "checksums",
    "machine": "machine",
}

_CARD = (
    Column("environment", "{environment}"),
    Column("route", "{route}"),
    Column("case", "{case}"),
    Column("drives", "{n}"),
    Column("mean (m)", "{cross_track_mean_m:.3f}"),
    Column("95 %", "cross_track_mean_ci95_m"),
    Column("largest (m)", "{cross_track_max_m:.2f}"),
    Column("drives departed", "{drives_departed}"),
    Column("95 %", lambda row: _percent(row["departure_rate_ci95"])),
    Column("expert, mean (m)", "{expert_m:.3f}"),
)
_DRIVES = (
    *_CARD[:3],
    Column("run", "{run}"),
    Column("seed", "{seed}"),
    Column("mean (m)", "{cross_track_mean_m:.3f}"),
    Column("largest (m)", "{cross_track_max_m:.2f}"),
    Column("there, x and y (m)", "{worst_at_m[0]:.1f}, {worst_at_m[1]:.1f}"),
    Column("at (s)", "{worst_time_s:.1f}"),
    Column("left at (s)", "{departed_time_s:.1f}"),
)
_ROUNDS = (
    Column("round", "{round}"),
    Column("epochs", "{epochs}"),
    Column("least held-out loss", lambda row: _recorded(row["held_out_loss"])),
    Column(
        "least closed-loop error (m)", lambda row: _recorded(row["closed_loop_error_m"])
    ),
)
_ERRORS = (
    "Distance from the lane centre: mean over all steps of all drives, with a 95 % "
    "interval over drives, and the largest of any step. A drive has departed when its "
    "distance exceeds half the lane less half the car ({}); the share of such drives "
    "has a Wilson interval. Fewer than five drives have no intervals. The expert "
    "knows its position and drives from the same starts."
)
_NOT_MEASURED = (
    "Times of day driven in: {}; exposures: {}. Nothing is known of all others, of "
    "other routes and of other objects than those below."
)


def write_policy_page(
    folder: Path,
    evaluation: Mapping[str, Any],
    record: TrainingRecord | None,
    card: Mapping[str, Any],
    drives: NamedDrives,
) -> Path:
    """Write `NAME.md`, `NAME.card.json` and `NAME.png`.

    Args:
        folder: an existing folder; NAME is the name of the policy's file.
        evaluation: what it is of, JSON: `policy`, `command`, `settings`,
            `environments`, `versions`, `seconds_a_drive` and more.
        record: of the policy's training; None without a record.
        card: {ENVIRONMENT: {ROUTE: {CASE: figures}}}.
        drives: of the card, and of the expert as case "expert".

    Returns:
        The Markdown file.
    """
    name = policy_name(str(evaluation["policy"]))
    document = {
        "schema": SCHEMA,
        **evaluation,
        "machine": machine(),
        "environments": card,
        "training": None if record is None else training_facts(record),
    }
    files.write_json(folder / f"{name}.card.json", document)
    errors(folder / f"{name}.png", drives, _limits(card), signed=True)
    path = folder / f"{name}.md"
    files.write_text(path, page_text(name, document))
    return path


def policy_name(policy: str) -> str:
    """Name the files of a page after a policy: `FILE`, `FILE.py:NAME` or a URL."""
    if policy.startswith(("http://", "https://")):
        return "policy"
    return Path(policy.removeprefix("bundled:").replace(".py:", "-")).stem


def page_text(name: str, document: Mapping[str, Any]) -> str:
    """Write the page.

    Args:
        name: of the policy.
        document: content of the JSON file next to the page.
    """
    rows = list(card_rows(document["environments"]))
    runs = [{**cell, **run} for cell in rows for run in cell["per_run"]]
    departed = [run for run in runs if run["departed"]]
    stayed = [run for run in runs if not run["departed"]]
    stayed.sort(key=lambda run: -run["cross_track_max_m"])
    limits = _limits(document["environments"]).items()
    under = document["environments_under"].values()
    exposures = sorted({item["exposure_ev"] for item in under})
    sections = {
        "Errors in the closed loop": [
            Table.of(rows, _CARD),
            _ERRORS.format(", ".join(f"{route} {m:.2f} m" for route, m in limits)),
            Picture("Distance from the lane centre over time", Path(f"{name}.png")),
        ],
        "Failures": [
            f"Drives that left the lane: {len(departed)} of {len(runs)}.",
            *([Table.of(departed, _DRIVES)] if departed else []),
            "The largest errors of drives that did not:",
            Table.of(stayed[:5], _DRIVES),
        ],
        "Not measured": [
            _NOT_MEASURED.format(
                ", ".join(sorted({item["sky"] for item in under})),
                ", ".join(f"{ev:+g} EV" if ev else "0 EV" for ev in exposures),
            )
        ],
        "Training": _training(document["training"]),
        "How it was measured": [
            {"command": code(document["command"]), **_measuring(document)}
        ],
    }
    lead = summary(document["environments"])
    return markdown(Markup("Policy ") + code(name), lead, sections)


def _training(facts: Mapping[str, Any] | None) -> list[Block]:
    """Return what a training was given, and what its rounds came to."""
    if facts is None:
        return [
            f"There is no record of the training beside the policy: {NOT_RECORDED}."
        ]
    shown = {label: facts[name] for name, label in _SHOWN.items()}
    shown |= {k: v for k, v in facts["settings"].items() if k not in shown}
    rounds = [{"round": i, **row} for i, row in enumerate(facts["rounds"])]
    return [_flat(shown), Table.of(rounds, _ROUNDS)]


def _percent(ends: Sequence[float] | None) -> str:
    return "–" if ends is None else f"{100 * ends[0]:.0f} to {100 * ends[1]:.0f} %"


def _recorded(value: float | None) -> str:
    return NOT_RECORDED if value is None else f"{value:.4f}"


def summary(card: Mapping[str, Any]) -> str:
    """Say in a sentence how many drives left their lane, and the errors."""
    rows = list(card_rows(card))
    total = sum(row["n"] for row in rows)
    left = sum(row["drives_departed"] for row in rows)
    means = [row["cross_track_mean_m"] for row in rows]
    return (
        f"{left} of {total} drives left the lane; mean distance from the lane centre "
        f"{min(means):.3f} to {max(means):.3f} m by environment, route and case."
    )


def training_facts(record: TrainingRecord) -> dict[str, Any]:
    """Pick what a page shows from the record of a training."""
    shown = record.model_dump(mode="json", include={*_SHOWN, "settings"})
    return {**shown, "rounds": [_round(rows) for rows in record.training]}


def _round(rows: Sequence[Epoch]) -> dict[str, Any]:
    errors = [row[ERROR] for row in rows if ERROR in row]
    return {
        "epochs": len(rows),
        "held_out_loss": min(row["held_out_loss"] for row in rows),
        "closed_loop_error_m": min(errors, default=None),
    }


def _measuring(document: Mapping[str, Any]) -> dict[str, str]:
    """Return names and values of how a policy was measured."""
    seconds = document.get("seconds_a_drive") or {}
    shown = {
        "machine": document["machine"],
        **{
            f"seconds a drive on one worker, {name}": f"{value:.1f}"
            for name, value in seconds.items()
        },
        "policy": document["policy_section"],
        "place": document["place"],
        "environment": document["environments_under"],
        "settings": document["settings"],
        "version": document["versions"],
    }
    return _flat(shown)


def _limits(card: Mapping[str, Any]) -> dict[str, float]:
    return {cell["route"]: cell["departure_limit_m"] for cell in card_rows(card)}


def _flat(values: Mapping[str, Any], prefix: str = "") -> dict[str, str]:
    """Return values, and what those of them hold, as text by name."""
    result = {}
    for key, value in values.items():
        name = f"{prefix}{key}"
        if isinstance(value, dict):
            result |= _flat(value, f"{name}: ")
        elif isinstance(value, list | tuple):
            texts = (str(list(v) if isinstance(v, tuple) else v) for v in value)
            result[name] = ", ".join(texts)
        else:
            result[name] = NOT_RECORDED if value is None else str(value)
    return result
