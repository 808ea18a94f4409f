"""The rule that puts objects where such things stand."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from mi_nerfattack.deploy.roadside.footprint import Shape, Stands
from mi_nerfattack.deploy.roadside.surroundings import KERB_M, Surroundings
from mi_nerfattack.deploy.roadside.view import VisiblePoints, look
from mi_nerfattack.errors import InputError
from mi_nerfattack.fields.grid import GridField
from mi_nerfattack.ranges import (
    Count,
    Facing,
    NonNegative,
    Positive,
    Seconds,
    checked,
)
from mi_nerfattack.render.camera.pose import Pose
from mi_nerfattack.vehicle.route.route import Route

_TRIES = 32  # places of an object that are tried together,
_LOOKED_AT = 8  # and of those that are free, looked at together
_ROUNDS = 6
_AHEAD_S = 4.0  # of driving, from a drive's end to the farthest objects
_AFTER_S = 2.0  # of driving, from a patch to the drive's end: then its effect shows
_ALONG = math.radians(4)  # long objects stand along the road, but for this,
_BEND = math.radians(5)  # where it turns by less than this over their length


@dataclass(frozen=True)
@checked("Roadside")
class Roadside:
    """Where objects may stand: at the roadside, on free ground and in view.

    Objects stand off the lanes of all routes, beyond the kerb where a route has one.
    They stand on even ground with nothing above it, clear of walls and of one another.
    The shape of an object's occupied box decides its heading:

    - A box that is at least 1.5 times as long as wide stands along the road, within 4
      degrees, either way round.
    - A board is thinner than a quarter of its width and of its height. The wider of its
      -x and -y sides faces the traffic on the route, within 4 degrees.
    - A patch is lower than a quarter of its length and of its width. It lies on the
      lane of the route, where the lane is nearly straight, with +y along the lane
      within 4 degrees. The drive goes on for 2 s after the patch; a short drive goes on
      for at least half of its length.
    - Any other object stands at any angle.

    A drive along the lane's centre sees every object for `view_s` together. In these
    frames, which need not follow one another, about `view_px` pixels or more show a
    part of the object that neither the scene nor another object hides. The rule checks
    64 points of the object.

    Args:
        scales: range of the factor to the natural size, of each object in turns.
        gap_m: range of the distance from the road's edge (the kerb, or else the lane's
            edge) to an object's near side, metres; the lower end holds to all lanes.
        clearance_m: from walls, poles and other objects, metres.
        view_s: seconds of the drive in which an object is seen.
        view_px: pixels in which it is seen.
        facing: "shape": boards alone face the traffic; "traffic": every object does;
            "along": none does.
    """

    scales: tuple[tuple[Positive, Positive], ...] = ((1.0, 1.0),)
    gap_m: tuple[NonNegative, NonNegative] = (0.3, 2.5)
    clearance_m: NonNegative = 0.3
    view_s: Seconds = 1.0
    view_px: Count = 12
    facing: Facing = "shape"

    def __post_init__(self) -> None:
        for low, high in (*self.scales, self.gap_m):
            if low > high:
                raise InputError(f"Roadside: {low} to {high}; the smaller comes first")
        if not self.scales:
            raise InputError("Roadside.scales: none; at least one range")

    def draw(
        self,
        fields: Sequence[GridField],
        surroundings: Surroundings,
        route: Route,
        stretch: tuple[float, float],
        rng: np.random.Generator,
        kinds: Sequence[int] | None = None,
    ) -> list[Pose]:
        """Draw a pose of each object.

        Args:
            fields: upright, standing on z = 0 of their frames.
            surroundings: scene, lanes and camera.
            route: that is driven.
            stretch: arc lengths between which it is driven, metres.
            rng: source of all draws.
            kinds: number of each in `scales`, which repeat; 0, 1, 2 ... by default.

        Raises:
            InputError: no place found for all of them.
        """
        poses = self.find(
            fields, surroundings, route, stretch=stretch, rng=rng, kinds=kinds
        )
        placed = [pose for pose in poses if pose is not None]
        if len(placed) < len(fields):
            begin, end = stretch
            raise InputError(
                f"route {route.name!r}: places for {len(placed)} of {len(fields)} "
                "objects, off the lanes (patches within one), on free ground and in "
                f"view for {self.view_s} s of a drive from {begin:.1f} to {end:.1f} m "
                "of it; ask for fewer or other sizes of them, or move routes or "
                "obstacles"
            )
        return placed

    def find(
        self,
        fields: Sequence[GridField],
        surroundings: Surroundings,
        route: Route,
        stretch: tuple[float, float],
        rng: np.random.Generator,
        kinds: Sequence[int] | None = None,
    ) -> list[Pose | None]:
        """Draw as :meth:`draw`, with None for objects that find no place."""
        eyes = surroundings.drive(route, *stretch)
        placed: list[tuple[Stands, VisiblePoints]] = []
        poses: list[Pose | None] = []
        for kind, field in zip(kinds or range(len(fields)), fields, strict=True):
            shape, scales = Shape.of(field), self.scales[kind % len(self.scales)]
            pose = None
            for _ in range(_ROUNDS):
                stands = self._draw_stands(
                    shape, scales, surroundings, route=route, stretch=stretch, rng=rng
                )
                stands = self._free(stands, surroundings, [item for item, _ in placed])
                chosen = self._first_visible(stands, surroundings, eyes, placed=placed)
                if chosen is not None:
                    placed.append(chosen)
                    pose = chosen[0].pose(0)
                    break
            poses.append(pose)
        return poses

    def _draw_stands(
        self,
        shape: Shape,
        scales: tuple[float, float],
        surroundings: Surroundings,
        route: Route,
        stretch: tuple[float, float],
        rng: np.random.Generator,
    ) -> Stands:
        """Draw places beside the road, or on the lane; without ground, none."""
        scale = rng.uniform(*scales, _TRIES)
        begin, end = stretch
        farthest = end + _AHEAD_S * route.speed_ms
        if shape.is_patch:
            farthest = max(end - _AFTER_S * route.speed_ms, (begin + end) / 2)
        arc = rng.uniform(begin, farthest, _TRIES)
        side = rng.choice([-1.0, 1.0], _TRIES)
        gap = rng.uniform(*self.gap_m, _TRIES)
        turn = rng.uniform(-1, 1, _TRIES)
        back = np.pi * rng.integers(2, size=_TRIES)
        faces = self.facing == "traffic" or self.facing == "shape" and shape.is_board
        is_along = shape.is_patch or shape.is_long and not faces
        if shape.is_patch:  # the traffic drives along +y
            turn = _ALONG * turn - np.pi / 2
        elif faces:  # the traffic drives along +x of a box that is thin along x
            turn = _ALONG * turn - (shape.size[0] >= shape.size[1]) * np.pi / 2
        elif is_along:
            turn = _ALONG * turn + back + (shape.size[0] < shape.size[1]) * np.pi / 2
        else:
            turn *= np.pi
        half = scale[:, None] * shape.size[:2] / 2
        reach = half[:, 0] * np.abs(np.sin(turn)) + half[:, 1] * np.abs(np.cos(turn))
        if shape.is_patch:
            free = route.lane_width_m / 2 - reach
            lateral = np.where(free < 0, np.inf, free * rng.uniform(size=_TRIES))
        else:
            lateral = surroundings.kerb(route, arc, side) + gap + reach
        known = np.isfinite(lateral)
        if is_along:
            ends = arc + half.max(1) * [[-1.0], [1.0]]
            known &= np.abs(np.diff(route.heading_at(ends), axis=0)[0]) < _BEND
        arc, lateral = arc[known], (side * lateral)[known]
        centre = route.pose_at(arc, lateral)[:, :2]
        ground = surroundings.height(centre)
        lane = surroundings.height(route.pose_at(arc)[:, :2])
        stands = Stands(
            shape,
            centre,
            ground,
            yaw=route.heading_at(arc) + turn[known],
            scale=scale[known],
        )
        return stands[np.abs(ground - lane) < KERB_M[1]]

    def _free(
        self, stands: Stands, surroundings: Surroundings, placed: Sequence[Stands]
    ) -> Stands:
        """Keep what stands on free ground, clear of other objects.

        All but patches stand off the lanes.
        """
        for other in placed:
            stands = stands[stands.apart(other, self.clearance_m)]
        if not len(stands):
            return stands
        step = float(min(0.1, stands.half.min() / 2))
        if not stands.shape.is_patch:
            outline = stands.lattice(5 * step)
            stands = stands[~surroundings.on_lanes(outline, self.gap_m[0])]
        if not len(stands):
            return stands
        around = 0.0 if stands.shape.is_patch else self.clearance_m
        return stands[surroundings.stand_free(stands, step, around)]

    def _first_visible(
        self,
        stands: Stands,
        surroundings: Surroundings,
        eyes: np.ndarray,
        placed: list[tuple[Stands, VisiblePoints]],
    ) -> tuple[Stands, VisiblePoints] | None:
        """Return the first that is seen and leaves the others in view; None for none.

        Of the others, `placed` then has what is left in view.
        """
        for own, points in self._views(stands, surroundings, eyes):
            for other, _ in placed:
                points = points.without(other)
            if not self._long_enough(points, surroundings.period):
                continue
            others = [(other, view.without(own)) for other, view in placed]
            if all(self._long_enough(v, surroundings.period) for _, v in others):
                placed[:] = others
                return own, points
        return None

    def _views(
        self, stands: Stands, surroundings: Surroundings, eyes: np.ndarray
    ) -> Iterator[tuple[Stands, VisiblePoints]]:
        """Look at boxes, some at a time."""
        for start in range(0, len(stands), _LOOKED_AT):
            some = stands[start : start + _LOOKED_AT]
            for row, points in enumerate(look(surroundings, eyes, some)):
                yield some[row : row + 1], points

    def _long_enough(self, points: VisiblePoints, period: float) -> bool:
        frames = math.ceil(self.view_s / period - 1e-6)
        return int((points.pixels() >= self.view_px).sum()) >= frames
