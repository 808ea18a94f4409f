"""The sections ``[objective]`` and ``[attack.vary]``: of which drives, and what.

Terms, weights and reductions are one section each.
"""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import replace
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal

import numpy as np
from pydantic import AfterValidator, Field
from pydantic_core import PydanticCustomError

from mi_nerfattack.attack.objectives import (
    AbsoluteDeviation,
    CrossTrackDeviation,
    DepartureTime,
    Discounted,
    End,
    HeadingDeviation,
    LastSeconds,
    Linear,
    Listed,
    TargetDistance,
    Uniform,
)
from mi_nerfattack.attack.user_cost import UserCost
from mi_nerfattack.ranges import Finite, NonNegative, Positive
from mi_nerfattack.render.camera.disturbance import Disturbance
from mi_nerfattack.rollout.drive import departure_limit
from mi_nerfattack.rollout.loop import ClosedLoop
from mi_nerfattack.rollout.objective import (
    AbstractObjective,
    CVaR,
    Mean,
    StageCost,
    StageSum,
    Terminal,
    WeightedSum,
    Worst,
)
from mi_nerfattack.rollout.scene_sensor import SceneSensor
from mi_nerfattack.rollout.variation import SunRanges, Variation, Varied
from mi_nerfattack.scenario.named_file import Code, File
from mi_nerfattack.scenario.section import Kinds, Section, Trust
from mi_nerfattack.vehicle.dynamics import AbstractDynamics, to_state
from mi_nerfattack.vehicle.route.route import Route

if TYPE_CHECKING:
    from mi_nerfattack.scenario.scenario import Scenario

Weights = Annotated[
    Uniform | Linear | LastSeconds | Discounted | Listed | End, Kinds("uniform")
]
Pair = tuple[Finite, Finite]
Stops = Annotated[float, Field(ge=0, le=8)]  # powers of two
Logarithm = Annotated[float, Field(ge=0, le=1)]  # of factors

# Terms


class AbstractTerm(Section):
    """One part of the objective.

    Attributes:
        reads_all_rows: whether the cost takes all rows of the model's state, not the
            pose alone.
    """

    weight: Finite = 1.0

    reads_all_rows: ClassVar[bool] = False

    @property
    def name(self) -> str:
        """What messages call the term."""
        return str(dict(self)["kind"])

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

    weights: Weights = Uniform()

    def build(
        self, scenario: Scenario, route: Route, dynamics: AbstractDynamics
    ) -> AbstractObjective:
        """Make the term."""
        dt = scenario.vehicle.dt_s
        cost, steps = self.cost(route, dynamics), scenario.drive.steps(route, dt)
        if isinstance(self.weights, End):
            return Terminal(cost)
        return StageSum(cost, self.weights.of(steps, dt))

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

    reads_all_rows = True

    @property
    def name(self) -> str:
        """The function, without the folder of its file."""
        return self.function.name.replace("\\", "/").rpartition("/")[2]

    def cost(self, route: Route, dynamics: AbstractDynamics) -> StageCost:
        """Load the function and try it at two poses off the lane's centre."""
        function = self.function.load("objective.term.function", self.trust_code)
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
    Kinds("cross_track"),
]


class ObjectiveSection(Section):
    """What the attack makes smaller: the sum of terms."""

    term: Annotated[tuple[Term, ...], Field(min_length=1)] = (CrossTrackTerm(),)
    reduction: Annotated[Mean | Worst | CVaR, Kinds("mean")] = Mean()

    @property
    def name(self) -> str:
        """The terms and their weights, as verdict and pages call the objective."""
        terms = [
            term.name if term.weight == 1 else f"{term.weight:g} x {term.name}"
            for term in self.term
        ]
        return " + ".join(terms)

    @property
    def is_lane_distance(self) -> bool:
        """Whether the objective is the summed distance from the lane, as by default."""
        [first, *others] = self.term
        return (
            isinstance(first, CrossTrackTerm | AbsoluteCrossTrackTerm)
            and isinstance(first.weights, Uniform)
            and first.weight > 0
            and not others
        )

    @property
    def reads_all_rows(self) -> bool:
        """Whether a term takes all rows of the model's state, not the pose alone."""
        return any(term.reads_all_rows for term in self.term)

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
            (term.weight, term.build(scenario, route, dynamics)) for term in self.term
        )
        if len(terms) == 1 and self.term[0].weight == 1:
            return terms[0][1]
        return WeightedSum(terms)


def within(low: float, high: float) -> AfterValidator:
    """Hold a range to limits, and its two ends to their order."""

    def check(pair: Pair) -> Pair:
        if not low <= pair[0] <= pair[1] <= high:
            why = f"must be two numbers in order, from {low:g} to {high:g}"
            raise PydanticCustomError("range", "{why}", {"why": why})
        return pair

    return AfterValidator(check)


class SunSection(Section):
    """Sun and sky on objects: the range of each number, of which draws are even."""

    elevation_deg: Annotated[Pair, within(0, 90)] = (10.0, 70.0)
    azimuth_deg: Annotated[Pair, within(-360, 720)] = (0.0, 360.0)  # from +y to +x
    share: Annotated[Pair, within(0, 0.95)] = (0.0, 0.9)  # the sun's, of what faces it
    colour_k: Annotated[Pair, within(1500, 20000)] = (6500.0, 6500.0)  # of the sun

    def build(self) -> SunRanges:
        """Make the ranges."""
        return SunRanges(**self.model_dump())


class VarySection(Section):
    """Standard deviations of normal draws, one of each for the drive of a pose."""

    sun: SunSection | None = None  # None for that of the capture
    light_ev_sd: Stops = 0.0  # of the light on objects, powers of two
    light_colour_ev_sd: Stops = 0.0  # of each channel of it
    exposure_ev_sd: Stops = 0.0  # of the whole image, powers of two
    colour_ev_sd: Stops = 0.0  # of each channel of it
    blur_px_sd: NonNegative = 0.0  # of the number whose size blurs a drive
    noise_sd: NonNegative = 0.0  # of each frame, sRGB in [0, 1]
    pitch_deg_sd: Annotated[float, Field(ge=0, le=45)] = 0.0  # of the camera
    height_sd: Logarithm = 0.0  # of the logarithm of its height
    speed_sd: Logarithm = 0.0  # of the logarithm of the vehicle's speed
    steering_sd: Logarithm = 0.0  # of the logarithm of its heading rate
    #: Of the number whose size is the time constant of the steering.
    steering_lag_s_sd: NonNegative = 0.0
    #: Of the number whose size adds to the delay of the controls.
    delay_s_sd: Annotated[float, Field(ge=0, le=5)] = 0.0
    later: ClassVar[tuple[str, ...]] = ("sun", "steering_lag_s_sd", "delay_s_sd")

    def applied(self, loop: ClosedLoop, seed: int) -> ClosedLoop:
        """Return a loop whose drives differ.

        Args:
            loop: through a `SceneSensor`.
            seed: of all draws.

        Raises:
            InputError: there are no objects whose light could vary.
        """
        drawn = {name: getattr(self, name) for name in type(self).model_fields}
        drawn["sun"] = None if self.sun is None else self.sun.build()
        sizes = ("exposure_ev_sd", "blur_px_sd", "noise_sd", "colour_ev_sd")
        disturbance = Disturbance(
            **{name: drawn.pop(name) for name in sizes}, seed=seed
        )
        variation = Variation(**drawn, seed=seed)
        sensor, dynamics = loop.sensor, loop.dynamics
        if variation.of_light or variation.of_mount:
            assert isinstance(sensor, SceneSensor)  # as that of every world
            sensor = sensor.varied(variation)
        if variation.of_vehicle:
            dynamics = Varied(dynamics, variation, loop.transition.dt)
        return replace(loop, sensor=sensor, dynamics=dynamics, disturbance=disturbance)
