"""The ground that objects take, and the points by which they are seen."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mi_nerfattack.fields.grid import GridField
from mi_nerfattack.render.camera.pose import Pose

#: An object whose longer side is so many times the other stands along the road.
_LONG = 1.5
#: An object is a board if its thickness is a smaller share of its width and height.
_FLAT = 0.25
_POINTS = 64


@dataclass(frozen=True, eq=False)
class Shape:
    """The occupied part of a field that stands on z = 0 of its frame.

    Attributes:
        lower: (3,), lower corner of the box around the occupied cells, metres in the
            field's frame.
        upper: (3,), upper corner of this box.
        points: (64, 3) points in occupied cells.
    """

    lower: np.ndarray
    upper: np.ndarray
    points: np.ndarray

    @staticmethod
    def of(field: GridField) -> Shape:
        """Measure a field.

        Raises:
            InputError: nothing of it is occupied.
        """
        cells = field.occupancy.cells
        size = field.upper - field.lower
        lower, upper = field.lower + size * field.occupancy.bounds
        cell = size / cells.shape
        occupied, rng = np.flatnonzero(cells), np.random.default_rng(0)
        chosen = occupied[rng.integers(len(occupied), size=_POINTS)]
        index = np.stack(np.unravel_index(chosen, cells.shape), -1)
        points = field.lower + (index + rng.uniform(size=(_POINTS, 3))) * cell
        return Shape(lower, upper, points)

    @property
    def size(self) -> np.ndarray:
        """Lengths (3,) of the box, metres."""
        return self.upper - self.lower

    @property
    def is_long(self) -> bool:
        """Whether it stands along the road, as a car does."""
        return bool(self.size[:2].max() >= _LONG * self.size[:2].min())

    @property
    def is_patch(self) -> bool:
        """Whether it lies on the lane."""
        return bool(self.size[2] < _FLAT * self.size[:2].min())

    @property
    def is_board(self) -> bool:
        """Whether it faces the traffic, as a billboard does."""
        thickness, width = sorted(self.size[:2])
        return bool(thickness < _FLAT * min(width, self.size[2]))


@dataclass(frozen=True, eq=False)
class Stands:
    """Boxes of one shape that stand upright, n of them.

    Attributes:
        shape: the shape of all boxes.
        centre: (n, 2) of the boxes seen from above, metres in the world.
        ground: (n,), height of the ground, metres.
        yaw: (n,), radians.
        scale: (n,).
    """

    shape: Shape
    centre: np.ndarray
    ground: np.ndarray
    yaw: np.ndarray
    scale: np.ndarray

    def __len__(self) -> int:
        return len(self.yaw)

    def __getitem__(self, rows: np.ndarray | slice) -> Stands:
        return Stands(
            self.shape,
            centre=self.centre[rows],
            ground=self.ground[rows],
            yaw=self.yaw[rows],
            scale=self.scale[rows],
        )

    @property
    def half(self) -> np.ndarray:
        """Half the length and width, (n, 2), metres."""
        return self.scale[:, None] * self.shape.size[:2] / 2

    @property
    def height(self) -> np.ndarray:
        """Height of the tops above the ground, (n,), metres."""
        return self.scale * self.shape.upper[2]

    def to_world(self, offset: np.ndarray) -> np.ndarray:
        """Turn offsets (n, m, 2) along the boxes' sides into points of the world."""
        c, s = np.cos(self.yaw)[:, None], np.sin(self.yaw)[:, None]
        u, v = offset[..., 0], offset[..., 1]
        turned = np.stack([c * u - s * v, s * u + c * v], axis=-1)
        return self.centre[:, None] + turned

    def lattice(self, step: float, margin: float = 0.0) -> np.ndarray:
        """Cover each box, and a margin around it, with (n, m, 2) points.

        Args:
            step: metres between points, at most, unless a side had more than 64.
            margin: metres.
        """
        half = self.half + margin
        sides = [np.linspace(-1, 1, count) for count in points_along(half, step)]
        unit = np.stack(np.meshgrid(*sides, indexing="ij"), -1).reshape(1, -1, 2)
        return self.to_world(unit * half[:, None])

    def body(self) -> np.ndarray:
        """Return the shape's points in the world, (n, m, 3), metres."""
        middle = (self.shape.lower + self.shape.upper)[:2] / 2
        flat = (self.shape.points[:, :2] - middle) * self.scale[:, None, None]
        z = self.shape.points[:, 2] * self.scale[:, None] + self.ground[:, None]
        return np.concatenate([self.to_world(flat), z[..., None]], -1)

    def pose(self, row: int) -> Pose:
        """Return the field's pose in one of the boxes."""
        middle = (self.shape.lower + self.shape.upper)[:2] / 2
        yaw, scale = float(self.yaw[row]), float(self.scale[row])
        c, s = np.cos(yaw), np.sin(yaw)
        turned = scale * np.array([[c, -s], [s, c]]) @ middle
        x, y = (self.centre[row] - turned).tolist()
        return Pose.upright((x, y, float(self.ground[row])), yaw, scale)

    def apart(self, other: Stands, clearance: float) -> np.ndarray:
        """Tell which boxes (n,) are clear of one other, by the axes of both."""
        free = np.zeros(len(self), bool)
        gap = other.centre[0] - self.centre
        for yaw in (self.yaw, other.yaw):
            for turn in (0.0, np.pi / 2):
                axis = yaw + turn
                way = np.stack([np.cos(axis), np.sin(axis)], -1)
                reach = self._reach(axis) + other._reach(axis) + clearance
                free |= np.abs((gap * way).sum(-1)) >= reach
        return free

    def _reach(self, axis: np.ndarray) -> np.ndarray:
        """Return half the boxes' extents along directions (n,), metres."""
        turn = axis - self.yaw
        return self.half[:, 0] * np.abs(np.cos(turn)) + self.half[:, 1] * np.abs(
            np.sin(turn)
        )

    def hides(self, eyes: np.ndarray, points: np.ndarray) -> np.ndarray:
        """Tell which lines from eyes (m, 3) to points (m, 3) the first box crosses."""
        c, s = np.cos(self.yaw[0]), np.sin(self.yaw[0])
        turn = np.array([[c, -s], [s, c]])
        half = np.array([*self.half[0], self.height[0] / 2])
        centre = np.array([*self.centre[0], self.ground[0] + half[2]])
        begin, end = eyes - centre, points - centre
        for part in (begin, end):
            part[:, :2] = part[:, :2] @ turn
        way = end - begin
        safe = np.where(np.abs(way) < 1e-12, 1e-12, way)
        ends = np.sort([(-half - begin) / safe, (half - begin) / safe], axis=0)
        return ends[0].max(1).clip(0) < ends[1].min(1).clip(max=1)


def points_along(half: np.ndarray, step: float) -> np.ndarray:
    """Return how many points (2,) cover the longest of each side of boxes.

    Args:
        half: (n, 2), half the sides, metres.
        step: metres between points, at most, unless a side had more than 64.
    """
    return np.clip(np.ceil(2 * half.max(0) / step), 2, 64).astype(int) + 1
