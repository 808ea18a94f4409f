"""A run's result in words: what `metrics.json` proves."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from mi_nerfattack.evaluation.metrics import drives_of_run
from mi_nerfattack.evaluation.pairs import Effect, compare
from mi_nerfattack.rollout.drive import ATTACK, BEST_RANDOM, NO_OBJECT, OWN, RANDOM

#: An attack beats random textures if its gain is so many times theirs.
BEATS = 2.0
#: A texture is at its bounds from this share of its visible colour values on.
SATURATED = 0.5

ERROR, OBJECTIVE = "cross_track_mean_m", "objective"
_CHANGED = {"texture": "textures", "pose": "poses", "both": "textures and poses"}

Figures = Mapping[str, Any]


def verdict(document: Figures, surrogate: str) -> list[str]:
    """Return sentences: lane, policy, attack, transfer, recordings, search, texture.

    By default, an attack beats random textures in an environment if its mean error
    is at least `BEATS` times theirs.

    An objective of the scenario's own can have any sign, so that differences count.
    The gain of textures is the objective of the unattacked drives less that of the
    drives with the textures, over drives of equal starts. An attack beats random
    textures if its gain is positive, at least `BEATS` times their mean gain, and
    larger than that of the best of them.

    An attack that does so in a deployment transfers.

    Args:
        document: as of `metrics.metrics_document`, with `converged` and what follows.
        surrogate: name of the environment that the attack was optimised in.
    """
    sentences = []
    for route, environments in document["routes"].items():
        limit = document["departure_limits_m"][route]
        names = sorted(environments, key=lambda name: name != surrogate)
        sentences += _lane({name: environments[name] for name in names}, limit)
        sentences.append(_policy(environments, limit))
        for name in names:
            sentences += _attack(
                document, name, environments[name], is_surrogate=name == surrogate
            )
    for name, replayed in document.get("replay", {}).items():
        sentences += _replayed(name, replayed)
    sentences += _search(document)
    return sentences


def _lane(environments: Figures, limit: float) -> Iterator[str]:
    """Say how many attacked drives leave the lane, and by how much the others do not.

    Args:
        environments: by name, in the order of the sentence.
        limit: departure limit, metres.
    """
    clauses = []
    for name, cases in environments.items():
        if (attack := cases.get(ATTACK)) is None:
            continue
        left, beyond = attack["drives_departed"], attack["cross_track_max_m"] - limit
        if left:
            margin = f"at most {beyond:.2f} m beyond the limit"
        else:
            margin = f"{-beyond:.2f} m to spare"
        clauses.append(f"{left} of {attack['n']} drives in {name} ({margin})")
    if clauses:
        yield (
            f"With the attacked objects, the policy leaves its lane in "
            f"{' and in '.join(clauses)}; up to {limit:.2f} m from the lane centre are "
            "allowed."
        )


def _policy(environments: Figures, limit: float) -> str:
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
        "The policy is sound here: without objects and with unattacked ones it stays "
        f"within {largest:.2f} m of the lane centre, where {limit:.2f} m are allowed."
    )


def _by_starts(
    document: Figures, environment: str, cases: tuple[str, str], figure: str
) -> Effect:
    """Compare two cases by drives of equal starts, each of which counts once."""
    drives = drives_of_run(document)
    drives = drives[drives["environment"] == environment]
    drives = drives.assign(scenario=drives["start"].astype(str))
    one, other = (drives[drives["case"] == case] for case in cases)
    return compare(one, other, figure, seed=document["seed"])


def _interval(ends: Sequence[float] | None, starts: int, digits: str) -> str:
    if ends is None:
        return ""
    low, high = (format(end, digits) for end in ends)
    return f" (95 % interval over {starts} starts: {low} to {high})"


def _attack(
    document: Figures, name: str, cases: Figures, is_surrogate: bool
) -> Iterator[str]:
    if ATTACK not in cases or RANDOM not in cases:
        return
    freedom = document["scenario"].get("attack", {}).get("freedom", {})
    random = f"random {_CHANGED[freedom.get('kind', 'texture')]}"
    count = cases[RANDOM]["n"]  # a drive each
    drawn = f"{count} {random}"
    equal = document.get("baseline", {}).get("equal_textures") or count
    if is_surrogate and count < equal:
        drawn = f"{count} of the {equal} {random} that its cost pays for"
    objective = document.get("objective")
    if objective is None:
        beats, text = _by_error(document, name, cases, drawn=drawn)
    elif any(cases[case].get(OBJECTIVE) is None for case in cases):
        why = objective["missing"].get(name, "a drive ended before the others")
        yield f"The objective has no value in {name}, which is not judged: {why}."
        return
    elif OWN not in cases:
        return
    else:
        beats, text = _by_objective(document, name, cases, drawn=drawn)
    if is_surrogate:
        lead = "beats" if beats else "does not beat"
        yield f"The attack {lead} {random} in the surrogate: {text}."
    else:
        lead = f"It transfers to {name}"
        if not beats:
            lead = f"It does not transfer to {name}, where it does not beat {random}"
        yield f"{lead}: {text}."


def _by_error(
    document: Figures, name: str, cases: Figures, drawn: str
) -> tuple[bool, str]:
    """Judge an attack by the mean distance from the lane centre."""
    mean = cases[ATTACK][ERROR]
    ratio = _ratio(mean, cases[RANDOM][ERROR])
    effect = _by_starts(document, name, (ATTACK, RANDOM), figure=ERROR)
    text = f"a mean error of {mean:.3f} m, {ratio:.1f} times that of {drawn}"
    text += _interval(effect.ratio_ci95, effect.attacks, ".1f")
    if BEST_RANDOM in cases:
        best = _ratio(mean, cases[BEST_RANDOM][ERROR])
        text += f" and {best:.1f} times that of the best of them"
    return ratio >= BEATS, text


def _by_objective(
    document: Figures, name: str, cases: Figures, drawn: str
) -> tuple[bool, str]:
    """Judge an attack by its own objective, see :func:`verdict`."""
    gains = {
        case: _by_starts(document, name, (OWN, case), figure=OBJECTIVE)
        for case in (ATTACK, RANDOM, BEST_RANDOM)
        if case in cases
    }
    gain, chance = gains[ATTACK].difference, gains[RANDOM].difference
    values = {case: figures[OBJECTIVE] for case, figures in cases.items()}
    # as many digits as show three of the gain
    digits = max(0, 2 - math.floor(math.log10(abs(gain)))) if gain else 2
    text = (
        f"the objective {document['objective']['name']} is {values[ATTACK]:.{digits}f} "
        f"with it and {values[OWN]:.{digits}f} unattacked, a gain of {gain:.3g}"
    )
    text += _interval(gains[ATTACK].difference_ci95, gains[ATTACK].attacks, ".3g")
    if NO_OBJECT in values:
        text += f"; without objects it is {values[NO_OBJECT]:.{digits}f}"
        added = values[OWN] - values[NO_OBJECT]
        if 0 < gain <= 2 * added:  # else a share says nothing
            text += f", so that the attack removes {gain / added:.0%} of what they add"
    text += f"; {drawn} gain {chance:.3g} in the mean"
    beats = gain > 0 and gain >= BEATS * chance
    if BEST_RANDOM in gains:
        best = gains[BEST_RANDOM].difference
        text += f" and the best of them {best:.3g}"
        beats = beats and gain > best
    return beats, text


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
            "random textures; nothing that the policy does has an effect there."
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
