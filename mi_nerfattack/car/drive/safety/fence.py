"""A polygon that the car's outline must stay inside of."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mi_nerfattack.deploy.car import Car
from mi_nerfattack.errors import InputError
from mi_nerfattack.io import files
from mi_nerfattack.vehicle.route.route import Route


@dataclass(frozen=True, eq=False)
class Fence:
    """A simple polygon on the floor; concave ones, too.

    The car brakes at it: keep it a braking distance away from walls and people.

    Args:
        points: (n, 2), corners in turn, metres, n >= 3; the first is not repeated.

    Raises:
        InputError: fewer corners, one that is not finite, no area, or sides that cross.
    """

    points: np.ndarray

    def __post_init__(self) -> None:
        points = _points(self.points)
        object.__setattr__(self, "points", points)
        x, y = points.T
        area = 0.5 * float(np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y))
        if abs(area) < 1e-6:
            raise InputError(f"fence: {points.tolist()}; must enclose an area")
        if _cross(points, points):
            raise InputError(
                f"fence: {points.tolist()}; sides cross, give the corners in turn"
            )

    @classmethod
    def from_file(cls, path: str | Path) -> Fence:
        """Read a TOML file with ``points_m = [[x, y], ...]``.

        Raises:
            InputError: it cannot be read or is no fence.
        """
        table = files.read_toml(path)
        if set(table) != {"points_m"}:
            raise InputError(f"{path}: has {sorted(table)}; needs points_m alone")
        try:
            return cls(table["points_m"])
        except InputError as error:
            raise InputError(f"{path}: {error}") from error

    @classmethod
    def around(cls, route: Route, margin_m: float) -> Fence:
        """Return the upright rectangle around a route, wider by a margin."""
        low, high = route.points.min(0) - margin_m, route.points.max(0) + margin_m
        x, y = (low[0], high[0]), (low[1], high[1])
        return cls(np.array([(x[0], y[0]), (x[1], y[0]), (x[1], y[1]), (x[0], y[1])]))

    def holds(self, points: np.ndarray) -> bool:
        """Whether all points (n, 2) are inside; one that is not finite is not."""
        x, y = np.asarray(points, np.float64)[:, None].transpose(2, 0, 1)
        (x0, y0), (x1, y1) = self.points.T, np.roll(self.points, -1, axis=0).T
        # a ray along +x crosses an odd number of sides from inside
        spans = (y0 > y) != (y1 > y)
        with np.errstate(divide="ignore", invalid="ignore"):
            crossed = spans & (x < x0 + (y - y0) * (x1 - x0) / (y1 - y0))
        return bool((crossed.sum(1) % 2 == 1).all() and np.isfinite(points).all())

    def encloses(self, outline: np.ndarray) -> bool:
        """Whether a whole polygon is inside: no corner of the fence reaches into it.

        Args:
            outline: (n, 2), corners in turn, metres.
        """
        return self.holds(outline) and not _cross(self.points, outline)


def car_corners(car: Car, body_to_world: np.ndarray) -> np.ndarray:
    """Return the corners (4, 2) of a car's outline on the floor.

    Args:
        car: its length is taken to reach as far beyond either axle.
        body_to_world: (4, 4), x forward, y left, the middle of the rear axle.
    """
    overhang, half = 0.5 * (car.length - car.wheelbase), 0.5 * car.width
    back, front = -overhang, car.wheelbase + overhang
    corners = np.array([(back, -half), (front, -half), (front, half), (back, half)])
    return corners @ body_to_world[:2, :2].T + body_to_world[:2, 3]


def _points(corners: Any) -> np.ndarray:
    try:
        points = np.array(corners, np.float64)
    except (TypeError, ValueError) as error:
        raise InputError(f"fence: {corners!r}; needs corners x, y in metres") from error
    if points.ndim != 2 or points.shape[1:] != (2,) or len(points) < 3:
        raise InputError(
            f"fence: shape {points.shape}; needs (n, 2), at least 3 corners x, y"
        )
    if not np.isfinite(points).all():
        raise InputError(f"fence: {points.tolist()}; must be finite")
    return points


def _cross(one: np.ndarray, other: np.ndarray) -> bool:
    """Whether sides of two polygons cross; to touch, as neighbours do, is not to."""
    apart = _separates(one, other) & _separates(other, one).T
    return bool(apart.any())


def _separates(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Return (i, j): the line of side i of one parts side j of the other."""
    along = np.roll(one, -1, axis=0) - one
    away = other[None] - one[:, None]
    side = np.sign(along[:, None, 0] * away[..., 1] - along[:, None, 1] * away[..., 0])
    return side * np.roll(side, -1, axis=1) < 0
