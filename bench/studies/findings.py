"""The findings of the studies, computed from their committed tables.

A title follows the rules of docs/results/findings/index.md: one side is farther from
the lane centre than another only if it is farther at so many places that Wilson's 95 %
interval of their share lies above one half. A study with missing attacks claims
nothing.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from typing import Any

import pandas as pd

from bench.studies.attack import CASES, attack, country, is_farther, place_name
from bench.studies.charts import (
    draw_ratios,
    draw_searches,
    draw_shares,
)
from bench.studies.content import (
    ERROR,
    Finding,
    ends_cell,
    interval_words,
    metres,
    share_words,
)
from bench.studies.fit_quality import fit_quality
from bench.studies.limits import limits
from bench.studies.plan import Study, state
from bench.studies.repaired import repaired
from bench.studies.transfer import transfer
from bench.studies.vary import light, vary_parts
from mi_nerfattack.drives.table import records, with_starts
from mi_nerfattack.evaluation.pairs import compare
from mi_nerfattack.evaluation.summary import summary
from mi_nerfattack.experiment.sweep.summary import GRADIENT
from mi_nerfattack.rollout.drive import ATTACK, BEST_RANDOM, RANDOM
from mi_nerfattack.scenario.deployment import SURROGATE

_BY_GRADIENT = ("attached", "open_loop", "single_frame")
FLAT_PLACES, FLAT_AIM = 30, 0.6  # of bench/flat.toml: places, share of drives
EQUAL = 0.8  # of the gradient's frames, from which on a search has an equal budget

_OF_SEARCHES = (
    "attacks = drives.query(\"case == 'attack' and environment == 'surrogate'\")\n"
    'print(attacks.groupby(["method", "route"]).cross_track_mean_m.mean().unstack())'
)


def finding(study: Study) -> Finding | None:
    """Return the finding of a study; None if it has no page or no rows."""
    table = study.read()
    if study.finding is None or table is None:
        return None
    if study.grid is not None:
        table = with_starts(table[table["status"] == "complete"], "cell")
        table["scenario"] = table["route"] + ", " + table["objects"]
    question, make = FINDINGS[study.finding]
    made, one = make(table), state(study, compare=False)
    if one.done == one.wanted:
        return made
    exist = f"{one.done} of {one.wanted} {study.units} exist"
    return replace(made, title=f"Not yet known {question}: {exist}")


def gradient(drives: pd.DataFrame) -> Finding:
    """Compare the gradient with each other search at an equal number of frames."""
    own = _attacks(drives)
    sides = {str(name): side for name, side in own.groupby("method", sort=False)}
    base = sides.pop(GRADIENT)
    effects = {name: compare(base, side, ERROR) for name, side in sides.items()}
    farther = {name: is_farther(base, side) for name, side in sides.items()}
    frames = own.groupby("method", sort=False)["frames"].mean()
    fair = {name: effects[name] for name in effects if _is_equal(frames, name)}
    without = [name for name in fair if name not in _BY_GRADIENT]
    others = [name for name in fair if name in _BY_GRADIENT]
    better, also = (
        sum(farther[name][1] for name in names) for names in (without, others)
    )
    title = (
        f"The gradient moves the car farther than {better} of {len(without)} searches "
        "without a gradient at equal cost"
    )
    close, nearest = min(
        ((name, fair[name]) for name in without or fair),
        key=lambda item: item[1].ratio or 0.0,
    )
    closest = f"Of the searches {'without a gradient' if without else 'at equal cost'}"
    wins = [farther[name][0] for name in fair]
    there = _deployed(drives)
    head = [GRADIENT, f"{frames[GRADIENT]:.0f}", f"{nearest.one:.3f}"]
    rows = [[*head, _metres_cell(there, GRADIENT), *(5 * ["–"])]] + [
        [
            *(name, f"{frames[name]:.0f}", f"{effect.other:.3f}"),
            _metres_cell(there, name),
            *(f"{effect.ratio:.2f}", ends_cell(effect.ratio_ci95, 2)),
            f"{farther[name][0]}/{effect.attacks}",
            *(metres(effect.difference), metres(effect.spread)),
        ]
        for name, effect in effects.items()
    ]
    return Finding(
        title=title,
        sentences=(
            f"Over {nearest.attacks} places, the gradient moves the car "
            f"{nearest.one:.2f} m from the lane centre on average in the surrogate, "
            f"and is farther than {also} of {len(others)} other searches by gradient "
            f"at equal cost ({', '.join(f'`{name}`' for name in others)}).",
            f"{closest}, `{close}` is the closest: the "
            f"gradient moves the car {nearest.ratio:.2f} times as far "
            f"({interval_words(nearest.ratio_ci95, 2)}).",
            f"Compared with each of the {len(fair)} searches at equal cost, the "
            "gradient is farther at "
            f"{min(wins)} to {max(wins)} of {nearest.attacks} places.",
        ),
        head=[
            *("search", "frames", "mean error (m)", "in `mitsuba` (m)"),
            "gradient to search",
            *("95 % interval", "gradient farther", "difference", "its spread"),
        ],
        rows=rows,
        draw=lambda figure: draw_ratios(
            figure, {n: (e.ratio or 0.0, e.ratio_ci95) for n, e in effects.items()}
        ),
        pandas=_OF_SEARCHES,
        threats=tuple(_threats_to_gradient(own, frames, list(fair))),
    )


def _threats_to_gradient(
    own: pd.DataFrame, frames: pd.Series, fair: list[str]
) -> Iterator[str]:
    """Yield what speaks against the finding about the gradient.

    Args:
        own: drives with the attack in the surrogate.
        frames: mean number by search.
        fair: searches of equal cost.
    """
    for name in own["method"].unique():
        if name not in (GRADIENT, *fair):
            yield (
                f"`{name}` cost {frames[name]:.0f} frames and the gradient "
                f"{frames[GRADIENT]:.0f}, so the title does not count this search."
            )
    by = ["scenario", "seed", "method"]
    costs = own.groupby(by)["frames"].mean().unstack()
    for name in fair:
        cheap = costs[name] < EQUAL * costs[GRADIENT]
        if cheap.any():
            yield (
                f"`{name}` has an equal cost on average only: at {cheap.sum()} of "
                f"{len(costs)} places, it rendered less than {EQUAL} times the frames "
                "of the gradient."
            )
    places = own.groupby(by)[ERROR].mean().unstack()
    behind = places[places[GRADIENT] < places[fair].max(axis=1)]
    for place, errors in behind.iterrows():
        error = errors[GRADIENT]
        names = ", ".join(f"`{name}`" for name in fair if errors[name] > error)
        yield (
            f"At {place_name(place)}, the gradient has {error:.2f} m, and these "
            f"searches have more: {names}."
        )


def searches(drives: pd.DataFrame) -> Finding:
    """Rank the searches by the geometric mean of their attacks over the routes.

    The grid has one place per route, so the rank alone decides nothing.
    """
    own = _attacks(drives)
    errors = own.groupby(["method", "route"], sort=False)[ERROR].mean().unstack()
    rank = errors.dropna().map(math.log).mean(axis=1).map(math.exp)
    best = str(rank.idxmax())
    title = "Not yet known which search by gradient is best: one place per route"
    spread = own.groupby("cell")[ERROR].std()
    return Finding(
        title=title,
        sentences=(
            f"Of the {len(rank)} searches with an attack on each route of the table, "
            f"`{best}` has the largest geometric mean of the error in the surrogate, "
            f"{rank.max():.2f} m.",
            "There is one place per route, so the table has no intervals and the order "
            "is uncertain.",
            "Between the drives of one attack, the error has a standard deviation of "
            f"{spread.mean():.3f} m on average, and of {spread.median():.3f} m in the "
            "median.",
        ),
        head=["search", *(f"{route}, surrogate (m)" for route in errors.columns)],
        rows=[
            [str(name), *("–" if pd.isna(x) else f"{x:.3f}" for x in line)]
            for name, line in zip(errors.index, errors.to_numpy(), strict=True)
        ],
        draw=lambda figure: draw_searches(figure, errors),
        pandas=_OF_SEARCHES,
    )


def flat(drives: pd.DataFrame) -> Finding:
    """Count the drives that leave the lane, as bench/flat.toml says."""
    own = drives[drives["environment"] == "built_in"]
    left, count = (
        own.groupby("case")["departed"].agg(statistic).astype(int)
        for statistic in ("sum", "count")
    )
    shares = {name: left[c] / count[c] for c, name in CASES.items() if c in left}
    places = own[own["case"] == ATTACK].groupby("cell")["departed"].any()
    out, all_places = int(places.sum()), len(places)
    missing = 2 * (FLAT_PLACES - all_places)  # two drives at each
    most = (left[ATTACK] + missing) / (count[ATTACK] + missing)
    lost = (
        " We missed this aim."
        if not missing
        else (f" At most {100 * most:.0f} % are possible now, so we missed this aim.")
    )
    percent = f"{100 * shares[CASES[ATTACK]]:.0f} %"
    title = f"Flat objects send the car out of its lane in {percent} of the drives"
    kinds = summary(own, ["objects", "case"], ["cell"])
    by_case = dict(list(own.groupby("case")))
    attacks, randoms = by_case[ATTACK], by_case[BEST_RANDOM]
    farther, _ = is_farther(attacks, randoms)
    effect = compare(attacks, randoms, ERROR)
    return Finding(
        title=title,
        sentences=(
            f"With the attack, {left[ATTACK]} of {count[ATTACK]} drives leave the lane "
            "in the path-traced scene, where its sun and sky light the object. "
            f"The drives that leave it are at {out} of {all_places} places (share: "
            f"{share_words(out, all_places)}). {_by_environment(drives)}",
            f"With random textures, {left[RANDOM]} of {count[RANDOM]} drives leave the "
            "lane. The attack moves the car farther than the worst random texture at "
            f"{farther} of {all_places} places (ratio of the means {effect.ratio:.2f}, "
            f"{interval_words(effect.ratio_ci95, 2)}).",
            "The aim that we set before the first result is 60 % of the drives with "
            "the attack, and none with random textures."
            + (lost if most < FLAT_AIM else ""),
        ),
        head=[
            "object",
            "texture",
            "mean error, `built_in` (m)",
            "drives out of the lane",
        ],
        rows=[
            [
                *(row["objects"], CASES[row["case"]], f"{row[ERROR]:.3f}"),
                f"{row['drives_departed']}/{row['drives']}",
            ]
            for row in records(kinds)
            if row["case"] in CASES
        ],
        draw=lambda figure: draw_shares(
            figure, shares, "share of drives that leave the lane"
        ),
        pandas='lit = drives[drives.environment == "built_in"]\n'
        'print(lit.groupby(["objects", "case"]).departed.mean())',
        threats=(_routes(own),),
    )


def _by_environment(drives: pd.DataFrame) -> str:
    """Say in which environment flat objects lose their effect."""
    attacks = drives[drives["case"] == ATTACK].groupby("environment", sort=False)
    left, means = attacks["departed"].agg(["sum", "size"]), attacks[ERROR].mean()
    counts = ", ".join(
        f"`{name}` {count} of {n} ({means[name]:.2f} m)"
        for name, count, n in left.itertuples()
    )
    return (
        "By environment, these drives with the attack leave the lane (with the mean "
        f"error): {counts}."
    )


def _routes(own: pd.DataFrame) -> str:
    """Say how many places of each kind and route the rows have."""
    by = ["objects", "route"]
    places: Any = own.groupby(by, sort=False)["cell"].nunique()
    counts = ", ".join(
        f"{kind} on `{route}` {count}" for (kind, route), count in places.items()
    )
    return (
        f"The places so far: {counts}. Places are in the order of the grid, so missing "
        "ones are not random. Another route may give another share."
    )


#: By the name of the page: what is not known while attacks are missing, and the rest.
FINDINGS: dict[str, tuple[str, Callable[[pd.DataFrame], Finding]]] = {
    "attack": ("whether the attack works", attack),
    "gradient": ("whether the gradient is needed", gradient),
    "searches": ("which search by gradient is best", searches),
    "flat": ("whether flat objects mislead the policy", flat),
    "transfer": ("whether attacks transfer", transfer),
    "light": ("whether attacks survive other light and wheels", light),
    "parts": ("which part of `vary` helps", vary_parts),
    "repaired": ("whether the policy is repaired", repaired),
    "limits": ("what limits attacks", limits),
    "surrogate": ("how good the surrogate must be", fit_quality),
    "country": ("whether the attack works at a second place", country),
}


def _attacks(drives: pd.DataFrame) -> pd.DataFrame:
    """Return the drives with the attack in the surrogate."""
    return drives[(drives["environment"] == SURROGATE) & (drives["case"] == ATTACK)]


def _deployed(drives: pd.DataFrame) -> dict[str, float]:
    """Return the mean errors with the attack where no search drove, by search."""
    own = drives[(drives["environment"] != SURROGATE) & (drives["case"] == ATTACK)]
    return {str(name): x for name, x in own.groupby("method")[ERROR].mean().items()}


def _metres_cell(errors: Mapping[str, float], name: str) -> str:
    return f"{errors[name]:.3f}" if name in errors else "–"


def _is_equal(frames: pd.Series, name: str) -> bool:
    """Whether a search rendered about as many frames as the gradient."""
    return bool(frames[name] >= EQUAL * frames[GRADIENT])
