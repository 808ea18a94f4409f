"""A box in the frames of a camera, from where the car was when they were taken."""

from __future__ import annotations

import numpy as np
import pytest

from mi_nerfattack.car.devices import DeviceLostError, Frame, TrackedPose
from mi_nerfattack.props.overlaid import OverlaidCamera
from mi_nerfattack.render.camera.intrinsics import (
    CameraMount,
    camera_to_body,
    from_fov,
    planar_body,
)

RADIUS, SPEED = 1.1, 1.0
POSE_S, POSE_LATE_S, FRAME_S, FRAME_LATE_S = 0.02, 0.01, 0.1, 0.03
MOUNT = CameraMount(0.2, 0.3, 10.0)


def body_at(time_s: float) -> np.ndarray:
    angle = SPEED * time_s / RADIUS
    x, y = RADIUS * np.cos(angle), RADIUS * np.sin(angle)
    return planar_body(np.array([x, y, angle + np.pi / 2]))


class Car:
    """Tracker and camera of a car on a circle, by a clock that is moved by hand."""

    camera = from_fov(4, 2, 90.0)

    def __init__(self) -> None:
        self.now_s, self.error, self.is_seen = 10.0, None, True
        self.closed = 0

    def newest(self, body: str | None = None) -> Frame | TrackedPose | None:
        if body is None:
            index = int((self.now_s - FRAME_LATE_S) / FRAME_S + 1e-6)
            return Frame(np.zeros((2, 4, 3), np.uint8), index * FRAME_S, index)
        if self.error is not None:
            raise self.error
        index = int((self.now_s - POSE_LATE_S) / POSE_S + 1e-6)
        where = body_at(index * POSE_S)
        if not self.is_seen:
            where = np.full((4, 4), np.nan)
        return TrackedPose(where, index * POSE_S, index)

    def close(self) -> None:
        self.closed += 1


class NotingOverlay:
    """An overlay that paints nothing and notes from where it was asked to."""

    def __init__(self) -> None:
        self.places: list[np.ndarray] = []

    def apply(self, frame: np.ndarray, camera_to_world: np.ndarray) -> np.ndarray:
        self.places.append(camera_to_world)
        return frame + len(self.places)


def test_a_frame_shows_the_box_from_where_it_was_taken():
    """Within the sagitta of the way between two poses, 20 ms on the circle."""
    car, overlay = Car(), NotingOverlay()
    camera = OverlaidCamera(car, overlay, car, "car", MOUNT)
    assert camera.camera is car.camera
    frames = {}
    for _ in range(200):
        frame = camera.newest()
        assert frame is not None
        frames[frame.index] = frame
        car.now_s += 0.01
    assert len(overlay.places) == len(frames) == 21  # each is painted once
    sagitta = (SPEED * POSE_S) ** 2 / 8 / RADIUS
    # the first frame came before any pose later than it
    for place, frame in list(zip(overlay.places, frames.values(), strict=True))[1:]:
        expected = body_at(frame.time_s) @ camera_to_body(MOUNT)
        assert np.abs(place - expected).max() < 2 * sagitta
    assert frame.image.max() == 21
    camera.close()
    assert car.closed == 1


def test_no_frame_without_a_pose_and_the_last_one_of_a_lost_tracker():
    car, overlay = Car(), NotingOverlay()
    camera = OverlaidCamera(car, overlay, car, "car", MOUNT)
    car.is_seen = False
    assert camera.newest() is None and not overlay.places
    car.is_seen = True
    assert camera.newest() is not None
    car.error = DeviceLostError("gone")
    car.now_s += 1.0
    assert camera.newest() is not None
    last = body_at(10.0 - POSE_S) @ camera_to_body(MOUNT)
    np.testing.assert_allclose(overlay.places[-1], last, atol=1e-9)
    car.error = ValueError("a mistake")
    with pytest.raises(ValueError, match="a mistake"):
        camera.newest()
