"""From a network's answer to controls: its columns, or positions that are followed."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import torch

from mi_nerfattack.errors import InputError
from mi_nerfattack.policy.checks import columns_of
from mi_nerfattack.ranges import NonNegative, Positive, checked

Axes = Literal["forward_left", "forward_right", "left_forward", "right_forward"]
#: Distance, metres, below which a point is too near to steer at.
_NEAR_M = 0.1


@dataclass(frozen=True)
@checked("trajectory")
class Trajectory:
    """Follow positions over time: pure pursuit, and a law for the speed.

    The vehicle steers at a point on the path. This point lies at the distance
    ``L = max(look_ahead_m, look_ahead_s v)``, but not before the first position, nor
    beyond the last. For a point x forward and y to the left, the curvature is
    ``2 y / (x^2 + y^2)``. The acceleration is ``speed_gain (w - v)``, with w the mean
    speed along the path until `speed_s`. Both are differentiable, except where the path
    bends or ends.

    Source: Coulter 1992, Implementation of the pure pursuit path tracking algorithm.

    Args:
        times_s: of the positions, seconds from now, increasing.
        controls: what the vehicle takes.
        wheelbase_m: of the vehicle; has an effect on "steering" alone.
        look_ahead_m: least look-ahead, metres.
        look_ahead_s: seconds.
        speed_s: seconds, at most the last of `times_s`; the last by default.
        speed_gain: 1 / seconds.
        axes: of the network's positions.
    """

    times_s: tuple[Positive, ...]
    controls: tuple[Literal["heading_rate", "steering", "acceleration"], ...] = (
        "heading_rate",
    )
    wheelbase_m: Positive = 2.7
    look_ahead_m: Positive = 3.0
    look_ahead_s: NonNegative = 0.6
    speed_s: Positive | None = None
    speed_gain: Positive = 1.0
    axes: Axes = "forward_left"

    def __post_init__(self) -> None:
        times = (0.0, *self.times_s)
        if not self.times_s or list(times) != sorted(set(times)):
            raise InputError(f"trajectory.times_s: {self.times_s}; must increase")
        if self.controls not in (
            ("heading_rate",),
            ("steering",),
            ("steering", "acceleration"),
        ):
            raise InputError(
                f"trajectory.controls: {list(self.controls)}; heading_rate, steering, "
                "or steering and acceleration"
            )
        if self.speed_s is not None and self.speed_s > self.times_s[-1]:
            raise InputError(
                f"trajectory.speed_s: {self.speed_s}; at most {self.times_s[-1]}, the "
                "last of times_s"
            )

    def follow(self, positions: torch.Tensor, speed: torch.Tensor) -> torch.Tensor:
        """Compute controls.

        Args:
            positions: (n, k, 2) or (n, 2 k), metres, in the vehicle's frame.
            speed: v, (n,), metres per second.

        Returns:
            (n,) for one control, otherwise (n, 2).

        Raises:
            InputError: another number of positions.
        """
        count = len(self.times_s)
        if tuple(positions.shape[1:]) not in ((count, 2), (2 * count,)):
            raise InputError(
                f"policy.trajectory: positions {tuple(positions.shape)}; {count} "
                "points of two numbers are needed, one for each of times_s"
            )
        points = positions.reshape(len(positions), count, 2)
        if self.axes in ("left_forward", "right_forward"):
            points = points.flip(-1)
        if "right" in self.axes:
            points = points * points.new_tensor([1.0, -1.0])
        path = torch.cat([torch.zeros_like(points[:, :1]), points], 1)
        way = _lengths(path)
        curvature = self._curvature(path, way, speed)
        turn = speed * curvature
        if self.controls[0] == "steering":
            turn = torch.atan(self.wheelbase_m * curvature)
        if len(self.controls) == 1:
            return turn
        return torch.stack(
            [turn, self.speed_gain * (self._target_speed(way) - speed)], 1
        )

    def _curvature(
        self, path: torch.Tensor, way: torch.Tensor, speed: torch.Tensor
    ) -> torch.Tensor:
        """Return 2 y / d^2 of the point at the look-ahead, (n,), 1 / metres."""
        ahead = torch.clamp(self.look_ahead_s * speed, min=self.look_ahead_m)
        ahead = torch.maximum(ahead, way[:, 1])  # a chord from the vehicle is no arc
        # the segment in which it lies, or the last one, at whose end it stops
        index = torch.searchsorted(way.detach(), ahead.detach()[:, None])
        index = index.clamp(1, path.shape[1] - 1)[:, 0]
        rows = torch.arange(len(path), device=path.device)
        before, after = path[rows, index - 1], path[rows, index]
        length = way[rows, index] - way[rows, index - 1]
        share = (ahead - way[rows, index - 1]) / length.clamp(min=1e-6)
        point = before + share.clamp(max=1)[:, None] * (after - before)
        square = point.square().sum(1)
        return 2 * point[:, 1] / (square + _NEAR_M**2 * (square < _NEAR_M**2))

    def _target_speed(self, way: torch.Tensor) -> torch.Tensor:
        """Return the mean speed along the path until `speed_s`, (n,)."""
        times = (0.0, *self.times_s)
        until = self.speed_s or self.times_s[-1]
        index = next(i for i in range(1, len(times)) if times[i] >= until - 1e-9)
        share = (until - times[index - 1]) / (times[index] - times[index - 1])
        far = way[:, index - 1] + share * (way[:, index] - way[:, index - 1])
        return far / until


def _lengths(path: torch.Tensor) -> torch.Tensor:
    """Return the way along paths (n, k, 2) to each point, (n, k), metres."""
    steps = (path[:, 1:] - path[:, :-1]).square().sum(2)
    lengths = torch.sqrt(steps + 1e-12)  # points that coincide have a derivative, too
    return torch.nn.functional.pad(torch.cumsum(lengths, 1), (1, 0))


@dataclass(frozen=True)
class Action:
    """What a network's answer means.

    Args:
        output: column of the control, needed where there are several; of several
            controls a column each.
        scale: factor from the network's units and signs to the vehicle's: one, or one
            a control.
        trajectory: the answer holds positions instead; how they are followed.

    Raises:
        InputError: another number of factors than of columns, or columns of positions.
    """

    output: int | tuple[int, ...] | None = None
    scale: float | tuple[float, ...] = 1.0
    trajectory: Trajectory | None = None

    def __post_init__(self) -> None:
        if self.trajectory is not None and (self.output, self.scale) != (None, 1.0):
            raise InputError(
                "policy.trajectory: stands beside output or control_scale; the network "
                "gives positions in metres"
            )
        columns = self.output if isinstance(self.output, tuple) else (0,)
        if len(set(columns)) < len(columns):
            raise InputError(f"policy.output: {list(columns)}; a column stands twice")
        if isinstance(self.scale, tuple) and len(self.scale) != len(columns):
            raise InputError(
                f"policy.control_scale: {len(self.scale)} factors for "
                f"{len(columns)} controls; give one each, or one for all"
            )

    @property
    def count(self) -> int:
        """Number of controls."""
        if self.trajectory is not None:
            return len(self.trajectory.controls)
        return len(self.output) if isinstance(self.output, tuple) else 1

    @property
    def needs_speed(self) -> bool:
        """Whether controls depend on the speed."""
        return self.trajectory is not None

    def controls(
        self, values: torch.Tensor, count: int, speed: torch.Tensor | None, name: str
    ) -> torch.Tensor:
        """Take the controls out of an answer.

        Args:
            values: the network's; see `columns_of`, of positions `Trajectory.follow`.
            count: n.
            speed: (n,), metres per second; not read unless needed.
            name: of the policy, for messages.

        Returns:
            (n,) for one control, (n, k) for several.

        Raises:
            InputError: another shape, or a value that is not finite.
        """
        if self.trajectory is None:
            controls = columns_of(values, count, self.output, name=name)
            if isinstance(self.scale, tuple):
                return controls * controls.new_tensor(self.scale)
            return self.scale * controls
        if count == 1 and values.ndim and len(values) != 1:  # axes of size 1 dropped
            values = values[None]
        if values.ndim < 2 or len(values) != count or speed is None:
            raise InputError(
                f"{name}: positions {tuple(values.shape)} for {count} images; "
                "(n, k, 2) or (n, 2 k) are needed"
            )
        if not torch.isfinite(values).all():
            raise InputError(
                f"{name}: positions that are not finite; check the weights and "
                "policy.preprocess"
            )
        return self.trajectory.follow(values, speed)
