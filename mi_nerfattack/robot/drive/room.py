"""A car, its camera and its tracker in a rendered room, by a clock of its own.

Time passes where the loop sleeps, so a drive takes as long as it takes to render.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from mi_nerfattack.deploy.car import Car
from mi_nerfattack.deploy.place import Conditions, Place
from mi_nerfattack.deploy.registry import mitsuba_view
from mi_nerfattack.deploy.vehicle import planar_body
from mi_nerfattack.errors import InputError
from mi_nerfattack.robot.camera.rendered import RenderedCamera
from mi_nerfattack.robot.devices import (
    AbstractEnable,
    AbstractMotor,
    AbstractPilot,
    AbstractTracker,
    Command,
    Decision,
    Frame,
    MotorValues,
    TrackedPose,
)
from mi_nerfattack.robot.drive.pilot import Control

_STEP_S = 0.005
_POSE_S, _VALUES_S = 0.02, 0.05  # between poses, and between the motor's values
FRAME_LATENCY_S, POSE_LATENCY_S, DECISION_S = 0.03, 0.01, 0.02
_TIMEOUT_S = 0.25
_FOLLOWS_MS2, _BRAKES_MS2 = 4.0, 3.0


class SimulatedRoom:
    """What the devices share: the time, and where the car was.

    The car is the kinematic single-track model: its steering angle is the one
    commanded, its speed follows as fast as it can. Without a command for 0.25 s it
    brakes.

    Args:
        car: its wheelbase and largest steering angle.
        pose: (3,), where it stands, metres and radians.
    """

    def __init__(self, car: Car, pose: np.ndarray) -> None:
        self.car, self.now_s = car, 0.0
        self.state, self.speed_ms = np.array(pose, np.float64), 0.0
        self.command, self.commanded_s = Command(0.0, 0.0), -math.inf
        self._past = deque([(0.0, self.state)], maxlen=64)

    def clock(self) -> float:
        """Return seconds since the room was made."""
        return self.now_s

    def sleep(self, seconds: float) -> None:
        """Let time pass, and the car drive."""
        end = self.now_s + seconds
        while self.now_s < end - 1e-9:
            step = min(_STEP_S, end - self.now_s)
            self.now_s += step
            self._move(step)
            self._past.append((self.now_s, self.state))

    @property
    def has_timed_out(self) -> bool:
        """Whether the motor controller brakes because nobody commands it."""
        return self.now_s - self.commanded_s > _TIMEOUT_S

    def pose_before(self, latency_s: float, period_s: float) -> TrackedPose:
        """Return the newest pose that is so old, of those at multiples of a period."""
        index = int((self.now_s - latency_s) / period_s + 1e-6)
        time_s = max(index, 0) * period_s
        near = min(self._past, key=lambda item: abs(item[0] - time_s))
        return TrackedPose(planar_body(near[1]), time_s, max(index, 0))

    def _move(self, step_s: float) -> None:
        brakes = self.has_timed_out
        goal, rate = (
            (0.0, _BRAKES_MS2) if brakes else (self.command.speed_ms, _FOLLOWS_MS2)
        )
        change = goal - self.speed_ms
        self.speed_ms += min(max(change, -rate * step_s), rate * step_s)
        x, y, heading = self.state
        way = self.speed_ms * step_s
        turn = way * math.tan(self.command.steering_rad) / self.car.wheelbase
        chord = way * float(np.sinc(0.5 * turn / np.pi))
        ahead = heading + 0.5 * turn
        self.state = np.array(
            [x + chord * math.cos(ahead), y + chord * math.sin(ahead), heading + turn]
        )


class SimulatedTracker(AbstractTracker):
    """Tells the car's pose 50 times a second, whatever it is called.

    Args:
        room: of the car.
    """

    def __init__(self, room: SimulatedRoom) -> None:
        self._room = room

    def newest(self, body: str) -> TrackedPose:
        """Return the newest pose."""
        return self._room.pose_before(POSE_LATENCY_S, _POSE_S)

    def close(self) -> None:
        """Nothing is held."""


class SimulatedMotor(AbstractMotor):
    """Moves the car.

    Args:
        room: of the car.
    """

    def __init__(self, room: SimulatedRoom) -> None:
        self._room, self._values, self._is_armed = room, None, False

    def arm(self, check: Callable[[], None] = lambda: None) -> None:
        """Let it move; its timeout is that of the simulation."""
        self._is_armed = True

    def send(self, command: Command) -> Command:
        """Command it."""
        if not self._is_armed:
            raise InputError("simulated motor: not armed")
        most = self._room.car.max_steer
        angle = min(max(command.steering_rad, -most), most)
        self._room.command = sent = Command(command.speed_ms, angle)
        self._room.commanded_s = self._room.now_s
        return sent

    def brake(self) -> None:
        """Brake as after the timeout, and centre the steering."""
        self._room.command, self._room.commanded_s = Command(0.0, 0.0), -math.inf

    def read(self) -> MotorValues:
        """Return speed and timeout, 20 times a second."""
        room, values = self._room, self._values
        if values is None or room.now_s - values.time_s >= _VALUES_S:
            self._values = values = MotorValues(
                room.now_s, room.speed_ms, has_timed_out=room.has_timed_out
            )
        return values

    def close(self) -> None:
        """Brake."""
        self.brake()


class SimulatedPilot(AbstractPilot):
    """Decides at once, and lets its decision be known some time later.

    Args:
        control: of a frame.
        room: whose time it is.
    """

    def __init__(self, control: Control, room: SimulatedRoom) -> None:
        self._control, self._room = control, room
        self._decisions: deque[Decision] = deque(maxlen=8)

    def submit(self, frame: Frame) -> None:
        """Decide."""
        value, then = self._control(frame), self._room.now_s + DECISION_S
        self._decisions.append(Decision(value, frame.index, frame.time_s, then))

    def newest(self) -> Decision | None:
        """Return the newest decision whose time has come."""
        made = [item for item in self._decisions if item.time_s <= self._room.now_s]
        return made[-1] if made else None

    def close(self) -> None:
        """Nothing is held."""


class SimulatedEnable(AbstractEnable):
    """Somebody who holds the button from the first second on.

    Args:
        room: whose time it is.
    """

    def __init__(self, room: SimulatedRoom) -> None:
        self._room = room

    def is_held(self) -> bool:
        """Whether a second has passed."""
        return self._room.now_s >= 1.0

    def close(self) -> None:
        """Nothing is held."""


def simulated_camera(
    room: SimulatedRoom, place: Place, spp: int, seed: int = 0
) -> RenderedCamera:
    """Return the car's camera at a place, 10 times a second.

    Args:
        room: of the car.
        place: scene, camera and its mount.
        spp: samples per pixel.
        seed: of the samples.
    """
    view = mitsuba_view(replace(place, car=room.car), Conditions(spp=spp))

    def pose() -> TrackedPose:
        return room.pose_before(FRAME_LATENCY_S, _STEP_S)

    return RenderedCamera(view, place.mount, pose, room.clock, place.period, seed)
