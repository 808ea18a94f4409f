"""Charts of certificates."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from mi_nerfattack.evaluation.certificate import bound_within
from mi_nerfattack.report.plots.charts import BLUE, GREY, ORANGE, chart

_POINTS = 200  # of the curve


def plot_robustness(path: str | Path, document: Mapping[str, Any]) -> None:
    """Draw the bound on the chance of a departure, and attacks, against the radius.

    Args:
        path: PNG file.
        document: of `certify_robustness`.
    """
    settings, rows = document["settings"], document["rows"]
    radii = [row["radius"] for row in rows]
    along = np.linspace(0, 1.15 * max(radii), _POINTS)
    sd, confidence = settings["sd"], settings["confidence"]
    bound = [bound_within(document["chance_bound"], r, sd) for r in along.tolist()]
    chances = [document["chance"], *(row["attack_chance"] for row in rows)]
    ends = [document["chance_interval"], *(row["attack_interval"] for row in rows)]
    errors = np.abs(np.array(ends) - np.array(chances)[:, None]).T
    with chart(path, 4.2) as figure:
        axis = figure.subplots()
        axis.plot(along, bound, color=BLUE, label=f"bound, {100 * confidence:g} %")
        axis.fill_between(along, bound, 1, color=BLUE, alpha=0.08, linewidth=0)
        axis.errorbar(
            [0, *radii],
            chances,
            errors,
            fmt="o",
            color=ORANGE,
            capsize=3,
            label="best attack that was found; at 0 the original textures",
        )
        for row in rows:  # the gap is the result
            gap = row["attack_chance"], row["bound"]
            axis.plot([row["radius"]] * 2, gap, ":", color=GREY, linewidth=1)
        axis.set_ylim(-0.03, 1.03)
        axis.set_xlabel("radius of the change (sRGB, Euclidean over all coefficients)")
        axis.set_ylabel("chance of a departure")
        axis.set_title(
            f"{document['scenario']}, {settings['environment']}: under noise of "
            f"{sd:g} in each of {document['coefficients']} coefficients"
        )
        axis.grid(alpha=0.25)
        axis.legend(frameon=False, loc="upper left")


def plot_gradient(path: str | Path, document: Mapping[str, Any]) -> None:
    """Draw slope and cosine by horizon, and real changes against predicted ones.

    Args:
        path: PNG file.
        document: of `certify_gradient`.
    """
    rows = [row for row in document["rows"] if "slope" in row]
    time_s = np.array([row["time_s"] for row in rows])
    with chart(path, 3.9) as figure:
        left, right = figure.subplots(1, 2)
        for name, colour, shift in (("slope", BLUE, -1), ("cosine", ORANGE, 1)):
            values = np.array([row[name] for row in rows])
            ends = np.array([row[f"{name}_ci95"] for row in rows]).reshape(-1, 2)
            errors = np.abs(ends.T - values)
            at = time_s + shift * 0.006 * document["rows"][-1]["time_s"]
            left.errorbar(at, values, errors, fmt="o-", color=colour, label=name)
        left.axhline(1, color=GREY, linewidth=0.8)
        left.axhline(0, color=GREY, linewidth=0.8)
        left.set_xlabel("horizon (s)")
        left.set_title("1: the prediction is right", fontsize=9)
        left.legend(frameon=False)
        last = document["rows"][-1]
        right.plot(last["predicted"], last["real"], "o", color=BLUE, markersize=3)
        right.plot(
            [last["along_predicted"]],
            [last["along_real"]],
            "*",
            color=ORANGE,
            markersize=9,
            label="along the gradient",
        )
        right.axline((0, 0), slope=1, color=GREY, linewidth=0.8)
        right.set_xlabel("predicted change of the objective")
        right.set_ylabel("real change")
        right.set_title(f"the whole drive of {last['time_s']:g} s", fontsize=9)
        right.legend(frameon=False)
