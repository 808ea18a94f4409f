"""The section ``[attack]``: search method, what may change, and the adjoint."""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from pydantic import Field, model_validator

from mi_nerfattack.attack.base import AbstractAttack, Freedom
from mi_nerfattack.attack.black_box.blocks import BlockSearch
from mi_nerfattack.attack.black_box.low_frequency import LowFrequency
from mi_nerfattack.attack.black_box.random_looks import RandomLooks, RandomSearch
from mi_nerfattack.attack.black_box.search import AbstractSearch
from mi_nerfattack.attack.black_box.surrogate import SurrogateSearch, Task
from mi_nerfattack.attack.gradient import GradientAttack
from mi_nerfattack.attack.opening import FEWEST, AbstractOpening, Restarts, Sides
from mi_nerfattack.attack.plan import Follow, Plan, Schedule
from mi_nerfattack.attack.texture.colours import Colours
from mi_nerfattack.attack.texture.constraints import Constraints
from mi_nerfattack.attack.texture.gamut import Gamut
from mi_nerfattack.errors import InputError
from mi_nerfattack.fields.grid import GridField
from mi_nerfattack.ranges import (
    Count,
    Finite,
    Natural,
    NonNegative,
    Positive,
    Share,
    SomeShare,
)
from mi_nerfattack.rollout.adjoint import Checkpointed, KeptBackgrounds, Replay
from mi_nerfattack.rollout.function import Rollout
from mi_nerfattack.scenario.named_file import File
from mi_nerfattack.scenario.objective import VarySection
from mi_nerfattack.scenario.section import Kinds, Section, refuse

Population = Annotated[int, Field(ge=2)]


class AbstractMethod(Section):
    """A way to search."""

    needs_derivatives: ClassVar[bool]
    group: ClassVar[str] = "mi_nerfattack.methods"

    @abstractmethod
    def build(self, task: Task) -> AbstractAttack:
        """Make the attack, before its first iteration.

        Raises:
            InputError: it cannot change what it may.
            TypeError: it needs derivatives, and the policy has none.
        """

    @abstractmethod
    def iterations(self, frames: int) -> int:
        """Return how many iterations there are at most.

        Args:
            frames: of the drives of one of them.
        """

    def rendered(self, horizon: int) -> int:
        """Return how many frames are rendered for a drive of so many periods."""
        return horizon


class AbstractGradientMethod(AbstractMethod):
    """Adam along a gradient."""

    max_iterations: Count = 48  # fewer where the attack converges before
    final_rate: SomeShare = 0.1  # of the learning rates, at the end
    one_level: bool = False  # march objects as one level meanwhile: faster, not exact
    opening: Literal["none", "sides", "restarts"] = "none"
    opening_share: SomeShare = 0.25  # of the iterations, for all tries of the opening
    follow: Follow = "always"  # iterations after it in which attack.attached holds

    needs_derivatives = True

    @model_validator(mode="after")
    def _check_opening(self) -> Any:
        """Refuse an opening that leaves no iterations, or has none."""
        count = self.max_iterations
        if self.opening != "none" and not (
            self._each >= FEWEST and self._each * self._tries < count
        ):
            tried = FEWEST * self._tries
            least = max(math.ceil(tried / self.opening_share), tried + 1)
            refuse(
                "opening_share",
                f"{self.opening_share:g} of {count} iterations for {self._tries} "
                f"tries; each try takes at least {FEWEST}, and one is left over; give "
                f"max_iterations = {least} or more, or another share",
            )
        return self

    @property
    def _tries(self) -> int:
        kinds = {"sides": Sides, "restarts": Restarts}
        return kinds[self.opening].count if self.opening in kinds else 0

    @property
    def _each(self) -> int:
        return int(self.opening_share * self.max_iterations) // max(self._tries, 1)

    def build(self, task: Task) -> AbstractAttack:
        """See :meth:`AbstractMethod.build`."""
        left = self.max_iterations - self._each * self._tries
        return GradientAttack(
            self._rollout(task),
            task.route,
            task.initial,
            task.freedom,
            Plan(Schedule(left, self.final_rate), self._opening(task), self.follow),
            one_level=self.one_level,
        )

    def _opening(self, task: Task) -> AbstractOpening | None:
        if self.opening == "sides":
            return Sides(self._each, task.route)
        if self.opening == "restarts":
            seed = task.seed + (1 << 31)  # other draws than those of the baseline
            looks = RandomLooks(task.fields, task.freedom, "blobs", seed)
            return Restarts(self._each, looks)
        return None

    @abstractmethod
    def _rollout(self, task: Task) -> Rollout:
        """Make the drives that are differentiated."""

    def iterations(self, frames: int) -> int:
        """See :meth:`AbstractMethod.iterations`."""
        del frames
        return self.max_iterations


class GradientMethod(AbstractGradientMethod):
    """Of the closed loop, or of the images along an unattacked drive."""

    kind: Literal["gradient", "open_loop"] = "gradient"

    def _rollout(self, task: Task) -> Rollout:
        if self.kind == "gradient":
            return task.rollout
        return task.rollout.open_loop(task.initial)


class FrameMethod(AbstractGradientMethod):
    """Of one frame of an unattacked drive: rendered once, it is shown all the time."""

    kind: Literal["single_frame"]
    frame: Natural = 0  # of the drive

    def rendered(self, horizon: int) -> int:
        """See :meth:`AbstractMethod.rendered`."""
        del horizon
        return 1

    def _rollout(self, task: Task) -> Rollout:
        return task.rollout.open_loop(task.initial, self.frame)


class AbstractSearchMethod(AbstractMethod):
    """Drives alone, of textures."""

    frames: Count = 6000  # rendered; the drives that reach it are the last

    needs_derivatives = False

    def build(self, task: Task) -> AbstractAttack:
        """See :meth:`AbstractMethod.build`."""
        if task.freedom.texture_rate is None or task.freedom.pose_rate is not None:
            raise InputError(
                "attack.freedom.kind: searches change textures alone; set it to "
                "'texture', or attack.method.kind to 'gradient'"
            )
        return SurrogateSearch(
            self.search(task),
            task.rollout,
            task.route,
            initial=task.initial,
            freedom=task.freedom,
            frames=self.frames,
        )

    @abstractmethod
    def search(self, task: Task) -> AbstractSearch:
        """Make what proposes textures; it draws from the task's seed alone."""

    def iterations(self, frames: int) -> int:
        """See :meth:`AbstractMethod.iterations`."""
        return -(-self.frames // frames)


class RandomMethod(AbstractSearchMethod):
    """Random textures."""

    kind: Literal["random"]
    texture_kind: Literal["noise", "blobs", "flat", "mixed"] = "mixed"

    def search(self, task: Task) -> AbstractSearch:
        seed = task.seed + (1 << 31)  # other draws than those of the baseline
        looks = RandomLooks(task.fields, task.freedom, self.texture_kind, seed)
        return RandomSearch(looks, task.colourings)


class BlockMethod(AbstractSearchMethod):
    """Random colours of blocks."""

    kind: Literal["blocks"]
    first_block: SomeShare = 0.3  # of the lattice

    def search(self, task: Task) -> AbstractSearch:
        proposals = self.iterations(task.frames)
        fields = task.fields
        return BlockSearch(
            task.colourings, fields, proposals, share=self.first_block, seed=task.seed
        )


class EvolutionMethod(AbstractSearchMethod):
    """CMA-ES."""

    kind: Literal["cma_es"]
    variant: Literal["separable", "learning_rate"] = "separable"
    coefficients: Count = 256  # of all objects, at most
    spread: Positive = 0.3  # of the first samples, sRGB
    population: Population | None = None

    def search(self, task: Task) -> AbstractSearch:
        from mi_nerfattack.attack.black_box.evolution import EvolutionSearch

        basis = LowFrequency(task.colourings, self.coefficients)
        return EvolutionSearch(
            basis, self.variant, self.spread, population=self.population, seed=task.seed
        )


class BayesianMethod(AbstractSearchMethod):
    """A Gaussian process."""

    kind: Literal["bayesian"]
    coefficients: Annotated[int, Field(ge=1, le=64)] = 64  # of all objects, at most

    def search(self, task: Task) -> AbstractSearch:
        from mi_nerfattack.attack.black_box.bayesian import BayesianSearch

        basis = LowFrequency(task.colourings, self.coefficients)
        return BayesianSearch(basis, seed=task.seed)


MethodSection = Annotated[
    GradientMethod
    | FrameMethod
    | RandomMethod
    | BlockMethod
    | EvolutionMethod
    | BayesianMethod,
    Kinds("gradient", AbstractMethod),
]

Corner = tuple[Finite, Finite, Finite]
Box = tuple[Corner, Corner]
Resolution = Annotated[int, Field(ge=2, le=512)]
Smoothing = Annotated[int, Field(ge=0, le=8)]
Axis = Literal["x", "y", "z", "roll", "pitch", "yaw"]


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
            linf=self.linf,
            l2=self.l2,
            lowest=self.lowest,
            highest=self.highest,
            gamut=Gamut.load(self.gamut.file) if self.gamut else None,
            fixed=self.fixed_m,
            total_variation=self.total_variation,
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

    kind: Literal["texture"] = "texture"

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

    kind: Literal["pose"]

    def build(self) -> Freedom:
        """Say what the attack may change."""
        return self._with(None)


class BothFreedom(AbstractTextureFreedom, AbstractPoseFreedom):
    """Textures may change, too."""

    kind: Literal["both"]

    def build(self) -> Freedom:
        """Say what the attack may change."""
        return replace(self._with(self.learning_rate), colouring=self._colouring())


class AttackSection(Section):
    """How textures and poses are optimised."""

    method: MethodSection = GradientMethod()
    poses: Count = 1  # initial poses of an iteration; the first is nominal
    freedom: Annotated[TextureFreedom | PoseFreedom | BothFreedom, Kinds("texture")] = (
        TextureFreedom()
    )
    adjoint: Annotated[Replay | KeptBackgrounds | Checkpointed, Kinds("replay")] = (
        Replay()
    )
    attached: bool = False
    jitter: bool = False
    vary: VarySection = VarySection()  # between the poses' drives
    checkpoint_every: Count = 10
    deterministic: bool = False  # equal bits from run to run, on one thread

    @model_validator(mode="after")
    def _check_follow(self) -> Any:
        """Refuse to follow the camera along a path, or only when told otherwise."""
        method = self.method
        if self.attached and method.kind in ("open_loop", "single_frame"):
            refuse(
                "attached",
                f"is true; the images of {method.kind} do not follow the vehicle, set "
                "attached to false",
            )
        if isinstance(method, AbstractGradientMethod) and method.follow != "always":
            if not self.attached:
                refuse(
                    "attached",
                    f"is false, and method.follow is {method.follow!r}; set attached "
                    "to true, or leave follow out",
                )
        return self
