"""The finding about the quality of the surrogate: attacks in good and poor fields."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import Any

import pandas as pd

from bench.studies.charts import draw_searches
from bench.studies.content import (
    ERROR,
    Finding,
    deployment_of,
    ends_cell,
    geometric_interval,
    interval_words,
)
from bench.studies.plan import ROOT
from mi_nerfattack.evaluation.summary import Interval
from mi_nerfattack.io import files
from mi_nerfattack.rollout.drive import ATTACK, OWN
from mi_nerfattack.scenario.deployment import SURROGATE

FIELDS = ROOT / "bench/fit_quality/fields"
#: The method that attacks in the bundled field.
BEST = "steps_12000"
_THREATS = (
    "An interval that contains 1 does not show that two fields are equally good.",
    "All fields are from the same 384 views with depth. A field from fewer views has "
    "other faults.",
)


def fit_quality(
    drives: pd.DataFrame, psnr: Mapping[str, float] | None = None
) -> Finding:
    """Compare attacks in each field with those in the bundled one, in the deployment.

    Args:
        drives: of the grid bench/fit_quality.toml; a method is a field.
        psnr: by method, dB; by default the mean over the routes of `FIELDS`.
    """
    where = deployment_of(drives)
    inside, deployed, own = (
        _by_place(drives, environment, case)
        for environment, case in (
            (SURROGATE, ATTACK),
            (where, ATTACK),
            (SURROGATE, OWN),
        )
    )
    out, counts = (
        _by_place(drives, where, ATTACK, "departed", statistic)
        for statistic in ("sum", "count")
    )
    names = list(deployed.index)
    psnr = {name: _psnr(name) for name in names} if psnr is None else psnr
    logs = deployed.map(math.log)
    transfer, gains = logs - inside.map(math.log), logs - logs.loc[BEST]
    ratios = {name: _mean(gains.loc[name]) for name in names if name != BEST}
    shares = {name: _mean(transfer.loc[name]) for name in names}
    worst = min(ratios, key=lambda name: psnr[name])
    rows = [
        [
            *(f"`{name}`", f"{psnr[name]:.1f}"),
            *(f"{errors.loc[name].mean():.3f}" for errors in (own, inside, deployed)),
            *_cells(shares[name]),
            *_cells(ratios.get(name)),
            f"{out.loc[name].sum():.0f} of {counts.loc[name].sum():.0f}",
        ]
        for name in names
    ]
    listed = ", ".join(f"{share:#.2g} (`{n}`)" for n, (share, _) in shares.items())
    errors = deployed.set_axis([f"{n}, {psnr[n]:.1f} dB" for n in names])
    errors.columns = [f"{route} {seed}" for route, seed in deployed.columns]
    weaker = int((gains.loc[worst] < 0).sum())
    return Finding(
        title=_title(
            len(_below(ratios)), len(ratios), ratios[worst][0], psnr=psnr[worst]
        ),
        sentences=(
            "`steps_N` is the field of the scene after N steps of its fit. In the "
            f"path-traced scene, attacks from `{worst}` have {ratios[worst][0]:.2f} "
            f"times the error of attacks from `{BEST}` (geometric mean over "
            f"{deployed.shape[1]} places, {interval_words(ratios[worst][1], 2)}). They "
            f"are weaker at {weaker} places.",
            f"Of its error in the field, an attack keeps {listed} in the path-traced "
            "scene. The interval of this share lies below 1 for "
            f"{_listed(_below(shares)) or 'none of them'}.",
            _rule(ratios)
            + " Metres are arithmetic means and ratios are geometric ones, so one "
            "large error can reverse their order.",
        ),
        head=[
            *("field", "PSNR along the routes (dB)"),
            *("original texture, in the field (m)", "attack, in the field (m)"),
            *(f"attack, `{where}` (m)", "kept of the field's", "95 % interval"),
            *(f"ratio to `{BEST}`", "95 % interval"),
            f"drives out of the lane, `{where}`",
        ],
        rows=rows,
        draw=lambda figure: draw_searches(figure, errors),
        pandas="attacks = drives.query(\"case == 'attack'\")\n"
        'print(attacks.pivot_table("cross_track_mean_m", "method", "environment"))',
        threats=(*_threats(drives, out), *_THREATS),
    )


def _title(poor: int, fields: int, ratio: float, psnr: float) -> str:
    """Return the title; `ratio` and `psnr` (dB) are those of the poorest field."""
    if not poor:
        return (
            f"Not shown that a poorer field makes weaker attacks: {ratio:.2f} times "
            f"the error at {psnr:.1f} dB"
        )
    return (
        f"Attacks from {poor} of {fields} poorer fields are weaker in the path-traced "
        f"scene: {ratio:.2f} times at {psnr:.1f} dB"
    )


def _rule(ratios: Mapping[str, tuple[float, Interval]]) -> str:
    """Say for which fields the rule of bench/fit_quality.toml holds."""
    has_intervals = any(ends is not None for _, ends in ratios.values())
    listed = _listed(_below(ratios)) or "none of them"
    return (
        f"By the rule, a field is too poor if the interval of the ratio to `{BEST}` in "
        "the path-traced scene lies below 1. "
        + (f"This holds for {listed}." if has_intervals else "None has one yet.")
    )


def _below(means: Mapping[str, tuple[float, Interval]]) -> list[str]:
    """Return the fields whose interval of a geometric mean lies below 1."""
    return [name for name, (_, ends) in means.items() if ends and ends[1] < 1]


def _listed(names: list[str]) -> str:
    return ", ".join(f"`{name}`" for name in names)


def _threats(drives: pd.DataFrame, out: Any) -> Iterator[str]:
    """Yield where cars leave the lane.

    Args:
        drives: all.
        out: by method and place, drives out with the attack in the deployment.
    """
    own = _by_place(drives, SURROGATE, OWN, "departed", "sum")
    failed = {str(name): places[places > 0] for name, places in own.iterrows()}
    for name, places in failed.items():
        if len(places):
            at = " and ".join(f"{route} {seed}" for route, seed in places.index)
            yield (
                f"In the field of `{name}`, the policy leaves its lane with the "
                f"original textures, too, at {at} ({places.sum():.0f} drives). `check` "
                "refuses an attack there."
            )
    at = [
        f"{route} {seed} (`{'`, `'.join(column[column > 0].index)}`)"
        for (route, seed), column in out.items()
        if column.any() and not column[BEST]
    ]
    if at:
        yield (
            "Few places decide about the means: there, the car leaves the lane with "
            f"attacks from poorer fields, but not from `{BEST}`: "
            f"{' and '.join(at)}. The search is local, so another field leads it to "
            "another texture."
        )


def _by_place(
    drives: pd.DataFrame,
    environment: str,
    case: str,
    value: str = ERROR,
    statistic: Any = "mean",
) -> Any:
    """Return a statistic of a column by method and place; by default the mean error."""
    own = drives[(drives["environment"] == environment) & (drives["case"] == case)]
    return own.pivot_table(
        value, "method", ["route", "seed"], aggfunc=statistic, sort=False
    )


def _mean(logs: Any) -> tuple[float, Interval]:
    """Return the geometric mean of the places that exist, and its interval."""
    known = logs.dropna().to_numpy()
    return math.exp(known.mean()), geometric_interval(known)


def _cells(ratio: tuple[float, Interval] | None) -> list[str]:
    """Return a ratio and its interval as cells; of the bundled field, itself."""
    return ["1", "–"] if ratio is None else [f"{ratio[0]:.2f}", ends_cell(ratio[1], 2)]


def _psnr(method: str) -> float:
    """Return the mean PSNR of a field's frames along the routes, dB."""
    routes = files.read_json(FIELDS / method / "metrics.json")["routes"].values()
    return sum(route["psnr_mean_db"] for route in routes) / len(routes)
