"""The section ``[objective]``: terms, weights and reductions, one section each."""

from __future__ import annotations

from abc import abstractmethod
from typing import TYPE_CHECKING, Annotated, Literal

import numpy as np
from pydantic import Field

from mi_nerfattack.attack import weights
from mi_nerfattack.attack.objectives import (
    AbsoluteDeviation,
    CrossTrackDeviation,
    DepartureTime,
    HeadingDeviation,
    TargetDistance,
)
from mi_nerfattack.attack.user_cost import UserCost
from mi_nerfattack.ranges import Finite, Positive, SomeShare
from mi_nerfattack.rollout.drive import departure_limit
from mi_nerfattack.rollout.objective import (
    AbstractObjective,
    StageCost,
    StageSum,
    Terminal,
    WeightedSum,
)
from mi_nerfattack.rollout.reduction import AbstractReduction, CVaR, Mean, Worst
from mi_nerfattack.scenario.named_file import Code, File
from mi_nerfattack.scenario.section import Kinds, Section, Trust
from mi_nerfattack.vehicle.dynamics import AbstractDynamics
from mi_nerfattack.vehicle.route.route import Route
from mi_nerfattack.vehicle.state import to_state

if TYPE_CHECKING:
    from mi_nerfattack.scenario.scenario import Scenario

# Weights of the times


class PlainWeights(Section):
    """Equal weights, or such that grow with time."""

    weights: Literal["uniform", "linear"] = "uniform"

    def build(self, steps: int, dt: float) -> np.ndarray | None:
        """Return a weight a control period of `dt` seconds; None for equal ones."""
        return weights.linear(steps) if self.weights == "linear" else None


class LastWeights(Section):
    """The last seconds alone."""

    weights: Literal["last"]
    last_s: Positive

    def build(self, steps: int, dt: float) -> np.ndarray:
        """Return the weights."""
        return weights.last_seconds(steps, dt, self.last_s)


class DiscountWeights(Section):
    """Weights that fade with time."""

    weights: Literal["discount"]
    discount_per_s: SomeShare

    def build(self, steps: int, dt: float) -> np.ndarray:
        """Return the weights."""
        return weights.discounted(steps, dt, self.discount_per_s)


class ListedWeights(Section):
    """Weights of the user's."""

    weights: Literal["listed"]
    listed_weights: tuple[Finite, ...]  # one a control period

    def build(self, steps: int, dt: float) -> np.ndarray:
        """Return the weights."""
        return weights.listed(steps, self.listed_weights)


Weights = Annotated[
    PlainWeights | LastWeights | DiscountWeights | ListedWeights, Kinds("weights")
]

# States that count


class AllTimes(Section):
    """The states after all control periods."""

    at: Literal["all_times"] = "all_times"
    weights: Weights = Field(default=PlainWeights(), validation_alias="(weights)")

    def build(
        self, cost: StageCost, scenario: Scenario, route: Route
    ) -> AbstractObjective:
        """Sum the cost over time."""
        dt = scenario.vehicle.dt_s
        steps = scenario.drive.steps(route, dt)
        return StageSum(cost, self.weights.build(steps, dt))


class AtEnd(Section):
    """The last state alone."""

    at: Literal["end"]

    def build(
        self, cost: StageCost, scenario: Scenario, route: Route
    ) -> AbstractObjective:
        """Take the cost of the last state."""
        return Terminal(cost)


# Terms


class AbstractTerm(Section):
    """One part of the objective."""

    weight: Finite = 1.0

    @abstractmethod
    def build(
        self, scenario: Scenario, route: Route, dynamics: AbstractDynamics
    ) -> AbstractObjective:
        """Make the term without its weight; see :meth:`ObjectiveSection.build`."""


class DepartureTimeTerm(AbstractTerm):
    """The expected time in the lane."""

    kind: Literal["departure_time"]
    limit_m: Positive | None = None  # half of what the lane is wider than the car
    softness_m: Positive = 0.25

    def build(
        self, scenario: Scenario, route: Route, dynamics: AbstractDynamics
    ) -> AbstractObjective:
        """Make the term."""
        width = scenario.vehicle.width_m
        limit = self.limit_m or departure_limit(route.lane_width_m, width)
        return DepartureTime(route, limit, self.softness_m)


class AbstractStageTerm(AbstractTerm):
    """A cost of states."""

    at: Annotated[AllTimes | AtEnd, Kinds("at")] = Field(
        default=AllTimes(), validation_alias="(at)"
    )

    def build(
        self, scenario: Scenario, route: Route, dynamics: AbstractDynamics
    ) -> AbstractObjective:
        """Make the term."""
        return self.at.build(self.cost(route, dynamics), scenario, route)

    @abstractmethod
    def cost(self, route: Route, dynamics: AbstractDynamics) -> StageCost:
        """Make the cost of a state."""


class CrossTrackTerm(AbstractStageTerm):
    """The distance from the lane centre, rounded at 0."""

    kind: Literal["cross_track"] = "cross_track"
    rounding_m: Positive = 0.05

    def cost(self, route: Route, dynamics: AbstractDynamics) -> StageCost:
        """Make the cost."""
        return CrossTrackDeviation(route, self.rounding_m)


class AbsoluteCrossTrackTerm(AbstractStageTerm):
    """The distance from the lane centre."""

    kind: Literal["absolute_cross_track"]

    def cost(self, route: Route, dynamics: AbstractDynamics) -> StageCost:
        """Make the cost."""
        return AbsoluteDeviation(route)


class HeadingTerm(AbstractStageTerm):
    """The angle to the lane."""

    kind: Literal["heading"]
    rounding_deg: Positive = 1.0

    def cost(self, route: Route, dynamics: AbstractDynamics) -> StageCost:
        """Make the cost."""
        return HeadingDeviation(route, float(np.radians(self.rounding_deg)))


class TargetPathTerm(AbstractStageTerm):
    """The distance to a path of the attacker's."""

    kind: Literal["target_path"]
    target: File  # JSON of routes
    target_route: str
    rounding_m: Positive = 0.05

    def cost(self, route: Route, dynamics: AbstractDynamics) -> StageCost:
        """Load the path."""
        path = Route.from_file(self.target.file, self.target_route)
        return TargetDistance(path, self.rounding_m)


class FunctionTerm(AbstractStageTerm):
    """A function of the user's."""

    kind: Literal["function"]
    function: Code
    trust_code: Trust = False  # it runs with all rights of the account

    def cost(self, route: Route, dynamics: AbstractDynamics) -> StageCost:
        """Load the function and try it beside the lane, off its centre."""
        function = self.function.load("objective.function", self.trust_code)
        cost = UserCost(self.function.name, function)
        arc = np.array([0.25, 0.75]) * route.length
        poses = route.pose_at(arc, np.array([0.31, -0.17]), np.array([0.07, -0.05]))
        cost.check(to_state(dynamics.extend(poses)))
        return cost


Term = Annotated[
    CrossTrackTerm
    | AbsoluteCrossTrackTerm
    | HeadingTerm
    | TargetPathTerm
    | FunctionTerm
    | DepartureTimeTerm,
    Kinds("kind"),
]

# Reductions over the initial poses


class PlainReduction(Section):
    """The mean of the costs, or the largest."""

    reduction: Literal["mean", "worst"] = "mean"

    def build(self) -> AbstractReduction:
        """Make the reduction."""
        return Worst() if self.reduction == "worst" else Mean()


class CVaRReduction(Section):
    """The mean of the largest costs."""

    reduction: Literal["cvar"]
    cvar_fraction: SomeShare

    def build(self) -> AbstractReduction:
        """Make the reduction."""
        return CVaR(self.cvar_fraction)


class ObjectiveSection(Section):
    """What the attack makes smaller: the sum of a term and further ones."""

    first: Term = Field(default=CrossTrackTerm(), validation_alias="(first)")
    reduction: Annotated[PlainReduction | CVaRReduction, Kinds("reduction")] = Field(
        default=PlainReduction(), validation_alias="(reduction)"
    )
    terms: tuple[Term, ...] = ()

    def build(
        self, scenario: Scenario, route: Route, dynamics: AbstractDynamics
    ) -> AbstractObjective:
        """Make the objective.

        Args:
            scenario: gives horizon, control period and the width of the vehicle.
            route: the lane centre, with the vehicle's speed.
            dynamics: the vehicle, for the number of rows of a state.

        Raises:
            InputError: a file is missing or wrong, a function of the user's returns
                something else than costs, or weights do not fit the horizon.
        """
        terms = tuple(
            (term.weight, term.build(scenario, route, dynamics))
            for term in (self.first, *self.terms)
        )
        if len(terms) == 1 and self.first.weight == 1:
            return terms[0][1]
        return WeightedSum(terms)
