"""Batches of rays for a fit: drawing them, and comparing what is seen with images."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import drjit as dr
import mitsuba as mi

from mi_nerfattack.fields.base import AbstractField
from mi_nerfattack.fit.cameras import POSES
from mi_nerfattack.fit.loss import LossWeights, loss_and_cotangent
from mi_nerfattack.fit.rays import RayBank, RayBatch
from mi_nerfattack.render.posed import PosedField
from mi_nerfattack.render.rays import March, Rays
from mi_nerfattack.render.walk import sample_count

STOP = 1e-3  # transmittance at which a ray ends while fields are fitted
_PROBE = 2048  # rays that tell how many samples a ray has
_STEPS_BEHIND = 4  # marching steps that a ray goes on behind a known surface


@dataclass
class Score:
    """Sums over the rays of a step, one entry each.

    Attributes:
        loss: sum over rays.
        square: sum over rays of the squared sRGB error, mean over channels.
        rays: used.
        listed: samples where light might come from.
        visible: samples that light reaches the eye from.
    """

    loss: mi.Float = field(default_factory=lambda: mi.Float(0))
    square: mi.Float = field(default_factory=lambda: mi.Float(0))
    rays: mi.UInt32 = field(default_factory=lambda: mi.UInt32(0))
    listed: mi.UInt32 = field(default_factory=lambda: mi.UInt32(0))
    visible: mi.UInt32 = field(default_factory=lambda: mi.UInt32(0))

    def plus(self, other: Score) -> Score:
        """Add up."""
        return Score(
            self.loss + other.loss,
            self.square + other.square,
            self.rays + other.rays,
            listed=self.listed + other.listed,
            visible=self.visible + other.visible,
        )


@dataclass
class Draw:
    """A batch of rays with its random numbers.

    Attributes:
        index: (n,), of the pixels.
        batch: rays and what the images show.
        rays: the rays.
        shade: (3, n), a random colour.
    """

    index: mi.UInt32
    batch: RayBatch
    rays: Rays
    shade: mi.Color3f


class BatchSource:
    """Draws rays of images, and compares.

    Args:
        bank: pixels and poses.
        weights: of the loss.
        radiance_field: the field that is fitted.
        sky: let the field's background lie behind it. Otherwise a random colour does,
            another one for each ray, so that density cannot hide in the background.
    """

    def __init__(
        self,
        bank: RayBank,
        weights: LossWeights,
        radiance_field: AbstractField,
        sky: bool,
    ) -> None:
        self.bank, self.weights, self.field = bank, weights, radiance_field
        self.sky = sky

    @property
    def learns_poses(self) -> bool:
        """Whether the poses of the cameras are parameters."""
        return POSES in self.bank.corrections.values

    def state(self) -> list[Any]:
        """Return all that a kernel reads or was compiled for, for `drjit.freeze`."""
        return [self, self.bank.state()]

    def draw(self, random: Any, limit: mi.UInt32) -> Draw:
        """Draw rays.

        Args:
            random: `mi.PCG32`, one stream per ray; it is advanced.
            limit: rays in use; the rest is inactive.
        """
        index = self.bank.draw(random)
        jitter = random.next_float32()
        shade = mi.Color3f(*(random.next_float32() for _ in range(3)))
        with dr.suspend_grad():
            batch = self.bank.batch(index)
        active = dr.arange(mi.UInt32, dr.width(index)) < limit
        ends = self.ends(batch.depth)
        rays = Rays(batch.origin, batch.direction, ends, jitter=jitter, active=active)
        dr.eval(batch, rays, shade, random)
        return Draw(index, batch, rays, shade)

    def ends(self, depth: Any) -> Any:
        """End rays a little behind known surfaces: more samples would teach nothing.

        Where depth is unknown (NaN) they go to the end of the box.
        """
        if depth is None:
            return dr.opaque(mi.Float, dr.inf)
        is_hit = dr.isfinite(depth)
        known = dr.select(is_hit, depth, 0)
        step = dr.maximum(self.field.step_m, self.field.cone * known)
        return dr.select(is_hit, known + _STEPS_BEHIND * step, dr.inf)

    def compare(self, draw: Draw, primal: March, used: mi.Bool) -> tuple[Score, March]:
        """Compare a march with the images.

        Derivatives reach the sky and the exposures through Dr.Jit's graph.

        Args:
            draw: the batch.
            primal: of its rays, detached.
            used: (n,), rays that count.

        Returns:
            the score, and the derivative of the mean loss by `primal`.
        """
        batch = draw.batch
        behind = draw.shade
        if self.sky:
            behind = self.field.background(draw.rays.direction)
        rays = dr.count(used)
        share = dr.select(used, dr.rcp(mi.Float(dr.maximum(rays, 1))), 0)
        gain = self.bank.corrections.gain(batch.image)
        loss, square, cotangent = loss_and_cotangent(
            primal, behind, batch, weights=self.weights, share=share, gain=gain
        )
        loss, square = dr.select(used, loss, 0), dr.select(used, square, 0)
        score = Score(dr.sum(loss), dr.sum(square), rays)
        dr.eval(score, cotangent)
        return score, cotangent

    def backward_rays(self, draw: Draw, by_origin: Any, by_direction: Any) -> None:
        """Pass derivatives by the rays on to the corrections of the poses."""
        batch = self.bank.batch(draw.index)  # attached
        dr.backward_from(
            dr.dot(batch.origin, by_origin) + dr.dot(batch.direction, by_direction)
        )


def mean_samples(posed: PosedField, source: BatchSource, seed: int) -> float:
    """Return the mean number of samples of a ray that does not end early.

    Args:
        posed: the field; its occupancy decides.
        source: of the rays.
        seed: of those that are counted.
    """
    random = mi.PCG32(_PROBE, seed)  # pyright: ignore[reportCallIssue]
    rays = source.draw(random, dr.opaque(mi.UInt32, _PROBE)).rays
    count = sample_count(posed, rays)
    return float(dr.mean(count)[0])
