"""Drives of a run and recordings of real ones, drawn along a route."""

from __future__ import annotations

import numpy as np
from helpers.recorded_drives import CALIBRATION, image_message, pose_message, write_log

from mi_nerfattack.render.camera.intrinsics import CameraMount, from_fov
from mi_nerfattack.robot.compare.course import Course
from mi_nerfattack.rollout.drive import Drive, Lane
from mi_nerfattack.vehicle.route.route import Route

SPEED, PERIOD, STEPS = 5.0, 0.1, 24
LENGTH = SPEED * PERIOD * STEPS
ANGLE = 2 * np.pi * np.arange(600) / 600
LOOP = Route("loop", 0, 10 * np.stack([np.cos(ANGLE), np.sin(ANGLE)], 1), closed=True)
LINE = Route("line", 0, np.array([[-20.0, 0], [60, 0]]))


def course_of(route: Route, start: float = 0.0, length: float = LENGTH, **changes):
    camera, mount = from_fov(16, 8, 90.0), CameraMount()
    about = {"control_unit": "rad/s", "wheelbase": 2.7} | changes
    lane = Lane(0.85, 1.75)
    return Course(route, start, start + length, lane, camera, mount, PERIOD, **about)


def swerved(route: Route, arcs: np.ndarray, most: float, left=0.0) -> np.ndarray:
    """Return states (n, 3) that leave the lane to the right by `most` about 8 m."""
    lateral = left - most * np.exp(-(((arcs - 8) / 2) ** 2))
    slope = np.gradient(lateral, arcs)
    return route.pose_at(arcs, lateral, np.arctan(slope))


def made(route: Route, case: str, most: float, run: int = 0, left=0.0) -> Drive:
    """Return a drive of the run."""
    states = swerved(route, SPEED * PERIOD * np.arange(STEPS + 1), most, left)
    times = PERIOD * np.arange(1, STEPS + 1)
    controls, errors = np.diff(states[:, 2]) / PERIOD, route.cross_track_numpy(states)
    about = "surrogate", route.name, case, run, run
    return Drive(*about, states, controls, errors[1:], times)


def write_drive(path, states, period: float, began: float):
    """Write a recording of a vehicle's states (n, 3)."""
    poses = np.tile(np.eye(4), (len(states), 1, 1))
    cos, sin = np.cos(states[:, 2]), np.sin(states[:, 2])
    poses[:, 0, 0], poses[:, 0, 1] = cos, -sin
    poses[:, 1, 0], poses[:, 1, 1] = sin, cos
    poses[:, :2, 3] = states[:, :2]
    times = began + period * np.arange(len(states))
    image = image_message(path.parent, 0.0, 0)
    stamps = [pose_message(t, m) for t, m in zip(times, poses, strict=True)]
    images = [{**image, "timestamp": item["timestamp"]} for item in stamps]
    topics = {
        "/camera/image": ("foxglove.CompressedImage", images),
        "/vehicle/pose": ("foxglove.PoseInFrame", stamps),
        "/camera/calibration": ("foxglove.CameraCalibration", [CALIBRATION]),
    }
    return write_log(path, topics)


def real(path, most: float, began: float, until: float = 14.0, speed: float = 4.0):
    """Write a drive along LINE from 3 m before the stretch, at another speed."""
    period = 0.02 * 4.0
    return write_drive(
        path,
        swerved(LINE, np.arange(-3.0, until, speed * period), most),
        period,
        began,
    )
