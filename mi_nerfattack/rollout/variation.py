"""What differs from drive to drive of an attack: light, camera and vehicle."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import drjit as dr
import numpy as np

from mi_nerfattack.backend.arrays import rows_type
from mi_nerfattack.ranges import Natural, NonNegative, checked
from mi_nerfattack.render.lighting.lights import Sunlight
from mi_nerfattack.vehicle.dynamics import AbstractDynamics, Dubins

# Streams of the seed; disturbances and initial poses have others
_STREAM, _SUNS, _LAGS, _DELAYS = 4, 8, 9, 10

Range = tuple[float, float]


@dataclass(frozen=True)
class SunRanges:
    """From where to where each number of a `Sunlight` is drawn, evenly."""

    elevation_deg: Range = (10.0, 70.0)
    azimuth_deg: Range = (0.0, 360.0)
    share: Range = (0.0, 0.9)
    colour_k: Range = (6500.0, 6500.0)

    def draw(self, random: np.random.Generator, count: int) -> list[Sunlight]:
        """Draw `count` suns; those before the last do not depend on the count."""
        limits = [self.elevation_deg, self.azimuth_deg, self.share, self.colour_k]
        low, high = np.transpose(limits)
        numbers = random.uniform(low, high, (count, len(limits)))
        return [Sunlight(*row) for row in numbers.tolist()]


@dataclass(frozen=True)
@checked("Variation")
class Variation:
    """Draw light on the objects, the camera's mount and the vehicle for each drive.

    Everything drawn is a function of the seed and the drive's number. Factors are
    powers of two or of e, so that none is negative. A light changes the objects alone:
    with the exposure of a `Disturbance`, this is any ratio of object and background.

    Args:
        light_ev_sd: standard deviation of the light on objects, powers of two.
        light_colour_ev_sd: of each channel of it, powers of two.
        pitch_deg_sd: of the camera's pitch, degrees.
        height_sd: of the logarithm of the camera's height.
        speed_sd: of the logarithm of the vehicle's speed.
        steering_sd: of the logarithm of its answer to the steering, as by a wrong
            wheelbase or by understeer.
        steering_lag_s_sd: of the number whose size is the time constant of its
            steering, seconds.
        delay_s_sd: of the number whose size is the delay of its controls, seconds,
            in addition to that of the closed loop.
        sun: sun and sky that light the objects; None for the light of their capture.
        seed: of all draws.

    Source: Athalye et al. 2018, expectation over transformation.
    """

    light_ev_sd: NonNegative = 0.0
    light_colour_ev_sd: NonNegative = 0.0
    pitch_deg_sd: NonNegative = 0.0
    height_sd: NonNegative = 0.0
    speed_sd: NonNegative = 0.0
    steering_sd: NonNegative = 0.0
    steering_lag_s_sd: NonNegative = 0.0
    delay_s_sd: NonNegative = 0.0
    sun: SunRanges | None = None
    seed: Natural = 0

    @property
    def of_light(self) -> bool:
        """Whether the light on objects differs."""
        drawn = self.light_ev_sd or self.light_colour_ev_sd
        return bool(drawn) or self.sun is not None

    @property
    def of_mount(self) -> bool:
        """Whether the camera's mount differs."""
        return bool(self.pitch_deg_sd or self.height_sd)

    @property
    def of_vehicle(self) -> bool:
        """Whether the vehicle differs."""
        answer = self.speed_sd or self.steering_sd
        return bool(answer or self.steering_lag_s_sd or self.delay_s_sd)

    def draws(self, first: int, count: int) -> Draws:
        """Draw for `count` drives, of which the first has the number `first`."""
        # Row k belongs to drive k, whatever the batch
        random = np.random.default_rng([self.seed, _STREAM])
        normal = random.normal(size=(first + count, 8))[first:].T
        # Streams of their own, which leave the draws above as they are
        lags, delays = (
            abs(np.random.default_rng([self.seed, stream]).normal(size=first + count))
            for stream in (_LAGS, _DELAYS)
        )
        light = self.light_ev_sd * normal[0] + self.light_colour_ev_sd * normal[1:4]
        return Draws(
            light=2.0**light,
            pitch_deg=self.pitch_deg_sd * normal[4],
            height=np.exp(self.height_sd * normal[5]),
            speed=np.exp(self.speed_sd * normal[6]),
            steering=np.exp(self.steering_sd * normal[7]),
            lag_s=self.steering_lag_s_sd * lags[first:],
            delay_s=self.delay_s_sd * delays[first:],
        )

    def suns(self, first: int, count: int) -> list[Sunlight]:
        """Draw suns for the drives of :meth:`draws`."""
        assert self.sun is not None  # else nobody asks
        random = np.random.default_rng([self.seed, _SUNS])
        return self.sun.draw(random, first + count)[first:]


@dataclass(frozen=True)
class Draws:
    """What a `Variation` drew for n drives.

    Attributes:
        light: (3, n), factors of the objects' linear RGB.
        pitch_deg: (n,), added to the camera's pitch, degrees.
        height: (n,), factors of the camera's height.
        speed: (n,), factors of the vehicle's speed.
        steering: (n,), factors of its heading rate.
        lag_s: (n,), time constants of its steering, seconds.
        delay_s: (n,), added to the delay of its controls, seconds.
    """

    light: np.ndarray
    pitch_deg: np.ndarray
    height: np.ndarray
    speed: np.ndarray
    steering: np.ndarray
    lag_s: np.ndarray
    delay_s: np.ndarray


@dataclass(frozen=True)
class Varied(AbstractDynamics):
    """A vehicle whose speed and answer to the steering differ from drive to drive.

    Another speed changes the heading rate in proportion, so that the path stays, but
    for `Dubins`, whose control is the heading rate. Other rows of a state stay: where
    the speed is one of them, the vehicle goes faster or slower than that row says, at
    each speed in the same proportion.

    With a lag, the steering that acts is one row more, the last: it follows the command
    by a first-order lag from 0. The lag is at least an integration step, with which all
    integrators are stable. A delay is the `Transition`'s to apply.

    Args:
        model: the vehicle.
        variation: of it.
        step_s: length h of an integration step, seconds.
        first: number of the first drive of a batch.
    """

    model: AbstractDynamics
    variation: Variation
    step_s: float
    first: int = 0
    _uploaded: dict[Any, list[Any]] = field(
        default_factory=dict, init=False, repr=False, compare=False
    )

    def __post_init__(self) -> None:
        object.__setattr__(self, "recordable", self.model.recordable)
        object.__setattr__(self, "control_names", self.model.control_names)

    @property
    def state_size(self) -> int:
        """See :class:`AbstractDynamics`."""
        return self.model.state_size + self._has_lag

    @property
    def own_rows(self) -> int:
        """See :class:`AbstractDynamics`."""
        return self.model.own_rows

    def numbered(self, first: int) -> Varied:
        """See :meth:`AbstractDynamics.numbered`."""
        return replace(self, first=first)

    def extend(self, poses: np.ndarray) -> np.ndarray:
        """See :meth:`AbstractDynamics.extend`."""
        states = self.model.extend(poses)
        return np.pad(states, ((0, 0), (0, 1))) if self._has_lag else states

    def derivative(self, state: Any, control: Any) -> Any:
        """See :meth:`AbstractDynamics.derivative`."""
        speed, steering, *rate = self.constants(state)
        lagging = []
        if rate:  # what acts is a row of the state, which follows the command
            acting, several = state[len(state) - 1], self.control_size > 1
            command, *controls = list(control) if several else [control]
            lagging = [rate[0] * (command - acting)]
            control = rows_type(type(acting))(acting, *controls) if several else acting
        slope = self.model.derivative(self._without_lag(state), control)
        if not isinstance(self.model, Dubins):
            steering = steering * speed
        pose_rates = [speed * slope[0], speed * slope[1], steering * slope[2]]
        other_rates = [slope[i] for i in range(3, len(slope))]
        return type(state)(*pose_rates, *other_rates, *lagging)

    @cached_property
    def has_speed(self) -> bool:
        """See :class:`AbstractDynamics`."""
        return self.model.has_speed

    def speed_of(self, state: Any) -> Any:
        """See :meth:`AbstractDynamics.speed_of`."""
        return self.constants(state)[0] * self.model.speed_of(self._without_lag(state))

    def delays(self, count: int) -> np.ndarray | None:
        """See :meth:`AbstractDynamics.delays`."""
        own = self.variation.draws(self.first, count).delay_s
        return own if self.variation.delay_s_sd > 0 else None

    def saturate(self, control: Any) -> Any:
        """See :meth:`AbstractDynamics.saturate`."""
        return self.model.saturate(control)

    def check(self, state: Any) -> None:
        """See :meth:`AbstractDynamics.check`."""
        self.model.check(self._without_lag(state))

    @property
    def _has_lag(self) -> bool:
        return self.variation.steering_lag_s_sd > 0

    def _without_lag(self, state: Any) -> Any:
        """Return the state of the model."""
        return type(state)(*list(state)[:-1]) if self._has_lag else state

    def constants(self, state: Any) -> list[Any]:
        """See :meth:`AbstractDynamics.constants`."""
        key = kind, count = dr.detached_t(type(state[0])), dr.width(state)
        if key not in self._uploaded:
            drawn = self.variation.draws(self.first, count)
            numbers = [drawn.speed, drawn.steering]
            if self._has_lag:
                numbers += [1 / np.maximum(drawn.lag_s, self.step_s)]
            constants = [kind(values.tolist()) for values in numbers]
            dr.make_opaque(constants)
            self._uploaded[key] = constants
        return self._uploaded[key]
