"""Pilots on this computer: a policy in a thread of its own, and the expert."""

from __future__ import annotations

import threading
from collections.abc import Callable

import numpy as np

from mi_nerfattack.deploy.driving import policy_image
from mi_nerfattack.policy.base import AbstractPolicy
from mi_nerfattack.robot.devices import (
    AbstractPilot,
    AbstractTracker,
    Clock,
    Decision,
    DeviceLostError,
    Frame,
)
from mi_nerfattack.vehicle.expert.base import AbstractExpert


class LocalPilot(AbstractPilot):
    """A policy that is evaluated beside the loop, always with the newest frame.

    What takes long, or for ever, shows as a decision that grows old.

    Args:
        control: from a frame's image (height, width, 3), uint8 sRGB, to a control;
            called by the pilot's thread alone, see `policy_control`.
        clock: of the loop.
    """

    def __init__(self, control: Callable[[np.ndarray], float], clock: Clock) -> None:
        self._control, self._clock = control, clock
        self._changed = threading.Condition()
        self._waiting: Frame | None = None
        self._decision: Decision | None = None
        self._error: BaseException | None = None
        self._closed = False
        self._thread = threading.Thread(target=self._work, daemon=True)
        self._thread.start()

    def submit(self, frame: Frame) -> None:
        """Give it a frame; one that it has not begun with is replaced."""
        with self._changed:
            self._check()
            self._waiting = frame
            self._changed.notify()

    def newest(self) -> Decision | None:
        """Return the newest decision; None before the first."""
        with self._changed:
            self._check()
            return self._decision

    def close(self) -> None:
        """End the thread, but for a policy that never comes back."""
        with self._changed:
            self._closed = True
            self._changed.notify()
        self._thread.join(timeout=1.0)

    def _check(self) -> None:
        if self._error is not None:
            name = type(self._error).__name__
            raise DeviceLostError(
                f"policy: failed ({name}: {self._error}); try it on a recording first"
            ) from self._error

    def _work(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._closed or self._waiting)
                frame, self._waiting = self._waiting, None
                if self._closed or frame is None:
                    return
            try:
                decision = decide(self._control, frame, self._clock)
            except BaseException as error:  # a thread has nobody else to tell
                with self._changed:
                    self._error = error
                return
            with self._changed:
                self._decision = decision


class ExpertPilot(AbstractPilot):
    """An expert that knows the tracked pose, and looks at no frame.

    Args:
        expert: called once a frame, that is once a control period.
        tracker: of the pose.
        body: name of the car.
        clock: of the loop.
    """

    def __init__(
        self, expert: AbstractExpert, tracker: AbstractTracker, body: str, clock: Clock
    ) -> None:
        self._expert, self._tracker, self._body = expert, tracker, body
        self._clock = clock
        self._decision: Decision | None = None

    def submit(self, frame: Frame) -> None:
        """Decide at once."""
        pose = self._tracker.newest(self._body)
        if pose is not None:
            x_axis, position = pose.body_to_world[:2, 0], pose.body_to_world[:2, 3]
            state = [*position, np.arctan2(x_axis[1], x_axis[0])]
            control = float(self._expert.control(np.array(state))[0])
            self._decision = Decision(control, frame.index, frame.time_s, self._clock())

    def newest(self) -> Decision | None:
        """Return the newest decision; None before the first."""
        return self._decision

    def close(self) -> None:
        """Nothing is held."""


def decide(
    control: Callable[[np.ndarray], float], frame: Frame, clock: Clock
) -> Decision:
    """Return what is decided of a frame."""
    value = control(frame.image)
    return Decision(value, frame.index, frame.time_s, clock())


def policy_control(policy: AbstractPolicy, goal: int) -> Callable[[np.ndarray], float]:
    """Return what a policy makes of images, one after the other.

    Args:
        policy: one with memory starts with its initial one.
        goal: of the route.
    """
    memory = policy.initial_memory(1)

    def control(image: np.ndarray) -> float:
        nonlocal memory
        row, memory = policy.step(policy_image(image), goal, memory)
        return float(np.array(row)[0])

    return control
