"""The tables of results, made of documents as they are in files.

A run has ``metrics.json``, a sweep ``summary.json``, a transfer a whole
``transfer.json``; a policy card is that of `metrics.card_figures`.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mi_nerfattack.evaluation.metrics import cells
from mi_nerfattack.report.columns import Cell, Column, Table

if TYPE_CHECKING:
    from mi_nerfattack.report.pages.elements import RunPart

Document = Mapping[str, Any]
_TITLE = "Distance from the lane centre"
_MEAN = "Mean distance from the lane centre (m)"
_ROUTE, _ENVIRONMENT = Column("route", "route"), Column("environment", "environment")
_CASE = Column("case", lambda row: row["case"].replace("_", " "))
_FIGURES = (
    Column("mean (m)", "cross_track_mean_m", short="mean\n(m)"),
    Column("max (m)", "cross_track_max_m", short="max\n(m)"),
)
_NO_OBJECT, _RANDOM, _ATTACK = (
    Column(case.replace("_", " "), f"{case}.cross_track_mean_m")
    for case in ("no_object", "random", "attack")
)
_ATTACK_CI95 = Column("95 % (m)", "attack.cross_track_mean_ci95_m", terminal=False)
_DRIVES_OUT = ("attack.drives_departed", "attack.drives", "")
_OUT = ("attack.attacks_out", "attacks", "attack.attacks_out_rate_ci95")
_TRANSFER_SHARE = ("transfer.kept", "transfer.of", "transfer.rate_ci95")


def metrics_table(document: Document) -> Table:
    """Return the figures of a run: a row for each route, environment and case."""
    mean, largest = _FIGURES
    figures = [
        Column("runs", "n"),
        *_objective(document),
        mean,
        Column("95 % (m)", "cross_track_mean_ci95_m", terminal=False),
        largest,
        Column(
            "wheel out (s)",
            "wheel_out_s",
            2,
            short="wheel\nout (s)",
            terminal=document.get("objective") is None,  # 80 characters have no room
        ),
        Column("centre out (s)", "centre_out_s", 2, terminal=False),
        Column("departed", "drives_departed", short="drives\nout", bad=True),
    ]
    caption = (
        "Mean and maximum over all steps and runs. The interval is over random "
        "textures, of five or more; cases of one texture have none, since their runs "
        "differ in the start alone. Times are means over the runs; departed runs had a "
        "wheel out."
    )
    if (objective := document.get("objective")) is not None:
        caption += (
            f" The objective, {objective['name']}, is that of a drive, mean over the "
            "runs; the attack makes it smaller."
        )
        for name, why in objective["missing"].items():
            caption += f" It has no value in {name}: {why}."
    labels = [_ROUTE, _ENVIRONMENT, _CASE]
    return Table(_TITLE, labels, figures, list(_cases(document)), caption=caption)


def runs_table(document: Document) -> Table:
    """Return every drive of a run: a row each."""
    figures = [
        *(Column("run", "run"), *_objective(document), *_FIGURES),
        Column("wheel out (s)", "wheel_out_s", 2, bad=True),
        Column("centre out (s)", "centre_out_s", 2, bad=True),
        Column("back at (s)", "returned_s", 1),
    ]
    rows = [case | run for case in _cases(document) for run in case["per_run"]]
    return Table(_TITLE, [_ENVIRONMENT, _CASE], figures, rows)


def overview_table(runs: Sequence[RunPart]) -> Table:
    """Return what each run attacked and what came of it: a row for each run."""
    figures = [
        *(Column("policy", "policy"), Column("vehicle", "scenario.vehicle.kind")),
        *(Column("route", "route"), Column("objects", "objects")),
        Column("attack", "scenario.attack.method.kind"),
        Column("attack (m)", "surrogate.attack.cross_track_mean_m"),
        Column("times random", lambda row: _times_random(row["surrogate"]), 1),
        *(_out(where) for where in ("surrogate", "deployments")),
    ]
    if any(run.document.get("objective") for run in runs):
        for case, name in (("own", "unattacked"), ("attack", "attacked")):
            value = partial(_objective_of, case)
            figures.append(Column(f"objective, {name}", value))
    caption = (
        "What was attacked, and in the surrogate the mean distance from the lane "
        "centre and its multiple of that with random textures; attacked drives that "
        "leave the lane, in the surrogate and in all other environments."
    )
    rows = [_overview(run) for run in runs]
    return Table("Runs", [Column("run", "run")], figures, rows, caption=caption)


def _overview(run: RunPart) -> dict[str, Any]:
    scenario, routes = run.document["scenario"], run.document["routes"]
    environments = [cases for route in routes.values() for cases in route.items()]
    sums = [sha for key, sha in run.digests.items() if key.startswith("policy.")]
    policy = [Path(str(scenario.get("policy", {}).get("file") or "")).name]
    others = [cases for name, cases in environments if name != "surrogate"]
    attacked = [cases["attack"] for cases in others if "attack" in cases]
    return {
        "run": run.label,
        "scenario": scenario,
        "has_objective": run.document.get("objective") is not None,
        "policy": " ".join([*policy, *(f"({sha[:8]})" for sha in sums)]) or None,
        "route": ", ".join(routes),
        "objects": ", ".join(item["id"] for item in scenario.get("objects", ())),
        "surrogate": dict(environments).get("surrogate", {}),
        "deployments": {
            "attack": {
                key: sum(figures[key] for figures in attacked)
                for key in ("drives_departed", "n")
            }
            if attacked
            else None
        },
    }


def _objective_of(case: str, row: Document) -> Cell:
    """Return a case's objective in the surrogate; a dash of the default objective."""
    known = row["has_objective"] and case in row["surrogate"]
    return _significant(row["surrogate"][case]["objective"] if known else None)


def _out(where: str) -> Column:
    keys = f"{where}.attack.drives_departed", f"{where}.attack.n", ""
    return Column(f"out, {where}", keys, bad=True)


def headline_table(runs: Sequence[RunPart]) -> Table:
    """Compare runs in a table with one row per run, route and environment."""
    figures = [
        *(_NO_OBJECT, _RANDOM, Column("95 %", "random.cross_track_mean_ci95_m")),
        *(_ATTACK, Column("times random", _times_random, 1)),
        Column("wheel out (s)", "attack.wheel_out_s", 2),
        Column("departed", ("attack.drives_departed", "attack.n", ""), bad=True),
    ]
    caption = (
        "Mean distances from the lane centre (m); what the attack does as a multiple "
        "of random textures; seconds with a wheel out with the attack, mean over its "
        "drives, and how many of its drives have any."
    )
    rows = [
        {"run": run.label, **row}
        for run in runs
        for row in cells(run.document["routes"], "route", "environment")
    ]
    labels = [Column("run", "run"), _ROUTE, _ENVIRONMENT]
    return Table(_MEAN, labels, figures, rows, caption=caption)


def textures_table(document: Document) -> Table:
    """Return what the attack changed: a row for each object."""
    figures = [
        *(Column("L2 (rms)", "l2"), Column("L∞", "linf")),
        Column("saturated", lambda row: f"{100 * row['saturated_share']:.0f} %"),
        Column("total variation", "total_variation"),
    ]
    caption = (
        "Of the colours that the camera sees in the unattacked drive (sRGB in 0 to "
        "1): distances from the original, the share of values within 0.02 of 0 or 1, "
        "the mean difference of neighbouring vertices."
    )
    rows = list(cells(document["textures"], "object"))
    return Table("", [Column("object", "object")], figures, rows, caption=caption)


def card_table(card: Document) -> Table:
    """Return a policy card: a row for each environment, route and case."""
    figures = [
        *(Column("runs", "n"), *_FIGURES),
        Column("departed", "drives_departed", short="drives\ndeparted"),
        Column("expert (m)", "{expert_m:.3f}", short="expert\n(m)"),
    ]
    return Table(_TITLE, [_ENVIRONMENT, _ROUTE, _CASE], figures, list(card_rows(card)))


def card_rows(card: Document) -> Iterator[dict[str, Any]]:
    """Yield the figures of each cell of a card, with its names and `expert_m`.

    The mean error of the expert, metres, is NaN where no expert drives, and None in
    cases with objects.
    """
    for cell in cells(card, "environment", "route", "case"):
        expert = cell.get("expert", {"cross_track_mean_m": None})
        yield {**cell, "expert_m": expert["cross_track_mean_m"] if expert else math.nan}


def transfer_table(document: Document) -> Table:
    """Return a transfer over its attacks: a row for each environment and condition."""
    figures = [
        *(
            Column(
                case.replace("_", " "),
                f"{case}.cross_track_mean_m",
                short=case.replace("_", "\n"),
            )
            for case in document["cases"]
        ),
        _ATTACK_CI95,
        Column("to surrogate", "ratio_to_surrogate", 2, short="to sur-\nrogate"),
        Column("drives out", _DRIVES_OUT, terminal=False),
        Column("attacks out", _OUT, short="attacks\nout"),
        Column("transfer", _TRANSFER_SHARE, terminal=False),
    ]
    caption = (
        "Over attacks, each of which counts once: mean error and its 95 % interval, "
        "the mean error as a multiple of that in the surrogate (geometric mean), "
        "attacks with a wheel out for 1 s (a mean over drives), and of those that "
        "succeed in the surrogate how many do here, with Wilson's intervals."
    )
    rows = [column | column["cases"] for column in document["columns"]]
    labels = [_ENVIRONMENT, Column("condition", "condition")]
    return Table(_MEAN, labels, figures, rows, heading=1, caption=caption)


def quality_table(document: Document, condition: str) -> Table:
    """Return how attacks transfer, under one condition, by surrogate."""
    rows = [
        {"surrogate": surrogate, **column, **column["cases"]}
        for surrogate in document["surrogates"]
        for column in surrogate["columns"]
        if column["condition"] == condition
    ]
    labels = [
        Column("surrogate", lambda row: Path(row["surrogate"]["file"]).stem),
        Column("PSNR (dB)", "surrogate.psnr_heldout_db", 1),
        *(Column("steps", "surrogate.steps"), _ENVIRONMENT),
    ]
    figures = [_ATTACK, Column("transfer", _TRANSFER_SHARE)]
    return Table(f"Surrogates ({condition})", labels, figures, rows)


def retrain_table(document: Document) -> Table:
    """Return a retraining: a row for each group, environment and stage."""
    rows = [
        {**row, **row[stage], "stage": stage, "ratio": row["attack_to_clean"][stage]}
        for row in document["table"]
        for stage in ("before", "after")
    ]
    figures = [
        *(_NO_OBJECT, _ATTACK, _ATTACK_CI95, Column("ratio", "ratio", 2)),
        Column("drives out", _DRIVES_OUT, short="drives\ndeparted"),
        Column("attacks out", _OUT, short="attacks\nout"),
    ]
    caption = (
        f"Before and after retraining on {len(document['runs'])} attacks, from unseen "
        "starts. Mean distances from the lane centre (m), 95 % intervals over attacks, "
        "ratio to the mean without objects, attacks with a wheel out for a second."
    )
    if document.get("adaptive"):
        caption += (
            " Adaptive: the policy before past the attacks found on it, the policy "
            "after past attacks found on itself, in the same scenarios."
        )
    group = Column("attacks", lambda row: row["group"].replace("_", " "))
    labels = [group, _ENVIRONMENT, Column("policy", "stage")]
    title = "Before and after, mean distance from the lane centre (m)"
    return Table(title, labels, figures, rows, caption=caption)


def sweep_table(document: Document) -> Table:
    """Return a sweep over its attacks: a row for each group and case."""
    groups = document["groups"]
    if len({group["route"] for group in groups}) == 2:  # one route, and None
        groups = [group for group in groups if group["route"] is not None]
    left, out = ("drives_departed", "drives"), ("attacks_out", "attacks")
    figures = [
        Column("n", "attacks", terminal=False),
        Column("mean (m)", "cross_track_mean_m", short="mean"),
        Column("sd (m)", "cross_track_sd_m", short="± sd"),
        Column("95 % (m)", "cross_track_mean_ci95_m", short="95 % interval"),
        Column("wheel out (s)", "wheel_out_s", 2, terminal=False),
        Column("drives\ndeparted", (*left, ""), page=False),
        Column("drives out", (*left, "departure_rate_ci95"), terminal=False, bad=True),
        Column(
            "attacks out",
            (*out, "attacks_out_rate_ci95"),
            short="attacks\nout",
            bad=True,
        ),
    ]
    caption = (
        f"{document['complete']} of {document['cells']} attacks are done. Mean "
        "distance from the lane centre, over attacks, each of which counts once, with "
        "standard deviation and, of five or more, 95 % interval; drives with a wheel "
        f"out, and attacks with one out for {document['departed_s']:g} s in the mean "
        "over their drives, with Wilson's intervals."
    )
    return Table(
        _MEAN, [*_PLACE, _CASE], figures, records=groups, heading=3, caption=caption
    )


def comparisons_table(document: Document) -> Table:
    """Compare attacks with other drives of the same places, seeds and starts."""
    figures = [
        Column("n", "effect.attacks"),
        Column("ratio", "effect.ratio", 2),
        Column("95 %", "effect.ratio_ci95", 2),
        Column("difference (m)", "effect.difference"),
        Column("95 % (m)", "effect.difference_ci95"),
        Column("seed sd (m)", "effect.spread"),
        Column("out here", "departures.one"),
        Column("out there", "departures.other"),
        Column("p", "departures.p_value"),
    ]
    caption = (
        "Attacks beside other drives of the same places, seeds and starts: mean error, "
        "its difference and ratio with 95 % intervals over attacks; the difference's "
        "standard deviation from seed to seed; attacks that are out on this side alone "
        "and on the other alone, and McNemar's p-value."
    )
    labels, rows = [*_PLACE, Column("beside", _beside)], document["comparisons"]
    return Table(_MEAN, labels, figures, rows, caption=caption)


def attacks_table(rows: Sequence[dict[str, Any]]) -> Table:
    """Return every attack of a sweep, with the command that repeats it."""
    figures = [
        *(_NO_OBJECT, _RANDOM, _ATTACK),
        Column("wheel out (s)", "wheel_out_s", 2),
        Column("command", lambda row: Cell(row["repeat"], code=True)),
    ]
    rows = [
        row | {c: {"cross_track_mean_m": mean} for c, mean in row["cases"].items()}
        for row in rows
    ]
    caption = (
        "Mean distances from the lane centre (m), and seconds with a wheel out past "
        "the attack, each the mean over the attack's drives."
    )
    labels = [
        *(_ROUTE, Column("objects", "objects"), _METHOD, Column("seed", "seed")),
        Column("environment", _where),
    ]
    return Table(_MEAN, labels, figures, rows, caption=caption)


def _objective(document: Document) -> list[Column]:
    """Return the objective's column, unless it is the distance from the lane centre."""
    if document.get("objective") is None:
        return []
    return [
        Column(
            "objective",
            lambda row: _significant(row["objective"]),
            short="objec-\ntive",
        )
    ]


def _significant(value: float | None) -> Cell:
    return Cell("–" if value is None else f"{value:.4g}")


def _cases(document: Document) -> Iterator[dict[str, Any]]:
    return cells(document["routes"], "route", "environment", "case")


def _times_random(cases: Document) -> float | None:
    attack, chance = (column.of(cases) for column in (_ATTACK, _RANDOM))
    return attack / chance if attack is not None and chance else None


def _method(row: Document) -> str:
    budget = row["budget"]
    return str(row["method"]) if budget is None else f"{row['method']} {budget}"


def _beside(row: Document) -> str:
    case, method = row["other_case"].replace("_", " "), row["other_method"]
    return case if method == row["method"] else f"{method}, {case}"


def _where(row: Document) -> str:
    error = row["error"]
    return row["environment"] if error is None else f"failed: {error}"


_METHOD = Column("method", _method)
_PLACE = (Column("route", lambda row: row["route"] or "all"), _METHOD, _ENVIRONMENT)
