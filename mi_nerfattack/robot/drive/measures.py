"""Figures of a drive: laps, errors, period and latency."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from mi_nerfattack.deploy.vehicle import planar_state
from mi_nerfattack.robot.devices import Decision, TrackedPose
from mi_nerfattack.vehicle.route.route import Route


@dataclass(frozen=True)
class Figures:
    """What a drive was like; None where there are too few commands.

    Attributes:
        commands: sent.
        duration_s: from the first command to the last.
        laps: along the route, of a closed one; else shares of its length.
        largest_error_m: cross-track error.
        mean_error_m: likewise.
        period_s: between commands, the mean.
        period_jitter_s: its standard deviation.
        longest_period_s: between two commands.
        latency_median_s: from a frame's time to its command.
        latency_99_s: likewise, the 99th percentile.
    """

    commands: int
    duration_s: float
    laps: float
    largest_error_m: float
    mean_error_m: float
    period_s: float
    period_jitter_s: float
    longest_period_s: float
    latency_median_s: float
    latency_99_s: float


@dataclass
class Measures:
    """One row a command: its time, its frame's time, and where the car was."""

    rows: list[tuple[float, float, float, float, float]] = field(default_factory=list)

    def add(self, sent_s: float, decision: Decision, pose: TrackedPose) -> None:
        """Note a command."""
        x, y, heading = planar_state(pose.body_to_world).tolist()
        self.rows.append((sent_s, decision.frame_time_s, x, y, heading))

    def figures(self, route: Route) -> Figures | None:
        """Measure the drive; None of fewer than two commands."""
        if len(self.rows) < 2:
            return None
        rows = np.array(self.rows)
        sent, latency, states = rows[:, 0], rows[:, 0] - rows[:, 1], rows[:, 2:]
        arc, error, _ = route.project_numpy(states)
        steps = np.diff(arc)
        if route.closed:
            steps = (steps + 0.5 * route.length) % route.length - 0.5 * route.length
        period = np.diff(sent)
        return Figures(
            commands=len(rows),
            duration_s=float(sent[-1] - sent[0]),
            laps=float(steps.sum() / route.length),
            largest_error_m=float(np.abs(error).max()),
            mean_error_m=float(np.abs(error).mean()),
            period_s=float(period.mean()),
            period_jitter_s=float(period.std()),
            longest_period_s=float(period.max()),
            latency_median_s=float(np.median(latency)),
            latency_99_s=float(np.percentile(latency, 99)),
        )
