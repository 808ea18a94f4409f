"""The circles that the MuJoCo car drives, against those of the bicycle model."""

from __future__ import annotations

import io
import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from mi_nerfattack.deploy.car import CAR, SMALL_CAR, Car
from mi_nerfattack.deploy.mujoco.car import Handling
from mi_nerfattack.deploy.mujoco.vehicle import MujocoVehicle, SteeringAngle
from mi_nerfattack.io import files
from mi_nerfattack.report.plots.charts import GREEN, PALETTE

PERIOD_S = 0.1
CARS = {"full-size car": CAR, "small car": SMALL_CAR}
LIMIT = 0.05  # of the radius, where the tyres' friction suffices
_SETTLE_S = 3.0
_GRAVITY = 9.81
_COLOURS = PALETTE[:3]


@dataclass(frozen=True)
class Case:
    """What is driven: a car by name, steering angle (radians), speed (m/s)."""

    car: str
    steer: float
    speed_ms: float


#: Three angles and two speeds for each car, and one speed that the tyres cannot hold.
CASES = tuple(
    [Case("full-size car", a, v) for v in (3.0, 5.0) for a in (0.1, 0.3, 0.5)]
    + [Case("full-size car", 0.3, 10.0)]
    + [Case("small car", a, v) for v in (0.5, 1.5) for a in (0.1, 0.2, 0.3)]
    + [Case("small car", 0.3, 4.0)]
)


@dataclass(frozen=True, eq=False)
class Circle:
    """A circle as driven.

    Attributes:
        case: what was driven.
        expected_m: radius of the bicycle model, l / tan(u), of the rear axle.
        radius_m: of the circle through the driven positions, least squares.
        speed_ms: mean, of the rear axle.
        demand: centripetal acceleration of the model over what friction gives; above
            one no tyre holds the circle.
        positions: (n, 2), metres, after the steering has settled.
    """

    case: Case
    expected_m: float
    radius_m: float
    speed_ms: float
    demand: float
    positions: np.ndarray

    @property
    def error(self) -> float:
        """Relative error of the radius."""
        return self.radius_m / self.expected_m - 1


def fit_circle(points: np.ndarray) -> tuple[np.ndarray, float]:
    """Fit a circle to points (n, 2): centre (2,) and radius, algebraic least squares.

    Source: Kasa 1976.
    """
    columns = np.concatenate([2 * points, np.ones((len(points), 1))], axis=1)
    solution, *_ = np.linalg.lstsq(columns, (points**2).sum(axis=1), rcond=None)
    centre = solution[:2]
    return centre, math.sqrt(solution[2] + centre @ centre)


def drive_circle(
    case: Case, handling: Handling | None = None, share: float = 1.0
) -> Circle:
    """Drive around, from straight ahead.

    Args:
        case: what is driven.
        handling: of the car; None for the usual one.
        share: of the whole circle.
    """
    car: Car = CARS[case.car]
    handling = handling or Handling()
    expected = car.wheelbase / math.tan(case.steer)
    vehicle = MujocoVehicle(car, SteeringAngle(car.max_steer), PERIOD_S, handling)
    vehicle.reset(np.zeros(3), case.speed_ms)
    for _ in range(round(_SETTLE_S / PERIOD_S)):
        vehicle.advance(case.steer)
    states = []
    around = 2 * math.pi * expected / case.speed_ms
    for _ in range(math.ceil(share * around / PERIOD_S)):
        vehicle.advance(case.steer)
        states.append(vehicle.state)
    rows = np.array(states)
    return Circle(
        case,
        expected,
        fit_circle(rows[:, :2])[1],
        float(rows[:, 3].mean()),
        case.speed_ms**2 / expected / (_GRAVITY * handling.friction),
        rows[:, :2],
    )


def run(
    show: Callable[[int, int], None], cases: Sequence[Case] = CASES
) -> list[Circle]:
    """Drive all circles.

    Args:
        show: called with the number of circles done and of all.
        cases: what is driven.
    """
    circles = []
    for done, case in enumerate(cases):
        circles.append(drive_circle(case))
        show(done + 1, len(cases))
    return circles


def within_limit(circles: Sequence[Circle]) -> bool:
    """Tell whether all circles that friction allows are within 5 % of the model's."""
    return all(abs(c.error) <= LIMIT for c in circles if c.demand < 1)


def to_document(circles: Sequence[Circle]) -> dict[str, Any]:
    """Return the circles as JSON."""
    rows = [
        {
            **asdict(circle.case),
            "expected_m": circle.expected_m,
            "radius_m": circle.radius_m,
            "error": circle.error,
            "mean_speed_ms": circle.speed_ms,
            "friction_demand": circle.demand,
        }
        for circle in circles
    ]
    return {"limit": LIMIT, "circles": rows}


def write_figure(path: str | Path, circles: Sequence[Circle]) -> None:
    """Draw the circles of each car, driven and expected, and their errors as PNG."""
    names = list(dict.fromkeys(circle.case.car for circle in circles))
    figure = Figure(figsize=(5.5 * len(names), 9.5), dpi=110, layout="constrained")
    FigureCanvasAgg(figure)
    grid = figure.add_gridspec(2, len(names), height_ratios=(3, 2))
    for column, name in enumerate(names):
        own = [circle for circle in circles if circle.case.car == name]
        _draw_paths(figure.add_subplot(grid[0, column]), name, own)
        _draw_errors(figure.add_subplot(grid[1, column]), own)
    stream = io.BytesIO()
    figure.savefig(stream, format="png")
    files.write_bytes(path, stream.getvalue())


def _draw_paths(axes: Any, name: str, circles: Sequence[Circle]) -> None:
    angles = sorted({circle.case.steer for circle in circles})
    turn = np.linspace(0, 2 * math.pi, 181)
    for circle in circles:
        case = circle.case
        colour = _COLOURS[angles.index(case.steer) % len(_COLOURS)]
        centre, _ = fit_circle(circle.positions)
        points = circle.positions - centre
        slides = circle.demand > 1
        axes.plot(
            *points.T,
            color=colour,
            lw=1.0 if slides else 1.5,
            ls=":" if slides else "-",
            label=f"{case.steer:g} rad, {case.speed_ms:g} m/s"
            + (" (beyond friction)" if slides else ""),
        )
        ideal = circle.expected_m * np.stack([np.cos(turn), np.sin(turn)])
        axes.plot(*ideal, color="black", lw=0.7, ls="--", zorder=3)
    axes.plot([], [], color="black", lw=0.7, ls="--", label="bicycle model")
    axes.set(title=name, xlabel="x - centre, metres", ylabel="y - centre, metres")
    axes.set_aspect("equal")
    below = {"loc": "upper center", "bbox_to_anchor": (0.5, -0.12), "ncols": 2}
    axes.legend(fontsize=7, **below)
    axes.grid(alpha=0.3)


def _draw_errors(axes: Any, circles: Sequence[Circle]) -> None:
    errors = [100 * circle.error for circle in circles]
    held = [circle.demand < 1 for circle in circles]
    colours = [_COLOURS[0] if ok else _COLOURS[1] for ok in held]
    bars = axes.bar(range(len(circles)), errors, color=colours)
    axes.bar_label(bars, fmt="%+.2f", fontsize=8)
    axes.axhspan(-100 * LIMIT, 100 * LIMIT, color=GREEN, alpha=0.15)
    axes.axhline(0, color="black", lw=0.7)
    axes.set_yscale("symlog", linthresh=1)
    axes.set_ylim(-10, max(20, 3 * max(errors)))
    labels = [f"{c.case.steer:g} rad\n{c.case.speed_ms:g} m/s" for c in circles]
    axes.set_xticks(range(len(circles)), labels, fontsize=8)
    axes.set_ylabel("error of the radius, per cent")
    axes.set_title("shaded: within 5 %; orange: more than friction gives", fontsize=9)
