"""Brakes when the control loop does not come round; it cannot make the car move."""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from typing import TypeVar

from mi_nerfattack.robot.devices import Clock
from mi_nerfattack.robot.drive.safety.judge import Cause, Stop

_T = TypeVar("_T")


def suspended_clock() -> float:
    """Return seconds that go on while the computer is suspended, as by a closed lid.

    `time.monotonic` stands still meanwhile on Linux: what was measured before would
    look as if it had just come.
    """
    if sys.platform == "linux":
        return time.clock_gettime(time.CLOCK_BOOTTIME)
    return time.monotonic()


class Watchdog:
    """A thread of its own that brakes while the loop is late, again and again.

    It never sends a command and never keeps a motor alive: all it can do is brake, and
    refuse commands from then on. A car whose whole computer stands still is braked by
    its motor controller.

    Args:
        brake: `AbstractMotor.brake`, from another thread than the loop's.
        limit_s: between two rounds of the loop.
        clock: of the rounds; see `suspended_clock`.

    Attributes:
        limit_s, clock: as given.
        has_fired: whether the loop was late; it stays so.
    """

    def __init__(self, brake: Callable[[], None], limit_s: float, clock: Clock) -> None:
        self.limit_s, self.has_fired = limit_s, False
        self._brake, self.clock = brake, clock
        self._last_s: float | None = None
        self._sending, self._closed = threading.Lock(), threading.Event()
        self._thread = threading.Thread(target=self._watch, daemon=True)

    def start(self) -> None:
        """Start the thread; there is nothing to brake before the first `beat`."""
        self._thread.start()

    def beat(self) -> None:
        """Say that the loop has come round."""
        self._last_s = self.clock()

    def round_s(self) -> float:
        """Return seconds since the last `beat`, 0 before the first.

        Raises:
            Stop: these are too many, or the car was braked for that.
        """
        late = 0.0 if self._last_s is None else self.clock() - self._last_s
        if late > self.limit_s or self.has_fired:
            found = f"took {late:.3f} s, at most {self.limit_s:g} s"
            raise Stop(Cause.LOOP_LATE, found)
        return late

    def permit(self, send: Callable[[], _T]) -> _T:
        """Send a command, unless the loop is late; never after a brake of this thread.

        Raises:
            Stop: the loop is or was late.
        """
        with self._sending:
            self.round_s()
            return send()

    def check(self) -> None:
        """Brake if the loop is late; what the thread does all the time."""
        last = self._last_s
        if last is None or self._closed.is_set():
            return
        if self.clock() - last > self.limit_s:
            self.has_fired = True
            # behind a command that is on its way, but for one that hangs
            is_behind = self._sending.acquire(timeout=self.limit_s / 10)
            with suppress(Exception):  # whatever it is, the next check brakes again
                self._brake()
            if is_behind:
                self._sending.release()

    def close(self) -> None:
        """End the thread; more than once does no harm."""
        self._closed.set()
        if self._thread.is_alive() and self._thread is not threading.current_thread():
            self._thread.join(timeout=1.0)

    def _watch(self) -> None:
        while not self._closed.wait(self.limit_s / 10):
            self.check()
