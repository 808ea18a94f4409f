"""Tables of certificates, made of documents as they are in files."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from mi_nerfattack.report.columns import Column, Table


def robustness_table(document: Mapping[str, Any]) -> Table:
    """Return bound, attack and gap for each radius; the first row is the centre."""
    settings = document["settings"]
    percent = f"{100 * settings['confidence']:g} %"
    centre = {
        "radius": 0.0,
        "bound": document["chance_bound"],
        "attack_departed": document["departed"],
        "attack_drives": settings["runs"],
        "attack_chance": document["chance"],
        "attack_interval": document["chance_interval"],
        "gap": document["chance_bound"] - document["chance"],
    }
    attacked = ("attack_departed", "attack_drives", "")
    plain = ("plain_departed", "plain_drives", "")
    figures = [
        Column(f"bound ({percent})", "bound", short="bound"),
        Column("attack", "attack_chance"),
        Column(f"{percent} of the attack", "attack_interval", short="interval"),
        Column("drives out", attacked),
        Column("gap", "gap"),
        Column("out without noise", plain, short="no noise"),
    ]
    title = (
        f"Chance of a departure under noise of {settings['sd']:g} in each of "
        f"{document['coefficients']} coefficients, {settings['environment']}"
    )
    label = Column("radius", "radius")
    return Table(title, [label], figures, records=[centre, *document["rows"]])


def gradient_table(document: Mapping[str, Any]) -> Table:
    """Return slope and cosine for each horizon."""
    figures = [
        Column("slope", "slope"),
        Column("95 % of the slope", "slope_ci95", short="95 %"),
        Column("cosine", "cosine"),
        Column("95 % of the cosine", "cosine_ci95", short="95 %"),
        Column("along the gradient", _along, short="along"),
        Column("true", lambda row: _TRUE[row["is_true"]]),
    ]
    title = f"Real by predicted changes along {document['directions']} directions"
    label = Column("horizon (s)", lambda row: f"{row['time_s']:g}")
    return Table(title, [label], figures, records=document["rows"])


#: A dash where neither the gradient nor the drives change the objective.
_TRUE = {True: "yes", False: "no", None: "–"}


def _along(row: Mapping[str, Any]) -> float | None:
    """Return the real change along the gradient in units of the predicted one."""
    predicted = row["along_predicted"]
    return row["along_real"] / predicted if predicted else None
