"""A VESC with a car on it, on a pseudo-terminal, in a process of its own.

    python tests/support/devices/vesc.py --log car.jsonl --firmware 6.05

prints the name of its port, and writes what it does to the log. It obeys lines on its
standard input: `unplug` for good, `mute` its answers, `fault N` among its values,
`kill` as its kill switch does, `restart` as a loose plug does, `push M` by somebody,
`feed` as another program does. It knows the protocol from the firmware's description
alone: nothing of the package is used here. Its time is that of the monotonic clock, but
it stands still while this process does not run: a busy machine makes no timeout.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import math
import os
import random
import select
import struct
import time
import tty
from typing import Any

TICK_S = 0.001
CHECK_S = 0.01  # the firmware looks at its timeout so often
LONGEST_GAP_S = 0.2  # of this process's sleep that counts as time
MASS_KG, NEWTON_PER_A, FRICTION_MS2 = 4.5, 0.66, 0.15
ERPM_PER_MS, MOST_MS2 = 4614.0, 3.0  # of the speed controller
HOLDING_A, STIFF_MS2 = 3.0, 6.0
LEAST_ERPM = 900  # that it holds; for less it lets go of the motor
ALIVE_IDS = {5, 6, 7, 8, 9, 10, 30, 84}
SIGNATURES = {(7, 1): 982638166, (7, 0): 2099347128, (6, 5): 2099347128}
FLAWS = {
    "locked": "echoes a new configuration and keeps its own",
    "scribbling": "changes another byte of its configuration too",
    "deaf": "ignores new configurations without an echo",
    "endless": "says that it has a timeout, and drives on",
    "coasting": "says that it brakes, and rolls",
    "stiff": "says that it brakes, and its wheels stop by their friction alone",
    "dumb": "has no status byte among its values",
    "uncounted": "drives, and its tachometer stands once it was armed",
    "unmeasured": "drives, and neither tachometer nor ERPM shows it once it was armed",
}


def checksum(payload: bytes) -> int:
    """CRC-16, polynomial 0x1021, from 0, bit by bit."""
    value = 0
    for byte in payload:
        value ^= byte << 8
        for _ in range(8):
            value = (value << 1 ^ (0x1021 if value & 0x8000 else 0)) & 0xFFFF
    return value


def frame(payload: bytes) -> bytes:
    """Wrap a payload as the firmware sends it."""
    size = len(payload)
    head = bytes([2, size]) if size < 256 else b"\x03" + size.to_bytes(2, "big")
    return head + payload + checksum(payload).to_bytes(2, "big") + b"\x03"


def take_frames(heard: bytearray) -> list[bytes]:
    """Take the whole frames off the front of what was heard."""
    payloads = []
    while heard:
        head = {2: 2, 3: 3}.get(heard[0])
        if head is not None and len(heard) < head:
            break
        size = 0 if head is None else int.from_bytes(heard[1:head], "big")
        if head is None or not (0 < size < 256 if head == 2 else 255 <= size <= 512):
            del heard[0]
            continue
        if len(heard) < head + size + 3:
            break
        payload = bytes(heard[head : head + size])
        tail = checksum(payload).to_bytes(2, "big") + b"\x03"
        if heard[head + size : head + size + 3] == tail:
            payloads.append(payload)
            del heard[: head + size + 3]
        else:
            del heard[0]
    return payloads


class Car:
    """Motor, wheels and mass: a speed along a line."""

    def __init__(self) -> None:
        self.speed = self.distance = self.way = 0.0
        self.mode, self.value = "current", 0.0
        self.friction_ms2, self.charge, self.counted_s = FRICTION_MS2, 0.0, 0.0

    def tick(self) -> None:
        """Move for a tick under what the motor does."""
        if self.mode == "rpm" and abs(self.value) >= LEAST_ERPM:
            acceleration = (self.value / ERPM_PER_MS - self.speed) / 0.05
            self.speed += max(-MOST_MS2, min(MOST_MS2, acceleration)) * TICK_S
        else:
            rolling = self.friction_ms2
            if self.mode == "brake":
                rolling += abs(self.value) * NEWTON_PER_A / MASS_KG
            elif self.mode == "current":
                self.speed += self.value * NEWTON_PER_A / MASS_KG * TICK_S
            slower = max(0.0, abs(self.speed) - rolling * TICK_S)
            self.speed = math.copysign(slower, self.speed)
        self.distance += self.speed * TICK_S
        self.way += abs(self.speed) * TICK_S
        self.charge += self._current() * TICK_S
        self.counted_s += TICK_S

    def _current(self) -> float:
        if self.mode == "brake":
            return -self.value if self.speed else 0.0
        return HOLDING_A if self.mode == "rpm" else self.value

    def take_current(self) -> float:
        """Return the motor's mean current since this was called last."""
        mean = self.charge / self.counted_s if self.counted_s else self._current()
        self.charge = self.counted_s = 0.0
        return mean


class Controller:
    """The firmware: commands, values, configuration, timeout."""

    def __init__(self, options: argparse.Namespace, log: Any) -> None:
        major, minor = options.firmware.split(".")
        self.firmware = int(major), int(minor)
        self.flaw, self.log, self.car = options.flaw, log, Car()
        if self.flaw == "stiff":
            self.car.friction_ms2 = STIFF_MS2
        self.time = self.alive = 0.0
        self.ticks, self.servo, self.fault = 0, 0.5, 0
        self.timed_out = self.mute = self.killed = self.has_fired = False
        signature = SIGNATURES.get(self.firmware, 763356168)
        tail = random.Random(5).randbytes(options.config_bytes - 14)
        after_ms, brake_a = options.timeout_ms, options.brake_a
        timeout = struct.pack(">IBIf", signature, 9, after_ms, brake_a)
        self.config = self.stored = timeout + tail
        self.is_fed, self.counted_m = False, None
        self.busy_until = 0.0

    @property
    def brake_a(self) -> float:
        """Current that its timeout and its kill switch brake with."""
        return struct.unpack_from(">f", self.config, 9)[0]

    def tell(self, event: str) -> None:
        car = self.car
        line = {"time_s": round(self.time, 4), "monotonic_s": time.monotonic()}
        line |= {"speed_ms": round(car.speed, 5), "distance_m": round(car.distance, 5)}
        line |= {"way_m": round(car.way, 5), "servo": self.servo, "mode": car.mode}
        line |= {"timed_out": self.timed_out, "event": event}
        self.log.write(json.dumps(line) + "\n")
        self.log.flush()

    def advance(self, ticks: int) -> None:
        for _ in range(ticks):
            self.ticks += 1
            self.time = self.ticks * TICK_S
            self.car.tick()
            if self.is_fed:
                self.alive, self.timed_out = self.time, False
            if self.ticks % round(CHECK_S / TICK_S) == 0:
                self._check_timeout()
                self.tell("")

    def _check_timeout(self) -> None:
        (limit,) = struct.unpack_from(">I", self.config, 5)
        silent = (self.time - self.alive) * 1000 > limit
        if limit == 0 or not silent or self.timed_out or self.flaw == "endless":
            return
        self.timed_out = True
        self.has_fired = self.has_fired or self.car.speed > 0.3
        rolls = self.flaw in ("coasting", "stiff")
        self.car.mode, self.car.value = "brake", 0.0 if rolls else self.brake_a
        self.tell("timeout")

    def answer(self, payload: bytes) -> bytes | None:
        """Do what a payload says, and return what to answer."""
        reply = self._obey(payload)
        return None if self.mute else reply

    def _obey(self, payload: bytes) -> bytes | None:
        number, body = payload[0], payload[1:]
        if number in ALIVE_IDS:
            self.alive, self.timed_out = self.time, False
            self._drive(number, body)
            self.tell(f"command {number}")
        elif number == 12 and len(body) == 2:
            self.servo = min(1.0, max(0.0, struct.unpack(">h", body)[0] / 1000))
        elif number == 0:
            return self._version()
        elif number == 4:
            return b"\x04" + self._values(0xFFFFFFFF)
        elif number == 50 and len(body) == 4:
            return b"\x32" + body + self._values(int.from_bytes(body, "big"))
        elif number == 17:
            return b"\x11" + self.config
        elif number == 16 or (number == 149 and self.firmware >= (6, 0)):
            return self._configure(number, body)
        return None

    def _drive(self, number: int, body: bytes) -> None:
        if number == 30 or len(body) != 4:
            return
        value = struct.unpack(">i", body)[0]
        if self.killed:
            return
        modes = {6: ("current", 1e3), 7: ("brake", 1e3), 8: ("rpm", 1.0)}
        mode, scale = modes.get(number, ("current", math.inf))
        self.car.mode, self.car.value = mode, value / scale

    def _version(self) -> bytes:
        name = b"410\x00"
        return bytes([0, *self.firmware]) + name + bytes(range(12)) + b"\x01\x00\x00"

    def _configure(self, number: int, body: bytes) -> bytes | None:
        if self.flaw == "deaf" or body[:4] != self.config[:4]:
            return None
        if self.flaw != "locked":
            self.config = body
        if self.flaw == "scribbling":
            self.config = self.config[:40] + bytes([body[40] ^ 1]) + self.config[41:]
        if number == 16:
            self.busy_until = self.time + 0.2
        self.tell("flash" if number == 16 else "memory")
        return bytes([number])

    def _values(self, mask: int) -> bytes:
        current = self.car.take_current()
        distance, way, speed = self.car.distance, self.car.way, self.car.speed
        if self.flaw in ("uncounted", "unmeasured") and self.has_fired:
            distance = way = self.counted_m = self.counted_m or way
            speed *= self.flaw == "uncounted"
        steps = round(distance * ERPM_PER_MS / 10)
        way = round(way * ERPM_PER_MS / 10)
        fields = [
            (">h", 312), (">h", 287), (">i", int(current * 100)), (">i", 45),
            (">i", 0), (">i", int(current * 100)), (">h", 55),
            (">i", int(speed * ERPM_PER_MS)), (">h", 158), (">i", 1234),
            (">i", 56), (">i", 19000), (">i", 800), (">i", steps), (">i", way),
            (">B", self.fault), (">i", 0), (">B", 9), (">hhh", 301, 302, 303),
            (">i", 0), (">i", 2000), (">B", self.timed_out | self.killed << 1),
        ]  # fmt: skip
        if self.flaw == "dumb":
            del fields[21]
        return b"".join(
            struct.pack(*field) for bit, field in enumerate(fields) if mask >> bit & 1
        )


def obey(controller: Controller, line: str, ends: list[int]) -> None:
    word, _, value = line.strip().partition(" ")
    controller.tell(f"told {word}")
    if word == "unplug":
        while ends:
            os.close(ends.pop())
    elif word == "mute":
        controller.mute = True
    elif word == "restart":
        controller.config, controller.car.mode = controller.stored, "current"
        controller.car.value = controller.car.distance = controller.car.way = 0.0
    elif word == "push":
        controller.car.distance += float(value)
        controller.car.way += float(value)
    elif word == "feed":
        controller.is_fed = True
    elif word == "fault":
        controller.fault = int(value)
    elif word == "kill":
        controller.killed = True
        controller.car.mode, controller.car.value = "brake", controller.brake_a


def run(options: argparse.Namespace) -> None:
    # this process's own end of the port keeps it open when the other lets go
    ends = list(os.openpty())
    tty.setraw(ends[1])
    os.set_blocking(ends[0], False)
    heard, listens = bytearray(), [0]
    with open(options.log, "w") as log:
        print(os.ttyname(ends[1]), flush=True)
        controller = Controller(options, log)
        last, owed = time.monotonic(), 0.0
        end = last + options.seconds
        while last < end:
            ready = select.select([*ends[:1], *listens], [], [], 0.004)[0]
            last, before = time.monotonic(), last
            owed += min(last - before, LONGEST_GAP_S)
            ticks = int(owed / TICK_S)
            owed -= ticks * TICK_S
            controller.advance(ticks)
            if ends and ends[0] in ready:
                heard += os.read(ends[0], 65536)
                if controller.time < controller.busy_until:
                    heard.clear()
                for payload in take_frames(heard):
                    send(ends[0], controller.answer(payload))
            if 0 in ready:
                line = os.read(0, 4096).decode()
                listens = listens if line else []
                for part in line.splitlines():
                    obey(controller, part, ends)


def send(end: int, reply: bytes | None) -> None:
    """Write an answer, which is lost where nobody has read those before it."""
    if reply is not None:
        with contextlib.suppress(BlockingIOError):
            os.write(end, frame(reply))


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--log", default=os.devnull, help="file for a line every 10 ms")
    parser.add_argument("--firmware", default="6.05", help="version, MAJOR.MINOR")
    parser.add_argument("--timeout-ms", type=int, default=1000)
    parser.add_argument("--brake-a", type=float, default=0.0)
    parser.add_argument("--config-bytes", type=int, default=490)
    parser.add_argument("--flaw", choices=FLAWS, help=str(FLAWS))
    parser.add_argument("--seconds", type=float, default=300.0, help="until it ends")
    run(parser.parse_args())


if __name__ == "__main__":
    main()
