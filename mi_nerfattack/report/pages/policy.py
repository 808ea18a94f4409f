"""The page of a policy: Markdown, its numbers as JSON, and a figure."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from mi_nerfattack.io import files
from mi_nerfattack.report.pages.elements import render
from mi_nerfattack.report.plots.policy import plot_errors
from mi_nerfattack.rollout.drive import Drive
from mi_nerfattack.system.cores import machine
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

#: Drives by environment, route and case.
Drives = Mapping[tuple[str, str, str], Sequence[Drive]]


def write_policy_page(
    folder: Path,
    about: Mapping[str, Any],
    record: TrainingRecord | None,
    card: Mapping[str, Any],
    drives: Drives,
) -> Path:
    """Write `NAME.md`, `NAME.card.json` and `NAME.png`.

    Args:
        folder: exists; NAME is that of the policy's file.
        about: of the evaluation, JSON: `policy`, `command`, `settings`,
            `environments`, `versions`, `seconds_a_drive` and more.
        record: what training wrote beside the policy; None where there is nothing.
        card: {ENVIRONMENT: {ROUTE: {CASE: figures}}}.
        drives: of the card, and of the expert as case "expert".

    Returns:
        The Markdown file.
    """
    name = policy_name(str(about["policy"]))
    document = {
        "schema": SCHEMA,
        **about,
        "machine": machine(),
        "environments": card,
        "training": None if record is None else training_facts(record),
    }
    files.write_json(folder / f"{name}.card.json", document)
    plot_errors(folder / f"{name}.png", drives, _limits(card))
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
        document: content of the JSON beside it.
    """
    cells = list(_cells(document["environments"]))
    runs = [(*keys, run) for *keys, figures in cells for run in figures["per_run"]]
    stayed = [item for item in runs if not item[-1]["departed"]]
    under, training = document["environments_under"].values(), document["training"]
    exposures = sorted({item["exposure_ev"] for item in under})
    return render(
        "policy.md.j2",
        name=name,
        summary=summary(document["environments"]),
        cells=cells,
        limits=_limits(document["environments"]),
        departed=[item for item in runs if item[-1]["departed"]],
        stayed=sorted(stayed, key=lambda item: -item[-1]["cross_track_max_m"]),
        skies=sorted({item["sky"] for item in under}),
        stops=[f"{value:+g} EV" if value else "0 EV" for value in exposures],
        training=training,
        training_rows=[] if training is None else _training_rows(training),
        command=document["command"],
        measuring_rows=_measuring_rows(document),
        NOT_RECORDED=NOT_RECORDED,
    )


def summary(card: Mapping[str, Any]) -> str:
    """Say in a sentence how many drives left their lane, and the errors."""
    cells = [figures for *_, figures in _cells(card)]
    total = sum(figures["n"] for figures in cells)
    left = sum(figures["drives_departed"] for figures in cells)
    means = [figures["cross_track_mean_m"] for figures in cells]
    return (
        f"{left} of {total} drives left the lane; mean distance from the lane centre "
        f"{min(means):.3f} to {max(means):.3f} m by environment, route and case."
    )


def training_facts(record: TrainingRecord) -> dict[str, Any]:
    """Pick what a page shows from what training wrote beside the policy."""
    shown = record.model_dump(mode="json", include={*_SHOWN, "settings"})
    return {**shown, "rounds": [_round(rows) for rows in record.training]}


def _round(rows: Sequence[Epoch]) -> dict[str, Any]:
    """Summarise the epochs of one training."""
    errors = [row[ERROR] for row in rows if ERROR in row]
    return {
        "epochs": len(rows),
        "held_out_loss": min(row["held_out_loss"] for row in rows),
        "closed_loop_error_m": min(errors, default=None),
    }


def _training_rows(facts: Mapping[str, Any]) -> list[list[str]]:
    """Return names and values of what a training was given."""
    shown = {label: facts[name] for name, label in _SHOWN.items()}
    shown |= {k: v for k, v in facts["settings"].items() if k not in shown}
    return [row for name, value in shown.items() for row in _flat(name, value)]


def _measuring_rows(document: Mapping[str, Any]) -> list[list[str]]:
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
    return [row for name, value in shown.items() for row in _flat(name, value)]


def _cells(card: Mapping[str, Any]) -> Iterator[tuple[str, str, str, Any]]:
    for environment, routes in card.items():
        for route, cases in routes.items():
            for case, figures in cases.items():
                yield environment, route, case, figures


def _limits(card: Mapping[str, Any]) -> dict[str, float]:
    return {r: figures["departure_limit_m"] for _, r, _, figures in _cells(card)}


def _flat(name: str, value: Any) -> list[list[str]]:
    """Return rows for a value and what it holds."""
    if isinstance(value, dict):
        return [row for key in value for row in _flat(f"{name}: {key}", value[key])]
    if value is None:
        return [[name, NOT_RECORDED]]
    if not isinstance(value, list | tuple):
        return [[name, str(value)]]
    texts = (str(list(v) if isinstance(v, tuple) else v) for v in value)
    return [[name, ", ".join(texts)]]
