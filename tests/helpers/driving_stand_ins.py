"""A car's devices in memory, driven by a clock that a test turns."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from mi_nerfattack.deploy.car import SMALL_CAR
from mi_nerfattack.deploy.vehicle import planar_body
from mi_nerfattack.render.camera.intrinsics import from_fov
from mi_nerfattack.robot import devices
from mi_nerfattack.robot.drive.log import DriveLog
from mi_nerfattack.robot.drive.loop import Devices, DriveLoop, DriveSettings
from mi_nerfattack.robot.drive.safety.fence import Fence
from mi_nerfattack.robot.drive.safety.judge import Ages, Judge, Stop
from mi_nerfattack.robot.drive.safety.limits import Limits, Steering
from mi_nerfattack.robot.drive.safety.watchdog import Watchdog

CAMERA = from_fov(16, 8, 90.0)
WALL_NS = 1_790_000_000_123_456_789
FRAME_LATENCY_S, POSE_LATENCY_S, DECISION_S = 0.03, 0.004, 0.02
SPEED, RADIUS = 1.0, 1.5
FENCE = Fence(np.array([(-3.0, -3.0), (3.0, -3.0), (3.0, 3.0), (-3.0, 3.0)]))
JUDGE = Judge(Ages(), FENCE, SMALL_CAR, 0.8, 0.1)
SETTINGS = DriveSettings(
    "car", SPEED, JUDGE, Limits(), Steering("rad", 0.325), poll_s=0.01
)


class Bench:
    """What the devices of a car on a circle share, and their time.

    Attributes:
        now: seconds.
        events: (time, what, command) of all that the motor got.
        broken: what a device raises, by its name; of "signal", the loop's check.
        silent: devices that give nothing new, and since when.
        held: whether the enable is.
        control: of the policy.
        offset_m: of the car, along x.
        fault: of the motor controller.
        killed: whether its kill switch is pressed.
        stall_s: that the camera's next answer takes.
        asleep_s: that the computer was suspended, which no device tells.
    """

    def __init__(self, start_s: float = 1000.0) -> None:
        self.now = self.start_s = start_s
        self.events: list[tuple[float, str, devices.Command | None]] = []
        self.broken: dict[str, Exception | KeyboardInterrupt] = {}
        self.silent: dict[str, float] = {}
        self.held, self.control, self.offset_m = False, 0.2, 0.0
        self.fault, self.killed = 0, False
        self.stall_s, self.asleep_s = 0.0, 0.0
        self.plans: list[tuple[float, Callable[[], None]]] = []
        self.motor = StandInMotor(self)
        limit_s = JUDGE.ages.loop_s
        self.watchdog = Watchdog(
            self.motor.brake, limit_s, lambda: self.now + self.asleep_s
        )

    def at(self, time_s: float, action: Callable[[], None]) -> None:
        """Plan something after so many seconds."""
        self.plans.append((self.start_s + time_s, action))

    def clock(self) -> float:
        return self.now

    def sleep(self, seconds: float) -> None:
        """Let time pass, 10 ms at a time, and the watchdog watch."""
        end = self.now + seconds
        while self.now < end - 1e-9:
            self.now = min(self.now + 0.01, end)
            for plan in [item for item in self.plans if item[0] <= self.now]:
                self.plans.remove(plan)
                plan[1]()
            self.watchdog.check()

    def index(self, device: str, latency_s: float, period_s: float) -> int:
        """Return the number of the newest thing that a device has."""
        self.check(device)
        seen_s = min(self.now, self.silent.get(device, np.inf)) - latency_s
        return int((seen_s - self.start_s) / period_s)

    def check(self, name: str) -> None:
        if name in self.broken:
            raise self.broken[name]

    def drive(self, path: Path, **changed) -> tuple[Stop, DriveLoop]:
        """Drive until something stops it."""
        log = DriveLog(path, CAMERA, self.clock, WALL_NS, {"policy": "stand-in"})
        kinds = StandInCamera, StandInTracker, StandInPilot, StandInEnable
        camera, tracker, pilot, enable = (kind(self) for kind in kinds)
        loop = DriveLoop(
            Devices(camera, tracker, self.motor, pilot, enable),
            replace(SETTINGS, **changed),
            log,
            self.watchdog,
            self.clock,
            self.sleep,
            lambda text: None,
        )
        stop = loop.run(lambda: self.check("signal"))
        log.close()
        return stop, loop


class StandInCamera(devices.AbstractCamera):
    camera = CAMERA

    def __init__(self, bench: Bench) -> None:
        self._bench = bench

    def newest(self) -> devices.Frame:
        bench = self._bench
        stall, bench.stall_s = bench.stall_s, 0.0
        bench.sleep(stall)
        index = bench.index("camera", FRAME_LATENCY_S, 0.1)
        image = np.full((8, 16, 3), index % 256, np.uint8)
        return devices.Frame(image, bench.start_s + 0.1 * index, index)

    def close(self) -> None:
        """Nothing is held."""


class StandInTracker(devices.AbstractTracker):
    def __init__(self, bench: Bench) -> None:
        self._bench = bench

    def newest(self, body: str) -> devices.TrackedPose:
        assert body == "car"
        bench = self._bench
        index = bench.index("tracker", POSE_LATENCY_S, 0.02)
        turn = 0.02 * index * SPEED / RADIUS
        x, y = RADIUS * np.sin(turn) + bench.offset_m, -RADIUS * np.cos(turn)
        matrix = planar_body(np.array([x, y, turn]))
        return devices.TrackedPose(matrix, bench.start_s + 0.02 * index, index)

    def close(self) -> None:
        """Nothing is held."""


class StandInMotor(devices.AbstractMotor):
    def __init__(self, bench: Bench) -> None:
        self._bench, self._commanded_s = bench, -np.inf
        self._values: devices.MotorValues | None = None

    def arm(self, check: Callable[[], None] = lambda: None) -> None:
        """Nothing is proven here."""

    def send(self, command: devices.Command) -> devices.Command:
        self._bench.check("motor")
        sent = replace(command, steering_rad=round(command.steering_rad, 3))
        self._bench.events.append((self._bench.now, "send", sent))
        self._commanded_s = self._bench.now
        return sent

    def brake(self) -> None:
        self._bench.events.append((self._bench.now, "brake", None))
        self._bench.check("motor")

    def read(self) -> devices.MotorValues:
        bench = self._bench
        bench.check("motor")
        if self._values is None or bench.now - self._values.time_s >= 0.05:
            # once it was silent, nothing reaches it either
            last = min(self._commanded_s, bench.silent.get("motor", np.inf))
            self._values = devices.MotorValues(
                bench.now,
                fault=bench.fault,
                fault_name="over temperature" if bench.fault else "none",
                has_timed_out=bench.now - last > 0.25,
                is_killed=bench.killed,
            )
        return self._values

    def close(self) -> None:
        self.brake()


class StandInPilot(devices.AbstractPilot):
    def __init__(self, bench: Bench) -> None:
        self._bench = bench
        self._decisions: list[devices.Decision] = []

    def submit(self, frame: devices.Frame) -> None:
        bench = self._bench
        bench.check("pilot")
        if "pilot" not in bench.silent:
            then = bench.now + DECISION_S
            self._decisions.append(
                devices.Decision(bench.control, frame.index, frame.time_s, then)
            )

    def newest(self) -> devices.Decision | None:
        self._bench.check("pilot")
        made = [item for item in self._decisions if item.time_s <= self._bench.now]
        self._decisions = [*made[-1:], *self._decisions[len(made) :]]
        return made[-1] if made else None

    def close(self) -> None:
        """Nothing is held."""


class StandInEnable(devices.AbstractEnable):
    def __init__(self, bench: Bench) -> None:
        self._bench = bench

    def is_held(self) -> bool:
        return self._bench.held

    def close(self) -> None:
        """Nothing is held."""
