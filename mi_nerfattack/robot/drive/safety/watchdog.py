"""Brakes when the control loop does not come round; it cannot make the car move."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from contextlib import suppress

from mi_nerfattack.robot.devices import Clock
from mi_nerfattack.robot.drive.safety.judge import Cause, Stop


class Watchdog:
    """A thread of its own that brakes while the loop is late, again and again.

    It never sends a command and never keeps a motor alive: all it can do is brake. A
    car whose whole computer stands still is braked by its motor controller.

    Args:
        brake: `AbstractMotor.brake`, from another thread than the loop's.
        limit_s: between two rounds of the loop.
        clock: of the loop.

    Attributes:
        has_fired: whether the loop was late; it stays so.
    """

    def __init__(self, brake: Callable[[], None], limit_s: float, clock: Clock) -> None:
        self.limit_s, self.has_fired = limit_s, False
        self._brake, self._clock = brake, clock
        self._last_s: float | None = None
        self._closed = threading.Event()
        self._thread = threading.Thread(target=self._watch, daemon=True)

    def start(self) -> None:
        """Start the thread; there is nothing to brake before the first `beat`."""
        self._thread.start()

    def beat(self) -> None:
        """Say that the loop has come round."""
        self._last_s = self._clock()

    def check(self) -> None:
        """Brake if the loop is late; what the thread does all the time."""
        last = self._last_s
        if last is None or self._closed.is_set():
            return
        if self._clock() - last > self.limit_s:
            self.has_fired = True
            with suppress(Exception):  # whatever it is, the next check brakes again
                self._brake()

    def close(self) -> None:
        """End the thread; more than once does no harm."""
        self._closed.set()
        if self._thread.is_alive() and self._thread is not threading.current_thread():
            self._thread.join(timeout=1.0)

    def _watch(self) -> None:
        while not self._closed.wait(self.limit_s / 10):
            self.check()


class SleepCheck:
    """Ends the drive if the computer was suspended, as by its lid.

    Nothing else tells: the monotonic clock, and with it all ages, stand still
    meanwhile.

    Args:
        limit_s: of the sleep since it was made.
    """

    def __init__(self, limit_s: float) -> None:
        self._limit_s, self._before_s = limit_s, _asleep_s()

    def check(self) -> None:
        """Raise `Stop` if it slept."""
        slept = _asleep_s() - self._before_s
        if slept > self._limit_s:
            raise Stop(Cause.LOOP_LATE, f"the computer slept for {slept:.1f} s")


def _asleep_s() -> float:
    """Return how long the computer has slept since it started, where Linux tells."""
    if not hasattr(time, "CLOCK_BOOTTIME"):
        return 0.0
    return time.clock_gettime(time.CLOCK_BOOTTIME) - time.monotonic()
