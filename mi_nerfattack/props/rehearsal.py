"""A car, its camera and its tracker in a rendered room, by a clock of its own.

Time passes where the loop sleeps, so a drive takes as long as it takes to render.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from dataclasses import replace

import numpy as np

from mi_nerfattack.car.devices import (
    AbstractCamera,
    AbstractEnable,
    AbstractMotor,
    AbstractPilot,
    AbstractTracker,
    Clock,
    Command,
    Decision,
    DeviceLostError,
    Frame,
    MotorValues,
    TrackedPose,
)
from mi_nerfattack.car.drive.config import DriveConfig
from mi_nerfattack.car.drive.loop import Devices
from mi_nerfattack.car.drive.pilot import Control
from mi_nerfattack.car.drive.rig import Overlaid, Rig, Trained, begin_control
from mi_nerfattack.deploy.car import Car
from mi_nerfattack.deploy.place import Conditions, Place, bundled_place
from mi_nerfattack.deploy.registry import mitsuba_views
from mi_nerfattack.deploy.views.paste import AbstractView
from mi_nerfattack.errors import InputError
from mi_nerfattack.render.camera.intrinsics import (
    CameraMount,
    camera_to_body,
    planar_body,
)
from mi_nerfattack.vehicle.route.route import Route
from mi_nerfattack.vehicle.steering import heading_rate

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
        turn = heading_rate(self.command.steering_rad, way, self.car.wheelbase)
        chord = way * float(np.sinc(0.5 * turn / np.pi))
        ahead = heading + 0.5 * turn
        self.state = np.array(
            [x + chord * math.cos(ahead), y + chord * math.sin(ahead), heading + turn]
        )


class SimulatedTracker(AbstractTracker):
    """Gives the car's pose 50 times a second, under any name of a body."""

    def __init__(self, room: SimulatedRoom) -> None:
        self._room = room

    def newest(self, body: str) -> TrackedPose:
        """Return the newest pose."""
        return self._room.pose_before(POSE_LATENCY_S, _POSE_S)

    def close(self) -> None:
        """Nothing is held."""


class SimulatedMotor(AbstractMotor):
    """Moves the car."""

    def __init__(self, room: SimulatedRoom) -> None:
        self._room, self._values, self._is_armed = room, None, False

    def arm(self, check: Callable[[], None] = lambda: None) -> None:
        """Let it move; its timeout is that of the simulation."""
        self._is_armed = True

    def check(self) -> None:
        """Do nothing: a simulated controller never restarts."""

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
        begin: returns the control of frames, without a memory of former ones.
        room: whose time it is.
    """

    def __init__(self, begin: Callable[[], Control], room: SimulatedRoom) -> None:
        self._begin, self._control, self._room = begin, begin(), room
        self._decisions: deque[Decision] = deque(maxlen=8)

    def submit(self, frame: Frame) -> None:
        """Decide."""
        try:
            value = self._control(frame)
        except InputError as err:
            raise DeviceLostError(f"policy: {err}") from err
        then = self._room.now_s + DECISION_S
        self._decisions.append(Decision(value, frame.index, frame.time_s, time_s=then))

    def newest(self) -> Decision | None:
        """Return the newest decision whose time has come."""
        made = [item for item in self._decisions if item.time_s <= self._room.now_s]
        return made[-1] if made else None

    def reset(self) -> None:
        """Begin without memory."""
        self._control = self._begin()

    def close(self) -> None:
        """Nothing is held."""


class SimulatedEnable(AbstractEnable):
    """Somebody who holds the button from the first second on."""

    def __init__(self, room: SimulatedRoom) -> None:
        self._room = room

    def is_held(self) -> bool:
        """Whether a second has passed."""
        return self._room.now_s >= 1.0

    def close(self) -> None:
        """Nothing is held."""


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
    (view,) = mitsuba_views(replace(place, car=room.car), Conditions(spp=spp))

    def pose() -> TrackedPose:
        return room.pose_before(FRAME_LATENCY_S, _STEP_S)

    return RenderedCamera(
        view, place.mount, pose, clock=room.clock, period_s=place.period, seed=seed
    )


@contextmanager
def open_rehearsal(
    config: DriveConfig, route: Route, trained: Trained, overlaid: Overlaid | None
) -> Iterator[Rig]:
    """Open the simulated devices; arguments as of `open_rig`."""
    place = bundled_place("room")
    lens, mount = trained.camera or place.camera, trained.mount or place.mount
    place = replace(place, camera=lens, mount=mount)
    room = SimulatedRoom(config.car, route.pose_at(0.0))
    tracker, motor = SimulatedTracker(room), SimulatedMotor(room)
    with closing(simulated_camera(room, place, config.spp)) as camera, closing(motor):
        shown = overlaid(camera, tracker, mount) if overlaid else camera
        begin = begin_control(config, route, trained.policy, tracker=tracker)
        pilot, enable = SimulatedPilot(begin, room), SimulatedEnable(room)
        devices = Devices(shown, tracker, motor, pilot=pilot, enable=enable)
        yield Rig(devices, room.clock, room.sleep, room.clock, mount)
