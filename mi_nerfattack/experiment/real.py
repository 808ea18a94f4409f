"""Real drives as one more environment of a finished run."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mi_nerfattack.deploy.car import Car
from mi_nerfattack.deploy.replay.environment import open_recording
from mi_nerfattack.deploy.replay.mcap import McapTopics
from mi_nerfattack.deploy.replay.recording import vehicle_states
from mi_nerfattack.errors import InputError
from mi_nerfattack.evaluation.metrics import metrics_document
from mi_nerfattack.evaluation.sequential import Criteria, tested
from mi_nerfattack.experiment.run_folder import read_finished
from mi_nerfattack.experiment.transfer.found import FoundAttack
from mi_nerfattack.render.camera.intrinsics import Camera, CameraMount
from mi_nerfattack.rollout.drive import REAL, Drive, Lane
from mi_nerfattack.scenario.world import build_surrogate
from mi_nerfattack.vehicle.route.route import Route
from mi_nerfattack.vehicle.steering import steering_angle

#: Share of the stretch from which on a drive counts as whole.
MIN_SHARE = 0.95
_FAR = 3.0  # lane widths: another frame of the world
_STANDING = 0.1  # of the route's speed


@dataclass(frozen=True, eq=False)
class Course:
    """Where drives are compared, and how they are read.

    Attributes:
        route: the lane centre, with the vehicle's speed.
        start_m: arc length where the run's drives begin.
        end_m: where one at the vehicle's speed ends.
        lane: of the route.
        camera: of the scenario, for recordings without intrinsics.
        mount: of the camera on the vehicle, from the point of its state.
        period: seconds between two controls.
        car: of the scenario. Drives have steering angles, where these are its control
            (rad), and otherwise heading rates.
    """

    route: Route
    start_m: float
    end_m: float
    lane: Lane
    camera: Camera
    mount: CameraMount
    period: float
    car: Car

    @classmethod
    def of(cls, attack: FoundAttack) -> Course:
        """Return that of a run."""
        scenario, route = attack.scenario, attack.route
        rig = scenario.rig()
        rig.require_one(f"{attack.folder}", "recordings show one camera's images")
        camera, mount = rig.cameras[0], rig.mounts[0]
        if scenario.scene.surrogate is not None:
            camera = build_surrogate(scenario).intrinsics
        period, car = scenario.vehicle.dt_s, scenario.vehicle.car()
        start_m, end_m = scenario.drive.stretch(route, period)
        return cls(
            route,
            start_m,
            end_m,
            lane=attack.lane,
            camera=camera,
            mount=mount,
            period=period,
            car=car,
        )

    @property
    def length_m(self) -> float:
        """Arc length of the stretch."""
        return self.end_m - self.start_m

    def arcs(self, states: np.ndarray) -> np.ndarray:
        """Return arc lengths (n,) of states (n, 3), in order along the stretch.

        On a closed route they go on from lap to lap, and are of the laps by which they
        cover most of the stretch, of the first such.
        """
        arcs = self.route.project_numpy(states).arc_length
        if not self.route.closed:
            return arcs
        lap = self.route.length
        arcs = np.unwrap(arcs, period=lap)
        later = arcs + lap * np.ceil((self.start_m - arcs[0]) / lap)
        return max((later, later - lap), key=self.covered_m)

    def covered_m(self, arcs: np.ndarray) -> float:
        """Return how much of the stretch arc lengths cover; negative where none."""
        return float(min(arcs.max(), self.end_m) - max(arcs[0], self.start_m))

    def controls(self, states: np.ndarray, times: np.ndarray) -> np.ndarray:
        """Return the control that led from each state to the next, as driven.

        By the change of heading: per second, or per metre by the single-track model.

        Args:
            states: (n, 3), metres and radians.
            times: (n,), seconds, increasing.

        Returns:
            (n - 1,), radians of steering if that is the car's control, else radians per
            second of heading; positive to the left.

        Source: appendix A.7 and A.8.
        """
        turn = np.diff(states[:, 2])
        turn = np.arctan2(np.sin(turn), np.cos(turn))
        car = self.car
        if car.control_unit != "rad":
            return turn / np.diff(times)
        ahead = np.stack([np.cos(states[:, 2]), np.sin(states[:, 2])], 1)
        axle = states[:, :2] - car.reference * ahead
        way = np.hypot(*np.diff(axle, axis=0).T)
        return steering_angle(turn, way, car.wheelbase)


@dataclass(frozen=True, eq=False)
class RealDrive:
    """A real drive.

    Attributes:
        path: of the recording.
        drive: on the stretch, in the environment `REAL`; its time begins with it, its
            controls are as driven.
        began_s: when, by the recording.
        coverage: share of the stretch that it gets along, at most 1.
        driven: length of its path over that of the stretch.
        is_out: whether its centre ends out of the lane.
        remarks: what of the recording is left out.
    """

    path: Path
    drive: Drive
    began_s: float
    coverage: float
    driven: float
    is_out: bool
    remarks: tuple[str, ...]

    @property
    def is_whole(self) -> bool:
        """Whether it went all the way, or as far and out of the lane."""
        return self.coverage >= MIN_SHARE or (self.is_out and self.driven >= MIN_SHARE)


def read_all(
    recordings: Mapping[str, Sequence[Path]],
    course: Course,
    topics: McapTopics | None = None,
) -> list[RealDrive]:
    """Read recordings by case, in the order in which they were driven.

    Raises:
        InputError: as of :func:`read_real`, or one is given twice.
    """
    drives: list[RealDrive] = []
    for case, paths in recordings.items():
        for run, path in enumerate(paths):
            drive = read_real(path, case, run, course=course, topics=topics)
            for other in drives:
                is_same = other.began_s == drive.began_s
                if is_same and np.array_equal(other.drive.states, drive.drive.states):
                    raise InputError(f"{path}: is the drive of {other.path} again")
            drives.append(drive)
    return drives


def read_real(
    path: Path,
    case: str,
    run: int,
    course: Course,
    topics: McapTopics | None = None,
) -> RealDrive:
    """Read a recording of a real drive.

    It begins where the stretch does, and ends at its end or, out of the lane, when it
    has driven as far as that is long. What stands at either end is left out; of several
    laps, one counts.

    Args:
        path: video with poses, folder or .mcap log, as for replays.
        case: what the object showed.
        run: index among the drives of the case.
        course: where it was driven.
        topics: of a log.

    Raises:
        InputError: it cannot be read, is in another frame of the world, is nowhere on
            the stretch, or has too few poses.
    """
    mount = course.car.from_axle(course.mount)
    recording = open_recording(
        path, course.camera, mount, period=course.period, topics=topics
    )
    with closing(recording):
        track, remarks = recording.track, recording.remarks
    states = vehicle_states(track, course.mount)
    arcs = course.arcs(states)
    first, last = _cut(states, track.times, arcs, course=course)
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
    _check_gaps(path, states, first, course=course)
    covered = min(arcs[cut].max(), course.end_m) - begin
    way = float(np.hypot(*np.diff(states[:, :2], axis=0).T).sum())
    errors = course.route.cross_track_numpy(states)
    drive = Drive(
        environment=REAL,
        route=course.route.name,
        case=case,
        run=run,
        seed=run,
        states=states,
        controls=course.controls(states, times),
        cross_track_m=errors[1:],
        time_s=times[1:] - times[0],
    )
    is_out = bool(abs(errors[-1]) > course.lane.centre_m)
    covered, driven = covered / course.length_m, way / course.length_m
    return RealDrive(
        path,
        drive,
        float(times[0]),
        coverage=covered,
        driven=driven,
        is_out=is_out,
        remarks=remarks,
    )


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


def real_document(
    attack: FoundAttack,
    course: Course,
    of_run: Sequence[Drive],
    drives: Sequence[RealDrive],
    criteria: Criteria | None = None,
) -> dict[str, Any]:
    """Return the document of a run with the real drives among its own.

    Args:
        attack: the run.
        course: of the run.
        of_run: drives of the run.
        drives: from :func:`read_all`; may be none.
        criteria: of success; None for no test.

    Returns:
        what `metrics_document` returns, with the environment `REAL`; ``real``, what is
        known of each recording; and ``test`` with criteria.

    Raises:
        InputError: the run has no drives.
    """
    run = read_finished(attack.folder)
    if not of_run:
        raise InputError(f"{attack.folder}: no drives to compare with; attack again")
    everything = [*of_run, *(item.drive for item in drives)]
    lanes = {course.route.name: course.lane}
    document = metrics_document(
        run["scenario"], run["seed"], everything, lanes=lanes, cost=run["cost"]
    )
    cases = document["routes"][course.route.name].get(REAL, {})
    rows, outcomes = [], []
    for item in drives:
        case = item.drive.case
        row: dict[str, Any] = {
            "file": str(item.path),
            "case": case,
            "coverage": min(item.coverage, 1.0),
            "remarks": list(item.remarks),
        }
        if criteria is not None and case == criteria.case:
            figures = cases[case]["per_run"][item.drive.run]
            row["success"] = criteria.judge(figures, item.is_whole)
            if row["success"] is not None:
                outcomes.append(row["success"])
                row["decision"] = criteria.test.decisions(outcomes)[-1]
        rows.append(row)
    test = {} if criteria is None else {"test": tested(criteria, outcomes)}
    return document | {"real": rows, **test}
