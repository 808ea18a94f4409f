"""Methods of attack at equal numbers of rendered frames: a page in Markdown."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from bench.methods.tuning import METHODS, rows, settings_of
from bench.table2.page import flags, provenance, section
from bench.table2.rows import METHOD_HEADER, TITLES, interval, method_rows
from mi_nerfattack.experiment.sweep.summary import GRADIENT
from mi_nerfattack.rollout.drive import ATTACK
from mi_nerfattack.scenario.deployment import SURROGATE

_INTRODUCTION = """\
# Methods of attack at equal numbers of rendered frames

Three cars and three hydrants at natural size, attacked at once on three routes of the
bundled intersection. Each method has the setting that did best of three, at places that
are not compared ([`scenes/tuning.toml`](../../scenes/tuning.toml)); rule, places, seeds
and budgets of both sweeps were settled before their first results. A pass back counts
as many drives as it takes the time of, so searches without gradients drive more often.

Figures are mean distances from the lane's centre, metres: mean ± standard deviation
over attacks [95 % interval, BCa] (attacks); then how many of them have a wheel out of
the lane for 1 s, in the mean over their drives [95 % interval, Wilson, per cent].
Frames are those of an attack. The last column divides a method's error by the
gradient's at the same places: below 1, the gradient is better."""
_TUNING = """\
Mean error in the surrogate past one attack a route, metres, and its geometric mean over
the routes: the largest of a method is chosen, once all its settings are done."""
_AIM_HEADER = ["route", "method", "ratio", "places", "gradient above"]
_AIM = """\
The gradient above every other method on every route, at the places that both have: the
mean error of each other method in the surrogate, divided by the gradient's."""


def page(
    summary: Mapping[str, Any] | None,
    table: Sequence[Mapping[str, Any]],
    tuning: Mapping[str, Any],
    grid: Mapping[str, Any],
    compared: Mapping[str, Any],
    made: Mapping[str, Any],
) -> str:
    """Return the page.

    Args:
        summary: ``summary.json`` of the comparison; None before there is one.
        table: rows of its table, else those of the tuning.
        tuning: ``summary.json`` of the tuning.
        grid: of the tuning, ``scenes/tuning.toml``.
        compared: of the comparison, ``scenes/methods.toml``.
        made: date, machine and command, as of `bench.results.stamp`.
    """
    parts = [_INTRODUCTION]
    if summary is None:
        parts.append(flags(tuning, _cells(grid)))
    else:
        parts.append(flags(summary, _cells(compared)))
        aims = list(_aim_rows(summary))
        parts.append(section("What was aimed at", _AIM, _AIM_HEADER, aims))
        for environment, title in TITLES.items():
            own = list(method_rows(summary, environment, METHODS))
            if own:
                parts.append(section(title, "", METHOD_HEADER, own))
    names, routes = (
        [choice["name"] for choice in grid[axis]] for axis in ("methods", "routes")
    )
    settings = settings_of(tuning, names, routes)
    header = ["method", "setting", *routes, "geometric mean", ""]
    text = f"{_TUNING} {tuning['complete']} of {_cells(grid)} attacks are done."
    parts.append(section("Settings", text, header, rows(settings, routes)))
    commands = ["mi-nerfattack sweep scenes/tuning.toml -o TUNING"]
    if summary is not None:
        commands.append("mi-nerfattack sweep scenes/methods.toml -o FOLDER")
    commands.append(made["command"])
    attacks = (tuning if summary is None else summary)["attacks"]
    parts.append(provenance(commands, attacks, table, made))
    return "\n\n".join(parts) + "\n"


def _cells(grid: Mapping[str, Any]) -> int:
    return math.prod(len(grid[axis]) for axis in ("methods", "routes", "seeds"))


def _aim_rows(summary: Mapping[str, Any]) -> Iterator[Sequence[str]]:
    """Yield a row for each other method on each route, then on all."""
    for row in summary["comparisons"]:
        labels = row["environment"], row["other_method"], row["other_case"]
        effect = row["effect"]
        if labels == (SURROGATE, GRADIENT, ATTACK) and effect["ratio"] is not None:
            yield (
                row["route"] or "all",
                row["method"],
                f"{effect['ratio']:.2f}{interval(effect['ratio_ci95'])}",
                str(effect["attacks"]),
                "yes" if effect["ratio"] < 1 else "**no**",
            )
