"""Tables of a run: a CSV row per step, and the metrics for a terminal."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import rich.box
import rich.table

from mi_nerfattack.evaluation.metrics import lane_of
from mi_nerfattack.io import files
from mi_nerfattack.rollout.drive import ATTACK, NO_OBJECT, Drive, Lane

STEP_COLUMNS = (
    "environment",
    "route",
    "case",
    "run",
    "seed",
    "step",
    "time_s",
    "x_m",
    "y_m",
    "heading_rad",
    "control",
    "cross_track_m",
    "departed",
)


def write_steps(
    path: str | Path, drives: Iterable[Drive], lanes: Mapping[str, Lane]
) -> None:
    """Write a CSV file with a row per drive and step, atomically.

    Row `step` t = 1..T holds the state reached at `time_s`, the control that led to
    it and its signed cross-track error; `departed` is 1 beyond the limit, else 0.
    Numbers are written so that they read back to the same float64.

    Args:
        path: the file.
        drives: written in the given order.
        lanes: of each route.
    """
    buffer = io.StringIO()
    writer = csv.writer(buffer, lineterminator="\n")
    writer.writerow(STEP_COLUMNS)
    for drive in drives:
        writer.writerows(_rows(drive, lane_of(drive.route, lanes).wheel_m))
    files.write_text(path, buffer.getvalue())


def _rows(drive: Drive, limit: float) -> Iterable[list[Any]]:
    names = [drive.environment, drive.route, drive.case, drive.run, drive.seed]
    columns = zip(
        drive.time_s.tolist(),
        drive.states[1:].tolist(),
        drive.controls.tolist(),
        drive.cross_track_m.tolist(),
        drive.departed(limit).tolist(),
        strict=True,
    )
    for step, (time, state, control, error, departed) in enumerate(columns, start=1):
        yield [*names, step, time, *state, control, error, int(departed)]


def metrics_table(document: Mapping[str, Any]) -> rich.table.Table:
    """Return the metrics as a table that fits a terminal of 80 columns.

    Args:
        document: as of `metrics.metrics_document`.

    Returns:
        A row per route, environment and case: `wheel out` is the time beyond the limit,
        mean over the runs, `drives out` how many runs had such a time.
    """
    table = _distances()
    table.add_column("route", overflow="fold", max_width=14)
    for name in ("environment", "case"):
        table.add_column(name, no_wrap=True)
    for name in ("runs", "mean\n(m)", "max\n(m)", "wheel\nout (s)", "drives\nout"):
        table.add_column(name, justify="right", no_wrap=True)
    for route, environments in document["routes"].items():
        for environment, cases in environments.items():
            labels = [route, environment]
            for case, figures in cases.items():
                table.add_row(*labels, case, *_cells(figures))
                labels = ["", ""]
            table.add_section()
    return table


def card_table(card: Mapping[str, Any]) -> rich.table.Table:
    """Return a policy card as a table that fits a terminal of 80 columns.

    Args:
        card: {ENVIRONMENT: {ROUTE: {CASE: figures}}}, see `metrics.card_figures`.

    Returns:
        A row per environment, route and case; `drives departed` left the lane.
    """
    table = _distances()
    table.add_column("environment", overflow="fold", min_width=11, max_width=18)
    table.add_column("route", overflow="fold", min_width=8, max_width=14)
    table.add_column("case", no_wrap=True)
    for name in ("runs", "mean\n(m)", "max\n(m)", "drives\ndeparted", "expert\n(m)"):
        table.add_column(name, justify="right", no_wrap=True)
    for environment, routes in card.items():
        labels = [environment]
        for route, cases in routes.items():
            labels.append(route)
            for case, figures in cases.items():
                table.add_row(*labels, case, *_card_cells(figures))
                labels = ["", ""]
            labels = [""]
        table.add_section()
    return table


def transfer_table(document: Mapping[str, Any]) -> rich.table.Table:
    """Return the summary of a transfer as a table that fits a terminal of 80 columns.

    Args:
        document: whole, of `transfer.figures.make_document`.

    Returns:
        A row per environment and condition: the mean error of each case over the
        attacks; the attack's as a multiple of that in the surrogate; how many attacks
        have a wheel out for a second, with Wilson's interval in per cent.
    """
    table = _distances("Mean distance from the lane centre (m)")
    table.add_column("environment", overflow="fold", max_width=19)
    for case in document["cases"]:
        table.add_column(case.replace("_", "\n"), justify="right", no_wrap=True)
    for name in ("to sur-\nrogate", "attacks\nout"):
        table.add_column(name, justify="right", no_wrap=True)
    last = ""
    for column in document["columns"]:
        if column["environment"] != last:
            table.add_section()
            last = column["environment"]
            table.add_row(last)
        condition = column["condition"].replace(",", ",\n ")
        table.add_row(f" {condition}", *_transfer_cells(column))
    return table


def quality_table(document: Mapping[str, Any], condition: str) -> rich.table.Table:
    """Return how attacks transfer by the surrogate that they were made in.

    Args:
        document: whole, of `transfer.figures.make_document`.
        condition: the one that is told of.

    Returns:
        A row per surrogate and environment: PSNR on held-out views and steps of the
        fit, the attacks' mean error, and how many of those that succeed in their
        surrogate do there, with Wilson's interval in per cent.
    """
    table = _distances(f"Surrogates ({condition})")
    table.add_column("surrogate", overflow="fold", max_width=18)
    for name in ("PSNR\n(dB)", "steps"):
        table.add_column(name, justify="right", no_wrap=True)
    table.add_column("environment", overflow="fold", max_width=16)
    for name in ("attack\n(m)", "transfer"):
        table.add_column(name, justify="right", no_wrap=True)
    for surrogate in document["surrogates"]:
        psnr, steps = surrogate["psnr_heldout_db"], surrogate["steps"]
        quality = "" if psnr is None else f"{psnr:.1f}"
        about = [Path(surrogate["file"]).stem, quality, f"{steps or ''}"]
        for column in surrogate["columns"]:
            if column["condition"] == condition:
                attack, kept = column["cases"].get(ATTACK), column["transfer"]
                mean = "" if attack is None else f"{attack['cross_track_mean_m']:.3f}"
                share = (
                    ""
                    if kept is None
                    else _share(kept["kept"], kept["of"], kept["rate_ci95"])
                )
                table.add_row(*about, column["environment"], mean, share)
                about = ["", "", ""]
        table.add_section()
    return table


def retrain_table(document: Mapping[str, Any]) -> rich.table.Table:
    """Return what retraining came to as a table that fits a terminal of 80 columns.

    Args:
        document: with `table`, of `retrain.compare.table_rows`.

    Returns:
        A row per group of attacks, environment and stage: mean errors without objects
        and past attacks, their ratio, drives that left the lane past attacks, and how
        many attacks have a wheel out for a second.
    """
    table = _distances("Before and after, mean distance from the lane centre (m)")
    for name in ("attacks", "environment", "policy"):
        table.add_column(name, overflow="fold", max_width=19)
    for name in ("no\nobject", "attack", "ratio", "drives\ndeparted", "attacks\nout"):
        table.add_column(name, justify="right", no_wrap=True)
    for row in document["table"]:
        labels = [row["group"].replace("_", " "), row["environment"]]
        for stage in ("before", "after"):
            clean, attack = (row[stage][case] for case in (NO_OBJECT, ATTACK))
            table.add_row(
                *labels,
                stage,
                *(f"{case['cross_track_mean_m']:.3f}" for case in (clean, attack)),
                f"{row['attack_to_clean'][stage]:.2f}",
                f"{attack['drives_departed']}/{attack['drives']}",
                f"{attack['attacks_out']}/{row['attacks']}",
            )
            labels = ["", ""]
        table.add_section()
    return table


def sweep_table(document: Mapping[str, Any]) -> rich.table.Table:
    """Return the summary of a sweep as a table that fits a terminal of 80 columns.

    Args:
        document: whole, of `sweep.summary.summarise`.

    Returns:
        A row per route (and of all, if there are several), method, budget, environment
        and case: mean error over the attacks, each of which counts once, its standard
        deviation and BCa interval; drives that left the lane; how many attacks have a
        wheel out for a second, with Wilson's interval in per cent.
    """
    table = _distances("Mean distance from the lane centre (m)")
    table.add_column("case", overflow="fold", max_width=22)
    for name in ("mean", "± sd", "95 % interval", "drives\ndeparted", "attacks\nout"):
        table.add_column(name, justify="right", no_wrap=True)
    last, groups = "", document["groups"]
    single = len({group["route"] for group in groups}) == 2  # it, and None
    for group in groups:
        if single and group["route"] is None:
            continue
        route = "all routes" if group["route"] is None else group["route"]
        labels = route, group["method"], group["budget"], group["environment"]
        title = " ".join(str(label) for label in labels if label is not None)
        if title != last:
            table.add_section()
            last = title
            table.add_row(title)
        table.add_row(f" {group['case']}", *_sweep_cells(group))
    return table


def _sweep_cells(group: Mapping[str, Any]) -> list[str]:
    spread, interval = group["cross_track_sd_m"], group["cross_track_mean_ci95_m"]
    out = group["attacks_out"], group["attacks"], group["attacks_out_rate_ci95"]
    return [
        f"{group['cross_track_mean_m']:.3f}",
        "" if spread is None else f"{spread:.3f}",
        "" if interval is None else f"[{interval[0]:.3f}, {interval[1]:.3f}]",
        f"{group['drives_departed']}/{group['drives']}",
        _share(*out),
    ]


def _transfer_cells(column: Mapping[str, Any]) -> list[str]:
    cases, ratio = column["cases"], column["ratio_to_surrogate"]
    means = [f"{figures['cross_track_mean_m']:.3f}" for figures in cases.values()]
    attack, out = cases.get(ATTACK), ""
    if attack is not None:
        rate = attack["attacks_out_rate_ci95"]
        out = _share(attack["attacks_out"], column["attacks"], rate)
    return [*means, "" if ratio is None else f"{ratio:.2f}", out]


def _share(count: int, total: int, interval: Sequence[float]) -> str:
    low, high = (round(100 * end) for end in interval)
    return f"{count}/{total} [{low}, {high}]"


def _distances(title: str = "Distance from the lane centre") -> rich.table.Table:
    box = rich.box.SIMPLE_HEAD
    return rich.table.Table(title=title, box=box, pad_edge=False, padding=(0, 1))


def _card_cells(figures: Mapping[str, Any]) -> list[str]:
    """Return runs, mean, largest, drives that left the lane, the expert's mean."""
    expert = figures.get("expert")
    return [
        str(figures["n"]),
        f"{figures['cross_track_mean_m']:.3f}",
        f"{figures['cross_track_max_m']:.3f}",
        str(figures["drives_departed"]),
        "" if expert is None else f"{expert['cross_track_mean_m']:.3f}",
    ]


def _cells(figures: Mapping[str, Any]) -> list[str]:
    return [
        str(figures["n"]),
        f"{figures['cross_track_mean_m']:.3f}",
        f"{figures['cross_track_max_m']:.3f}",
        f"{figures['wheel_out_s']:.1f}",
        str(figures["drives_departed"]),
    ]
