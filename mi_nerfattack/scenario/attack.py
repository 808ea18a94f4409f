"""The section ``[attack]``: what may change, and the way back through a drive."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field, model_validator

from mi_nerfattack.attack.freedom import Freedom
from mi_nerfattack.attack.texture.colours import Colours
from mi_nerfattack.attack.texture.constraints import Constraints
from mi_nerfattack.attack.texture.gamut import Gamut
from mi_nerfattack.errors import InputError
from mi_nerfattack.fields.grid import GridField
from mi_nerfattack.ranges import (
    Count,
    Finite,
    NonNegative,
    Positive,
    Share,
)
from mi_nerfattack.render.camera.disturbance import Disturbance
from mi_nerfattack.rollout.adjoint import (
    AbstractAdjoint,
    Checkpointed,
    KeptBackgrounds,
    Replay,
)
from mi_nerfattack.scenario.method import GradientMethod, MethodSection
from mi_nerfattack.scenario.named_file import File
from mi_nerfattack.scenario.section import Kinds, Section, refuse

Corner = tuple[Finite, Finite, Finite]
Box = tuple[Corner, Corner]
Resolution = Annotated[int, Field(ge=2, le=512)]
Smoothing = Annotated[int, Field(ge=0, le=8)]
Axis = Literal["x", "y", "z", "roll", "pitch", "yaw"]


class PlainAdjoint(Section):
    """Costates solved for period by period; each frame is rendered again."""

    adjoint: Literal["replay", "kept_backgrounds"] = "replay"

    def build(self) -> AbstractAdjoint:
        """Make the way back through a drive."""
        return KeptBackgrounds() if self.adjoint == "kept_backgrounds" else Replay()


class CheckpointedAdjoint(Section):
    """Segments differentiated one by one."""

    adjoint: Literal["checkpointed"]
    segment: Count = 16  # control periods between the checkpoints

    def build(self) -> AbstractAdjoint:
        """Make the way back through a drive."""
        return Checkpointed(self.segment)


class AbstractTextureFreedom(Section):
    """Colours may change, within what is allowed."""

    learning_rate: Positive = 0.3  # of colours (sRGB in 0 to 1) an iteration
    resolution: Resolution | None = None  # vertices an edge that are stepped in
    smoothing: Smoothing = 0  # passes of a filter over the gradient
    linf: Positive | None = None  # largest change of a colour value
    l2: Positive | None = None  # largest root mean square change
    lowest: Share | None = None  # of all colour values
    highest: Share | None = None
    gamut: File | None = None  # ICC profile or list of sRGB colours
    fixed_m: tuple[Box, ...] = ()  # lower and upper corner, in the object's frame
    total_variation: NonNegative = 0.0  # weight of the penalty

    @model_validator(mode="after")
    def _check_constraints(self) -> Any:
        """Refuse an empty range or box, and a file that is no gamut."""
        try:
            self._constraints()
        except InputError as err:
            text = str(err)
            of_range = "highest" if self.lowest is None else "lowest"
            keys = {"fixed": "fixed_m", "lowest": of_range}
            refuse(keys.get(text.split(":")[0], "gamut"), text)
        return self

    def _constraints(self) -> Constraints:
        return Constraints(
            self.linf,
            self.l2,
            self.lowest,
            self.highest,
            Gamut.load(self.gamut.file) if self.gamut else None,
            self.fixed_m,
            self.total_variation,
        )

    def _colouring(self) -> Callable[[GridField], Colours]:
        return partial(
            Colours,
            resolution=self.resolution,
            smoothing=self.smoothing,
            constraints=self._constraints(),
        )


class TextureFreedom(AbstractTextureFreedom):
    """Textures may change."""

    parameters: Literal["texture"] = "texture"

    def build(self) -> Freedom:
        """Say what the attack may change."""
        return Freedom(self.learning_rate, colouring=self._colouring())


class AbstractPoseFreedom(Section):
    """Objects may move."""

    pose_learning_rate: Positive = 0.02  # metres and radians
    pose_axes: Annotated[tuple[Axis, ...], Field(min_length=1)] = ("x", "y", "yaw")
    pose_limit_m: Positive = 1.0  # along each axis of the world
    pose_limit_deg: Positive = 30.0  # about each axis

    def _with(self, texture_rate: float | None) -> Freedom:
        limit = float(np.radians(self.pose_limit_deg))
        rate, axes = self.pose_learning_rate, self.pose_axes
        return Freedom(texture_rate, rate, axes, self.pose_limit_m, limit)


class PoseFreedom(AbstractPoseFreedom):
    """Objects alone may change."""

    parameters: Literal["pose"]

    def build(self) -> Freedom:
        """Say what the attack may change."""
        return self._with(None)


class BothFreedom(AbstractTextureFreedom, AbstractPoseFreedom):
    """Textures may change, too."""

    parameters: Literal["both"]

    def build(self) -> Freedom:
        """Say what the attack may change."""
        return replace(self._with(self.learning_rate), colouring=self._colouring())


class AttackSection(Section):
    """How textures and poses are optimised."""

    method: MethodSection = Field(default=GradientMethod(), validation_alias="(method)")
    poses: Count = 1  # initial poses of an iteration; the first is nominal
    freedom: Annotated[
        TextureFreedom | PoseFreedom | BothFreedom, Kinds("parameters")
    ] = Field(default=TextureFreedom(), validation_alias="(freedom)")
    adjoint: Annotated[PlainAdjoint | CheckpointedAdjoint, Kinds("adjoint")] = Field(
        default=PlainAdjoint(), validation_alias="(adjoint)"
    )
    attached: bool = False
    jitter: bool = False
    exposure_ev_sd: NonNegative = 0.0  # of the poses' drives, powers of two
    blur_px_sd: NonNegative = 0.0  # of the number whose size blurs a drive
    noise_sd: NonNegative = 0.0  # of each frame, sRGB in [0, 1]
    checkpoint_every: Count = 10
    deterministic: bool = False  # equal bits from run to run, on one thread

    def disturbance(self, seed: int) -> Disturbance:
        """Make what the attack's images go through."""
        sizes = self.exposure_ev_sd, self.blur_px_sd, self.noise_sd
        return Disturbance(*sizes, seed)
