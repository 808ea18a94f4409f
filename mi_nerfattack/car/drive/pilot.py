"""Who decides on this computer: a policy or an expert, in a thread of its own."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable

import numpy as np

from mi_nerfattack.car.devices import (
    AbstractPilot,
    AbstractTracker,
    Clock,
    Decision,
    DeviceLostError,
    Frame,
)
from mi_nerfattack.errors import InputError
from mi_nerfattack.policy.base import AbstractPolicy
from mi_nerfattack.policy.http.client import PolicyClient
from mi_nerfattack.render.camera.intrinsics import planar_state
from mi_nerfattack.vehicle.expert.lane_follower import AbstractExpert

#: What is to be done, of a frame, in the unit of the policy's vehicle.
Control = Callable[[Frame], float]


class LocalPilot(AbstractPilot):
    """A policy that a second thread evaluates, always with the newest frame.

    Where the policy takes long, or never returns, the newest decision grows old.

    Args:
        begin: returns a function that maps a frame to the control and has no memory of
            former frames. Only the pilot's thread calls `begin` and this function. See
            `policy_control` and `expert_control`.
        clock: of the loop.
    """

    def __init__(self, begin: Callable[[], Control], clock: Clock) -> None:
        self._begin, self._clock, self._begins = begin, clock, True
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

    def reset(self) -> None:
        """Begin without memory at the next frame that it has not begun with."""
        with self._changed:
            self._begins = True

    def close(self) -> None:
        """End the thread, unless its policy never returns."""
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
        control: Control | None = None
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._closed or self._waiting)
                frame, self._waiting = self._waiting, None
                if self._closed or frame is None:
                    return
                begins, self._begins = self._begins, False
            try:
                if begins or control is None:
                    control = self._begin()
                value = control(frame)
                now = self._clock()
                decision = Decision(value, frame.index, frame.time_s, time_s=now)
            except BaseException as error:  # a thread has nobody else to tell
                with self._changed:
                    self._error = error
                return
            with self._changed:
                self._decision = decision


def policy_control(policy: AbstractPolicy, goal: int) -> Callable[[np.ndarray], float]:
    """Return the function from an image (height, width, 3) to a policy's control.

    The images come one after the other.

    Args:
        policy: a policy with memory starts with its initial memory.
        goal: of the route.

    Raises:
        InputError: the policy needs numbers, which the car does not measure, and not
            only images and the goal.
    """
    from mi_nerfattack.deploy.environment import policy_image

    if policy.numbers:
        raise InputError(
            f"policy: it asks for {', '.join(policy.numbers.columns)}, which the car "
            "does not measure; drive it in simulation, or give a policy of images"
        )
    memory = policy.initial_memory(1)

    def control(image: np.ndarray) -> float:
        nonlocal memory
        row, memory = policy.step(policy_image(image), goal, memory)
        values = np.array(row)
        if values.size != 1:
            raise InputError(
                f"policy.output: {values.size} controls for an image; the car needs "
                "one: give its column"
            )
        return float(values.item())

    return control


def http_control(client: PolicyClient, goal: int) -> Control:
    """Return what a policy behind a URL makes of frames, one after the other.

    A decision belongs to the frame that was posted for it, whose time the car knows:
    nothing that the server says of time counts.

    Args:
        client: of the policy.
        goal: of the route.
    """
    step = 0

    def control(frame: Frame) -> float:
        nonlocal step
        values = client.ask(frame.image.transpose(2, 0, 1)[None], [goal], step)
        step += 1
        if values.size != 1:
            raise InputError(
                f"{client.url}: {values.size} controls for an image; the car needs "
                "one: give a TOML file with policy.url and policy.output"
            )
        return float(values.item())

    return control


def expert_control(
    expert: AbstractExpert, tracker: AbstractTracker, body: str
) -> Control:
    """Return what an expert makes of the tracked pose, once a frame.

    It looks at no image; before the first pose its control is not a number.

    Args:
        expert: of the route.
        tracker: of the pose.
        body: name of the car.
    """

    def control(frame: Frame) -> float:
        pose = tracker.newest(body)
        if pose is None:
            return math.nan
        return float(expert.control(planar_state(pose.body_to_world))[0])

    return control
