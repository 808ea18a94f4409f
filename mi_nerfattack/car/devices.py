"""The devices of a car on the floor, as the loop that drives the car sees them.

Every time is in seconds by one clock of this computer, by default
:func:`time.monotonic`. Where a device has another clock, the device's class converts
the device's times. Nothing waits: a device keeps its newest value, and the loop asks.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from mi_nerfattack.errors import InputError
from mi_nerfattack.render.camera.intrinsics import Camera

#: Returns seconds that never run backwards.
Clock = Callable[[], float]


class DeviceLostError(InputError):
    """A device that worked works no more: unplugged, silent, or speaking nonsense."""


@dataclass(frozen=True, eq=False)
class Frame:
    """An image of the car's camera.

    Args:
        image: (height, width, 3) uint8, sRGB.
        time_s: when it was taken, as nearly as is known.
        index: counts the camera's images, those included that nobody asked for.
    """

    image: np.ndarray
    time_s: float
    index: int


@dataclass(frozen=True, eq=False)
class TrackedPose:
    """Where a tracker saw a body.

    Args:
        body_to_world: (4, 4) float64, rigid, metres.
        time_s: when it was measured, as nearly as is known.
        index: the tracker's own frame number.
    """

    body_to_world: np.ndarray
    time_s: float
    index: int


@dataclass(frozen=True)
class Command:
    """What the car is to do until the next one.

    Args:
        speed_ms: metres per second, forward.
        steering_rad: of the front wheels, positive to the left.
    """

    speed_ms: float
    steering_rad: float


@dataclass(frozen=True)
class MotorValues:
    """What a motor controller says of itself; None where it says nothing.

    Args:
        time_s: when it was read.
        speed_ms: metres per second, forward, by the motor's turns.
        motor_current_a: amperes through the motor, mean since the last reading.
        input_voltage_v: volts of the battery.
        fet_temperature_c: of the controller's MOSFETs, degrees Celsius.
        fault: number of a fault, 0 for none.
        fault_name: of it.
        has_timed_out: whether the controller brakes because nobody commands it.
        is_killed: whether it brakes because its kill switch is pressed; let go, it
            would obey commands again.
    """

    time_s: float
    speed_ms: float | None = None
    motor_current_a: float | None = None
    input_voltage_v: float | None = None
    fet_temperature_c: float | None = None
    fault: int = 0
    fault_name: str = "none"
    has_timed_out: bool | None = None
    is_killed: bool | None = None


@dataclass(frozen=True)
class Decision:
    """What a policy made of a frame.

    Args:
        control: in the unit of the policy's vehicle.
        frame_index: of the frame.
        frame_time_s: of the frame, by the clock of this computer.
        time_s: when the decision was there, by the same clock.
    """

    control: float
    frame_index: int
    frame_time_s: float
    time_s: float


class AbstractCamera(ABC):
    """A camera that runs by itself.

    Attributes:
        camera: intrinsics of its frames.
    """

    camera: Camera

    @abstractmethod
    def newest(self) -> Frame | None:
        """Return the newest frame, the same again where no other came; None at first.

        Raises:
            DeviceLostError: no more will come.
        """

    @abstractmethod
    def close(self) -> None:
        """Let go of the device; more than once does no harm."""


class AbstractTracker(ABC):
    """A motion capture system that runs by itself."""

    @abstractmethod
    def newest(self, body: str) -> TrackedPose | None:
        """Return the newest measured pose of a body; None before the first.

        A body that is lost keeps its last pose, whose age grows.

        Raises:
            DeviceLostError: no more will come.
        """

    def explain(self, body: str) -> str:
        """Say why no new pose of a body comes, as far as is known, for a message."""
        return f"nothing new of {body!r} comes from the tracker"

    @abstractmethod
    def close(self) -> None:
        """Let go of the connection; more than once does no harm."""


class AbstractMotor(ABC):
    """A motor controller with the steering servo."""

    @abstractmethod
    def arm(self, check: Callable[[], None] = lambda: None) -> None:
        """Prove that the car brakes by itself when commands stop, and let it move.

        Args:
            check: called again and again while wheels may turn; what it raises ends
                this, braked and not armed.

        Raises:
            InputError: it is not proven; the message says what to do.
            DeviceLostError: no answer.
        """

    @abstractmethod
    def check(self) -> None:
        """Check that the controller still brakes by itself, as `arm` has proved.

        Raises:
            DeviceLostError: no answer, or the controller has restarted; arm it again.
        """

    @abstractmethod
    def send(self, command: Command) -> Command:
        """Send a command, which is the only sign of life that the controller gets.

        Returns:
            What was really sent, within the controller's own limits and its steps.

        Raises:
            InputError: not armed, or not finite.
            DeviceLostError: it cannot be sent.
        """

    @abstractmethod
    def brake(self) -> None:
        """Brake and centre the steering; allowed at any time, and from any thread.

        Raises:
            DeviceLostError: it cannot be sent.
        """

    @abstractmethod
    def read(self) -> MotorValues | None:
        """Return the newest values, for which it asks without waiting; None at first.

        Raises:
            DeviceLostError: the controller has fallen silent.
        """

    @abstractmethod
    def close(self) -> None:
        """Brake, and let go of the port; more than once does no harm."""


class AbstractPilot(ABC):
    """A policy that decides while the loop runs, on this or on another computer.

    Both `submit` and `newest` raise `DeviceLostError` where the link is lost or the
    policy failed, with the message of the failure.
    """

    @abstractmethod
    def submit(self, frame: Frame) -> None:
        """Give it a frame; one that it has not begun with is replaced."""

    @abstractmethod
    def newest(self) -> Decision | None:
        """Return the newest decision; None before the first."""

    def reset(self) -> None:
        """Forget the frames before the next one that is given to it.

        What has no memory has nothing to forget.
        """
        return None

    @abstractmethod
    def close(self) -> None:
        """Let go of threads and connections; more than once does no harm."""


class AbstractEnable(ABC):
    """What a person holds as long as the car may move."""

    @abstractmethod
    def is_held(self) -> bool:
        """Whether it is held at this moment; False, too, when that is unknown."""

    @abstractmethod
    def close(self) -> None:
        """Let go of the device; more than once does no harm."""
