"""The sections ``[vehicle]``, one for each model."""

from __future__ import annotations

import math
from abc import abstractmethod
from dataclasses import replace
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from pydantic import Field, model_validator

from mi_nerfattack.deploy.car import CAR, Car, Control
from mi_nerfattack.deploy.vehicle import Motion
from mi_nerfattack.ranges import Count, Finite, Natural, Positive
from mi_nerfattack.scenario.named_file import AnyCode
from mi_nerfattack.scenario.section import (
    Kinds,
    OneOrSeveral,
    Section,
    Trust,
    Unit,
    refuse,
)
from mi_nerfattack.vehicle.bicycle import KinematicBicycle, RateLimitedAckermann
from mi_nerfattack.vehicle.dynamics import AbstractDynamics, Ackermann, Dubins
from mi_nerfattack.vehicle.integrators import (
    RK4,
    AbstractIntegrator,
    ExplicitEuler,
    ImplicitMidpoint,
)
from mi_nerfattack.vehicle.single_track import DynamicSingleTrack, KinematicSingleTrack
from mi_nerfattack.vehicle.trial import try_model
from mi_nerfattack.vehicle.user_model import FunctionDynamics, user_controls

INTEGRATORS: dict[str, type[AbstractIntegrator]] = {
    "euler": ExplicitEuler,
    "rk4": RK4,
    "implicit_midpoint": ImplicitMidpoint,
}
#: Ratio of step and time constant at which the integration of a lag diverges.
_STABLE_RATIO = {"euler": 2.0, "rk4": 2.78, "implicit_midpoint": float("inf")}
#: The same that keeps 6 s of hard steering by rk4 within 1 cm.
_FINE_RATIO, _MOST_SUBSTEPS = 0.4, 64
#: The same that keeps a car calm which comes to rest.
_CALM_RATIO = 2.0
SteerAngle = Annotated[float, Field(gt=0, lt=90)]


class AbstractVehicleSection(Section):
    """What all vehicles have: a control period, divided into integration steps."""

    integrator: Literal["euler", "rk4", "implicit_midpoint"] = "rk4"
    dt_s: Positive = 0.1  # control period
    substeps: Count = 1  # integration steps a control period
    delay_steps: Natural = 0  # integration steps
    width_m: Positive = 1.8
    group: ClassVar[str] = "mi_nerfattack.vehicles"
    has_wheels: ClassVar[bool] = True

    @abstractmethod
    def build(self) -> AbstractDynamics:
        """Make the model; a variant must be set for a custom one.

        Raises:
            InputError: a function cannot be loaded, or is no model of a vehicle.
        """

    def motion(self) -> Motion:
        """Make the model with its time step; see :meth:`build`.

        Raises:
            InputError: the model of another package fails its trial.
        """
        model, integrator = self.build(), INTEGRATORS[self.integrator]()
        if self.package:
            car = self.car()
            limits = (car.max_control, *(item.highest for item in car.more_controls))
            try_model(f"vehicle.kind: {self.package}", model, limits)
        return Motion(model, integrator, self.substeps, self.delay_steps)

    def car(self) -> Car:
        """Describe the car with wheels: of this width, other sizes in proportion.

        A custom vehicle's says its limit alone.
        """
        size = self.width_m / CAR.width
        names = ("wheelbase", "length", "track", "wheel_radius")
        sizes = {name: size * getattr(CAR, name) for name in names}
        sizes |= {"width": self.width_m, "mass": CAR.mass * size**3}
        return replace(CAR, **{**sizes, **self.handling()})

    @property
    def unit(self) -> str | None:
        """Unit of the control; None where a custom vehicle does not say it."""
        return self.car().control_unit

    @property
    def fits_wheels(self) -> bool:
        """Whether MuJoCo's car, which has wheels, takes the control."""
        return self.has_wheels and self.unit != "other"

    @property
    def has_expert(self) -> bool:
        """Whether an expert knows what the control does."""
        named = [control.name for control in self.car().more_controls]
        return self.unit in ("rad/s", "rad") and named in ([], ["acceleration"])

    @abstractmethod
    def handling(self) -> dict[str, Any]:
        """Return what the model says about the car: keys of `deploy.car.Car`."""

    def _divide(self, key: str, time_s: float, fine_ratio: float) -> None:
        """Take steps that are fine enough by default, and refuse those that diverge.

        Args:
            key: that an error names.
            time_s: smallest time constant of the model, seconds.
            fine_ratio: of a step and this time, that is fine enough.
        """
        fine = math.ceil(self.dt_s / (fine_ratio * time_s) - 1e-9)
        is_free = "substeps" not in self.model_fields_set and self.integrator == "rk4"
        if is_free and fine <= _MOST_SUBSTEPS:
            object.__setattr__(self, "substeps", max(1, fine))  # it is frozen
        step, limit = self.dt_s / self.substeps, _STABLE_RATIO[self.integrator]
        if step / time_s >= limit:
            refuse(
                key,
                f"integration steps of dt_s / substeps = {step:g} s diverge "
                f"with {self.integrator}: they must be below {limit:g} x "
                f"{time_s:.4g} s; raise substeps",
            )


class DubinsSection(AbstractVehicleSection):
    """Controlled by its heading rate."""

    kind: Literal["dubins"] = "dubins"
    speed_ms: Positive = 5.0
    max_heading_rate: Positive = 1.5

    def build(self) -> AbstractDynamics:
        """Make the model."""
        return Dubins(self.speed_ms, self.max_heading_rate)

    def handling(self) -> dict[str, Any]:
        return {"max_control": self.max_heading_rate}


class AckermannSection(AbstractVehicleSection):
    """Controlled by its steering angle."""

    kind: Literal["ackermann"]
    speed_ms: Positive = 5.0
    wheelbase_m: Positive = 2.7
    max_steer_deg: SteerAngle = 34.0

    def build(self) -> AbstractDynamics:
        """Make the model."""
        steer = float(np.radians(self.max_steer_deg))
        return Ackermann(self.speed_ms, self.wheelbase_m, steer)

    def handling(self) -> dict[str, Any]:
        return _steered(self.wheelbase_m, self.max_steer_deg)


class AckermannRateSection(AbstractVehicleSection):
    """Controlled by a steering angle that it follows with a lag."""

    kind: Literal["ackermann_rate"]
    speed_ms: Positive = 5.0
    wheelbase_m: Positive = 2.7
    max_steer_deg: SteerAngle = 34.0
    max_steer_rate_deg_s: Positive = 40.0
    steer_time_s: Positive = 0.1  # time constant of the steering's lag

    @model_validator(mode="after")
    def _check_steps(self) -> Any:
        """Take steps that follow the lag."""
        self._divide("steer_time_s", self.steer_time_s, _FINE_RATIO)
        return self

    def build(self) -> AbstractDynamics:
        """Make the model."""
        steer = math.radians(self.max_steer_deg)  # Dr.Jit takes no NumPy numbers
        rate = math.radians(self.max_steer_rate_deg_s)
        return RateLimitedAckermann(
            self.speed_ms, self.wheelbase_m, steer, rate, self.steer_time_s
        )

    def handling(self) -> dict[str, Any]:
        return _steered(self.wheelbase_m, self.max_steer_deg)


class BicycleSection(AbstractVehicleSection):
    """Controlled by its steering angle, about its centre of gravity."""

    kind: Literal["bicycle"]
    speed_ms: Positive = 5.0
    front_axle_m: Positive = 1.35  # from the centre of gravity
    rear_axle_m: Positive = 1.35
    max_steer_deg: SteerAngle = 34.0

    def build(self) -> AbstractDynamics:
        """Make the model."""
        front, rear = self.front_axle_m, self.rear_axle_m
        steer = float(np.radians(self.max_steer_deg))
        return KinematicBicycle(self.speed_ms, front, rear, steer)

    def handling(self) -> dict[str, Any]:
        wheelbase, rear = self.front_axle_m + self.rear_axle_m, self.rear_axle_m
        return _steered(wheelbase, self.max_steer_deg) | {"reference": rear}


class AbstractSingleTrackSection(AbstractVehicleSection):
    """Controlled by its steering angle and its acceleration; the speed is a state."""

    speed_ms: Positive = 5.0  # at the start; the expert keeps it
    max_steer_deg: SteerAngle = 34.0
    max_acceleration_ms2: Positive = 3.0
    max_brake_ms2: Positive = 8.0
    stop_speed_ms: Positive = 0.5  # below three times this, brakes fade

    @property
    @abstractmethod
    def fastest_rate(self) -> float:
        """Largest rate of decay of the model, 1/s."""

    @model_validator(mode="after")
    def _check_steps(self) -> Any:
        """Take steps that keep the car calm at rest."""
        self._divide("substeps", 1 / self.fastest_rate, _CALM_RATIO)
        return self

    def _limits(self) -> dict[str, float]:
        steer = math.radians(self.max_steer_deg)  # Dr.Jit takes no NumPy numbers
        brakes = {"max_brake": self.max_brake_ms2, "stop_speed": self.stop_speed_ms}
        most = {"max_steer": steer, "max_acceleration": self.max_acceleration_ms2}
        return {"speed": self.speed_ms, **most, **brakes}

    def _accelerated(self, wheelbase: float) -> dict[str, Any]:
        most, brake = self.max_acceleration_ms2, self.max_brake_ms2
        controls = (Control("acceleration", "m/s^2", lowest=-brake, highest=most),)
        return _steered(wheelbase, self.max_steer_deg) | {"more_controls": controls}


class KinematicSingleTrackSection(AbstractSingleTrackSection):
    """Rolls without slip, about its rear axle."""

    kind: Literal["kinematic_single_track"]
    wheelbase_m: Positive = 2.7

    def build(self) -> AbstractDynamics:
        """Make the model."""
        return KinematicSingleTrack(**self._limits(), wheelbase=self.wheelbase_m)

    @property
    def fastest_rate(self) -> float:
        """See :class:`AbstractSingleTrackSection`."""
        return self.max_brake_ms2 / self.stop_speed_ms

    def handling(self) -> dict[str, Any]:
        return self._accelerated(self.wheelbase_m)


class DynamicSingleTrackSection(AbstractSingleTrackSection):
    """Has tyres that slip, about its centre of gravity."""

    kind: Literal["dynamic_single_track"]
    front_axle_m: Positive = 1.35  # from the centre of gravity
    rear_axle_m: Positive = 1.35
    mass_kg: Positive = 1400.0
    yaw_inertia_kgm2: Positive = 2200.0
    front_stiffness_n_rad: Positive = 80000.0  # of both tyres of an axle
    rear_stiffness_n_rad: Positive = 80000.0
    friction: Positive = 0.9
    low_speed_ms: Positive = 1.0  # around and below it, slip angles are less

    def build(self) -> DynamicSingleTrack:
        """Make the model."""
        return DynamicSingleTrack(
            **self._limits(),
            front_m=self.front_axle_m,
            rear_m=self.rear_axle_m,
            mass=self.mass_kg,
            yaw_inertia=self.yaw_inertia_kgm2,
            front_stiffness=self.front_stiffness_n_rad,
            rear_stiffness=self.rear_stiffness_n_rad,
            friction=self.friction,
            low_speed=self.low_speed_ms,
        )

    @property
    def fastest_rate(self) -> float:
        """See :class:`AbstractSingleTrackSection`."""
        return self.build().fastest_rate

    def handling(self) -> dict[str, Any]:
        handling = self._accelerated(self.front_axle_m + self.rear_axle_m)
        return handling | {"mass": self.mass_kg, "reference": self.rear_axle_m}


class CustomSection(AbstractVehicleSection):
    """A function of the user's."""

    kind: Literal["custom"]
    has_wheels: ClassVar[bool] = False
    function: AnyCode
    trust_code: Trust = False  # it runs with all rights of the account
    framework: Literal["drjit", "torch"] = "drjit"  # of the function
    state_size: Annotated[int, Field(ge=3, le=16)] = 3
    controls: Annotated[int, Field(ge=1, le=8)] = 1  # of the function
    control_limit: OneOrSeveral[Positive]  # in the unit of each control
    rest_state: tuple[Finite, ...] = ()  # initial values of the rows after theta
    #: Drives do not depend on these two, only the expert that `evaluate` compares with.
    control_unit: Annotated[Unit | None, Field(exclude=True)] = None
    wheelbase_m: Annotated[Positive | None, Field(exclude=True)] = None
    later: ClassVar[tuple[str, ...]] = ("controls",)

    @property
    def limits(self) -> tuple[float, ...]:
        """The limit of each control."""
        limit = self.control_limit
        return limit if isinstance(limit, tuple) else (limit,) * self.controls

    @model_validator(mode="after")
    def _check_sizes(self) -> Any:
        """Refuse initial values and limits of too many or too few numbers."""
        if len(self.rest_state) not in (0, self.state_size - 3):
            refuse(
                "rest_state",
                f"has {len(self.rest_state)} numbers; state_size = "
                f"{self.state_size} needs {self.state_size - 3} or none",
            )
        if len(self.limits) != self.controls:
            refuse(
                "control_limit",
                f"has {len(self.limits)} numbers; controls = {self.controls} needs one "
                "for all, or one for each",
            )
        return self

    @model_validator(mode="after")
    def _check_unit(self) -> Any:
        """Refuse a steering angle of which no heading rate follows."""
        if self.control_unit == "rad":
            if self.wheelbase_m is None:
                refuse("wheelbase_m", 'is missing; control_unit = "rad" needs it')
            if self.limits[0] >= math.pi / 2:
                refuse("control_limit", "is no steering angle; must be below pi / 2")
        return self

    @property
    def unit(self) -> str | None:
        """What the key says."""
        return self.control_unit

    def build(self) -> AbstractDynamics:
        """Load the function, and try it near the origin and the initial state."""
        kind = FunctionDynamics
        if self.framework == "torch":
            from mi_nerfattack.vehicle.torch_model import TorchDynamics as kind
        function = self.function.load("vehicle.function", self.trust_code)
        dynamics = kind(
            function,
            size=self.state_size,
            limit=self.limits[0] if self.controls == 1 else self.limits,
            rest_state=self.rest_state,
            controls=self.controls,
        )
        try_model(dynamics.name, dynamics, self.limits)
        return dynamics

    def handling(self) -> dict[str, Any]:
        (limit, *others), wheelbase = self.limits, self.wheelbase_m
        steered = {"max_steer": limit} if self.control_unit == "rad" else {}
        sizes = {} if wheelbase is None else {"wheelbase": wheelbase}
        pairs = zip(user_controls(self.controls)[1:], others, strict=True)
        other_controls = [Control(name, "other", -most, most) for name, most in pairs]
        steering = {"max_control": limit, "control_unit": self.control_unit or "other"}
        return {**steering, **steered, **sizes, "more_controls": tuple(other_controls)}


def _steered(wheelbase: float, max_steer_deg: float) -> dict[str, Any]:
    steer = float(np.radians(max_steer_deg))
    control = {"control_unit": "rad", "max_control": steer, "max_steer": steer}
    return {"wheelbase": wheelbase, **control}


VehicleSection = Annotated[
    DubinsSection
    | AckermannSection
    | AckermannRateSection
    | BicycleSection
    | KinematicSingleTrackSection
    | DynamicSingleTrackSection
    | CustomSection,
    Kinds("dubins", AbstractVehicleSection),
]
