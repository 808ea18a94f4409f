"""Environments whose frames come late or not at all, and whose controls come late.

Each is an environment around another one, so that they can be put around each other;
with a strength of zero all drives are those of the environment inside, bit by bit.
"""

from __future__ import annotations

from abc import abstractmethod
from collections import deque
from collections.abc import Sequence
from typing import Any

import numpy as np

from mi_nerfattack.deploy.environment import AbstractEnvironment, CameraFrame
from mi_nerfattack.deploy.vehicle import Controls, checked_control
from mi_nerfattack.errors import InputError
from mi_nerfattack.vehicle.route.route import Route

_STREAM = 5  # of a drive's seed


class AbstractAround(AbstractEnvironment):
    """An environment around another one, equal to it except for one change.

    Args:
        inside: the other environment, which this one resets, drives and closes.
    """

    def __init__(self, inside: AbstractEnvironment) -> None:
        self.inside, self.name, self.camera = inside, inside.name, inside.camera
        self.rig = inside.rig
        self.period, self.max_control = inside.period, inside.max_control
        self.control_unit = inside.control_unit
        self.more_controls = inside.more_controls

    def reset(
        self, route: Route, pose: np.ndarray | None = None, seed: int = 0
    ) -> CameraFrame:
        """Put the vehicle on the route's start, or elsewhere."""
        return self.begin(self.inside.reset(route, pose, seed), seed)

    @abstractmethod
    def begin(self, frame: CameraFrame, seed: int) -> CameraFrame:
        """Forget the drive before.

        Args:
            frame: of the environment inside, after its reset.
            seed: of what is random until the next reset.

        Returns:
            the first frame of the drive.
        """

    @property
    def state(self) -> np.ndarray:
        """State (m,) of the vehicle, as it is."""
        return self.inside.state

    @property
    def speed(self) -> float:
        """Speed of the vehicle, as it is."""
        return self.inside.speed

    @property
    def is_over(self) -> bool:
        """Whether there is nothing more to observe."""
        return self.inside.is_over

    def show(self, objects: Sequence[Any]) -> None:
        """Show fields."""
        self.inside.show(objects)

    def close(self) -> None:
        """Close the environment inside."""
        self.inside.close()


class LateFrames(AbstractAround):
    """Frames come some periods after they were taken, the first one as often before.

    Args:
        inside: takes the frames.
        periods: k >= 0: a step gives the frame of k steps before.
    """

    def __init__(self, inside: AbstractEnvironment, periods: int) -> None:
        super().__init__(inside)
        self._frames: deque[CameraFrame] = deque(
            maxlen=_checked_periods("late", periods) + 1
        )

    def step(self, control: Controls) -> CameraFrame:
        """Hold a control, and return the frame that arrives."""
        self._frames.append(self.inside.step(control))
        return self._frames[0]

    def begin(self, frame: CameraFrame, seed: int) -> CameraFrame:
        """Forget the drive before; see the family."""
        del seed
        self._frames.extend([frame] * (self._frames.maxlen or 1))
        return frame


class DroppedFrames(AbstractAround):
    """Frames are lost at random, each for itself; the last that came is seen again.

    The first of a drive always comes. Lost ones are not rendered. Which are lost
    follows from the seed of the drive; a larger share loses the same and more.

    Args:
        inside: takes the frames.
        share: of frames that are lost, in [0, 1].
    """

    def __init__(self, inside: AbstractEnvironment, share: float) -> None:
        super().__init__(inside)
        if not 0 <= share <= 1:
            raise InputError(f"dropped: {share!r}; a share of frames in [0, 1]")
        self.share = share
        self._draws = np.random.default_rng()
        self._last: CameraFrame | None = None

    def step(self, control: Controls) -> CameraFrame:
        """Hold a control, and return the last frame that came."""
        if self._last is None:
            raise InputError(f"environment {self.name!r}: step comes after reset")
        if self._draws.random() < self.share:
            self.inside.advance(control)
        else:
            self._last = self.inside.step(control)
        return self._last

    def begin(self, frame: CameraFrame, seed: int) -> CameraFrame:
        """Forget the drive before; see the family."""
        self._draws = np.random.default_rng([seed, _STREAM])
        self._last = frame
        return frame


class LateControls(AbstractAround):
    """Controls take effect some periods after they were given; 0 does before.

    Args:
        inside: is driven.
        periods: k >= 0: a step holds the control that was given k steps before.
    """

    def __init__(self, inside: AbstractEnvironment, periods: int) -> None:
        super().__init__(inside)
        self.periods = _checked_periods("latency", periods)
        self._controls: deque[Controls] = deque()

    def step(self, control: Controls) -> CameraFrame:
        """Take a control, and hold the one whose turn it is."""
        return self.inside.step(self._exchange(control))

    def advance(self, control: Controls) -> None:
        """Take a control and hold the one whose turn it is, without a new frame."""
        self.inside.advance(self._exchange(control))

    def _exchange(self, control: Controls) -> Controls:
        checked_control(control, self.control_names)  # now, not when its turn comes
        self._controls.append(control)
        return self._controls.popleft()

    def begin(self, frame: CameraFrame, seed: int) -> CameraFrame:
        """Forget the drive before; see the family."""
        del seed
        count = len(self.control_names)
        none = 0.0 if count == 1 else np.zeros(count)
        self._controls = deque([none] * self.periods)
        return frame


def _checked_periods(name: str, periods: int) -> int:
    if not isinstance(periods, int) or periods < 0:
        raise InputError(f"{name}: {periods!r}; a whole number of control periods")
    return periods
