"""How well each expert follows each route in each environment, without images."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from mi_nerfattack.deploy.kinematic import KinematicVehicle, Motion
from mi_nerfattack.deploy.mujoco.vehicle import MujocoVehicle
from mi_nerfattack.deploy.place import Place, bundled_place
from mi_nerfattack.deploy.registry import kinematic_vehicle
from mi_nerfattack.deploy.vehicle import AbstractVehicle
from mi_nerfattack.vehicle.ackermann_rate import RateLimitedAckermann
from mi_nerfattack.vehicle.expert import expert_for
from mi_nerfattack.vehicle.expert.base import AbstractExpert
from mi_nerfattack.vehicle.route.route import Route, load_routes

LIMIT_M = 0.1
LAPS = 2
#: Starts of recoveries: metres to the left, and radians.
STARTS = tuple(
    (side * 0.5, turn * np.radians(10)) for side in (1, -1) for turn in (1, -1)
)
#: Seconds until a car with real wheels answers: the lags of its column and its servo.
LAG_S = 0.15
#: What an expert is told that labels frames for cars with and without lag.
LABEL_LAG_S = 0.1


@dataclass(frozen=True)
class Drives:
    """A vehicle with its expert on one route.

    Attributes:
        environment: those whose vehicle it is.
        route: name.
        expert: name of the class.
        lag_s: of the vehicle.
        told_s: lag that the expert was told: the vehicle's, or the default.
        max_m, mean_m: cross-track error of a drive from the route's start.
        recovered_s: time after which no start half a metre and ten degrees off is
            farther than 0.1 m any more; infinite if one is to the end.
    """

    environment: str
    route: str
    expert: str
    lag_s: float
    told_s: float
    max_m: float
    mean_m: float
    recovered_s: float


@dataclass(frozen=True, eq=False)
class Case:
    """A vehicle, the environments that have it, and its lag, seconds."""

    environment: str
    place: Place
    vehicle: AbstractVehicle
    lag_s: float

    def expert(self, route: Route, told_s: float) -> AbstractExpert:
        """Make the expert of a route, which is told a lag."""
        place, vehicle = self.place, self.vehicle
        return expert_for(
            vehicle.control_unit,
            route,
            place.period,
            vehicle.max_control,
            place.car.wheelbase,
            told_s,
        )


def cases() -> Iterator[Case]:
    """Make every vehicle of the bundled places."""
    for name, environments in (
        ("intersection", "surrogate, mitsuba"),
        ("room", "mitsuba"),
    ):
        place = bundled_place(name)
        simple = kinematic_vehicle(place)
        yield Case(environments, place, simple, 0.0)
        if place.car.control_unit == "rad":
            yield Case("rate-limited steering", place, _rate_limited(place), LAG_S)
        physical = MujocoVehicle(place.car, period=place.period)
        yield Case("mujoco", place, physical, LAG_S)


def _rate_limited(place: Place) -> KinematicVehicle:
    car = place.car
    model = RateLimitedAckermann(
        wheelbase=car.wheelbase, max_steer=car.max_control, max_steer_rate=1.5
    )
    motion = Motion(model, substeps=2)
    return KinematicVehicle(motion, place.period, car.max_control, "rad")


def follow(
    vehicle: AbstractVehicle,
    expert: AbstractExpert,
    route: Route,
    period: float,
    start: tuple[float, float] = (0.0, 0.0),
    laps: int = LAPS,
) -> np.ndarray:
    """Drive along a route, and return the cross-track errors (steps,), metres.

    Args:
        vehicle: reset here.
        expert: reset here.
        route: driven to its end, or around.
        period: of the vehicle, seconds.
        start: metres to the left and radians from the route's start.
        laps: of a closed route.
    """
    vehicle.reset(route.pose_at(0.0, *start), route.speed_ms)
    expert.reset()
    states = []
    length = laps * route.length if route.closed else route.length
    for _ in range(int(length / (route.speed_ms * period))):
        vehicle.advance(float(expert.control(vehicle.state)[0]))
        states.append(vehicle.state)
    return route.cross_track_numpy(np.array(states))


def recovered(errors: np.ndarray, period: float) -> float:
    """Return the time after which |errors| stay within the limit, seconds."""
    beyond = np.flatnonzero(np.abs(errors) > LIMIT_M)
    if len(beyond) == 0:
        return 0.0
    # entry i is the error at time (i + 1) period
    last = int(beyond[-1])
    return (last + 2) * period if last + 1 < len(errors) else float("inf")


def run(show: Callable[[int, int], None] = lambda done, total: None) -> list[Drives]:
    """Drive everything; `show` gets pairs of vehicle and route done and wanted."""
    work = [
        (case, route, told)
        for case in cases()
        for route in load_routes(case.place.routes)
        for told in (case.lag_s, LABEL_LAG_S)
    ]
    results = []
    for item in work:
        show(len(results), len(work))
        results.append(_drive(*item))
    show(len(work), len(work))
    return results


def _drive(case: Case, route: Route, told_s: float) -> Drives:
    """Drive from the route's start, and recover from others."""
    expert, period = case.expert(route, told_s), case.place.period
    error = np.abs(follow(case.vehicle, expert, route, period))
    starts = [
        follow(case.vehicle, expert, route, period, start, laps=1) for start in STARTS
    ]
    return Drives(
        case.environment,
        route.name,
        type(expert).__name__,
        case.lag_s,
        told_s,
        float(error.max()),
        float(error.mean()),
        max(recovered(errors, period) for errors in starts),
    )


def within_limit(results: list[Drives]) -> bool:
    """Whether every expert stays within the limit."""
    return all(result.max_m <= LIMIT_M for result in results)


def to_document(results: list[Drives]) -> dict[str, Any]:
    """Return what `--json` prints; a time that is infinite becomes None."""
    rows = [asdict(result) for result in results]
    for row in rows:
        if not np.isfinite(row["recovered_s"]):
            row["recovered_s"] = None
    return {"limit_m": LIMIT_M, "drives": rows}
