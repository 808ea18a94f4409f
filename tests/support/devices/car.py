"""A car's devices in memory, a joystick, and VICON's stream."""

from __future__ import annotations

import os
import socket
import struct
from bisect import bisect
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from mi_nerfattack.car import devices
from mi_nerfattack.car.drive.log import DriveLog
from mi_nerfattack.car.drive.loop import Devices, DriveLoop, DriveSettings
from mi_nerfattack.car.drive.safety.fence import Fence
from mi_nerfattack.car.drive.safety.judge import Ages, Judge, Stop
from mi_nerfattack.car.drive.safety.limits import Limits, Steering
from mi_nerfattack.deploy.car import SMALL_CAR
from mi_nerfattack.render.camera.intrinsics import from_fov, planar_body

CAMERA = from_fov(16, 8, 90.0)
WALL_NS = 1_790_000_000_123_456_789
FRAME_LATENCY_S, POSE_LATENCY_S, DECISION_S = 0.03, 0.004, 0.02
SPEED, RADIUS = 1.0, 1.5
FENCE = Fence(np.array([(-3.0, -3.0), (3.0, -3.0), (3.0, 3.0), (-3.0, 3.0)]))
JUDGE = Judge(Ages(), FENCE, SMALL_CAR, 0.8, 0.1)
LIMITS = Limits(speed_ms=1.5, steering_rad=0.4, acceleration_ms2=1.0, steering_rate=3.2)
SETTINGS = DriveSettings(
    "car", SPEED, JUDGE, LIMITS, Steering("rad", 0.325), poll_s=0.01
)


class Bench:
    """What the devices of a car on a circle share, and their time `now`.

    Attributes:
        events: (time, what, command) of all that the motor got.
        broken: what a device raises, by its name; of "signal", the loop's check.
        silent: devices that give nothing new, and since when.
        stall_s: that the camera's next answer takes.
        asleep_s: that the computer was suspended, which no device tells.
        fed: whether somebody else commands the motor controller, too.
        restarted: whether the motor controller was, which its values do not tell.
        gain, motor_gain: speed on the floor, and by the motor, for each metre a second
            that is commanded.
        resets: when the pilot was reset.
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
        self.fed = self.restarted = False
        self.volts, self.celsius = 11.1, 40.0
        self.gain = self.motor_gain = 1.0
        self.speed_ms, self.resets = 0.0, []
        self._times, self._ways = [start_s], [0.0]

    def at(self, time_s: float, action: Callable[[], None]) -> None:
        """Plan something after so many seconds."""
        self.plans.append((self.start_s + time_s, action))

    def press(self, after_s: float = 0.5) -> None:
        """Plan that the enable is held."""
        self.at(after_s, lambda: setattr(self, "held", True))

    def clock(self) -> float:
        return self.now

    def with_sleep(self) -> float:
        return self.now + self.asleep_s

    def sleep(self, seconds: float) -> None:
        """Let time pass, 10 ms at a time; the car follows its commands at once."""
        end = self.now + seconds
        while self.now < end - 1e-9:
            before, self.now = self.now, min(self.now + 0.01, end)
            way = self._ways[-1] + self.gain * self.speed_ms * (self.now - before)
            self._times.append(self.now)
            self._ways.append(way)
            self.motor.watch()
            for plan in [item for item in self.plans if item[0] <= self.now]:
                self.plans.remove(plan)
                plan[1]()

    def way_m(self, time_s: float) -> float:
        first = max(bisect(self._times, time_s) - 2, 0)
        near = slice(first, first + 4)
        return float(np.interp(time_s, self._times[near], self._ways[near]))

    def index(self, device: str, latency_s: float, period_s: float) -> int:
        """Return the number of the newest thing that a device has."""
        self.check(device)
        newest_s = min(self.now, self.silent.get(device, np.inf)) - latency_s
        return int((newest_s - self.start_s) / period_s)

    def check(self, name: str) -> None:
        if name in self.broken:
            raise self.broken[name]

    def drive(self, path: Path, **changed) -> tuple[Stop, DriveLoop]:
        log = DriveLog(path, CAMERA, self.clock, WALL_NS, {"policy": "stand-in"})
        camera, tracker = StandInCamera(self), StandInTracker(self)
        pilot, enable = StandInPilot(self), StandInEnable(self)
        car_devices = Devices(camera, tracker, self.motor, pilot, enable)
        settings, say = replace(SETTINGS, **changed), lambda text: None
        loop = DriveLoop(
            car_devices, settings, log, self.with_sleep, self.clock, self.sleep, say
        )
        stop = loop.run(lambda: self.check("signal"))
        log.close()
        return stop, loop


class StandInCamera(devices.AbstractCamera):
    camera = CAMERA

    def __init__(self, bench: Bench) -> None:
        self._bench = bench

    def close(self) -> None: ...

    def newest(self) -> devices.Frame:
        bench = self._bench
        stall, bench.stall_s = bench.stall_s, 0.0
        bench.sleep(stall)
        index = bench.index("camera", FRAME_LATENCY_S, 0.1)
        image = np.full((8, 16, 3), index % 256, np.uint8)
        return devices.Frame(image, bench.start_s + 0.1 * index, index)


class StandInTracker(devices.AbstractTracker):
    def __init__(self, bench: Bench) -> None:
        self._bench = bench

    def close(self) -> None: ...

    def newest(self, body: str) -> devices.TrackedPose:
        assert body == "car"
        bench = self._bench
        index = bench.index("tracker", POSE_LATENCY_S, 0.02)
        turn = bench.way_m(bench.start_s + 0.02 * index) / RADIUS
        x, y = RADIUS * np.sin(turn) + bench.offset_m, -RADIUS * np.cos(turn)
        matrix = planar_body(np.array([x, y, turn]))
        return devices.TrackedPose(matrix, bench.start_s + 0.02 * index, index)


class StandInMotor(devices.AbstractMotor):
    def __init__(self, bench: Bench) -> None:
        self._bench, self._commanded_s = bench, -np.inf
        self.has_timed_out = True
        self._values: devices.MotorValues | None = None

    def arm(self, check: Callable[[], None] = lambda: None) -> None:
        """Nothing is proven here."""

    def check(self) -> None:
        if self._bench.restarted:
            raise devices.DeviceLostError("serial: it has started anew")

    def watch(self) -> None:
        """Brake, where no command has come for so long."""
        bench = self._bench
        last = min(self._commanded_s, bench.silent.get("motor", np.inf))
        self.has_timed_out = not bench.fed and bench.now - last > 0.25
        if self.has_timed_out and bench.speed_ms > 0.0:
            bench.speed_ms = 0.0
            bench.events.append((bench.now, "timeout", None))

    def send(self, command: devices.Command) -> devices.Command:
        self._bench.check("motor")
        if "motor" not in self._bench.silent:  # else nothing reaches it
            self._bench.speed_ms = command.speed_ms
        sent = replace(command, steering_rad=round(command.steering_rad, 3))
        self._bench.events.append((self._bench.now, "send", sent))
        self._commanded_s = self._bench.now
        return sent

    def brake(self) -> None:
        self._bench.speed_ms = 0.0
        self._bench.events.append((self._bench.now, "brake", None))
        self._bench.check("motor")

    def read(self) -> devices.MotorValues:
        bench = self._bench
        bench.check("motor")
        if self._values is None or bench.now - self._values.time_s >= 0.05:
            self._values = devices.MotorValues(
                bench.now,
                speed_ms=bench.motor_gain * bench.speed_ms,
                input_voltage_v=bench.volts,
                fet_temperature_c=bench.celsius,
                fault=bench.fault,
                fault_name="over temperature" if bench.fault else "none",
                has_timed_out=self.has_timed_out,
                is_killed=bench.killed,
            )
        return self._values

    def close(self) -> None:
        self.brake()


class StandInPilot(devices.AbstractPilot):
    def __init__(self, bench: Bench) -> None:
        self._bench = bench
        self._decisions: list[devices.Decision] = []

    def close(self) -> None: ...

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

    def reset(self) -> None:
        self._bench.resets.append(self._bench.now)


class StandInEnable(devices.AbstractEnable):
    def __init__(self, bench: Bench) -> None:
        self._bench = bench

    def close(self) -> None: ...

    def is_held(self) -> bool:
        return self._bench.held


class Pad:
    """A joystick with one button, number 5."""

    def __init__(self, path: Path) -> None:
        os.mkfifo(path)
        self._end = os.open(path, os.O_RDWR | os.O_NONBLOCK)

    def press(self, is_down: bool) -> None:
        os.write(self._end, struct.pack("<IhBB", 0, int(is_down), 1, 5))

    def close(self) -> None:
        os.close(self._end)


#: Name, three millimetres, three radians.
Item = tuple[str, Sequence[float], Sequence[float]]
ITEM_BYTES, FIRST, NUMBERS = 75, 5, 27  # of an item; where the first, its numbers begin


def item_bytes(item: Item) -> bytes:
    name, position_mm, rotation_rad = item
    raw = struct.pack("<B", 0) + struct.pack("<H", 72) + name.encode().ljust(24, b"\0")
    for value in (*position_mm, *rotation_rad):
        raw += struct.pack("<d", value)
    return raw


def datagrams(
    frame: int, items: Sequence[Item], size: int = 256, padding: bytes = b"\0"
) -> list[bytes]:
    """Return the blocks of a frame: as many as it takes, at least one."""
    each, blocks = (size - 5) // 75, []
    for start in range(0, max(len(items), 1), each):
        held = items[start : start + each]
        raw = struct.pack("<I", frame) + struct.pack("<B", len(held))
        raw += b"".join(item_bytes(item) for item in held)
        blocks.append(raw + (padding * size)[: size - len(raw)])
    return blocks


class Sender:
    """Tracker's end of the stream."""

    def __init__(self, address: tuple[str, int], source: str = "127.0.0.1") -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind((source, 0))
        self._address = address

    def send(self, raw: bytes) -> None:
        self._socket.sendto(raw, self._address)

    def close(self) -> None:
        self._socket.close()
