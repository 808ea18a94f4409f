"""Recorded drives and when they leave the lane."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from mi_nerfattack.errors import InputError
from mi_nerfattack.notebook import picture
from mi_nerfattack.ranges import Name, Natural, Positive, checked
from mi_nerfattack.vehicle.route.route import Route

#: In the order of documents and plots; others follow, by name.
ENVIRONMENTS = (
    "surrogate",
    "mitsuba",
    "mujoco",
    "mujoco_gl",
    "replay",
    "carla",
    "real",
)
REAL = "real"

#: What objects show in a drive.
NO_OBJECT, OWN, RANDOM, BEST_RANDOM, ATTACK = (
    "no_object",
    "own",
    "random",
    "best_random",
    "attack",
)
#: In the order of documents and plots.
CASES = (NO_OBJECT, OWN, RANDOM, BEST_RANDOM, ATTACK)
#: The expert drives without objects.
EXPERT = "expert"
_SEVERAL = re.compile(rf"{RANDOM}_([2-9]|[1-9][0-9]+)")


@dataclass(frozen=True, eq=False)
@checked("Drive")
class Drive:
    """One closed-loop drive of T >= 1 steps; its arrays are read-only float64 copies.

    Args:
        environment: its name, one of `ENVIRONMENTS` or your own.
        route: name of the reference route.
        case: one of `CASES`, of ``random_case``, or `EXPERT`.
        run: index among the drives of one route, environment and case, from 0.
        seed: seed of this drive.
        states: (T+1, m), m >= 3, rows of the vehicle's state, initial state included:
            x and y in metres, heading in radians, then what the vehicle adds, see
            `AbstractEnvironment.state`. Controls that a delay holds back are no rows:
            they are among `controls`.
        controls: (T,), the policy's control of each period, as it came to state t+1;
            (T, k) of a vehicle with k > 1 controls.
        cross_track_m: (T,), signed cross-track error of `states[1:]`, metres.
        time_s: (T,), time of `states[1:]`, seconds, increasing.

    Raises:
        InputError: for an unknown case, an empty name, a wrong shape or a value that is
            not finite.
    """

    environment: Name
    route: Name
    case: str
    run: Natural
    seed: Natural
    states: np.ndarray
    controls: np.ndarray
    cross_track_m: np.ndarray
    time_s: np.ndarray

    def __post_init__(self) -> None:
        if self.case not in (*CASES, EXPERT) and not _SEVERAL.fullmatch(self.case):
            raise InputError(f"Drive.case: {self.case!r}; one of {', '.join(CASES)}")
        for name in ("run", "seed"):
            object.__setattr__(self, name, int(getattr(self, name)))
        steps = np.shape(self.controls)[0] if np.ndim(self.controls) else 0
        if steps < 1:
            raise InputError("Drive.controls: no step; a drive has at least one")
        rows = max(3, np.shape(self.states)[-1] if np.ndim(self.states) else 0)
        self._freeze("states", (steps + 1, rows))
        self._freeze("controls", (steps, *np.shape(self.controls)[1:2]))
        for name in ("cross_track_m", "time_s"):
            self._freeze(name, (steps,))
        if np.any(np.diff(self.time_s) <= 0):
            raise InputError("Drive.time_s: not increasing; give seconds step by step")

    def __repr__(self) -> str:
        distance = self.distance_m
        return (
            f"Drive({self.environment}, {self.route}, {self.case}, run {self.run}: "
            f"{len(distance)} steps, distance from the lane centre "
            f"{distance.mean():.3f} m in the mean, {distance.max():.3f} m at most)"
        )

    def _repr_png_(self) -> bytes:
        return picture(self)

    def arrays(self) -> dict[str, np.ndarray]:
        """Return the arrays by name."""
        names = ("states", "controls", "cross_track_m", "time_s")
        return {name: getattr(self, name) for name in names}

    def _freeze(self, name: str, shape: tuple[int, ...]) -> None:
        array = np.array(getattr(self, name), dtype=np.float64)
        if array.shape != shape:
            raise InputError(f"Drive.{name}: shape {array.shape}; must be {shape}")
        if not np.all(np.isfinite(array)):
            step = np.argwhere(~np.isfinite(array))[0][0]
            raise InputError(
                f"Drive.{name}: value at index {step} is not finite; the drive diverged"
            )
        array.flags.writeable = False
        object.__setattr__(self, name, array)

    @property
    def poses(self) -> np.ndarray:
        """Return x and y in metres and heading in radians, (T+1, 3)."""
        return self.states[:, :3]

    @property
    def first_controls(self) -> np.ndarray:
        """Return the first control of each period, (T,), which steers."""
        return self.controls if self.controls.ndim == 1 else self.controls[:, 0]

    @property
    def distance_m(self) -> np.ndarray:
        """Return the distance from the lane centre at each step, (T,), metres."""
        return np.abs(self.cross_track_m)

    def departed(self, limit: float) -> np.ndarray:
        """Return a boolean per step, (T,): whether the distance exceeds the limit."""
        return self.distance_m > limit


def random_case(objects: int) -> str:
    """Name the case of so many objects with random textures: random, random_6."""
    return RANDOM if objects == 1 else f"{RANDOM}_{objects}"


def departure_limit(lane_width_m: float, car_width_m: float) -> float:
    """Return the distance from the lane centre beyond which a step departs.

    Half a lane width less half a car width, metres.

    Raises:
        InputError: unless 0 < car_width_m < lane_width_m, both finite.
    """
    if not 0 < car_width_m < lane_width_m < float("inf"):
        raise InputError(
            f"car_width_m, lane_width_m: {car_width_m!r}, {lane_width_m!r}; both must "
            "be positive metres and the car narrower than the lane"
        )
    return (lane_width_m - car_width_m) / 2


@dataclass(frozen=True)
@checked("Lane")
class Lane:
    """How far from a lane's centre a car may be.

    Args:
        wheel_m: beyond it a wheel is out of the lane: the departure limit, metres.
        centre_m: beyond it the car's centre is: half the lane's width, metres.
    """

    wheel_m: Positive
    centre_m: Positive

    @classmethod
    def of(cls, route: Route, car_width_m: float) -> Lane:
        """Return the lane of a route; InputError unless it is wider than the car."""
        limit = departure_limit(route.lane_width_m, car_width_m)
        return cls(limit, route.lane_width_m / 2)


def departure_limits(routes: Iterable[Route], car_width_m: float) -> dict[str, float]:
    """Return the departure limit of each route by its name, metres.

    Raises:
        InputError: a lane is no wider than the car, or a width is not positive.
    """
    limits = {}
    for route in routes:
        try:
            limits[route.name] = departure_limit(route.lane_width_m, car_width_m)
        except InputError as error:
            raise InputError(
                f"route {route.name!r}: its lane is {route.lane_width_m} m wide, the "
                f"vehicle {car_width_m} m; give the vehicle's width in metres, or take "
                "a wider lane"
            ) from error
    return limits
