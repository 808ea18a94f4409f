"""The matrix of a transfer: what attacks do in each environment, by condition."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes

from mi_nerfattack.report.plots.charts import GREY, PALETTE, chart
from mi_nerfattack.rollout.drive import ATTACK
from mi_nerfattack.scenario.deployment import SURROGATE

#: Attacks that have lines of their own; of more there is the mean alone.
_MOST = 6
_LINE_IN, _MARGIN_IN = 0.26, 1.9
#: Share of the colours' range from which on text is black.
LIGHT = 0.6
COLOURS = "inferno"


@dataclass(frozen=True)
class Line:
    """A line of the matrix: its label, and by condition its error and its text.

    Attributes:
        label: what is driven past.
        cells: by condition, metres and what is written there.
    """

    label: str
    cells: Mapping[str, tuple[float, str]]


def plot_transfer(path: str | Path, document: Mapping[str, Any]) -> None:
    """Draw the mean distance from the lane centre of every case.

    Each environment has a block of lines, and each condition has a column. In a block,
    each case has one line, the mean over all attacks. If the attacks are few, each
    attack has a line, too. Below the mean error of the attacks, a cell shows how many
    of them have a wheel out for a second. Nothing was driven where a cell is grey,
    because light has no effect on a field.

    Args:
        path: PNG file.
        document: whole, of `transfer.figures.make_document`.
    """
    environments = list(dict.fromkeys(c["environment"] for c in document["columns"]))
    conditions = list(document["conditions"])
    lines, names = [], []
    for environment in environments:
        own = matrix_lines(document, environment)
        names += [environment] + [""] * (len(own) - 1)
        lines += own
    values = [
        [line.cells.get(c, (np.nan, ""))[0] for c in conditions] for line in lines
    ]
    with chart(path, _LINE_IN * len(lines) + _MARGIN_IN) as figure:
        axis = figure.subplots()
        most = max(np.nanmax(values), 1e-9)
        axis.set_facecolor("#d9d9d9")
        image = axis.imshow(values, cmap=COLOURS, vmin=0, vmax=most, aspect="auto")
        for row, line in enumerate(lines):
            for column, condition in enumerate(conditions):
                value, text = line.cells.get(condition, (0.0, ""))
                colour = "black" if value > LIGHT * most else "white"
                axis.text(column, row, text, color=colour, **_CENTRED)
        _label(axis, conditions, [line.label for line in lines], names=names)
        bar = figure.colorbar(image, ax=axis, shrink=0.6, pad=0.01)
        bar.set_label("mean distance from the lane centre (m)")
        axis.set_title(
            f"attacks: {len(document['attacks'])}, from {document['starts']} unseen "
            "starts each; below their error, how many have a wheel out for "
            f"{document['success_s']:g} s",
            fontsize=9,
        )


def plot_quality(path: str | Path, document: Mapping[str, Any]) -> None:
    """Draw transfer against the quality of the surrogate that attacks were made in.

    Above, of the attacks that succeed in their surrogate, the share that do elsewhere,
    with Wilson's intervals; below, their mean error, in the surrogate, too, with its
    interval over attacks. A point a surrogate with a known quality, of the condition
    `quality_condition`.

    Args:
        path: PNG file.
        document: whole, of attacks in several surrogates.
    """
    condition = quality_condition(document)
    points: dict[str, list[tuple[float, Mapping[str, Any]]]] = {}
    for surrogate in document["surrogates"]:
        for column in surrogate["columns"]:
            psnr, known = surrogate["psnr_heldout_db"], ATTACK in column["cases"]
            if psnr is not None and known and column["condition"] == condition:
                points.setdefault(column["environment"], []).append((psnr, column))
    with chart(path, 6.0) as figure:
        shares, errors = figure.subplots(2, sharex=True)
        for number, (environment, some) in enumerate(points.items()):
            style = {**_STYLES[number % len(_STYLES)], "label": environment}
            ends = [
                (psnr, share, transfer["rate_ci95"] or [share, share])
                for psnr, column in some
                if (transfer := column["transfer"])
                for share in [transfer["kept"] / transfer["of"]]
            ]
            if environment != SURROGATE:  # 1 by definition
                _curve(shares, ends, style)
            means = [(psnr, column["cases"][ATTACK]) for psnr, column in some]
            _curve(errors, [(x, *_mean(case)) for x, case in means], style)
        shares.set_ylim(-0.05, 1.05)
        shares.set_ylabel("attacks that transfer (share)")
        errors.set_ylim(bottom=0)
        errors.set_ylabel("mean distance\nfrom the lane centre (m)")
        errors.set_xlabel("PSNR of the surrogate on held-out views (dB)")
        for axis in (shares, errors):
            axis.grid(alpha=0.25)
        shares.set_title(f"{condition}; attacks of each surrogate")
        handles = errors.get_legend_handles_labels()
        figure.legend(*handles, loc="outside lower center", ncols=4)


def quality_condition(document: Mapping[str, Any]) -> str:
    """Return the condition by which surrogates are compared: day, or the first."""
    conditions = list(document["conditions"])
    return "day" if "day" in conditions else conditions[0]


def _mean(case: Mapping[str, Any]) -> tuple[float, list[float]]:
    mean = case["cross_track_mean_m"]
    return mean, case["cross_track_mean_ci95_m"] or [mean, mean]


def _curve(
    axis: Axes,
    points: list[tuple[float, float, list[float]]],
    style: Mapping[str, Any],
) -> None:
    """Draw points (x, y, ends of y's interval)."""
    if points:
        x, y, ends = (np.array(values) for values in zip(*points, strict=True))
        bars = np.maximum(np.abs(ends.T - y), 0)
        axis.errorbar(x, y, bars, capsize=3, linewidth=1, **style)


#: Of environments.
_STYLES: list[dict[str, Any]] = [
    {"color": color, "marker": marker}
    for color, marker in zip((GREY, *PALETTE), "osD^vP*", strict=True)
]
_CENTRED: dict[str, Any] = {"ha": "center", "va": "center", "fontsize": 6}


def matrix_lines(document: Mapping[str, Any], environment: str) -> list[Line]:
    """Return the lines of an environment: other cases, mean of the attacks, attacks.

    Args:
        document: whole, of `transfer.figures.make_document`.
        environment: one of its columns'.
    """
    columns = [c for c in document["columns"] if c["environment"] == environment]
    lines = []
    for case in document["cases"]:
        cells = {}
        for column in columns:
            figures = column["cases"][case]
            value, text = figures["cross_track_mean_m"], ""
            if case == ATTACK:
                text = f"\n{figures['attacks_out']}/{column['attacks']}"
            cells[column["condition"]] = value, f"{value:.2f}{text}"
        lines.append(Line(case.replace("_", " "), cells))
    attacks = [entry["label"] for entry in document["attacks"]]
    if ATTACK not in document["cases"] or not 1 < len(attacks) <= _MOST:
        return lines
    for attack in attacks:
        rows = [
            row
            for row in document["rows"]
            if (row["attack"], row["environment"]) == (attack, environment)
        ]
        means = {
            row["condition"]: row["cases"][ATTACK]["cross_track_mean_m"] for row in rows
        }
        cells = {key: (value, f"{value:.2f}") for key, value in means.items()}
        lines.append(Line(f"  {attack[-24:]}", cells))
    return lines


def _label(
    axis: Axes, conditions: list[str], labels: list[str], names: list[str]
) -> None:
    """Name lines and columns, and part the environments."""
    shown = [c.replace(",", ",\n") for c in conditions]
    axis.set_xticks(range(len(shown)), shown, rotation=45, ha="right", fontsize=7)
    texts = [
        f"{name}: {label}" if name else label
        for name, label in zip(names, labels, strict=True)
    ]
    axis.set_yticks(range(len(texts)), texts, fontsize=7)
    axis.tick_params(length=0)
    for row, name in enumerate(names):
        if name and row:
            axis.axhline(row - 0.5, color=GREY, linewidth=2)
