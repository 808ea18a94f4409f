"""Reasons to doubt a run: what `metrics.json` does not prove."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from mi_nerfattack.evaluation.pairs import Effect
from mi_nerfattack.evaluation.verdict import ERROR, OBJECTIVE, SATURATED
from mi_nerfattack.rollout.drive import ATTACK, RANDOM

Figures = Mapping[str, Any]

#: Random looks are enough from this share of their drives in which a wheel is out on.
RANDOM_ENOUGH = 0.1
#: Iterations from which on a search may have converged, as in `attack.plan`.
FEWEST = 10
#: An object is hardly in view below this share of the pixels, on average over a drive.
HARDLY = 0.001

#: A gradient misleads where the real gain is less than this share of the predicted one.
LEAST_SHARE = 0.01

#: Keys of `[attack.freedom]` that random textures do not keep.
_LIMITS = ("linf", "l2", "lowest", "highest", "gamut", "fixed_m", "total_variation")

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
    attack = document.get("scenario", {}).get("attack", {})
    method = attack.get("method", {})
    # Random textures keep no limit, and are judged without the penalty of the curve
    is_limited = any(attack.get("freedom", {}).get(name) for name in _LIMITS)
    opens = method.get("opening", "none") != "none"
    incomparable = is_limited or (opens and _ends_early(document))
    if by_gradient and curve is not None and not incomparable:
        looks = _random_curve(curve["frames"][0], document["baseline"]["objectives"])
        yield from black_box_better(curve, {"random textures": looks})
    for environments in document["routes"].values():
        for name, cases in environments.items():
            yield from _random_enough(name, cases)
            yield from _noise(name, cases, document.get("objective") is not None)
    if document["converged"] is False:
        why = _unsettled(curve if by_gradient and not opens else None)
        yield f"not converged: {why}; raise its iterations, or frames"
    for name, texture in document["textures"].items():
        yield from _texture(name, texture)


def _ends_early(document: Figures) -> bool:
    """Whether the random textures cost no more than the tries of the opening.

    Until then, the attack has only tried where to begin.
    """
    method, curve = document["scenario"]["attack"]["method"], document["curve"]
    tried = math.ceil(method["opening_share"] * method["max_iterations"])
    frames = curve["frames"][0] * len(document["baseline"]["objectives"])
    return frames <= curve["frames"][min(tried, len(curve["frames"]) - 1)]


def _unsettled(curve: Curve | None) -> str:
    """Say why a search has not converged, as far as its curve tells."""
    ended = "when the search ended, or its learning rates fell"
    if curve is None:
        return (
            f"{ended}, it was still gaining, had gained nothing, or had done fewer "
            "than ten iterations"
        )
    full = math.ceil(0.75 * (len(curve["frames"]) - 1))
    if full < FEWEST:
        return f"it did {full} iterations at full rates, and {FEWEST} are needed"
    first, *_, last = curve["objective"]
    return f"{ended}, it was still gaining" if last < first else "it gained nothing"


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
        yield _noise_told(
            figure, effect.difference, effect.spread, between="seed to seed"
        )


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
    figure = OBJECTIVE if has_objective else ERROR
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
        yield _noise_told(
            f"{what} in {name}{unit}", effect, noise, between="drive to drive"
        )


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
