"""A run's result in words: what `metrics.json` proves, by stated thresholds."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import Any

from mi_nerfattack.evaluation.flags import SATURATED
from mi_nerfattack.evaluation.pairs import compare, outcomes
from mi_nerfattack.rollout.drive import ATTACK, BEST_RANDOM, NO_OBJECT, OWN, RANDOM

#: An attack beats random looks from this multiple of their mean error on.
BEATS = 2.0
#: It transfers if it does so in the deployment too.
TRANSFERS = 2.0

Figures = Mapping[str, Any]


def verdict(document: Figures, surrogate: str) -> list[str]:
    """Return sentences: policy, attack against random, transfer, convergence, texture.

    Args:
        document: as of `metrics.metrics_document`, with `converged` and what follows.
        surrogate: name of the environment that the attack was optimised in.
    """
    found = []
    for route, environments in document["routes"].items():
        limit = document["departure_limits_m"][route]
        found.append(_policy(environments, limit))
        for name in sorted(environments, key=lambda name: name != surrogate):
            found += _attack(document, name, environments[name], name == surrogate)
    for name, replayed in document.get("replay", {}).items():
        found += _replayed(name, replayed)
    found += _search(document)
    return found


def _policy(environments: Figures, limit: float) -> str:
    """Say whether the policy keeps its lane by itself."""
    largest, departed = 0.0, []
    for name, cases in environments.items():
        for case in (NO_OBJECT, OWN):
            if case in cases:
                largest = max(largest, cases[case]["cross_track_max_m"])
                if cases[case]["drives_departed"]:
                    what = "without objects" if case == NO_OBJECT else "unattacked"
                    departed.append(f"{name} ({what})")
    if departed:
        return (
            f"The policy is not sound here: it leaves its lane by itself in "
            f"{', '.join(departed)}; an attack proves little."
        )
    return (
        "The policy is sound here: without objects and with them as they are it stays "
        f"within {largest:.2f} m of the lane centre, where {limit:.2f} m are allowed."
    )


def _over_starts(document: Figures, name: str) -> str:
    """Say within what the ratio to random looks lies, by drives of equal starts."""
    attack, random = (
        [
            replace(drive, scenario=f"start {drive.start}")
            for drive in outcomes(document, name, case)
        ]
        for case in (ATTACK, RANDOM)
    )
    effect = compare(attack, random, "cross_track_mean_m", document["seed"])
    if effect.ratio_ci95 is None:
        return ""
    low, high = effect.ratio_ci95
    return f" (95 % interval over {effect.attacks} starts: {low:.1f} to {high:.1f})"


def _attack(
    document: Figures, name: str, cases: Figures, is_surrogate: bool
) -> Iterator[str]:
    if ATTACK not in cases or RANDOM not in cases:
        return
    attack, mean = cases[ATTACK], cases[ATTACK]["cross_track_mean_m"]
    ratio = _ratio(mean, cases[RANDOM]["cross_track_mean_m"])
    text = f"a mean error of {mean:.3f} m, {ratio:.1f} times that of random looks"
    text += _over_starts(document, name)
    if BEST_RANDOM in cases:
        best = _ratio(mean, cases[BEST_RANDOM]["cross_track_mean_m"])
        text += f" and {best:.1f} times that of the best of them"
    left = f"{attack['drives_departed']} of {attack['n']} drives leave the lane"
    if is_surrogate:
        lead = "beats" if ratio >= BEATS else "does not beat"
        yield f"The attack {lead} random looks in the surrogate: {text}; {left}."
    else:
        lead = "transfers" if ratio >= TRANSFERS else "does not transfer"
        yield f"It {lead} to {name}: {text}; {left}."


def _replayed(name: str, replayed: Figures) -> Iterator[str]:
    changes = {
        case: figures["control_change_mean"]
        for case, figures in replayed["cases"].items()
    }
    if ATTACK in changes and RANDOM in changes:
        ratio = _ratio(changes[ATTACK], changes[RANDOM])
        yield (
            f"In the recording {name} it changes the control by {changes[ATTACK]:.3f} "
            f"{replayed['control_unit']} on average, {ratio:.1f} times as much as "
            "random looks; nothing that the policy does has an effect there."
        )


def _search(document: Figures) -> Iterator[str]:
    """Say what no flag speaks against."""
    if document["converged"]:
        yield "The search has converged."
    shares = [each["saturated_share"] for each in document["textures"].values()]
    if (largest := max(shares, default=1.0)) < SATURATED:
        yield (
            f"No texture is saturated: at most {largest:.0%} of the visible colour "
            "values of an object are black or full."
        )


def _ratio(value: float, reference: float) -> float:
    return value / max(reference, 1e-9)
