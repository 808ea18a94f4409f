"""What a fit minimises, and its derivative by what a march returns."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from mi_nerfattack.backend.arrays import vjp
from mi_nerfattack.fit.rays import RayBatch
from mi_nerfattack.ranges import NonNegative, Positive, checked
from mi_nerfattack.render.rays import March

# Rounding may lift a white pixel above 1, where the sRGB curve has no derivative.
_BELOW_WHITE = 1 - 1e-5
_MOMENT_DELTA = 0.1  # of the depth, relative
_OPACITY_DELTA = 0.02  # small: a bright sky shines through a road of opacity 0.96


@dataclass(frozen=True)
@checked()
class LossWeights:
    """Weights and shapes of the terms of the loss.

    Attributes:
        huber: where the colour's Huber loss turns linear, sRGB values.
        depth: of the depth term, against that of colour; 0 ignores depths.
        opacity: of the opacity term where depths tell it; 0 ignores it.
        spread: of the spread of weights along a ray, which gathers fog on surfaces; of
            an NGP on a CPU alone.
    """

    huber: Positive = 0.1
    depth: NonNegative = 0.1
    opacity: NonNegative = 0.05
    spread: NonNegative = 0.0


def huber(error: Any, delta: float) -> Any:
    """Return ``error^2 / (2 delta)`` up to `delta`, ``|error| - delta / 2`` beyond."""
    size = dr.abs(error)
    return dr.select(size < delta, error * error * (0.5 / delta), size - 0.5 * delta)


def loss_and_cotangent(
    primal: March,
    background: Any,
    batch: RayBatch,
    weights: LossWeights,
    share: Any,
    gain: Any = None,
) -> tuple[Any, Any, March]:
    """Compare a march with the images.

    The loss of a ray is the mean over channels of the Huber loss between sRGB values.
    Where the batch has depths, two Huber losses are added: of the opacity, and, for
    rays that hit something, of the relative error of the depth moment. Neither is added
    where the depth is NaN, because it is unknown there. Derivatives reach `background`
    and `gain` through Dr.Jit's graph.

    Args:
        primal: of the batch's rays, detached.
        background: `mi.Color3f`, (3, n) linear, behind the field.
        batch: rays and images.
        weights: of the terms.
        share: (n,), weight of each ray in the objective.
        gain: (3, n), exposure of the rays' images; None for 1.

    Returns:
        loss (n,) and squared sRGB error (n,), both detached, and the derivative of the
        objective by radiance, opacity and moment.
    """
    behind = dr.detach(background)
    target = dr.linear_to_srgb(
        batch.alpha * dr.srgb_to_linear(batch.colour) + (1 - batch.alpha) * behind
    )

    def compare(integrals: March) -> tuple[Any, Any]:
        linear = integrals.radiance + (1 - integrals.opacity) * background
        if gain is not None:
            linear *= gain
        error = dr.linear_to_srgb(linear * _BELOW_WHITE) - target
        terms = [huber(channel, weights.huber) for channel in error]
        loss = (terms[0] + terms[1] + terms[2]) / 3
        if batch.depth is not None:
            loss += _geometry_loss(integrals, batch.depth, weights)
        return loss, dr.squared_norm(mi.Vector3f(error)) / 3

    with dr.suspend_grad():
        loss, square = compare(primal)
    cotangent = vjp(lambda integrals: compare(integrals)[0], primal, share)
    return loss, square, cotangent


def _geometry_loss(integrals: March, depth: Any, weights: LossWeights) -> Any:
    is_known = ~dr.isnan(depth)
    is_hit = dr.isfinite(depth)
    known = dr.select(is_hit, depth, 1)
    moment_error = dr.select(is_hit, integrals.moment / known - 1, 0)
    opacity_error = integrals.opacity - dr.select(is_hit, mi.Float(1), 0)
    loss = weights.depth * huber(moment_error, _MOMENT_DELTA) + (
        weights.opacity * huber(opacity_error, _OPACITY_DELTA)
    )
    return dr.select(is_known, loss, 0)
