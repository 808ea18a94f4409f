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
            *([0, *radii], chances, errors),
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
        axis.legend(frameon=False)
