"""The finding about the attack, at both places, and how two sides are compared."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import pandas as pd

from bench.studies.charts import draw_places
from bench.studies.content import (
    ERROR,
    HALF,
    Finding,
    deployment_of,
    ends_cell,
    geometric_interval,
    interval_words,
    metres,
    share_words,
)
from mi_nerfattack.drives.table import records
from mi_nerfattack.evaluation.pairs import Effect, compare
from mi_nerfattack.evaluation.summary import share_interval, summary
from mi_nerfattack.rollout.drive import ATTACK, BEST_RANDOM, NO_OBJECT, OWN, RANDOM
from mi_nerfattack.scenario.deployment import SURROGATE

#: Names of the cases in tables and charts.
CASES = {
    NO_OBJECT: "no object",
    OWN: "original texture",
    RANDOM: "random textures",
    BEST_RANDOM: "worst random texture",
    ATTACK: "attack",
}


def is_farther(one: pd.DataFrame, other: pd.DataFrame) -> tuple[int, bool]:
    """Count the places where one side's mean error is larger than the other's.

    Args:
        one: drives of one environment, case and method.
        other: as `one`, at the same places.

    Returns:
        The number of places, and whether Wilson's interval of their share lies above
        `HALF`.
    """
    means = by_place(one)
    count = int((means > by_place(other).reindex(means.index)).sum())
    return count, is_majority(count, len(means))


def is_majority(count: int, places: int) -> bool:
    """Whether Wilson's interval of a share of the places lies above `HALF`."""
    ends = share_interval(count, places)
    return ends is not None and ends[0] > HALF


def attack(drives: pd.DataFrame) -> Finding:
    """Compare the attack with the worst random texture."""
    where = deployment_of(drives)
    own = drives[drives["environment"] == where]
    by_case = {case: own[own["case"] == case] for case in CASES}
    attacks, randoms = by_case[ATTACK], by_case[BEST_RANDOM]
    effect = compare(attacks, randoms, ERROR)
    count, is_shown = is_farther(attacks, randoms)
    places = f"{count} of {effect.attacks} places"
    title = (
        f"The attack moves the car farther than the worst random texture at {places}"
    )
    if not is_shown:
        title = f"The attack is not shown to be better than random textures: {places}"
    groups = summary(drives, ["environment", "case"], ["cell"])
    rows = [
        [
            *(CASES[row["case"]], row["environment"], f"{row[ERROR]:.3f}"),
            ends_cell(row["cross_track_mean_ci95_m"]),
            f"{row['attacks_out']}/{row['attacks']}",
        ]
        for row in records(groups)
        if row["case"] in CASES
    ]
    out = int(summary(by_case[ATTACK], ["case"], ["cell"])["attacks_out"].iloc[0])
    drawn = {case: name for case, name in CASES.items() if case != OWN}
    errors = pd.DataFrame(
        {name: by_place(by_case[case]) for case, name in drawn.items()}
    )
    errors.index = [place_name(place) for place in errors.index]
    logs = np.log((by_place(attacks) / by_place(randoms)).to_numpy())
    ratio, ratio_ends = float(np.exp(logs.mean())), geometric_interval(logs)
    return Finding(
        title=title,
        sentences=(
            f"The search never used the environment `{where}`. There, the attack moves "
            f"the car {effect.one:.3f} m from the lane centre on average, and the "
            f"worst random texture {effect.other:.3f} m (ratio {effect.ratio:.1f}, "
            f"{interval_words(effect.ratio_ci95, 1)}).",
            f"The attack is farther at {places} (share: "
            f"{share_words(count, effect.attacks)}). The ratio has a geometric mean of "
            f"{ratio:.1f} over the places ({interval_words(ratio_ends, 1)}). At "
            f"{out} of {effect.attacks} places, a wheel is out of the lane for 1 s or "
            "more with the attack, on average over the drives (share: "
            f"{share_words(out, effect.attacks)}).",
            f"The difference is {effect.difference:.2f} m on average "
            f"({interval_words(effect.difference_ci95, 2)}). Between the places of one "
            f"route, it has a standard deviation of {metres(effect.spread)}. The "
            f"medians over the places are {by_place(attacks).median():.2f} m with the "
            f"attack and {by_place(randoms).median():.2f} m with the worst random "
            "texture.",
        ),
        head=[
            *("texture", "environment", "mean error (m)", "95 % interval"),
            "places with a wheel out for 1 s",
        ],
        rows=rows,
        draw=lambda figure: draw_places(figure, errors),
        pandas=f'deployed = drives[drives.environment == "{where}"]\n'
        'print(deployed.groupby(["route", "case"]).cross_track_mean_m.mean())',
        threats=tuple(_threats_to_attack(by_case, effect)),
    )


def country(drives: pd.DataFrame) -> Finding:
    """Do the same as `attack` at the second place; say how many cars leave the lane."""
    made, deployed = attack(drives), drives["environment"] != SURROGATE
    out = drives[deployed & (drives["case"] == ATTACK)]["departed"]
    lane = f"and out of its lane in {out.sum()} of {len(out)} drives"
    lane = lane if out.any() else "but never out of its lane"
    title = made.title.replace(" than the worst random texture", "")
    title = f"On a country road, {title[0].lower()}{title[1:]}, {lane}"
    return replace(made, title=title)


def _threats_to_attack(
    by_case: Mapping[str, pd.DataFrame], effect: Effect
) -> Iterator[str]:
    """Yield what speaks against the finding about the attack.

    Args:
        by_case: drives in the deployment environment.
        effect: attack and worst random texture, compared.
    """
    if effect.ratio_ci95 is not None and effect.ratio_ci95[0] <= 1:
        yield (
            "The interval of the ratio of the means contains 1, because the errors of "
            "the places differ a lot. So the title counts places."
        )
    own, random = by_case[ATTACK], by_case[BEST_RANDOM]
    cost, most = random["frames"].max(), own["frames"].max()
    yield (
        "The worst random texture is the one that the search's objective ranks first "
        f"in the surrogate. The random textures of a place cost {cost:,} frames, and "
        f"the attack up to {most:,}: they had at least {100 * cost // most} % of its "
        "budget. At the places of the intersection, [another study](gradient.md) "
        "compares at equal cost."
    )
    left = own.groupby("route", sort=False)["departed"].agg(["sum", "size"])
    means, others = (x.groupby("route")[ERROR].mean() for x in (own, random))
    counts = ", ".join(
        f"{route} {count} of {n} and {means[route] / others[route]:.1f}"
        for route, count, n in left.itertuples()
    )
    yield (
        "The routes differ. Drives with the attack that leave the lane, and ratio of "
        f"the mean errors: {counts}."
    )
    means, others = (by_place(one) for one in (own, random))
    far: Any = means.idxmax()
    drives = own.set_index(["scenario", "seed"]).loc[[far]][ERROR]
    mean_m, random_m = means.drop(far).mean(), others.drop(far).mean()
    yield (
        f"One place, {place_name(far)}, has a mean error of {means[far]:.2f} m: "
        f"{' and '.join(f'{error:.2f}' for error in drives)} m from its starts. Over "
        f"the other places, the means are {mean_m:.2f} m with the attack and "
        f"{random_m:.2f} m with the worst random texture (ratio "
        f"{mean_m / random_m:.1f})."
    )


def place_name(place: Any) -> str:
    """Return a short name of a scenario and its seed: the route and the seed."""
    scenario, seed = place
    return f"{str(scenario).split(',')[0]} {seed}"


def by_place(drives: pd.DataFrame) -> pd.Series:
    """Return the mean error by scenario and seed, metres."""
    return drives.groupby(["scenario", "seed"], sort=False)[ERROR].mean()
