"""The sections ``[vehicle]``, one for each model."""

from __future__ import annotations

import math
from abc import abstractmethod
from dataclasses import replace
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field, model_validator

from mi_nerfattack.deploy.car import CAR, Car
from mi_nerfattack.deploy.vehicle import Motion
from mi_nerfattack.ranges import Count, Finite, Positive, Whole
from mi_nerfattack.scenario.named_file import AnyCode
from mi_nerfattack.scenario.section import Kinds, Section, Trust, Unit, refuse
from mi_nerfattack.vehicle.bicycle import KinematicBicycle, RateLimitedAckermann
from mi_nerfattack.vehicle.dynamics import AbstractDynamics, Ackermann, Dubins, to_state
from mi_nerfattack.vehicle.integrators import (
    RK4,
    AbstractIntegrator,
    ExplicitEuler,
    ImplicitMidpoint,
)
from mi_nerfattack.vehicle.trial import require_model
from mi_nerfattack.vehicle.user_model import FunctionDynamics

INTEGRATORS: dict[str, type[AbstractIntegrator]] = {
    "euler": ExplicitEuler,
    "rk4": RK4,
    "implicit_midpoint": ImplicitMidpoint,
}
#: Ratio of step and time constant at which the integration of a lag diverges.
_STABLE_RATIO = {"euler": 2.0, "rk4": 2.78, "implicit_midpoint": float("inf")}
#: The same that keeps 6 s of hard steering by rk4 within 1 cm.
_FINE_RATIO, _MOST_SUBSTEPS = 0.4, 64
#: Vehicles with which a user's model is tried.
TRIALS = 3

SteerAngle = Annotated[float, Field(gt=0, lt=90)]


class AbstractVehicleSection(Section):
    """What all vehicles have: a control period, divided into integration steps."""

    integrator: Literal["euler", "rk4", "implicit_midpoint"] = "rk4"
    dt_s: Positive = 0.1  # control period
    substeps: Count = 1  # integration steps a control period
    delay_steps: Whole = 0  # integration steps
    width_m: Positive = 1.8

    @abstractmethod
    def build(self) -> AbstractDynamics:
        """Make the model; a variant must be set for a custom one.

        Raises:
            InputError: a function cannot be loaded, or is no model of a vehicle.
        """

    def motion(self) -> Motion:
        """Make the model with its time step; see :meth:`build`."""
        integrator = INTEGRATORS[self.integrator]()
        return Motion(self.build(), integrator, self.substeps, self.delay_steps)

    def car(self) -> Car:
        """Describe the car with wheels: of this width, other sizes in proportion.

        A custom vehicle's says its limit alone.
        """
        size = self.width_m / CAR.width
        names = ("wheelbase", "length", "track", "wheel_radius")
        sizes = {name: size * getattr(CAR, name) for name in names}
        sizes |= {"width": self.width_m, "mass": CAR.mass * size**3}
        return replace(CAR, **{**sizes, **self._handling()})

    @property
    def unit(self) -> str | None:
        """Unit of the control; None where a custom vehicle does not say it."""
        return self.car().control_unit

    @property
    def has_expert(self) -> bool:
        """Whether an expert knows what the control does."""
        return self.unit in ("rad/s", "rad")

    @abstractmethod
    def _handling(self) -> dict[str, Any]:
        """Return what the model says about the car."""


class DubinsSection(AbstractVehicleSection):
    """Controlled by its heading rate."""

    kind: Literal["dubins"] = "dubins"
    speed_ms: Positive = 5.0
    max_heading_rate: Positive = 1.5

    def build(self) -> AbstractDynamics:
        """Make the model."""
        return Dubins(self.speed_ms, self.max_heading_rate)

    def _handling(self) -> dict[str, Any]:
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

    def _handling(self) -> dict[str, Any]:
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
        """Take steps that are fine enough by default, and refuse those that diverge."""
        fine = math.ceil(self.dt_s / (_FINE_RATIO * self.steer_time_s) - 1e-9)
        is_free = "substeps" not in self.model_fields_set and self.integrator == "rk4"
        if is_free and fine <= _MOST_SUBSTEPS:
            object.__setattr__(self, "substeps", max(1, fine))  # it is frozen
        step, limit = self.dt_s / self.substeps, _STABLE_RATIO[self.integrator]
        if step / self.steer_time_s >= limit:
            refuse(
                "steer_time_s",
                f"integration steps of dt_s / substeps = {step:g} s diverge "
                f"with {self.integrator}: they must be below {limit:g} x "
                f"{self.steer_time_s:g} s; raise substeps",
            )
        return self

    def build(self) -> AbstractDynamics:
        """Make the model."""
        steer = math.radians(self.max_steer_deg)  # Dr.Jit takes no NumPy numbers
        rate = math.radians(self.max_steer_rate_deg_s)
        return RateLimitedAckermann(
            self.speed_ms, self.wheelbase_m, steer, rate, self.steer_time_s
        )

    def _handling(self) -> dict[str, Any]:
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
        steer = float(np.radians(self.max_steer_deg))
        return KinematicBicycle(
            self.speed_ms, self.front_axle_m, self.rear_axle_m, steer
        )

    def _handling(self) -> dict[str, Any]:
        return _steered(self.front_axle_m + self.rear_axle_m, self.max_steer_deg)


class CustomSection(AbstractVehicleSection):
    """A function of the user's."""

    kind: Literal["custom"]
    function: AnyCode
    trust_code: Trust = False  # it runs with all rights of the account
    framework: Literal["drjit", "torch"] = "drjit"  # of the function
    state_size: Annotated[int, Field(ge=3, le=16)] = 3
    control_limit: Positive  # in the unit of the function's control
    rest_state: tuple[Finite, ...] = ()  # initial values of the rows after theta
    #: Drives do not depend on these two, only the expert that `evaluate` compares with.
    control_unit: Annotated[Unit | None, Field(exclude=True)] = None
    wheelbase_m: Annotated[Positive | None, Field(exclude=True)] = None

    @model_validator(mode="after")
    def _check_rest(self) -> Any:
        """Refuse initial values of too many or too few rows."""
        if len(self.rest_state) not in (0, self.state_size - 3):
            refuse(
                "rest_state",
                f"has {len(self.rest_state)} numbers; state_size = "
                f"{self.state_size} needs {self.state_size - 3} or none",
            )
        return self

    @model_validator(mode="after")
    def _check_unit(self) -> Any:
        """Refuse a steering angle of which no heading rate follows."""
        if self.control_unit == "rad":
            if self.wheelbase_m is None:
                refuse("wheelbase_m", 'is missing; control_unit = "rad" needs it')
            if self.control_limit >= math.pi / 2:
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
        limit = self.control_limit
        dynamics = kind(function, self.state_size, limit, self.rest_state)
        rng = np.random.default_rng(0)
        states = dynamics.extend(rng.normal(size=(TRIALS, 3)))
        # Off the initial values of the other rows: there a model may have a kink.
        states[:, 3:] += 1e-3 * rng.uniform(0.5, 1, (TRIALS, self.state_size - 3))
        state = to_state(states)
        control = type(state[0])(limit * rng.uniform(0.1, 0.5, TRIALS))
        require_model(dynamics.name, dynamics, state, control)
        return dynamics

    def _handling(self) -> dict[str, Any]:
        limit, wheelbase = self.control_limit, self.wheelbase_m
        steered = {"max_steer": limit} if self.control_unit == "rad" else {}
        sizes = {} if wheelbase is None else {"wheelbase": wheelbase}
        unit = self.control_unit or "other"
        return {"max_control": limit, "control_unit": unit, **steered, **sizes}


def _steered(wheelbase: float, max_steer_deg: float) -> dict[str, Any]:
    steer = float(np.radians(max_steer_deg))
    return {
        "wheelbase": wheelbase,
        "max_steer": steer,
        "control_unit": "rad",
        "max_control": steer,
    }


VehicleSection = Annotated[
    DubinsSection
    | AckermannSection
    | AckermannRateSection
    | BicycleSection
    | CustomSection,
    Kinds("dubins"),
]
