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
from mi_nerfattack.evaluation.summary import Interval, share_interval
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
_LABEL = "geometric mean of the ratios by place, with its 95 % interval"


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
        f"For {name} attacks, it is {one.ratio:.2f} in `{where}`, and below 1 at "
        f"{one.weaker} of {one.places} places ({interval_words(one.ends, 2)})."
        for g, name in groups.items()
        for one in [compared[g, where]]
    )
    errors = _aimed(drives)
    return Finding(
        title=_title({group: not count for group, count in left.items()}),
        sentences=(
            "Old attacks were in the training, held-out attacks were not, and adaptive "
            "attacks were made on the new policy. The policy stays in its lane near a "
            "group if no drive leaves the lane, in the surrogate and in "
            f"`{where}`. With the new policy, these drives leave the lane: "
            f"{', '.join(listed)}.",
            "At each place, we divide the error after the retraining by the error "
            "before. The column 'ratio' is the geometric mean over the places, so it "
            f"is not the quotient of the two means. {' '.join(ratios)}",
            "We set two aims before the first result, as multiples of the old policy's "
            "error without objects. Near old attacks, the new policy may have "
            f"{AIMS[ATTACK]}: it has {errors[ATTACK]:.2f}, and {_aim(ATTACK, errors)}. "
            f"Without objects, it may have {AIMS[NO_OBJECT]}: it has "
            f"{errors[NO_OBJECT]:.2f}, and {_aim(NO_OBJECT, errors)}. Both are of the "
            "worse environment.",
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
            _LABEL,
        ),
        pandas="own = drives.query(\"case == 'attack'\")\n"
        'print(own.groupby(["group", "environment", "policy"]).departed.mean())',
        threats=tuple(_doubt(g, compared[g, where], where) for g in groups)
        + (
            (_ADAPTIVE, _adaptive(compared[ADAPTIVE, where], where))
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
        routes_out: such drives by route, before and after.
        places_out: places with such drives, before and after.
        weaker: places where the error is smaller after than before.
        drives: of each policy.
    """

    places: int
    means: tuple[float, float]
    ratio: float
    ends: Interval
    out: tuple[int, int]
    routes_out: dict[str, tuple[int, int]]
    places_out: tuple[int, int]
    weaker: int
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
    routes: Any = own.pivot_table(
        "departed", "route", "policy", aggfunc="sum", sort=False
    ).astype(int)
    by_place: Any = own.groupby(["policy", *place])["departed"].any()
    return _Compared(
        places=len(errors),
        means=(errors[BEFORE].mean(), errors[AFTER].mean()),
        ratio=math.exp(logs.mean()),
        ends=geometric_interval(logs.to_numpy()),
        out=(int(routes[BEFORE].sum()), int(routes[AFTER].sum())),
        routes_out={x.Index: (x.before, x.after) for x in routes.itertuples()},
        places_out=(int(by_place[BEFORE].sum()), int(by_place[AFTER].sum())),
        weaker=int((errors[AFTER] < errors[BEFORE]).sum()),
        drives=int((own["policy"] == AFTER).sum()),
    )


def _doubt(group: str, one: _Compared, where: str) -> str:
    """Say at how many places old and new policy leave the lane."""
    before, after = one.places_out
    ends = share_interval(after, one.places)
    low, high = (100 * end for end in ends or (0.0, 1.0))
    return (
        f"Few places decide about {GROUPS[group]} attacks. In `{where}`, the car "
        f"leaves the lane at {before} of {one.places} places with the old policy. With "
        f"the new one, it does so at {after} places (share: 95 % interval {low:.0f} to "
        f"{high:.0f} %)."
    )


def _adaptive(one: _Compared, where: str) -> str:
    """Say on which routes cars leave the lane."""
    routes = ", ".join(f"{name} {a} and {b}" for name, (a, b) in one.routes_out.items())
    return (
        f"In `{where}`, drives out by route, with old attacks on the old policy and "
        f"new attacks on the new one: {routes}."
    )


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
    return f"{verb} the aim"


def _title(is_repaired: dict[str, bool]) -> str:
    """Return the title; by group, whether no drive leaves the lane."""
    good, bad = (
        _listed([GROUPS[g] for g, is_good in is_repaired.items() if is_good == side])
        for side in (True, False)
    )
    if not good:
        return "The retrained policy leaves its lane near attacks of each group"
    title = f"The retrained policy stays in its lane near {good} attacks"
    return title + (f", not near {bad} ones" if bad else "")


def _listed(names: list[str]) -> str:
    return " and ".join([", ".join(names[:-1]), names[-1]] if names[1:] else names)
