"""The policy's side: takes frames of one car at a time, and sends decisions back."""

from __future__ import annotations

import math
import struct
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from mi_nerfattack.errors import is_interrupt
from mi_nerfattack.robot.devices import Clock
from mi_nerfattack.robot.remote import frames
from mi_nerfattack.robot.remote.frames import SentDecision, SentFrame
from mi_nerfattack.robot.remote.link import ZenohLink
from mi_nerfattack.robot.remote.sealed import (
    Endpoint,
    Kind,
    Message,
    Sealer,
    draw_id,
)

_KEPT = 100_000  # ages of decisions
#: From an image (height, width, 3), uint8 sRGB, to a control; for one drive.
Control = Callable[[np.ndarray], float]


@dataclass
class _Car:
    """A car that was heard.

    Attributes:
        link: its own number.
        control: what decides for it.
        last_s: when it was heard last.
        arrived: newest frame that nobody has looked at, and when it came.
        failure: why it gets no decisions any more.
    """

    link: bytes
    control: Control
    last_s: float
    arrived: tuple[SentFrame, float] | None = None
    failure: str | None = None


class PolicyServer:
    """Decides for a car that connects.

    Args:
        endpoint: to listen at.
        key: shared with the car, see :func:`read_key`.
        make_control: makes what decides, anew for each car, since it may remember.
        on_notice: told who comes, goes and is refused.
        clock: of this computer.
        lost_s: silence after which another car may take over, seconds.

    Attributes:
        decisions: that were made.
        ages_s: of their frames then, by the car's offset; of the newest 100,000.
        refused: messages whose seal was wrong.

    Raises:
        InputError: it cannot listen there, or others could without a key.
        SetupError: zenoh is not installed.
    """

    def __init__(
        self,
        endpoint: Endpoint,
        key: bytes,
        make_control: Callable[[], Control],
        on_notice: Callable[[str], None] = lambda text: None,
        clock: Clock = time.monotonic,
        lost_s: float = 1.0,
    ) -> None:
        self._sealer, self._session = Sealer.at(endpoint, key), draw_id()
        self._make_control, self._on_notice = make_control, on_notice
        self._clock, self._lost_s = clock, lost_s
        self._changed = threading.Condition()
        self._counts: dict[bytes, int] = {}
        self._sent = 0
        self._car: _Car | None = None
        self._hello: bytes | None = None
        self.ages_s: deque[float] = deque(maxlen=_KEPT)
        self.decisions = self.refused = 0
        self._link = ZenohLink(endpoint, True, self._receive)

    def run(self, is_over: Callable[[], bool] = lambda: False) -> None:
        """Serve until told otherwise; decisions are made by the calling thread."""
        told = 0
        while not is_over():
            with self._changed:
                self._changed.wait_for(self._has_news, 0.1)
                hello, self._hello = self._hello, None
                refused = self.refused
            if refused > 2 * told:  # a line each time that it has doubled
                told = refused
                self._on_notice(f"refused {refused} messages without the right key")
            if hello is not None:
                self._greet(hello)
            self._work()

    def close(self) -> None:
        """End the connection; more than once does no harm."""
        self._link.close()

    def summary(self) -> str:
        """Return how many decisions were made, and of how old frames."""
        found = self.figures()
        if not found["decisions"]:
            return "no decisions"
        return (
            f"{found['decisions']} decisions, on frames "
            f"{1e3 * found['age_median_s']:.0f} ms old in the median, "
            f"{1e3 * found['age_99_s']:.0f} ms at the 99th percentile"
        )

    def figures(self) -> dict[str, Any]:
        """Return the same as numbers; ages are None of no decisions."""
        ages: list[Any] = [None, None]
        if self.ages_s:
            ages = np.quantile(self.ages_s, [0.5, 0.99]).tolist()
        names = "decisions", "age_median_s", "age_99_s", "refused"
        return dict(zip(names, (self.decisions, *ages, self.refused), strict=True))

    def _has_news(self) -> bool:
        car = self._car
        arrived = car is not None and car.arrived is not None
        return self._hello is not None or arrived

    def _receive(self, raw: bytes) -> None:
        """Take up a message; what is no car's is left alone."""
        now = self._clock()
        message = self._sealer.open(raw)
        with self._changed:
            if message is None:
                self.refused += 1
                self._changed.notify()
                return
            known = self._counts.get(message.link, 0)
            if not message.is_from_car or message.count <= known:
                return
            if message.kind == Kind.HELLO:
                self._hello = message.link
                self._changed.notify()
            elif message.session != self._session:
                return
            self._counts[message.link] = message.count
            car = self._car
            if car is not None and car.link == message.link:
                car.last_s = now
                try:
                    self._heed(car, message, now)
                except struct.error:
                    car.failure = "a message says nothing; run one version on both"

    def _heed(self, car: _Car, message: Message, now: float) -> None:
        if message.kind == Kind.PING:
            (asked,) = frames.PING.unpack(message.body)
            body = frames.PONG.pack(asked, now, self._clock())
            self._send(car.link, Kind.PONG, body)
        elif message.kind == Kind.FRAME:
            car.arrived = frames.unpack_frame(message.body), now
            self._changed.notify()
        elif message.kind == Kind.BYE:
            car.last_s = -math.inf

    def _greet(self, link: bytes) -> None:
        """Welcome a car, unless there is another."""
        car = self._car
        if car is not None and car.link != link:
            silent = self._clock() - car.last_s
            if silent < self._lost_s and car.failure is None:
                self._send(link, Kind.FAILED, b"serves another car; end that drive")
                self._on_notice("refused a second car")
                return
            self._on_notice(f"the car before is gone; {self.summary()}")
        if car is None or car.link != link:
            made = _Car(link, self._make_control(), self._clock())
            with self._changed:
                self._car = made
            self._on_notice("a car is there")
        self._send(link, Kind.WELCOME, b"")

    def _work(self) -> None:
        """Decide on the newest frame."""
        with self._changed:
            car = self._car
            if car is None or car.arrived is None:
                return
            (frame, received), car.arrived = car.arrived, None
        try:
            if car.failure is None:
                control = car.control(frame.decode().image)
                self._answer(car, frame, control, received)
        except Exception as error:  # of a policy, which may raise anything
            if is_interrupt(error):
                raise
            car.failure = f"policy failed ({type(error).__name__}: {error})"
            self._on_notice(car.failure)
        if car.failure is not None:
            self._send(car.link, Kind.FAILED, car.failure.encode())

    def _answer(
        self, car: _Car, frame: SentFrame, control: float, received: float
    ) -> None:
        decided = self._clock()
        self.decisions += 1
        self.ages_s.append(decided - frame.ahead_s - frame.time_s)
        sent = SentDecision(control, frame.index, frame.time_s, received, decided)
        self._send(car.link, Kind.DECISION, sent.pack())

    def _send(self, link: bytes, kind: Kind, body: bytes) -> None:
        with self._changed:
            self._sent += 1
            message = Message(kind, link, self._session, self._sent, body)
            self._link.send(self._sealer.seal(message))
