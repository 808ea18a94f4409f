"""A rendered camera in simulated time."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.blank_view import BlankView

from mi_nerfattack.deploy.environment import CameraFrame
from mi_nerfattack.errors import InputError
from mi_nerfattack.render.camera.intrinsics import CameraMount, mount_matrix
from mi_nerfattack.robot.camera.rendered import RenderedCamera
from mi_nerfattack.robot.devices import DeviceLostError, TrackedPose


class NotingView(BlankView):
    """A view that notes from where it was asked to render, and that it was closed."""

    def __init__(self) -> None:
        super().__init__()
        self.places: list[np.ndarray] = []
        self.closed = 0

    def render(self, camera_to_world: np.ndarray, seed: int) -> CameraFrame:
        self.places.append(camera_to_world)
        return super().render(camera_to_world, seed)

    def close(self) -> None:
        self.closed += 1


class Car:
    """A car on a circle, by a clock that is moved by hand."""

    def __init__(self) -> None:
        self.time_s, self.is_seen = 100.0, True

    def state(self) -> np.ndarray:
        angle = self.time_s
        return np.array([3 * np.cos(angle), 3 * np.sin(angle), angle + np.pi / 2])

    def pose(self) -> TrackedPose | None:
        x, y, heading = self.state()
        cosine, sine = np.cos(heading), np.sin(heading)
        rows = [[cosine, -sine, 0, x], [sine, cosine, 0, y], [0, 0, 1, 0], [0, 0, 0, 1]]
        return TrackedPose(np.array(rows), self.time_s, 0) if self.is_seen else None


def test_images_come_in_step_with_the_clock():
    car, view, mount = Car(), NotingView(), CameraMount(0.2, 0.1, 10.0)
    camera = RenderedCamera(
        view, mount, car.pose, lambda: car.time_s, seed=(1 << 32) - 2
    )
    assert camera.camera is view.camera
    states, seen = [], []
    for step in range(60):  # at 50 Hz
        frame = camera.newest()
        assert frame is not None
        if frame.index != (seen[-1].index if seen else -1):
            seen.append(frame)
            states.append(car.state())
            assert frame.time_s == car.time_s
        assert frame is seen[-1] and frame.index == step // 5
        car.time_s += 0.02
    assert len(seen) == 12 and seen[0].image.shape == (2, 4, 3)
    expected = mount_matrix(np.array(states), mount)
    assert np.array(view.places) == pytest.approx(expected, abs=1e-9)
    assert view.seeds == [*range((1 << 32) - 2, 1 << 32), *range(10)]


def test_images_that_nobody_asked_for_are_counted():
    car, view = Car(), NotingView()
    camera = RenderedCamera(view, CameraMount(), car.pose, lambda: car.time_s)
    car.is_seen = False
    assert camera.newest() is None
    car.is_seen, car.time_s = True, car.time_s + 0.75
    frame = camera.newest()
    assert frame is not None and frame.index == 7 and len(view.places) == 1
    car.is_seen, car.time_s = False, car.time_s + 1
    assert camera.newest() is frame  # and grows old
    camera.close()
    camera.close()
    assert view.closed == 1
    with pytest.raises(DeviceLostError):
        camera.newest()
    with pytest.raises(InputError, match="period_s: 0"):
        RenderedCamera(view, CameraMount(), car.pose, lambda: 0.0, period_s=0)
