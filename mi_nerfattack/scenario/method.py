"""The keys of ``[attack]`` that choose how textures are searched, and how long."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, Literal

from pydantic import Field

from mi_nerfattack.attack.base import AbstractAttack
from mi_nerfattack.attack.black_box.blocks import BlockSearch
from mi_nerfattack.attack.black_box.low_frequency import LowFrequency
from mi_nerfattack.attack.black_box.random_looks import RandomLooks, RandomSearch
from mi_nerfattack.attack.black_box.search import AbstractSearch
from mi_nerfattack.attack.black_box.surrogate import SurrogateSearch, textured
from mi_nerfattack.attack.freedom import Freedom
from mi_nerfattack.attack.gradient import GradientAttack
from mi_nerfattack.attack.schedule import Schedule
from mi_nerfattack.attack.texture.colours import Colours
from mi_nerfattack.errors import InputError
from mi_nerfattack.fields.grid import GridField
from mi_nerfattack.ranges import Count, Positive, SomeShare, Whole
from mi_nerfattack.rollout.function import Rollout
from mi_nerfattack.scenario.section import Kinds, Section
from mi_nerfattack.vehicle.route.route import Route

Population = Annotated[int, Field(ge=2)]


@dataclass(frozen=True, eq=False)
class Task:
    """What an attack is made for.

    Attributes:
        rollout: the loop, its objective and its adjoint.
        route: the lane centre.
        initial: (m, n) that it starts from.
        freedom: what may change.
        seed: of the scenario.
    """

    rollout: Rollout
    route: Route
    initial: Any
    freedom: Freedom
    seed: int

    @property
    def fields(self) -> Sequence[GridField]:
        """Of the objects."""
        return textured(self.rollout.loop).fields

    @property
    def frames(self) -> int:
        """Frames of the drives of one judgement."""
        return self.rollout.horizon * len(self.initial[0])


class AbstractMethod(Section):
    """A way to search."""

    needs_derivatives: ClassVar[bool]

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

    needs_derivatives = True

    def build(self, task: Task) -> AbstractAttack:
        """See :meth:`AbstractMethod.build`."""
        schedule = Schedule(self.max_iterations, self.final_rate)
        rest = task.route, task.initial, task.freedom, schedule
        return GradientAttack(self._rollout(task), *rest)

    @abstractmethod
    def _rollout(self, task: Task) -> Rollout:
        """Make the drives that are differentiated."""

    def iterations(self, frames: int) -> int:
        """See :meth:`AbstractMethod.iterations`."""
        del frames
        return self.max_iterations


class GradientMethod(AbstractGradientMethod):
    """Of the closed loop, or of the images along an unattacked drive."""

    method: Literal["gradient", "open_loop"] = "gradient"

    def _rollout(self, task: Task) -> Rollout:
        if self.method == "gradient":
            return task.rollout
        return task.rollout.open_loop(task.initial)


class FrameMethod(AbstractGradientMethod):
    """Of one frame of an unattacked drive: rendered once, it is shown all the time."""

    method: Literal["single_frame"]
    frame: Whole = 0  # of the drive

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
                "attack.parameters: searches change textures alone; set it to "
                "'texture', or attack.method to 'gradient'"
            )
        search = self._search(task)
        parts = task.rollout, task.route, task.initial, task.freedom
        return SurrogateSearch(search, *parts, self.frames)

    @abstractmethod
    def _search(self, task: Task) -> AbstractSearch:
        """Make what proposes textures."""

    def iterations(self, frames: int) -> int:
        """See :meth:`AbstractMethod.iterations`."""
        return -(-self.frames // frames)


class RandomMethod(AbstractSearchMethod):
    """Random textures."""

    method: Literal["random"]
    texture_kind: Literal["noise", "blobs", "flat", "mixed"] = "mixed"

    def _search(self, task: Task) -> AbstractSearch:
        fields = task.fields
        seed = task.seed + (1 << 31)  # other draws than those of the baseline
        return RandomSearch(RandomLooks(fields, task.freedom, self.texture_kind, seed))


class BlockMethod(AbstractSearchMethod):
    """Random colours of blocks."""

    method: Literal["blocks"]
    first_block: SomeShare = 0.3  # of the lattice

    def _search(self, task: Task) -> AbstractSearch:
        proposals = self.iterations(task.frames)
        fields = task.fields
        rest = proposals, self.first_block, task.seed
        return BlockSearch(_colourings(task), fields, *rest)


class EvolutionMethod(AbstractSearchMethod):
    """CMA-ES."""

    method: Literal["cma_es"]
    variant: Literal["separable", "learning_rate"] = "separable"
    coefficients: Count = 256  # of all objects, at most
    spread: Positive = 0.3  # of the first samples, sRGB
    population: Population | None = None

    def _search(self, task: Task) -> AbstractSearch:
        from mi_nerfattack.attack.black_box.evolution import EvolutionSearch

        basis = LowFrequency(_colourings(task), self.coefficients)
        rest = self.variant, self.spread, self.population, task.seed
        return EvolutionSearch(basis, *rest)


class BayesianMethod(AbstractSearchMethod):
    """A Gaussian process."""

    method: Literal["bayesian"]
    coefficients: Annotated[int, Field(ge=1, le=64)] = 64  # of all objects, at most

    def _search(self, task: Task) -> AbstractSearch:
        from mi_nerfattack.attack.black_box.bayesian import BayesianSearch

        basis = LowFrequency(_colourings(task), self.coefficients)
        return BayesianSearch(basis, seed=task.seed)


def _colourings(task: Task) -> list[Colours]:
    found = [task.freedom.colouring(field) for field in task.fields]
    return [item for item in found if isinstance(item, Colours)]  # which all are


MethodSection = Annotated[
    GradientMethod
    | FrameMethod
    | RandomMethod
    | BlockMethod
    | EvolutionMethod
    | BayesianMethod,
    Kinds("method"),
]
