"""What every kind of the section ``[policy]`` has, whatever its file."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from typing import Annotated, Any, ClassVar

from pydantic import Field, model_validator

from mi_nerfattack.deploy.car import Car
from mi_nerfattack.errors import InputError
from mi_nerfattack.policy.action import Action, Trajectory
from mi_nerfattack.policy.base import AbstractPolicy, Numbers
from mi_nerfattack.policy.inputs import Inputs
from mi_nerfattack.ranges import Natural, Positive
from mi_nerfattack.scenario.policy.parts import (
    NonZero,
    PreprocessSection,
    TrajectorySection,
)
from mi_nerfattack.scenario.section import (
    OneOrSeveral,
    Section,
    Trust,
    Unit,
    refuse,
)

Views = Mapping[str, tuple[slice, slice]]
NO_VIEWS: Views = {}


class AbstractPolicySection(Section):
    """What describes every policy."""

    #: To rad/s (dubins) or rad, positive to the left; of several controls one each.
    control_scale: OneOrSeveral[NonZero] = 1.0
    #: After `control_scale`; results do not depend on this key.
    control_unit: Annotated[Unit | None, Field(exclude=True)] = None
    #: Column of the control, where there are several; or columns of several.
    output: OneOrSeveral[Natural] | None = None
    #: What the policy is given, in its order: image or names of cameras, speed, route,
    #: time, goal; by default images and goal.
    inputs: tuple[str, ...] = ()
    route_m: tuple[Positive, ...] = ()  # of the points of "route"
    trajectory: TrajectorySection | None = None
    preprocess: PreprocessSection = PreprocessSection()
    trust_code: Trust = False  # of files that are code: they run with all rights

    later: ClassVar[tuple[str, ...]] = ("inputs", "route_m", "trajectory")
    group: ClassVar[str] = "mi_nerfattack.policies"
    #: Whether a server has the policy; it may keep a state, which several processes
    #: would mix.
    is_remote: ClassVar[bool] = False
    #: Times of the positions that the kind itself gives, seconds; () where none.
    own_times_s: ClassVar[tuple[float, ...]] = ()
    #: Control period that the kind was trained with, seconds; None where any will do.
    period_s: ClassVar[float | None] = None

    @property
    def source(self) -> str:
        """The file or URL, as it is given; the kind of a policy with neither."""
        values = dict(self)
        return str(values.get("file") or values.get("url") or values["kind"])

    def unit(self) -> str | None:
        """Return the unit of the first control; None where nothing says it."""
        return self.control_unit if self.trajectory is None else self.trajectory.unit

    @abstractmethod
    def build(self, views: Views = NO_VIEWS) -> AbstractPolicy:
        """Make the policy.

        Args:
            views: rows and columns of each camera's image in the frame, by its name;
                by default the frame is the only image.

        Raises:
            InputError: a file is missing or wrong, or is code without the word of
                trust, or a package that the kind needs is not installed.
        """

    def action(self) -> Action:
        """Return what the policy's answer means."""
        return Action(self.columns, self.control_scale, self._follower())

    @property
    def columns(self) -> int | tuple[int, ...] | None:
        """Columns of the controls in the answer."""
        return self.output

    def _follower(self) -> Trajectory | None:
        times, section = self.own_times_s, self.trajectory
        return None if section is None else section.build(times)

    def build_inputs(self, views: Views) -> Inputs:
        """Return what the policy is given; `views` as of :meth:`build`."""
        speed = "speed" in self.inputs or self.trajectory is not None
        numbers = Numbers(speed, self.route_m, "time" in self.inputs)
        return Inputs(self.inputs, numbers, views)

    def check_driven(self, views: Views, car: Car) -> None:
        """Refuse what does not go with a vehicle's cameras and controls.

        Args:
            views: as of :meth:`build`.
            car: the vehicle's.
        """
        try:
            self.build_inputs(views)
        except InputError as error:
            refuse("policy.inputs", str(error).partition("policy.inputs: ")[2])
        check_count(self.action().count, car.control_names)
        follower = self._follower()
        steers = car.control_names[0] == "steering"  # the units were compared before
        if follower is not None and steers:
            ratio = follower.wheelbase_m / car.wheelbase
            if not 0.99 < ratio < 1.01:
                refuse(
                    "policy.trajectory.wheelbase_m",
                    f"is {follower.wheelbase_m:g}; the vehicle's is {car.wheelbase:g}",
                )

    @model_validator(mode="after")
    def _check_keys(self) -> Any:
        """Refuse points that are not told, or told without distances."""
        if ("route" in self.inputs) != bool(self.route_m):
            refuse(
                "route_m",
                'arc lengths to points ahead, metres, go with "route" among inputs',
            )
        if self.trajectory is not None and self.control_unit is not None:
            refuse("control_unit", "trajectory.controls says it; leave it out")
        self._check_trajectory()
        try:
            self.action()
        except InputError as error:
            refuse("output", str(error))
        return self

    def _check_trajectory(self) -> None:
        """Refuse a trajectory without times, with those of another, or a wrong one."""
        if self.trajectory is None:
            return
        if self.trajectory.times_s is None and not self.own_times_s:
            refuse("trajectory.times_s", "is missing")
        if self.trajectory.times_s is not None and self.own_times_s:
            refuse("trajectory.times_s", "the policy has its own times; leave it out")
        try:
            self._follower()
        except InputError as error:
            refuse("trajectory", str(error))
        section, usual = self.trajectory, self.trajectory.defaults()
        unused = ["wheelbase_m"] if section.controls[0] == "heading_rate" else []
        unused += ["speed_s", "speed_gain"] if len(section.controls) == 1 else []
        for key in unused:
            if getattr(section, key) != usual[key]:
                refuse(f"trajectory.{key}", f"has no effect on {section.controls[0]}")


def misfit(policy_unit: str | None, vehicle_unit: str | None, source: str) -> str:
    """Say why a vehicle does not take a policy's control; nothing if it may.

    Args:
        policy_unit: unit of the policy's control; None where nothing says it.
        vehicle_unit: unit of the vehicle's control; None where nothing says it.
        source: of the policy, for the message.
    """
    if None in (policy_unit, vehicle_unit) or policy_unit == vehicle_unit:
        return ""
    return (
        f"takes {vehicle_unit}, and {source} gives {policy_unit}; take another of "
        "them, convert the control by policy.control_scale, or, with waypoints, change "
        "policy.trajectory.controls"
    )


def check_count(count: int, names: Sequence[str]) -> None:
    """Refuse a policy that gives more or fewer controls than its vehicle takes.

    Args:
        count: number of the policy's.
        names: of the vehicle's.
    """
    if count != len(names):
        refuse(
            "policy.output",
            f"the policy gives {count}, the vehicle takes {len(names)}: "
            f"{', '.join(names)}; give a column for each",
        )
