"""A run's result in words, and its flags: what `metrics.json` proves and what not."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from mi_nerfattack.evaluation.metrics import drives_of_run
from mi_nerfattack.evaluation.pairs import Effect, compare
from mi_nerfattack.rollout.drive import ATTACK, BEST_RANDOM, NO_OBJECT, OWN, RANDOM

#: An attack beats random textures if its gain is so many times theirs.
BEATS = 2.0

_ERROR, _OBJECTIVE = "cross_track_mean_m", "objective"
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
    found = []
    for route, environments in document["routes"].items():
        limit = document["departure_limits_m"][route]
        names = sorted(environments, key=lambda name: name != surrogate)
        found += _lane({name: environments[name] for name in names}, limit)
        found.append(_policy(environments, limit))
        for name in names:
            found += _attack(document, name, environments[name], name == surrogate)
    for name, replayed in document.get("replay", {}).items():
        found += _replayed(name, replayed)
    found += _search(document)
    return found


def _lane(environments: Figures, limit: float) -> Iterator[str]:
    """Say how many attacked drives leave the lane, and by how much the others do not.

    Args:
        environments: by name, in the order of the sentence.
        limit: departure limit, metres.
    """
    parts = []
    for name, cases in environments.items():
        if (attack := cases.get(ATTACK)) is None:
            continue
        left, beyond = attack["drives_departed"], attack["cross_track_max_m"] - limit
        if left:
            how = f"at most {beyond:.2f} m beyond the limit"
        else:
            how = f"{-beyond:.2f} m to spare"
        parts.append(f"{left} of {attack['n']} drives in {name} ({how})")
    if parts:
        yield (
            f"With the attacked objects, the policy leaves its lane in "
            f"{' and in '.join(parts)}; up to {limit:.2f} m from the lane centre are "
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
    return compare(one, other, figure, document["seed"])


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
        beats, text = _by_error(document, name, cases, drawn)
    elif any(cases[case].get(_OBJECTIVE) is None for case in cases):
        why = objective["missing"].get(name, "a drive ended before the others")
        yield f"The objective has no value in {name}, which is not judged: {why}."
        return
    elif OWN not in cases:
        return
    else:
        beats, text = _by_objective(document, name, cases, drawn)
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
    mean = cases[ATTACK][_ERROR]
    ratio = _ratio(mean, cases[RANDOM][_ERROR])
    effect = _by_starts(document, name, (ATTACK, RANDOM), _ERROR)
    text = f"a mean error of {mean:.3f} m, {ratio:.1f} times that of {drawn}"
    text += _interval(effect.ratio_ci95, effect.attacks, ".1f")
    if BEST_RANDOM in cases:
        best = _ratio(mean, cases[BEST_RANDOM][_ERROR])
        text += f" and {best:.1f} times that of the best of them"
    return ratio >= BEATS, text


def _by_objective(
    document: Figures, name: str, cases: Figures, drawn: str
) -> tuple[bool, str]:
    """Judge an attack by its own objective, see :func:`verdict`."""
    gains = {
        case: _by_starts(document, name, (OWN, case), _OBJECTIVE)
        for case in (ATTACK, RANDOM, BEST_RANDOM)
        if case in cases
    }
    gain, chance = gains[ATTACK].difference, gains[RANDOM].difference
    values = {case: figures[_OBJECTIVE] for case, figures in cases.items()}
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


#: Random looks are enough from this share of their drives in which a wheel is out on.
RANDOM_ENOUGH = 0.1
#: A texture is at its bounds from this share of its visible colour values on.
SATURATED = 0.5
#: An object is hardly in view below this share of the pixels, on average over a drive.
HARDLY = 0.001

#: A gradient misleads where the real gain is less than this share of the predicted one.
LEAST_SHARE = 0.01

#: `frames` rendered, increasing, and the least `objective` until then, a number each.
Curve = Mapping[str, Sequence[float]]


def run_flags(
    document: Figures, without_gradient: Sequence[str], by_gradient: bool
) -> Iterator[str]:
    """Give reasons to doubt a run, from its own figures.

    Args:
        document: as of `metrics.metrics_document`, with all that follows.
        without_gradient: objects whose texture and pose the objective does not depend
            on, according to the attack's gradient.
        by_gradient: whether the attack has one.
    """
    if names := ", ".join(without_gradient):
        yield (
            f"gradient zero: the objective does not depend on {names}"
            "; bring it into view, or see whether the policy has derivatives where it "
            "is used"
        )
    if (gain := document.get("least_gain")) is not None:
        yield from _misleading(gain)
    curve = document.get("curve")
    if by_gradient and curve is not None:
        looks = _random_curve(curve["frames"][0], document["baseline"]["objectives"])
        yield from black_box_better(curve, {"random textures": looks})
    for environments in document["routes"].values():
        for name, cases in environments.items():
            yield from _random_enough(name, cases)
            yield from _noise(name, cases, document.get("objective") is not None)
    if document["converged"] is False:
        yield (
            "not converged: when the search ended, or its learning rates fell, it was "
            "still gaining, had gained nothing, or had done fewer than ten iterations; "
            "raise its iterations, or frames"
        )
    for name, texture in document["textures"].items():
        yield from _texture(name, texture)


def _misleading(gain: Figures) -> Iterator[str]:
    if gain["gain"] < LEAST_SHARE * gain["predicted"]:
        yield (
            f"gradient misleads: for the five iterations from {gain['first']} on, it "
            f"predicted that the objective falls by {gain['predicted']:.3g}; it fell "
            f"by {gain['gain']:.3g}; try a lower learning rate, or other starts"
        )


def black_box_better(gradient: Curve, others: Mapping[str, Curve]) -> Iterator[str]:
    """Tell of methods that find more without derivatives, at equal frames.

    An alarm on the gradient itself. Curves are compared at the largest number of frames
    that both reach, if the gradient has ended an iteration by then.

    Args:
        gradient: its curve.
        others: curves by method, of the same objective from the same starts.

    Source: AutoAttack's flags (Croce and Hein, ICML 2020).
    """
    for name, other in others.items():
        frames = min(gradient["frames"][-1], other["frames"][-1])
        if frames < min(gradient["frames"][1:], default=math.inf):
            continue
        ours, theirs = _reached(gradient, frames), _reached(other, frames)
        if ours is not None and theirs is not None and theirs < ours:
            yield (
                f"black box better: after {frames:.0f} frames, {name} had come to an "
                f"objective of {theirs:.4g}, the gradient to {ours:.4g} (less is worse "
                "for the policy); check the learning rate, and the gradient by "
                "differences, before either is believed"
            )


def noise_larger(effect: Effect, figure: str) -> Iterator[str]:
    """Warn of an effect that differs more from seed to seed than it is large.

    Args:
        effect: of several seeds; an effect of one seed gives no warning.
        figure: name of the compared figure, in words.
    """
    if effect.spread is not None and abs(effect.difference) < effect.spread:
        yield _noise_told(figure, effect.difference, effect.spread, "seed to seed")


def _random_enough(name: str, cases: Figures) -> Iterator[str]:
    if cases.get(RANDOM) is None:
        return
    left, count = cases[RANDOM]["drives_departed"], cases[RANDOM]["n"]
    if left >= RANDOM_ENOUGH * count:
        yield (
            f"random enough: in {name}, {left} of {count} drives with random textures "
            "leave the lane, so that an attack proves little about this policy; train "
            "it with such objects in view"
        )


def _noise(name: str, cases: Figures, has_objective: bool) -> Iterator[str]:
    """Compare what an attack adds to random textures with what drives of a case differ.

    Args:
        name: of the environment.
        cases: of the environment.
        has_objective: whether the scenario's objective counts, not the mean error.
    """
    if cases.get(ATTACK) is None or cases.get(RANDOM) is None:
        return
    figure = _OBJECTIVE if has_objective else _ERROR
    rows = [
        [run[figure] for run in cases[case]["per_run"]] for case in (ATTACK, RANDOM)
    ]
    if min(map(len, rows)) < 2 or any(None in row for row in rows):
        return
    attack, chance = (np.array(row) for row in rows)
    effect = float(attack.mean() - chance.mean()) * (-1 if has_objective else 1)
    noise = float(np.sqrt((attack.var(ddof=1) + chance.var(ddof=1)) / 2))
    if effect < noise:
        what = "objective" if has_objective else "mean error"
        unit = "" if has_objective else " (m)"
        yield _noise_told(f"{what} in {name}{unit}", effect, noise, "drive to drive")


def _noise_told(what: str, effect: float, noise: float, between: str) -> str:
    return (
        f"noise larger: the effect of the attack, {what}, is {effect:.3g}, and its "
        f"standard deviation from {between} {noise:.3g}; take more starts, "
        "textures and seeds"
    )


def _texture(name: str, texture: Figures) -> Iterator[str]:
    if (share := texture["saturated_share"]) >= SATURATED:
        yield (
            f"texture at its bounds: {share:.0%} of the colour values of {name} that "
            "are seen are black or full; lower the learning rate, or limit the change "
            "(linf, l2, total_variation)"
        )
    if (share := texture["picture_share"]) < HARDLY:
        yield (
            f"object hardly in view: {name} takes {100 * share:.2g} % of the pixels "
            "on average over the unattacked drive; move it, or the start, nearer"
        )


def _random_curve(frames: float, objectives: Sequence[float]) -> Curve:
    """Return the curve of looks that cost so many frames each."""
    return {
        "frames": (frames * np.arange(1, len(objectives) + 1)).tolist(),
        "objective": np.minimum.accumulate(objectives).tolist(),
    }


def _reached(curve: Curve, frames: float) -> float | None:
    """Return the least objective with so many frames; None if there was none yet."""
    done = int(np.searchsorted(curve["frames"], frames, side="right"))
    return curve["objective"][done - 1] if done else None
