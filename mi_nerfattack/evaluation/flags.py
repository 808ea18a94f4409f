"""What speaks against a result, by stated thresholds.

A flag is a sentence that begins with its name: what was found, and what to do.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from mi_nerfattack.evaluation.pairs import Effect
from mi_nerfattack.rollout.drive import ATTACK, RANDOM

#: Random looks are enough from this share of their drives in which a wheel is out on.
RANDOM_ENOUGH = 0.1
#: A texture is at its bounds from this share of its visible colour values on.
SATURATED = 0.5
#: An object is hardly in view below this share of the pixels, on average over a drive.
HARDLY = 0.001

Figures = Mapping[str, Any]
#: `frames` rendered, increasing, and the least `objective` until then, a number each.
Curve = Mapping[str, Sequence[float]]


def run_flags(
    document: Figures, without_gradient: Sequence[str], by_gradient: bool
) -> Iterator[str]:
    """Tell what one run says against itself.

    Args:
        document: as of `metrics.metrics_document`, with all that follows.
        without_gradient: objects whose texture and pose the objective does not depend
            on, as far as the attack's gradient tells.
        by_gradient: whether the attack has one.
    """
    if names := ", ".join(without_gradient):
        yield (
            f"gradient zero: the objective does not depend on {names}"
            "; bring it into view, or see whether the policy has derivatives where it "
            "is used"
        )
    curve = document.get("curve")
    if by_gradient and curve is not None:
        looks = _random_curve(curve["frames"][0], document["baseline"]["objectives"])
        yield from black_box_better(curve, {"random looks": looks})
    for environments in document["routes"].values():
        for name, cases in environments.items():
            yield from _random_enough(name, cases)
            yield from _noise(name, cases)
    if document["converged"] is False:
        yield from _not_converged(curve)
    for name, texture in document["textures"].items():
        yield from _texture(name, texture)


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
    """Tell of an effect that differs more from seed to seed than it is large.

    Args:
        effect: of several seeds; of one, nothing is told.
        figure: what it is of, in words.
    """
    if effect.spread is not None and abs(effect.difference) < effect.spread:
        yield _noise_told(figure, effect.difference, effect.spread, "seed to seed")


def _random_enough(name: str, cases: Figures) -> Iterator[str]:
    if cases.get(RANDOM) is None:
        return
    left, count = cases[RANDOM]["drives_departed"], cases[RANDOM]["n"]
    if left >= RANDOM_ENOUGH * count:
        yield (
            f"random enough: in {name}, {left} of {count} drives past random looks "
            "leave the lane, so that an attack proves little about this policy; train "
            "it with such objects in view"
        )


def _noise(name: str, cases: Figures) -> Iterator[str]:
    """Compare the mean error that an attack adds with what drives of a case differ."""
    if cases.get(ATTACK) is None or cases.get(RANDOM) is None:
        return
    attack, chance = (
        np.array([run["cross_track_mean_m"] for run in cases[case]["per_run"]])
        for case in (ATTACK, RANDOM)
    )
    if min(len(attack), len(chance)) < 2:
        return
    effect = float(attack.mean() - chance.mean())
    noise = float(np.sqrt((attack.var(ddof=1) + chance.var(ddof=1)) / 2))
    if effect < noise:
        yield _noise_told(f"mean error in {name} (m)", effect, noise, "drive to drive")


def _noise_told(what: str, effect: float, noise: float, between: str) -> str:
    return (
        f"noise larger: the effect of the attack, {what}, is {effect:.3g}, and its "
        f"standard deviation from {between} {noise:.3g}; take more starts, looks and "
        "seeds"
    )


def _not_converged(curve: Curve | None) -> Iterator[str]:
    text = (
        "not converged: the search had not settled when its iterations, or frames, ran "
        "out; raise them"
    )
    if curve is not None and (gain := curve["objective"][0] - curve["objective"][-1]):
        late = _reached(curve, 0.8 * curve["frames"][-1])
        if late is not None:
            share = (late - curve["objective"][-1]) / gain
            text += f"; the last fifth of the frames gave {share:.0%} of all the gain"
    yield text


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
