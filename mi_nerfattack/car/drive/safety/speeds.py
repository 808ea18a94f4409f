"""Whether a car drives as fast as it was commanded, by its tracker and its motor."""

from __future__ import annotations

import math
from collections import deque

from mi_nerfattack.car.devices import MotorValues, TrackedPose
from mi_nerfattack.car.drive.safety.judge import Cause, Stop

_SPAN_S, _KEPT_S = 0.3, 0.6  # of a mean, and of what is kept for it
_SHARE, _LEAST_MS = 0.3, 0.1  # tolerance: this share, but never less than this


class Speeds:
    """Means of speed over 0.3 s, compared with the commands and with each other.

    Args:
        is_tracked: whether the tracker sees the car drive; not with its wheels lifted.
    """

    def __init__(self, is_tracked: bool = True) -> None:
        self._is_tracked = is_tracked
        self._places: deque[tuple[float, float, float]] = deque()
        self._motor: deque[tuple[float, float]] = deque()
        self._commands: deque[tuple[float, float]] = deque()

    def add(self, pose: TrackedPose | None, values: MotorValues | None) -> None:
        """Note a pose and the motor's values, unless they are known."""
        if pose is not None and self._is_tracked:
            x, y = pose.body_to_world[:2, 3]
            _append(self._places, (pose.time_s, float(x), float(y)))
        if values is not None and values.speed_ms is not None:
            _append(self._motor, (values.time_s, values.speed_ms))

    def command(self, time_s: float, speed_ms: float) -> None:
        """Note a command."""
        _append(self._commands, (time_s, speed_ms))

    def tracked(self, span_s: float, until_s: float = math.inf) -> float | None:
        """Return the speed by the tracker over a time; None before so much is known.

        Args:
            span_s: the time.
            until_s: its end; the newest pose by default.
        """
        places = [item for item in self._places if item[0] <= until_s]
        for time_s, x0, y0 in reversed(places):
            last_s, x, y = places[-1]
            if last_s - time_s >= span_s - 1e-9:
                return math.hypot(x - x0, y - y0) / (last_s - time_s)
        return None

    def motor(self, until_s: float = math.inf) -> float | None:
        """Return the motor's mean speed over 0.3 s; None before so much is known.

        Args:
            until_s: end of the time; the newest values by default.
        """
        known = [item for item in self._motor if item[0] <= until_s]
        if not known or known[-1][0] - known[0][0] < _SPAN_S - 1e-9:
            return None
        since_s = known[-1][0] - _SPAN_S
        values = [speed for time_s, speed in known if time_s > since_s + 1e-9]
        return sum(values) / len(values)

    def _commanded(self, until_s: float) -> float:
        """Return the mean of the commands over 0.3 s, of none as 0."""
        way_m, end_s, since_s = 0.0, until_s, until_s - _SPAN_S
        for time_s, speed_ms in reversed(self._commands):
            begin_s = min(max(time_s, since_s), end_s)
            way_m, end_s = way_m + speed_ms * (end_s - begin_s), begin_s
        return way_m / _SPAN_S

    def check(self) -> None:
        """Compare the speeds.

        Raises:
            Stop: the car is faster than it was commanded, or tracker and motor differ.
        """
        by = {
            "tracker": (self.tracked(_SPAN_S), self._places),
            "motor": (self.motor(), self._motor),
        }
        for name, (speed_ms, items) in by.items():
            if speed_ms is None:
                continue
            commanded_ms = self._commanded(items[-1][0])
            if abs(speed_ms) > _above(commanded_ms):
                raise Stop(
                    Cause.TOO_FAST,
                    f"{speed_ms:.2f} m/s by the {name}, {commanded_ms:.2f} m/s "
                    "commanded; check erpm_per_ms of the calibration",
                )
        if not self._places or not self._motor:
            return
        until_s = min(self._places[-1][0], self._motor[-1][0])  # known by both
        tracked, turned = self.tracked(_SPAN_S, until_s), self.motor(until_s)
        if tracked is None or turned is None:
            return
        if max(tracked, abs(turned)) > _above(min(tracked, abs(turned))):
            raise Stop(
                Cause.SPEEDS_DIFFER,
                f"{tracked:.2f} m/s by the tracker, {turned:.2f} m/s by the motor; "
                "check erpm_per_ms of the calibration, and whether the wheels slip",
            )


def _above(speed_ms: float) -> float:
    return max((1 + _SHARE) * speed_ms, speed_ms + _LEAST_MS)


def _append(history: deque, item: tuple[float, ...]) -> None:
    """Append what is newer than the last, and drop what is too old."""
    if history and item[0] <= history[-1][0]:
        return
    history.append(item)
    while item[0] - history[0][0] > _KEPT_S:
        history.popleft()
