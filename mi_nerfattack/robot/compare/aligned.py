"""Drives side by side: at equal places of a route, and in the time to get there."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from mi_nerfattack.errors import InputError
from mi_nerfattack.robot.compare.course import Course
from mi_nerfattack.robot.compare.recorded import RecordedDrive
from mi_nerfattack.rollout.drive import Drive


@dataclass(frozen=True, eq=False)
class Profiles:
    """k drives at m places; NaN where one does not get.

    Attributes:
        cross_track_m: (k, m), signed, metres.
        control: (k, m), as driven, in the unit of the course.
        time_s: (k, m), seconds since each drive began.
    """

    cross_track_m: np.ndarray
    control: np.ndarray
    time_s: np.ndarray


@dataclass(frozen=True, eq=False)
class Aligned:
    """A real drive beside those of the run past the same look.

    Attributes:
        recorded: the real drive.
        places: (m,), arc lengths that both reach, metres.
        real: its profile, k = 1.
        run: those of the run.
        real_change: (m,), its control less that of real drives past the plain object;
            None without such.
        run_change: likewise of the run, means of its drives.
    """

    recorded: RecordedDrive
    places: np.ndarray
    real: Profiles
    run: Profiles
    real_change: np.ndarray | None
    run_change: np.ndarray | None

    def figures(self) -> dict[str, Any]:
        """Return figures of how near they are.

        - `from_m`, `to_m`: places compared at, arc lengths;
        - `runs`: drives of the run, of which means are compared with;
        - `cross_track_rms_m`: of the difference of the cross-track errors;
        - `cross_track_correlation`: of these (Pearson), null where one is constant;
        - `within_range`: share of the places at which the real error lies between the
          smallest and largest of the run; null for a single drive of it;
        - `control_rms`, `control_correlation`: likewise of the controls as driven;
        - `steering_change_correlation`: of what the look changes in the control,
          against drives past the plain object (or none) in either world; null without;
        - `time_behind_s`: by how much longer the real drive takes between the places.
        """
        error, control = self.real.cross_track_m[0], self.real.control[0]
        errors, changes = self.run.cross_track_m, (self.real_change, self.run_change)
        mean, mean_control = mean_of(errors), mean_of(self.run.control)
        low, high = np.nanmin(errors, axis=0), np.nanmax(errors, axis=0)
        inside = float(((low <= error) & (error <= high)).mean())
        real, run = self.real.time_s[0], mean_of(self.run.time_s)
        return {
            "from_m": float(self.places[0]),
            "to_m": float(self.places[-1]),
            "runs": len(errors),
            "cross_track_rms_m": _rms(error - mean),
            "cross_track_correlation": _correlation(error, mean),
            "within_range": inside if len(errors) > 1 else None,
            "control_rms": _rms(control - mean_control),
            "control_correlation": _correlation(control, mean_control),
            "steering_change_correlation": _correlation(*changes),
            "time_behind_s": float(real[-1] - real[0] - (run[-1] - run[0])),
        }


def profiles(course: Course, drives: Sequence[Drive], places: np.ndarray) -> Profiles:
    """Interpolate drives between their states, at places that they first reach.

    Args:
        course: of all drives.
        drives: k >= 1.
        places: (m,), arc lengths, metres.
    """
    rows = []
    for drive in drives:
        arcs, times = course.arcs(drive.states), np.append(0.0, drive.time_s)
        errors = course.route.cross_track_numpy(drive.states)
        controls = course.controls(drive.states, times)
        between = (arcs[1:] + arcs[:-1]) / 2
        ends = controls[[0, *range(len(controls)), -1]]
        rows.append(
            [
                _at(places, arcs, errors),
                _at(places, np.concatenate([arcs[:1], between, arcs[-1:]]), ends),
                _at(places, arcs, times),
            ]
        )
    return Profiles(*np.array(rows).transpose(1, 0, 2))


def align(
    course: Course,
    recorded: RecordedDrive,
    run: Sequence[Drive],
    real_plain: Sequence[Drive],
    run_plain: Sequence[Drive],
) -> Aligned:
    """Put a real drive beside those of a run.

    Args:
        course: of all drives.
        recorded: the real drive.
        run: at least one, past the same look.
        real_plain: real drives past the plain object or none; may be empty.
        run_plain: likewise of the run.

    Raises:
        InputError: they share no stretch of at least two control periods.
    """
    reach = [course.arcs(drive.states) for drive in run]
    own = course.arcs(recorded.drive.states)
    low = max(own[0], min(arcs[0] for arcs in reach))
    high = min(own.max(), max(arcs.max() for arcs in reach))
    step = course.route.speed_ms * course.period
    if high - low < 2 * step:
        raise InputError(
            f"{recorded.path}: shares {low:.2f} to {high:.2f} m of the route with the "
            f"run's drives past {recorded.drive.case}; at least {2 * step:.2f} m"
        )
    places = np.linspace(low, high, 1 + int(np.ceil((high - low) / step)))
    real, of_run = (
        profiles(course, drives, places) for drives in ([recorded.drive], run)
    )
    changes: list[np.ndarray | None] = [None, None]
    if real_plain and run_plain:
        pairs = (real, real_plain), (of_run, run_plain)
        changes = [
            mean_of(one.control) - mean_of(profiles(course, plain, places).control)
            for one, plain in pairs
        ]
    return Aligned(recorded, places, real, of_run, *changes)


def mean_of(values: np.ndarray) -> np.ndarray:
    """Return the mean (m,) over those of k drives (k, m) that get there; else NaN."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)
        return np.nanmean(values, axis=0)


def _at(places: np.ndarray, arcs: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Interpolate values where arc lengths are first reached; NaN elsewhere."""
    before = np.maximum.accumulate(np.append(-np.inf, arcs[:-1]))
    ahead = arcs > before
    return np.interp(places, arcs[ahead], values[ahead], np.nan, np.nan)


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.nanmean(values**2)))


def _correlation(one: np.ndarray | None, other: np.ndarray | None) -> float | None:
    """Return Pearson's correlation; None without values, or where one is constant."""
    if one is None or other is None:
        return None
    known = np.isfinite(one) & np.isfinite(other)
    one, other = one[known], other[known]
    if len(one) < 3 or min(np.ptp(one), np.ptp(other)) < 1e-9:
        return None
    return float(np.corrcoef(one, other)[0, 1])
