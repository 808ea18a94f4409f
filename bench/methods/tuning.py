"""Which setting of each method stands in the comparison."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from scipy.stats import gmean

from mi_nerfattack.rollout.drive import ATTACK
from mi_nerfattack.scenario.deployment import SURROGATE

#: Methods of the grids under scenes/; a setting's name begins with its method's.
METHODS = (
    *("gradient", "attached", "open_loop", "single_frame"),
    *("random", "blocks", "cma_es", "bayesian"),
)


@dataclass(frozen=True)
class Setting:
    """A setting of a method.

    Attributes:
        method: one of `METHODS`.
        name: in the grid.
        errors: mean distance from the lane's centre past the attacks by route, metres.
        score: geometric mean over the routes; None while one is missing.
    """

    method: str
    name: str
    errors: Mapping[str, float]
    score: float | None


def settings_of(
    summary: Mapping[str, Any], names: Iterable[str], routes: Sequence[str]
) -> list[Setting]:
    """Return the settings of a sweep, by method.

    Args:
        summary: ``summary.json``, of the sweep as far as it is done; attacks are judged
            in the surrogate.
        names: of all settings, in the grid's order.
        routes: names of all.
    """
    found: dict[str, dict[str, float]] = {name: {} for name in names}
    for group in summary["groups"]:
        place = group["environment"], group["case"]
        if place == (SURROGATE, ATTACK) and group["route"] is not None:
            found[group["method"]][group["route"]] = group["cross_track_mean_m"]
    return [
        Setting(method, name, errors, _score(errors, routes))
        for method in METHODS
        for name, errors in found.items()
        if name.startswith(f"{method}_")
    ]


def chosen(settings: Sequence[Setting]) -> dict[str, Setting]:
    """Return the best setting of each method whose settings are all done."""
    found: dict[str, Setting] = {}
    for method in METHODS:
        scores = [
            (setting.score, setting) for setting in settings if setting.method == method
        ]
        known = [(score, setting) for score, setting in scores if score is not None]
        if known and len(known) == len(scores):
            found[method] = max(known, key=lambda pair: pair[0])[1]
    return found


def rows(settings: Sequence[Setting], routes: Sequence[str]) -> Iterator[list[str]]:
    """Yield a row of text a setting: its errors, score, and whether it is chosen."""
    best = chosen(settings)
    for setting in settings:
        errors = (setting.errors.get(route) for route in routes)
        is_best = best.get(setting.method) is setting
        yield [
            setting.method,
            setting.name,
            *("" if error is None else f"{error:.3f}" for error in errors),
            "" if setting.score is None else f"{setting.score:.3f}",
            "chosen" if is_best else "",
        ]


def _score(errors: Mapping[str, float], routes: Sequence[str]) -> float | None:
    known = [errors[route] for route in routes if route in errors]
    return float(gmean(known)) if len(known) == len(routes) else None
