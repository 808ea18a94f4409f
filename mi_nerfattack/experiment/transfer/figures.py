"""The document ``transfer.json``: rows as they are finished, then their summary."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from mi_nerfattack.evaluation.intervals import share_interval
from mi_nerfattack.evaluation.metrics import summarise
from mi_nerfattack.evaluation.pairs import DEPARTED_S, over_attacks
from mi_nerfattack.experiment.transfer.found import FoundAttack
from mi_nerfattack.experiment.transfer.work import Batch, TransferWork
from mi_nerfattack.rollout.drive import ATTACK, Drive
from mi_nerfattack.scenario.deployment import SURROGATE

SCHEMA = 1

#: Figures of a case by the digest of its batch.
Figures = Mapping[str, dict[str, Any]]
Row = dict[str, Any]


def case_figures(
    work: TransferWork, batch: Batch, drives: Sequence[Drive]
) -> dict[str, Any]:
    """Summarise the drives of a batch.

    Returns:
        the figures of `metrics.summarise`, and ``departure_rate_ci95`` (Wilson) of
        the share of drives that left the lane.
    """
    found = work.attacks[batch.number]
    lanes = {found.route.name: found.lane}
    by_case = summarise(drives, lanes, work.seed)[found.route.name]
    figures = by_case[batch.column.environment][batch.case]
    left = share_interval(figures["drives_departed"], figures["n"])
    return {**figures, "departure_rate_ci95": left}


def make_document(work: TransferWork, figures: Figures) -> dict[str, Any]:
    """Return what ``transfer.json`` holds, of the rows that are whole.

    Args:
        work: all that is wanted.
        figures: of the batches that are done.
    """
    rows = [
        {
            "attack": work.attacks[number].label,
            "environment": column.environment,
            "condition": column.condition.label,
            "cases": {case: figures[batch.digest] for case, batch in row.items()},
        }
        for (number, column), row in work.rows.items()
        if all(batch.digest in figures for batch in row.values())
    ]
    compare_rows(rows)
    complete = len(rows) == len(work.rows)
    return {
        "schema": SCHEMA,
        "complete": complete,
        "seed": work.seed,
        "starts": work.starts,
        "cases": list(work.cases),
        "success_s": DEPARTED_S,
        "conditions": {
            column.condition.label: asdict(column.condition)
            for column in sorted(work.columns, key=lambda c: c.environment == SURROGATE)
        },
        "attacks": [_about(found) for found in work.attacks],
        "rows": rows,
        "columns": column_figures(rows, work.seed) if complete else [],
        "surrogates": _surrogates(work, rows) if complete else [],
    }


def _about(found: FoundAttack) -> dict[str, Any]:
    scenario = found.scenario
    return {
        "label": found.label,
        "folder": str(found.folder),
        "scenario": scenario.name,
        "seed": scenario.seed,
        "route": found.route.name,
        "policy": scenario.policy.source,
        "objects": [item.id for item in scenario.objects],
        "surrogate": dict(found.surrogate),
        "departure_limit_m": found.lane.wheel_m,
        "found_sha256": found.digest,
    }


def compare_rows(rows: Sequence[Row]) -> None:
    """Set each row's attack beside the same in the surrogate without a condition.

    Args:
        rows: of ``transfer.json``; get ``ratio_to_surrogate``, ``succeeds`` and
            ``succeeds_in_surrogate``.
    """
    bases = {
        row["attack"]: row["cases"].get(ATTACK)
        for row in rows
        if (row["environment"], row["condition"]) == (SURROGATE, "day")
    }
    for row in rows:
        here, base = row["cases"].get(ATTACK), bases.get(row["attack"])
        ratio = None
        if here and base and base["cross_track_mean_m"] > 0:
            ratio = here["cross_track_mean_m"] / base["cross_track_mean_m"]
        row["ratio_to_surrogate"] = ratio
        row["succeeds"] = None if here is None else _is_out(here)
        row["succeeds_in_surrogate"] = None if base is None else _is_out(base)


def column_figures(rows: Sequence[Row], seed: int) -> list[dict[str, Any]]:
    """Summarise each column over the attacks that have it.

    Args:
        rows: of :func:`compare_rows`.
        seed: of the bootstrap.

    Returns:
        ``columns`` of ``transfer.json``, in the order of the rows.
    """
    found, groups = [], {}
    for row in rows:
        groups.setdefault((row["environment"], row["condition"]), []).append(row)
    for key, own in groups.items():
        ratios = [r for row in own if (r := row["ratio_to_surrogate"])]
        mean = float(np.exp(np.log(ratios).mean())) if len(ratios) == len(own) else None
        found.append(
            {
                "environment": key[0],
                "condition": key[1],
                "attacks": len(own),
                "cases": {
                    case: _over_attacks([row["cases"][case] for row in own], seed)
                    for case in own[0]["cases"]
                },
                "ratio_to_surrogate": mean,
                "transfer": _transfer(own),
            }
        )
    return found


def _surrogates(work: TransferWork, rows: Sequence[Row]) -> list[dict[str, Any]]:
    """Summarise attacks by surrogate, the worst first; none if there is one."""
    groups: dict[str, list[FoundAttack]] = {}
    for found in work.attacks:
        groups.setdefault(found.surrogate["sha256"], []).append(found)
    if len(groups) < 2:
        return []
    summaries = []
    for group in groups.values():
        labels = [found.label for found in group]
        own = [row for row in rows if row["attack"] in labels]
        columns = column_figures(own, work.seed)
        about = dict(group[0].surrogate)
        summaries.append({**about, "attacks": labels, "columns": columns})
    unknown = float("inf")
    return sorted(
        summaries,
        key=lambda s: unknown if s["psnr_heldout_db"] is None else s["psnr_heldout_db"],
    )


def _over_attacks(cases: Sequence[dict[str, Any]], seed: int) -> dict[str, Any]:
    """Summarise a case of one column over the attacks, each of which counts once."""
    errors, out_s = (
        np.array([case[name] for case in cases])
        for name in ("cross_track_mean_m", "wheel_out_s")
    )
    return {
        **over_attacks(errors, out_s, seed),
        "cross_track_max_m": max(case["cross_track_max_m"] for case in cases),
        "drives": sum(case["n"] for case in cases),
        "drives_departed": sum(case["drives_departed"] for case in cases),
    }


def _transfer(rows: Sequence[Row]) -> dict[str, Any] | None:
    """Count how many of the attacks that succeed in the surrogate do so here."""
    some = [row for row in rows if row["succeeds_in_surrogate"]]
    if not some or some[0]["succeeds"] is None:
        return None
    kept = sum(row["succeeds"] for row in some)
    ci95 = share_interval(kept, len(some))
    return {"of": len(some), "kept": kept, "rate_ci95": ci95}


def _is_out(case: dict[str, Any]) -> bool:
    return case["wheel_out_s"] >= DEPARTED_S
