"""The closed loop: sensor, policy, vehicle, sensor, ...

A policy gets images of eight bits, as a camera gives them and every environment does:
``round(255 x) / 255`` of what the sensor renders, after what disturbs it. The
derivative of this rounding is taken as 1 (*straight through*); its true one is 0 almost
everywhere.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_nerfattack.backend.arrays import vjp
from mi_nerfattack.errors import InputError
from mi_nerfattack.notebook import picture
from mi_nerfattack.policy.base import Numbers
from mi_nerfattack.render.camera.disturbance import Disturbance
from mi_nerfattack.rollout.objective import StateHistory
from mi_nerfattack.rollout.sensor import (
    AbstractDifferentiableSensor,
    AbstractSensor,
    Observation,
)
from mi_nerfattack.vehicle.dynamics import (
    AbstractDynamics,
    control_size,
    controls_as,
    require_controls,
    to_state,
)
from mi_nerfattack.vehicle.integrators import AbstractIntegrator, Transition
from mi_nerfattack.vehicle.route.route import Route

OnStep = Callable[[int], None]


@dataclass(frozen=True)
class ClosedLoop:
    """Everything that turns an initial state into a drive.

    Attributes:
        sensor: what the policy sees.
        policy: a policy.AbstractPolicy (named so because this package imports no
            torch).
        goal: index of the policy's goal.
        dynamics: the vehicle.
        integrator: the time step.
        dt: control period, seconds: time between two images; a control is held for
            one period.
        substeps: integration steps a control period.
        delay: integration steps until a control takes effect; before the first one
            does, the control is 0.
        eight_bit: round images as a camera does; without it the policy gets what the
            sensor renders, and derivatives equal finite differences.
        disturbance: of the sensor's images, before they are rounded; one row per
            vehicle.
        route: whose points a policy gets; needed where the policy asks for points.
    """

    sensor: AbstractSensor
    policy: Any
    goal: int
    dynamics: AbstractDynamics
    integrator: AbstractIntegrator
    dt: float
    substeps: int = 1
    delay: int = 0
    eight_bit: bool = True
    disturbance: Disturbance = Disturbance()
    route: Route | None = None
    transition: Transition = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        transition = Transition(
            self.dynamics,
            self.integrator,
            self.dt,
            substeps=self.substeps,
            delay=self.delay,
        )
        object.__setattr__(self, "transition", transition)

    def __repr__(self) -> str:
        components = self.sensor, self.policy, self.dynamics, self.integrator
        names = ", ".join(type(component).__name__ for component in components)
        return f"ClosedLoop({names}, goal {self.goal}, periods of {self.dt:g} s)"

    def numbered(self, first: int) -> ClosedLoop:
        """Return this loop with a number of the first drive, on which all draws depend.

        A drive alone with the number of its row is the same as in the batch.
        """
        return replace(
            self,
            sensor=self.sensor.numbered(first),
            dynamics=self.dynamics.numbered(first),
            disturbance=replace(self.disturbance, first=first),
        )

    def initial(self, poses: np.ndarray) -> Any:
        """Upload initial poses (n, 3), metres and radians, as full states (m, n)."""
        return to_state(self.dynamics.extend(np.atleast_2d(poses)))

    def numbers(self, state: Any, step: int) -> Any:
        """Return the numbers that the policy gets, (n, k), evaluated; or None.

        Args:
            state: (m, n) before the period.
            step: index of the control period.
        """
        if not self.policy.numbers:
            return None
        with dr.suspend_grad():
            return stacked(self._number_rows(dr.detach(state), step))

    def numbers_vjp(self, state: Any, step: int, d_numbers: Any) -> Any:
        """Return the derivative by the state, (m, n), from that by the numbers."""
        kind, size = dr.detached_t(type(state[0])), self.policy.numbers.size
        index = size * dr.arange(dr.uint32_array_t(kind), dr.width(state))
        array = d_numbers.array
        weights = [kind(dr.gather(type(array), array, index + i)) for i in range(size)]

        def weighed(leaf: Any) -> Any:
            pairs = zip(weights, self._number_rows(leaf, step), strict=True)
            # not every number depends on the state: a speed may be constant
            return sum((weight * row for weight, row in pairs), 0 * leaf[0])

        return vjp(weighed, state, 1)

    def _number_rows(self, state: Any, step: int) -> list[Any]:
        """Return the numbers as rows (n,), differentiable in the state (m, n)."""
        speed = self.dynamics.speed_of(state) if self.policy.numbers.speed else None
        return numbers_of(
            self.policy.numbers, state, speed, time=step * self.dt, route=self.route
        )

    def shown(self, observation: Observation, step: int) -> Any:
        """Return the image that the policy gets, (n, height, width, 3), evaluated."""
        image = observation.image
        if self.disturbance:
            image = self.disturbance.apply(image, step, self.sensor.layout)
        if self.eight_bit:
            # a literal would be multiplied by its inverse, which is off in the last bit
            most = dr.opaque(type(image.array), 255)
            image = type(image)(dr.round(most * image.array) / most, image.shape)
        dr.eval(image)
        return image

    def shown_vjp(self, observation: Observation, step: int, d_shown: Any) -> Any:
        """Return the derivative by the sensor's image from that by the policy's."""
        if not self.disturbance:
            return d_shown
        layout = self.sensor.layout
        return self.disturbance.vjp(observation.image, step, d_shown, layout)


def numbers_of(
    numbers: Numbers, state: Any, speed: Any, time: float, route: Route | None
) -> list[Any]:
    """Return the numbers that a policy asks for, as rows (n,) in its order.

    Args:
        numbers: what it asks for.
        state: (m, n), its first rows px, py (metres) and theta (radians).
        speed: (n,), metres per second; not read unless asked for.
        time: seconds since the start.
        route: whose points the policy gets.

    Raises:
        InputError: the policy asks for points, and there is no route.
    """
    rows = [speed] if numbers.speed else []
    if numbers.route_m:
        if route is None:
            raise InputError("route: the policy is told points of it; give it one")
        rows += route.ahead(state, numbers.route_m)
    if numbers.time:
        row = dr.detached_t(type(state[0]))
        rows.append(dr.opaque(row, time, dr.width(state)))
    return rows


def stacked(rows: Sequence[Any]) -> Any:
    """Lay rows (n,) side by side: a tensor (n, k) in double precision, evaluated."""
    kind: Any = dr.float64_array_t(mi.TensorXf)
    row = dr.array_t(kind)
    count, size = dr.width(rows[0]), len(rows)
    result = dr.empty(row, count * size)
    index = size * dr.arange(mi.UInt32, count)
    for column, values in enumerate(rows):
        dr.scatter(result, row(values), index + column)
    dr.eval(result)
    return kind(result, (count, size))


@dataclass(frozen=True)
class CameraPath:
    """States that frames are rendered from, wherever the vehicle is: an open loop.

    Attributes:
        states: (m, n) of each control period.
        frame: control period whose frame all periods show; None for each its own.
    """

    states: Sequence[Any] = field(repr=False)
    frame: int | None = None

    def at(self, period: int) -> tuple[Any, int]:
        """Return the state, and the index of its period, for a period's frame."""
        index = period if self.frame is None else self.frame
        return self.states[index], index


@dataclass(frozen=True)
class Step:
    """What happened in one control period, for those who keep parts of it.

    Attributes:
        index: from 0.
        state: (m, n) before it.
        observation: what was seen.
        memory: of the policy, before it.
    """

    index: int
    state: Any = field(repr=False)
    observation: Observation
    memory: tuple[Any, ...] = field(repr=False)


@dataclass(frozen=True)
class Trajectory:
    """States and controls of a batch of drives.

    Attributes:
        states: horizon + 1 arrays (m, n), metres and radians, evaluated.
        controls: of each period (n,), or (k, n) of k > 1: the policy's raw outputs,
            evaluated.
        dt: control period, seconds.
        tape: what `keep` returned for each control period.
        camera_path: None where the camera was on the vehicle.
        still: the only frame, where the camera path shows a single one.
        rows: number of rows of a state that costs see; None for all.
    """

    states: tuple[Any, ...]
    controls: tuple[Any, ...]
    dt: float
    tape: tuple[Any, ...] = ()
    camera_path: CameraPath | None = None
    still: Observation | None = None
    rows: int | None = None

    def __repr__(self) -> str:
        return (
            f"Trajectory({self.count} drives, {self.horizon} periods of {self.dt:g} s)"
        )

    def _repr_png_(self) -> bytes:
        return picture(self)

    @property
    def horizon(self) -> int:
        """Number of control periods."""
        return len(self.controls)

    @property
    def count(self) -> int:
        """Number of vehicles."""
        return dr.width(self.states[0])

    def camera(self, period: int) -> tuple[Any, int]:
        """Return state and index of the period that a frame was rendered from."""
        path = self.camera_path or CameraPath(self.states)
        return path.at(period)

    def observe(self, sensor: AbstractSensor, period: int) -> Observation:
        """Return the frame of a period, rendered again unless it is `still`."""
        if self.still is not None:
            return self.still
        state, index = self.camera(period)
        return sensor.observe(state, index)

    def restore(
        self, sensor: AbstractDifferentiableSensor, period: int, record: Any
    ) -> Observation:
        """Return the frame of a period from what the sensor kept of it."""
        if self.still is not None:
            return self.still
        state, index = self.camera(period)
        return sensor.restore(state, index, record)

    def states_numpy(self) -> np.ndarray:
        """States as (n, horizon + 1, m) float64."""
        return np.stack([np.array(s) for s in self.states], axis=-1).transpose(1, 2, 0)

    def controls_numpy(self) -> np.ndarray:
        """Controls as (n, horizon) float64; of k > 1 as (n, horizon, k)."""
        return np.stack([np.array(c).T for c in self.controls], axis=1)

    def history(self) -> StateHistory:
        """Lay all states but the first side by side, detached."""
        return StateHistory.of(self.states_numpy()[:, 1:, : self.rows], self.dt)


def simulate(
    loop: ClosedLoop,
    initial: Any,
    horizon: int,
    on_step: OnStep | None = None,
    keep: Callable[[Step], Any] | None = None,
    camera_path: CameraPath | None = None,
) -> Trajectory:
    """Drive a batch of vehicles.

    Args:
        loop: the closed loop.
        initial: (m, n) from :meth:`ClosedLoop.initial`.
        horizon: number of control periods, at least 1.
        on_step: called after each with its index.
        keep: called in each; what it returns is kept for a backward pass. Otherwise
            nothing but states and controls is.
        camera_path: render frames from there; by default from the vehicles.

    Raises:
        ValueError: horizon below 1, or a state of the wrong size.
        InputError: the policy fails or gives another number of controls than the
            vehicle takes, or an implicit step does not converge.
    """
    _check_drive(loop, initial, horizon)
    states, controls, tape = [initial], [], []
    memory = loop.policy.initial_memory(dr.width(initial))
    camera = camera_path or CameraPath(states)  # which grow as the vehicles drive
    still: Observation | None = None
    for index in range(horizon):
        # The camera sees the scene, from the vehicle or from the path
        view, period = camera.at(index)
        observation = still or loop.sensor.observe(view, period)
        still = None if camera.frame is None else observation
        step = Step(index, states[-1], observation, memory)
        # The policy steers by what it is shown
        image, numbers = loop.shown(observation, index), loop.numbers(states[-1], index)
        control, memory = loop.policy.step(image, loop.goal, memory, numbers)
        require_controls(control_size(control), loop.dynamics.control_names)
        controls.append(controls_as(dr.value_t(type(initial)), control))
        # The vehicle moves by the control that acts now: with a delay, an earlier one
        acting = loop.transition.controls(controls, index, initial)
        states.append(loop.transition.advance(states[-1], *acting))
        dr.eval(controls[-1])
        if keep is not None:
            tape.append(keep(step))
        if on_step is not None:
            on_step(index)
    return Trajectory(
        states=tuple(states),
        controls=tuple(controls),
        dt=loop.dt,
        tape=tuple(tape),
        camera_path=camera_path,
        still=still,
        rows=loop.dynamics.own_rows,
    )


def _check_drive(loop: ClosedLoop, initial: Any, horizon: int) -> None:
    """Raise ValueError for a horizon below 1, or states of the wrong size."""
    if horizon < 1:
        raise ValueError(f"horizon: {horizon}; at least 1")
    if len(initial) != loop.dynamics.state_size:
        raise ValueError(
            f"states: {len(initial)} rows; {type(loop.dynamics).__name__} has "
            f"{loop.dynamics.state_size}: make them by ClosedLoop.initial"
        )
