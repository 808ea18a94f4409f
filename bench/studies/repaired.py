"""The finding about retraining: what is left of old, held-out and adaptive attacks."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import pandas as pd

from bench.studies.charts import draw_ratios
from bench.studies.content import (
    ERROR,
    Finding,
    deployment_of,
    ends_cell,
    geometric_interval,
    interval_words,
    with_labels,
)
from mi_nerfattack.evaluation.summary import Interval
from mi_nerfattack.experiment.retrain.compare import (
    ADAPTIVE,
    AFTER,
    BEFORE,
    HELD_OUT,
    OLD,
)
from mi_nerfattack.rollout.drive import ATTACK, NO_OBJECT
from mi_nerfattack.scenario.deployment import SURROGATE

#: Names of the groups, in sentences.
GROUPS = {OLD: "old", HELD_OUT: "held-out", ADAPTIVE: "adaptive"}
#: Of bench/repair.toml: most that the errors with old attacks and without objects may
#: be after the retraining, as multiples of the error without objects before it.
AIMS = {ATTACK: 1.2, NO_OBJECT: 1.1}


_ADAPTIVE = (
    "In the rows of adaptive attacks, 'before' is the old policy near the old attacks, "
    "and 'after' is the new policy near the new attacks. Both have equal places and "
    "budgets."
)


def repaired(drives: pd.DataFrame) -> Finding:
    """Compare drives of the policy before and after the retraining, paired by place.

    Args:
        drives: ``NAME-retrain.csv`` of ``mi-nerfattack retrain``.
    """
    where = deployment_of(drives)
    groups = {g: name for g, name in GROUPS.items() if g in set(drives["group"])}
    worlds = (SURROGATE, where)
    compared = {(g, e): _compare(drives, g, e) for g in groups for e in worlds}
    left = {g: sum(compared[g, e].out[1] for e in worlds) for g in groups}
    counts = {g: sum(compared[g, e].drives for e in worlds) for g in groups}
    listed = (f"{left[g]} of {counts[g]} ({name})" for g, name in groups.items())
    ratios = (
        f"It is {one.ratio:.2f} near {name} attacks ({interval_words(one.ends, 2)})."
        for g, name in groups.items()
        for one in [compared[g, where]]
    )
    errors = _aimed(drives)
    return Finding(
        title=_title({group: not count for group, count in left.items()}),
        sentences=(
            "A group of attacks counts as repaired if no drive with one of them leaves "
            f"the lane, in the surrogate and in `{where}`. With the new policy, these "
            f"drives leave the lane: {', '.join(listed)}.",
            f"The ratio is the error of the new policy in `{where}`, divided by the "
            f"error of the old one (geometric mean). {' '.join(ratios)}",
            "The two aims are multiples of the error that the old policy has without "
            f"objects. Near old attacks, the new policy has {errors[ATTACK]:.2f} times "
            f"this error in the worse environment ({_aim(ATTACK, errors)}). Without "
            f"objects, it has {errors[NO_OBJECT]:.2f} times this error "
            f"({_aim(NO_OBJECT, errors)}).",
        ),
        head=[
            *("attacks", "environment", "error before (m)", "after (m)", "ratio"),
            *("95 % interval", "drives out before", "after"),
        ],
        rows=[
            [f"{GROUPS[group]} ({one.places})", f"`{environment}`", *one.cells()]
            for (group, environment), one in compared.items()
        ],
        draw=lambda figure: draw_ratios(
            figure,
            {f"{GROUPS[g]}, {e}": (x.ratio, x.ends) for (g, e), x in compared.items()},
        ),
        pandas="own = drives.query(\"case == 'attack'\")\n"
        'print(own.groupby(["group", "environment", "policy"]).departed.mean())',
        threats=(
            (_ADAPTIVE, _uncertain(compared[ADAPTIVE, where], where))
            if ADAPTIVE in groups
            else ()
        ),
    )


@dataclass(frozen=True)
class _Compared:
    """Drives with attacks of one group in one environment, before and after.

    Attributes:
        places: number of attacks.
        means: errors before and after, metres.
        ratio: of both errors, geometric mean over the places.
        ends: of its interval.
        out: drives that leave the lane, before and after.
        places_out: places with such drives, before and after.
        drives: of each policy.
    """

    places: int
    means: tuple[float, float]
    ratio: float
    ends: Interval
    out: tuple[int, int]
    places_out: tuple[int, int]
    drives: int

    def cells(self) -> list[str]:
        """Return a row of the table, from the errors on."""
        means = [f"{mean:.3f}" for mean in self.means]
        out = [f"{count}/{self.drives}" for count in self.out]
        ratio = [f"{self.ratio:.2f}", ends_cell(self.ends, 2)]
        return [*means, *ratio, *out]


def _compare(drives: pd.DataFrame, group: str, environment: str) -> _Compared:
    """Compare both policies, paired by place.

    An adaptive attack is another one than the old attack at its place.
    """
    own = with_labels(drives[drives["case"] == ATTACK])
    own = own[(own["group"] == group) & (own["environment"] == environment)]
    place = ["route", "seed"] if group == ADAPTIVE else ["attack"]
    errors: Any = own.pivot_table(ERROR, place, "policy", sort=False)
    logs = errors[AFTER].map(math.log) - errors[BEFORE].map(math.log)
    by_policy = own.groupby("policy")["departed"].agg(["sum", "size"])
    by_place = own.groupby(["policy", *place])["departed"].any()
    return _Compared(
        places=len(errors),
        means=(errors[BEFORE].mean(), errors[AFTER].mean()),
        ratio=math.exp(logs.mean()),
        ends=geometric_interval(logs.to_numpy()),
        out=(int(by_policy["sum"][BEFORE]), int(by_policy["sum"][AFTER])),
        places_out=(int(by_place[BEFORE].sum()), int(by_place[AFTER].sum())),
        drives=int(by_policy["size"][AFTER]),
    )


def _uncertain(one: _Compared, where: str) -> str:
    """Say how sure the comparison with adaptive attacks is, and where cars get out."""
    counts = (
        f"In `{where}`, drives leave the lane at {one.places_out[1]} of {one.places} "
        f"places with the new attacks, and at {one.places_out[0]} with the old ones."
    )
    low, high = one.ends or (-math.inf, math.inf)
    if not low < 1 < high:
        return counts
    words = "The interval of the ratio near adaptive attacks contains 1, so new attacks"
    return f"{words} may be weaker or stronger than the old ones. {counts}"


def _aimed(drives: pd.DataFrame) -> dict[str, float]:
    """Return the new policy's errors near old attacks and without objects.

    By case, as the largest multiple, over the environments, of the error that the old
    policy has without objects.
    """
    own = drives[drives["group"] == OLD]
    means: Any = own.groupby(["policy", "case", "environment"])[ERROR].mean()
    clean = means[BEFORE, NO_OBJECT]
    return {case: float((means[AFTER, case] / clean).max()) for case in AIMS}


def _aim(case: str, errors: dict[str, float]) -> str:
    verb = "reaches" if errors[case] <= AIMS[case] else "misses"
    return f"{verb} the aim of at most {AIMS[case]}"


def _title(is_repaired: dict[str, bool]) -> str:
    """Return the title; by group, whether no drive leaves the lane."""
    good, bad = (
        _listed([GROUPS[g] for g, is_good in is_repaired.items() if is_good == side])
        for side in (True, False)
    )
    if not good:
        return "Retraining does not repair the policy against any group of attacks"
    title = f"Retraining repairs the policy against {good} attacks"
    return title + (f", not against {bad} attacks" if bad else "")


def _listed(names: list[str]) -> str:
    return " and ".join([", ".join(names[:-1]), names[-1]] if names[1:] else names)
