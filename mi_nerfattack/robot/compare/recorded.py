"""Real drives: recordings, cut to the stretch that a run drives."""

from __future__ import annotations

import hashlib
from contextlib import closing
from dataclasses import dataclass
from datetime import datetime, timezone
from pathlib import Path

import numpy as np

from mi_nerfattack.deploy.replay.environment import open_recording
from mi_nerfattack.deploy.replay.recording import Track, vehicle_states
from mi_nerfattack.errors import InputError
from mi_nerfattack.robot.compare.course import Course
from mi_nerfattack.rollout.drive import Drive

REAL = "real"
#: Share of the stretch from which on a drive counts as whole.
WHOLE = 0.95
_FAR = 3.0  # lane widths: another frame of the world
_STANDING = 0.1  # of the route's speed
_EPOCH = 1e9  # smaller times are of no calendar


@dataclass(frozen=True, eq=False)
class RecordedDrive:
    """A real drive.

    Attributes:
        path: of the recording.
        drive: on the stretch, in the environment `REAL`; its time begins with it, its
            controls are as driven.
        began: when the recording began, seconds since 1970.
        has_clock: whether the recording says so itself; else its file does.
        sha256: of its times and poses.
        first: index of the recording's frame that it begins with.
        coverage: share of the stretch that it gets along, at most 1.
        driven: length of its path over that of the stretch.
        is_out: whether its centre ends out of the lane.
        remarks: what of the recording is left out.
    """

    path: Path
    drive: Drive
    began: float
    has_clock: bool
    sha256: str
    first: int
    coverage: float
    driven: float
    is_out: bool
    remarks: tuple[str, ...]

    @property
    def is_whole(self) -> bool:
        """Whether it went all the way, or as far and out of the lane."""
        return self.coverage >= WHOLE or (self.is_out and self.driven >= WHOLE)

    @property
    def began_utc(self) -> str:
        """When the recording began."""
        return datetime.fromtimestamp(self.began, timezone.utc).isoformat()


def read_recorded(path: Path, case: str, run: int, course: Course) -> RecordedDrive:
    """Read a recording of a real drive.

    It begins where the stretch does, and ends at its end or, out of the lane, when it
    has driven as far as that is long. What stands at either end is left out; of several
    laps, one counts.

    Args:
        path: video with poses, folder or .mcap log, as for replays.
        case: what the object showed.
        run: index among the drives of the case.
        course: where it was driven.

    Raises:
        InputError: it cannot be read, is in another frame of the world, is nowhere on
            the stretch, or has too few poses.
    """
    recording = open_recording(path, course.camera, course.mount, course.period)
    with closing(recording):
        track, remarks = recording.track, recording.remarks
    states = vehicle_states(track, course.mount)
    arcs = course.arcs(states)
    first, last = _cut(states, track.times, arcs, course)
    _check_frame(path, states[first], course)
    if last - first < 2:
        raise InputError(
            f"{path}: its {len(arcs)} poses cover {arcs.min():.2f} to "
            f"{arcs.max():.2f} m of route {course.route.name!r}, the run's drives "
            f"{course.start_m:.2f} to {course.end_m:.2f} m; give a drive there, with "
            "its poses"
        )
    had_run_up = arcs[: first + 1].min() < course.start_m
    begin = course.start_m if had_run_up else arcs[first]
    cut = slice(first, last + 1)
    states, times = states[cut], track.times[cut]
    _check_gaps(path, states, first, course)
    covered = min(arcs[cut].max(), course.end_m) - begin
    way = float(np.hypot(*np.diff(states[:, :2], axis=0).T).sum())
    errors = course.route.cross_track_numpy(states)
    drive = Drive(
        REAL,
        course.route.name,
        case,
        run,
        run,
        states,
        course.controls(states, times),
        errors[1:],
        times[1:] - times[0],
    )
    content = track.times.tobytes() + track.camera_to_world.tobytes()
    digest = hashlib.sha256(content).hexdigest()
    began = _began(track)
    shares = covered / course.length_m, way / course.length_m
    is_out = bool(abs(errors[-1]) > course.lane.centre_m)
    return RecordedDrive(path, drive, *began, digest, first, *shares, is_out, remarks)


def _check_frame(path: Path, state: np.ndarray, course: Course) -> None:
    """Refuse a drive that begins far from the route, or looks another way."""
    route = course.route
    measures = route.project_numpy(state)
    far = abs(float(measures.cross_track[0]))
    turned = abs(float(np.degrees(measures.heading_error[0])))
    if far > _FAR * route.lane_width_m or turned > 90:
        raise InputError(
            f"{path}: begins {far:.2f} m from route {route.name!r}, whose lane is "
            f"{route.lane_width_m:g} m wide, turned from it by {turned:.0f} degrees: "
            "in another frame of the world, or not in metres; give poses in the frame "
            "of the run's scene"
        )


def _check_gaps(path: Path, states: np.ndarray, first: int, course: Course) -> None:
    """Refuse poses that are too far apart to tell where it drove."""
    way = np.hypot(*np.diff(states[:, :2], axis=0).T)
    widest, limit = int(way.argmax()), course.route.lane_width_m / 2
    if way[widest] > limit:
        raise InputError(
            f"{path}: from frame {first + widest} to the next its pose moves by "
            f"{way[widest]:.2f} m; at most {limit:.2f} m, half a lane: record more "
            "poses, or take out the one that is wrong"
        )


def _cut(
    states: np.ndarray, times: np.ndarray, arcs: np.ndarray, course: Course
) -> tuple[int, int]:
    """Return the first and last pose on the stretch that belong to the drive."""
    way = np.hypot(*np.diff(states[:, :2], axis=0).T)
    moving = np.flatnonzero(way / np.diff(times) > _STANDING * course.route.speed_ms)
    moving = moving[arcs[moving] >= course.start_m]
    if not len(moving):
        return 0, 0
    first, last = int(moving[0]), int(moving[-1]) + 1
    # out of its lane it ends when it has driven as far; in it, it may weave
    driven = np.append(0.0, np.cumsum(way[first:]))
    out = abs(course.route.cross_track_numpy(states[first:])) > course.lane.centre_m
    over = (arcs[first:] >= course.end_m) | (out & (driven >= course.length_m))
    return first, min(last, first + int(over.argmax())) if over.any() else last


def _began(track: Track) -> tuple[float, bool]:
    """Return when it began, and whether the recording says so itself."""
    first, last = float(track.times[0]), float(track.times[-1])
    if first > _EPOCH:
        return first, True
    return Path(track.where).stat().st_mtime - (last - first), False
