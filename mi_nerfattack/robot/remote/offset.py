"""How far another computer's clock is ahead, by questions and answers.

Of a question sent at t0 by the own clock, received at t1 and answered at t2 by the
other, and back at t3, the other clock is ahead by ((t1 - t0) + (t2 - t3)) / 2, wrong by
at most half of the round trip (t3 - t0) - (t2 - t1): the way there took between none
and all of it. Of the last questions the one of the least round trip counts.

Source: Mills 1991, "Internet Time Synchronization", section 3.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass


@dataclass(frozen=True)
class Offset:
    """An estimate.

    Attributes:
        ahead_s: seconds that the other clock shows more.
        error_s: by how much that may be wrong, apart from drift since.
        asked_s: when the question was sent, by the own clock.
    """

    ahead_s: float
    error_s: float
    asked_s: float


class ClockOffset:
    """Estimates how far another clock is ahead, again and again.

    Args:
        window_s: seconds that an answer counts; over 10 s clocks that differ by 50 ppm
            drift by 0.5 ms.
    """

    def __init__(self, window_s: float = 10.0) -> None:
        self._window_s = window_s
        self._answers: deque[Offset] = deque()
        self.best: Offset | None = None

    def add(self, t0: float, t1: float, t2: float, t3: float) -> None:
        """Take up an answer; see the module. One that runs backwards is left out."""
        round_trip = (t3 - t0) - (t2 - t1)
        if t3 < t0 or t2 < t1 or round_trip < 0:
            return
        ahead = ((t1 - t0) + (t2 - t3)) / 2
        self._answers.append(Offset(ahead, round_trip / 2, t0))
        while self._answers[0].asked_s < t3 - self._window_s:
            self._answers.popleft()
            if not self._answers:
                return
        self.best = min(self._answers, key=lambda answer: answer.error_s)
