"""The document ``transfer.json``: rows as they are finished, then their summary."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from mi_nerfattack.drives.run import Groups, OnSteps, run_drives
from mi_nerfattack.drives.table import INTEGER, NUMBER, TEXT, TRUTH, records
from mi_nerfattack.errors import InputError
from mi_nerfattack.evaluation.metrics import summarise
from mi_nerfattack.evaluation.summary import DEPARTED_S, share_interval, summary
from mi_nerfattack.experiment.run_folder import SCENARIO
from mi_nerfattack.experiment.transfer.found import FoundAttack
from mi_nerfattack.experiment.transfer.work import Batch, TransferDrives
from mi_nerfattack.io import files, locks
from mi_nerfattack.report.plots.transfer import plot_quality, plot_transfer
from mi_nerfattack.rollout.drive import ATTACK, Drive
from mi_nerfattack.scenario.deployment import SURROGATE
from mi_nerfattack.system.workers import AbstractWorkers

SCHEMA = 1
#: Columns of :func:`drives_of`, one row per drive.
TABLE = {
    **dict.fromkeys(("attack", "environment", "condition", "case", "route"), TEXT),
    "run": INTEGER,
    **dict.fromkeys(("cross_track_mean_m", "cross_track_max_m", "wheel_out_s"), NUMBER),
    "departed": TRUTH,
}

#: Figures of a case by the digest of its batch.
Figures = Mapping[str, dict[str, Any]]
Row = dict[str, Any]
_OF_CASE = (
    *("attacks", "cross_track_mean_m", "cross_track_sd_m", "cross_track_mean_ci95_m"),
    *("wheel_out_s", "attacks_out", "attacks_out_rate_ci95", "cross_track_max_m"),
    *("drives", "drives_departed"),
)


def case_figures(
    work: TransferDrives, batch: Batch, drives: Sequence[Drive]
) -> dict[str, Any]:
    """Summarise the drives of a batch.

    Returns:
        the figures of `metrics.summarise`, and ``departure_rate_ci95`` (Wilson) of
        the share of drives that left the lane.
    """
    attack = work.attacks[batch.number]
    lanes = {attack.route.name: attack.lane}
    by_case = summarise(drives, lanes, work.seed)[attack.route.name]
    figures = by_case[batch.column.environment][batch.case]
    left = share_interval(figures["drives_departed"], figures["n"])
    return {**figures, "departure_rate_ci95": left}


def make_document(work: TransferDrives, figures: Figures) -> dict[str, Any]:
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
            column.condition.label: column.condition.identity()
            for column in sorted(work.columns, key=lambda c: c.environment == SURROGATE)
        },
        "attacks": [_describe(attack) for attack in work.attacks],
        "rows": rows,
        "columns": column_figures(rows, _drives(rows), work.seed) if complete else [],
        "surrogates": _surrogates(work, rows) if complete else [],
    }


def _describe(attack: FoundAttack) -> dict[str, Any]:
    return {
        **attack.description,
        "folder": str(attack.folder),
        "policy": attack.scenario.policy.source,
        "surrogate": dict(attack.surrogate),
        "departure_limit_m": attack.lane.wheel_m,
    }


def read_document(folder: Path) -> dict[str, Any]:
    """Read the finished ``transfer.json`` of a folder.

    Raises:
        InputError: it is of another kind, or rows are missing.
    """
    path = folder / DOCUMENT
    document = files.read_json(path)
    if not isinstance(document, dict) or document.get("schema") != 1:
        raise InputError(
            f"{path}: is not of 'mi-nerfattack transfer'; give the folder of one"
        )
    if not document["complete"]:
        raise InputError(
            f"{path}: rows are missing; the same command of 'mi-nerfattack transfer' "
            "goes on with them"
        )
    return document


def compare_rows(rows: Sequence[Row]) -> None:
    """Compare each row's attack with the attack in the surrogate, without conditions.

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
        case, base = row["cases"].get(ATTACK), bases.get(row["attack"])
        ratio = None
        if case and base and base["cross_track_mean_m"] > 0:
            ratio = case["cross_track_mean_m"] / base["cross_track_mean_m"]
        row["ratio_to_surrogate"] = ratio
        row["succeeds"] = None if case is None else _is_out(case)
        row["succeeds_in_surrogate"] = None if base is None else _is_out(base)


def column_figures(
    rows: Sequence[Row], drives: pd.DataFrame, seed: int
) -> list[dict[str, Any]]:
    """Summarise each column over the attacks, each of which counts once.

    Args:
        rows: of :func:`compare_rows`.
        drives: of these rows, with `attack`, `environment`, `condition` and `case`.
        seed: of the bootstrap.

    Returns:
        ``columns`` of ``transfer.json``, in the order of the rows.
    """
    by = ["environment", "condition", "case"]
    cases: dict[tuple[str, str], dict[str, Any]] = {}
    for figures in records(summary(drives, by, ["attack"], seed=seed)):
        environment, condition, case = (figures[name] for name in by)
        own = cases.setdefault((environment, condition), {})
        own[case] = {name: figures[name] for name in _OF_CASE}
    columns = []
    for key, of_case in cases.items():
        own = [r for r in rows if (r["environment"], r["condition"]) == key]
        ratios = [r for row in own if (r := row["ratio_to_surrogate"])]
        mean = float(np.exp(np.log(ratios).mean())) if len(ratios) == len(own) else None
        columns.append(
            {
                "environment": key[0],
                "condition": key[1],
                "attacks": len(own),
                "cases": of_case,
                "ratio_to_surrogate": mean,
                "transfer": _transfer(own),
            }
        )
    return columns


def drives_of(document: Mapping[str, Any]) -> pd.DataFrame:
    """Return the drives of a whole ``transfer.json`` with `TABLE`'s columns."""
    routes = {item["label"]: item["route"] for item in document["attacks"]}
    drives = _drives(document["rows"])
    drives["route"] = drives["attack"].map(routes)
    return drives[list(TABLE)].astype(TABLE)


def _drives(rows: Sequence[Row]) -> pd.DataFrame:
    runs = [
        {name: row[name] for name in ("attack", "environment", "condition")}
        | {"case": case, **run, "departed": run["steps_departed"] > 0}
        for row in rows
        for case, figures in row["cases"].items()
        for run in figures["per_run"]
    ]
    return pd.DataFrame(runs)


def _surrogates(work: TransferDrives, rows: Sequence[Row]) -> list[dict[str, Any]]:
    """Summarise attacks by surrogate, the worst first; none if there is one."""
    groups: dict[str, list[FoundAttack]] = {}
    for attack in work.attacks:
        groups.setdefault(attack.surrogate["sha256"], []).append(attack)
    if len(groups) < 2:
        return []
    summaries = []
    for group in groups.values():
        labels = [attack.label for attack in group]
        own = [row for row in rows if row["attack"] in labels]
        columns = column_figures(own, _drives(own), work.seed)
        surrogate = dict(group[0].surrogate)
        summaries.append({**surrogate, "attacks": labels, "columns": columns})
    unknown = float("inf")
    return sorted(
        summaries,
        key=lambda s: unknown if s["psnr_heldout_db"] is None else s["psnr_heldout_db"],
    )


def _transfer(rows: Sequence[Row]) -> dict[str, Any] | None:
    """Count how many of the attacks that succeed in the surrogate do so here."""
    some = [row for row in rows if row["succeeds_in_surrogate"]]
    if not some or some[0]["succeeds"] is None:
        return None
    successes = sum(row["succeeds"] for row in some)
    ci95 = share_interval(successes, len(some))
    return {"of": len(some), "kept": successes, "rate_ci95": ci95}


def _is_out(case: dict[str, Any]) -> bool:
    return case["wheel_out_s"] >= DEPARTED_S


DOCUMENT, PICTURE, DRIVES = "transfer.json", "transfer.png", "drives"
QUALITY = "quality.png"


def check_output(folder: Path) -> None:
    """Make the folder of a transfer; InputError if it is the one of a run."""
    if (folder / SCENARIO).exists():
        raise InputError(f"{folder}: is the folder of a run; choose another with -o")
    files.make_folder(folder)


def run_transfer(
    work: TransferDrives,
    output: Path,
    workers: AbstractWorkers,
    progress: OnSteps = lambda done, total: None,
) -> dict[str, Any]:
    """Do the drives that are not there yet, and summarise all.

    ``transfer.json`` is written again whenever a row is whole.

    Args:
        work: all drives; their store is in `output`.
        output: the folder, see `check_output`.
        workers: who does them.
        progress: called with control periods done and wanted.

    Returns:
        the document that ``transfer.json`` holds.

    Raises:
        InputError: before the first drive, an environment that cannot be made, another
            process in the folder, or a damaged drive there; later, whatever a drive
            raises.
    """
    figures: dict[str, dict[str, Any]] = {}
    document: dict[str, Any] = {"rows": None}

    def on_groups(groups: Groups) -> None:
        for index, items in groups.items():
            batch = work.batches[index]
            drives = [item.drive for item in items]
            figures[batch.digest] = case_figures(work, batch, drives)
        written = make_document(work, figures)
        if written["rows"] != document["rows"]:
            document.update(written)
            files.write_json(output / DOCUMENT, document)

    with locks.exclusive(output):
        locks.remove_partial(output)
        run_drives(work, workers, progress, on_groups=on_groups)
        plot_transfer(output / PICTURE, document)
        known = [s for s in document["surrogates"] if s["psnr_heldout_db"] is not None]
        if len(known) > 1:
            plot_quality(output / QUALITY, document)
    return document
