"""A rendered world as a car's camera sees it."""

from __future__ import annotations

import math
from collections.abc import Callable

from mi_nerfattack.deploy.views.base import AbstractView
from mi_nerfattack.errors import InputError
from mi_nerfattack.render.camera.intrinsics import CameraMount, camera_to_body
from mi_nerfattack.robot.devices import (
    AbstractCamera,
    Clock,
    DeviceLostError,
    Frame,
    TrackedPose,
)


class RenderedCamera(AbstractCamera):
    """A view, moved to where the car is.

    Images are due at multiples of the period from the moment it is made. One that is
    due is rendered when it is asked for, which takes as long as that takes: made for
    clocks that stand still meanwhile. By a clock that runs on, its image is as old as
    its rendering took. Others that were due before are only counted.

    Args:
        view: what renders; closed with the camera.
        mount: of the camera on the body.
        pose: returns where the body is; None as long as nobody knows.
        clock: of all times.
        period_s: between two images, seconds.
        seed: of the samples of the first image.
    """

    def __init__(
        self,
        view: AbstractView,
        mount: CameraMount,
        pose: Callable[[], TrackedPose | None],
        clock: Clock,
        period_s: float = 0.1,
        seed: int = 0,
    ) -> None:
        if not 0 < period_s < math.inf:
            raise InputError(f"period_s: {period_s}; positive and finite, seconds")
        self.camera = view.camera
        self._view, self._pose, self._clock = view, pose, clock
        self._to_body = camera_to_body(mount)
        self._start_s, self._period_s, self._seed = clock(), period_s, seed
        self._frame: Frame | None = None
        self._is_closed = False

    def newest(self) -> Frame | None:
        """Return the newest image, rendered if it is due."""
        if self._is_closed:
            raise DeviceLostError("rendered camera: it is closed")
        # a clock that adds up periods may be short of one by rounding
        due = int((self._clock() - self._start_s) / self._period_s + 1e-6)
        if self._frame is None or self._frame.index < due:
            pose = self._pose()
            if pose is not None:
                seed = (self._seed + due) % (1 << 32)
                shown = self._view.render(pose.body_to_world @ self._to_body, seed)
                self._frame = Frame(shown.image, pose.time_s, due)
        return self._frame

    def close(self) -> None:
        """Close the view."""
        if not self._is_closed:
            self._is_closed = True
            self._view.close()
