"""The page of a policy: Markdown, its numbers as JSON, and a figure."""

from __future__ import annotations

import platform
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from mi_nerfattack.io import files
from mi_nerfattack.report.plots.policy import plot_errors
from mi_nerfattack.rollout.drive import Drive
from mi_nerfattack.system.cores import cores

SCHEMA = 1
#: Written where the training says nothing about something.
NOT_RECORDED = "not recorded"
_WORST_SHOWN = 5
_FORMER_SCHEMA = 1  # of a training's JSON: its settings are those of the validation

#: Drives by environment, route and case.
Drives = Mapping[tuple[str, str, str], Sequence[Drive]]


def write_policy_page(
    folder: Path,
    about: Mapping[str, Any],
    record: Mapping[str, Any] | None,
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
    machine = f"{cores()} cores, {platform.system()} {platform.machine()}"
    document = {
        "schema": SCHEMA,
        **about,
        "machine": machine,
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
    card = document["environments"]
    sections = [
        [f"# Policy `{name}`", "", summary(card)],
        ["## Errors in the closed loop", "", *_errors(name, document)],
        ["## Failures", "", *failures(card)],
        ["## Not measured", "", *_unmeasured(document)],
        ["## Training", "", *_training(document["training"])],
        ["## How it was measured", "", *_measuring(document)],
    ]
    return "\n\n".join("\n".join(section) for section in sections) + "\n"


def summary(card: Mapping[str, Any]) -> str:
    """Say in a sentence how many drives left their lane, and the errors."""
    cells = [figures for *_, figures in _cells(card)]
    total = sum(figures["n"] for figures in cells)
    left = sum(figures["departures"] for figures in cells)
    means = [figures["cross_track_mean_m"] for figures in cells]
    return (
        f"{left} of {total} drives left the lane; mean distance from the lane centre "
        f"{min(means):.3f} to {max(means):.3f} m by environment, route and case."
    )


def failures(card: Mapping[str, Any]) -> list[str]:
    """List the drives that left their lane, and the worst of the others."""
    runs = [
        (environment, route, case, run)
        for environment, route, case, figures in _cells(card)
        for run in figures["per_run"]
    ]
    out = [item for item in runs if item[3]["departed"]]
    rest = [item for item in runs if not item[3]["departed"]]
    rest.sort(key=lambda item: -item[3]["cross_track_max_m"])
    lines = [f"Drives that left the lane: {len(out)} of {len(runs)}.", ""]
    if out:
        lines += [*_run_table(out), ""]
    shown = rest[:_WORST_SHOWN]
    return [
        *lines,
        "The largest errors of drives that did not:",
        "",
        *_run_table(shown),
    ]


def training_facts(record: Mapping[str, Any]) -> dict[str, Any]:
    """Pick from a training's JSON what a page shows; None where it says nothing.

    Args:
        record: the JSON beside the policy, of any schema.
    """
    recorded = record.get("schema", 0) > _FORMER_SCHEMA
    settings = record.get("settings") if recorded else None
    settings = settings if isinstance(settings, dict) else {}
    facts = {
        name: record.get(name, settings.get(name))
        for name in ("command", "seed", "data", "augmentation", "checksums", "machine")
    }
    facts["data"] = facts["data"] or settings.get("frames")
    facts["settings"] = settings or None
    facts["rounds"] = [_round(rows) for rows in record.get("training") or [] if rows]
    return facts


def _round(rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Summarise the epochs of one training."""
    losses = [row["held_out_loss"] for row in rows if "held_out_loss" in row]
    errors = [
        row["closed_loop_error_m"] for row in rows if "closed_loop_error_m" in row
    ]
    return {
        "epochs": len(rows),
        "held_out_loss": min(losses, default=None),
        "closed_loop_error_m": min(errors, default=None),
    }


def _errors(name: str, document: Mapping[str, Any]) -> list[str]:
    rows = []
    for environment, route, case, figures in _cells(document["environments"]):
        expert = figures.get("expert")
        share = figures["departure_rate_ci95"]
        rows.append(
            [
                environment,
                route,
                case,
                str(figures["n"]),
                f"{figures['cross_track_mean_m']:.3f}",
                _interval(figures["cross_track_mean_ci95_m"], "{:.3f}"),
                f"{figures['cross_track_max_m']:.2f}",
                str(figures["departures"]),
                _interval([100 * value for value in share], "{:.0f}") + " %",
                "" if expert is None else f"{expert['cross_track_mean_m']:.3f}",
            ]
        )
    head = ["environment", "route", "case", "drives", "mean (m)", "95 %", "largest (m)"]
    head += ["left the lane", "95 %", "expert, mean (m)"]
    limits = ", ".join(f"{r} {m:.2f} m" for r, m in _limits_by_route(document).items())
    return [
        *_table(head, rows),
        "",
        "Distance from the lane centre: mean over all steps of all drives, with a "
        "bootstrap interval over drives, and the largest of any step. A drive has left "
        "the lane when its distance exceeds half the lane less half the car "
        f"({limits}); the share of such drives has a Wilson interval. The expert knows "
        "its position and drives from the same starts.",
        "",
        f"![Distance from the lane centre over time]({name}.png)",
    ]


def _unmeasured(document: Mapping[str, Any]) -> list[str]:
    """Say which conditions nobody drove in."""
    under = document["environments_under"]
    skies = sorted({item["sky"] for item in under.values()})
    exposures = sorted({item["exposure_ev"] for item in under.values()})
    stops = ", ".join(f"{value:+g} EV" if value else "0 EV" for value in exposures)
    return [
        f"Times of day driven in: {', '.join(skies)}; exposures: {stops}. Nothing is "
        "known of all others, of other routes and of other objects than those below."
    ]


def _training(facts: Mapping[str, Any] | None) -> list[str]:
    if facts is None:
        return [
            f"There is no record of the training beside the policy: {NOT_RECORDED}."
        ]
    shown = [
        ("command", facts["command"]),
        ("frames", facts["data"]),
        ("augmentation", facts["augmentation"]),
        ("seed", facts["seed"]),
        ("checksums", facts["checksums"]),
        ("machine", facts["machine"]),
    ]
    rows = [row for name, value in shown for row in _flat(name, value)]
    settings = facts["settings"] or {}
    skipped = ("frames", "seed", "augmentation")
    rows += [
        row
        for name, value in settings.items()
        if name not in skipped
        for row in _flat(name, value)
    ]
    if not settings:
        rows.append(["settings", NOT_RECORDED])
    lines = _table(["", ""], rows)
    rounds = [
        [str(number), str(item["epochs"]), *_round_cells(item)]
        for number, item in enumerate(facts["rounds"])
    ]
    head = ["round", "epochs", "least held-out loss", "least closed-loop error (m)"]
    return [*lines, "", *_table(head, rounds)]


def _round_cells(item: Mapping[str, Any]) -> list[str]:
    names = ("held_out_loss", "closed_loop_error_m")
    return [NOT_RECORDED if item[n] is None else f"{item[n]:.4f}" for n in names]


def _measuring(document: Mapping[str, Any]) -> list[str]:
    seconds = document.get("seconds_a_drive") or {}
    rows = [
        ["command", f"`{document['command']}`"],
        ["machine", document["machine"]],
        *(
            [f"seconds a drive on one worker, {name}", f"{value:.1f}"]
            for name, value in seconds.items()
        ),
        *_flat("policy", document["policy_section"]),
        *_flat("place", document["place"]),
        *_flat("environment", document["environments_under"]),
        *_flat("settings", document["settings"]),
        *_flat("version", document["versions"]),
    ]
    return _table(["", ""], rows)


def _run_table(runs: Sequence[tuple[str, str, str, Mapping[str, Any]]]) -> list[str]:
    head = ["environment", "route", "case", "run", "seed", "mean (m)", "largest (m)"]
    head += ["there, x and y (m)", "at (s)", "left at (s)"]
    rows = []
    for environment, route, case, run in runs:
        left = run["departed_time_s"]
        x, y = run["worst_at_m"]
        rows.append(
            [
                environment,
                route,
                case,
                str(run["run"]),
                str(run["seed"]),
                f"{run['cross_track_mean_m']:.3f}",
                f"{run['cross_track_max_m']:.2f}",
                f"{x:.1f}, {y:.1f}",
                f"{run['worst_time_s']:.1f}",
                "" if left is None else f"{left:.1f}",
            ]
        )
    return _table(head, rows)


def _cells(card: Mapping[str, Any]) -> Iterator[tuple[str, str, str, Any]]:
    for environment, routes in card.items():
        for route, cases in routes.items():
            for case, figures in cases.items():
                yield environment, route, case, figures


def _limits(card: Mapping[str, Any]) -> dict[str, float]:
    return {r: figures["departure_limit_m"] for _, r, _, figures in _cells(card)}


def _limits_by_route(document: Mapping[str, Any]) -> dict[str, float]:
    return _limits(document["environments"])


def _flat(name: str, value: Any) -> list[list[str]]:
    """Return rows for a value and what it holds."""
    if isinstance(value, dict):
        return [row for key in value for row in _flat(f"{name}: {key}", value[key])]
    if value is None:
        return [[name, NOT_RECORDED]]
    text = ", ".join(map(str, value)) if isinstance(value, list | tuple) else str(value)
    return [[name, text]]


def _interval(values: Sequence[float] | None, form: str) -> str:
    return "" if values is None else " to ".join(form.format(value) for value in values)


def _table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    """Return the lines of a Markdown table."""
    lines = [list(head), ["---"] * len(head), *rows]
    safe = [[cell.replace("|", "\\|") for cell in row] for row in lines]
    return [f"| {' | '.join(row)} |" for row in safe]
