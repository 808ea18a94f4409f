"""The car's side: a pilot whose policy decides on another computer."""

from __future__ import annotations

import struct
import threading
import time
from dataclasses import dataclass

from mi_nerfattack.errors import InputError
from mi_nerfattack.robot.devices import (
    AbstractPilot,
    Clock,
    Decision,
    DeviceLostError,
    Frame,
)
from mi_nerfattack.robot.remote import frames
from mi_nerfattack.robot.remote.frames import SentDecision
from mi_nerfattack.robot.remote.link import ZenohLink
from mi_nerfattack.robot.remote.offset import ClockOffset, Offset
from mi_nerfattack.robot.remote.sealed import (
    NO_SESSION,
    Endpoint,
    Kind,
    Message,
    Sealer,
    draw_id,
)

_JOIN_S = 0.5  # the most that closing waits for what is being sent
_ASK_S = 0.25  # between two questions for the time
_FIRST_ASKS, _FIRST_ASK_S = 8, 0.02
_AGAIN_S = 0.5  # after which an unanswered frame no longer holds up the next


@dataclass(frozen=True)
class Delays:
    """Where the time of a decision went, by one offset of the clocks.

    Attributes:
        there_s: from when the frame was taken to its arrival at the policy.
        deciding_s: until the decision.
        back_s: until that was here.
        offset: of the clocks; `there_s` and `back_s` are as wrong as it is.
    """

    there_s: float
    deciding_s: float
    back_s: float
    offset: Offset


class RemotePilot(AbstractPilot):
    """A policy behind ``mi-nerfattack car serve``.

    One frame is on its way at a time: the newest waits for the decision of the last,
    so that none grows old in the network.

    Args:
        endpoint: of the server.
        key: shared with it, see :func:`read_key`.
        jpeg_quality: of frames, 1 to 95; None sends them as they are.
        clock: of the loop.
        lost_s: silence after which the link counts as lost, seconds.
        connect_s: longest wait for the first answer, seconds.

    Attributes:
        delays: of the newest decision; None before the first.

    Raises:
        InputError: another computer's endpoint without a key, or a wrong quality.
        DeviceLostError: nobody listens or answers there, or the answer is a refusal.
        SetupError: zenoh is not installed.
    """

    def __init__(
        self,
        endpoint: Endpoint,
        key: bytes,
        jpeg_quality: int | None = None,
        clock: Clock = time.monotonic,
        lost_s: float = 1.0,
        connect_s: float = 5.0,
    ) -> None:
        if jpeg_quality is not None and not 1 <= jpeg_quality <= 95:
            raise InputError(f"jpeg_quality: {jpeg_quality}; 1 to 95")
        self._endpoint, self._clock = endpoint, clock
        self._jpeg_quality, self._lost_s = jpeg_quality, lost_s
        self._sealer, self._id = Sealer.at(endpoint, key), draw_id()
        self._changed = threading.Condition()
        self._session, self._sent, self._heard = NO_SESSION, 0, 0
        self._failure: str | None = None
        self._closed = False
        self._offset = ClockOffset()
        self._last_s = clock()
        self._waiting: Frame | None = None
        self._on_way_s: float | None = None
        self._decision: Decision | None = None
        self.delays: Delays | None = None
        self._link = ZenohLink(endpoint, False, self._receive, connect_s)
        self._thread = threading.Thread(target=self._work, daemon=True)
        try:
            self._connect(connect_s)
        except BaseException:
            self._link.close()
            raise
        self._thread.start()

    @property
    def offset(self) -> Offset:
        """How far the policy's clock is ahead."""
        with self._changed:
            assert self._offset.best is not None, "known since it is connected"
            return self._offset.best

    def submit(self, frame: Frame) -> None:
        """Give it a frame; one that was not sent yet is replaced."""
        frames.check_frame(frame)
        with self._changed:
            self._check()
            self._waiting = frame
            self._changed.notify_all()

    def newest(self) -> Decision | None:
        """Return the newest decision, whose time is that of its arrival."""
        with self._changed:
            self._check()
            return self._decision

    def close(self) -> None:
        """End the connection."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()
        self._thread.join(_JOIN_S)
        is_free = not self._thread.is_alive()  # and sends nothing any more
        self._link.close(self._sealed(Kind.BYE, b"") if is_free else None)

    def _connect(self, connect_s: float) -> None:
        """Wait for the server's session, and for the first offset."""
        until, asked = self._clock() + connect_s, 0
        while asked < _FIRST_ASKS or self._offset.best is None:
            with self._changed:
                welcome = self._session != NO_SESSION
                if self._failure is not None:
                    raise DeviceLostError(self._failure)
                if self._clock() > until:
                    raise DeviceLostError(
                        f"policy at {self._endpoint}: no answer within {connect_s:g} "
                        "s; what listens there is no 'mi-nerfattack car serve', or "
                        "has another key"
                    )
                if welcome:
                    self._send(Kind.PING, frames.PING.pack(self._clock()))
                    asked += 1
                else:
                    self._send(Kind.HELLO, b"")
                self._changed.wait(_FIRST_ASK_S)

    def _work(self) -> None:
        try:
            self._send_on()
        except Exception as error:  # a thread has nobody else to tell
            with self._changed:
                self._failure = (
                    f"policy at {self._endpoint}: sending failed "
                    f"({type(error).__name__}: {error})"
                )

    def _send_on(self) -> None:
        """Send frames, and ask for the time, again and again, until it is closed."""
        due_s = self._clock()
        while True:
            with self._changed:
                wait_s = max(due_s - self._clock(), 0)
                self._changed.wait_for(lambda: self._closed or self._is_free(), wait_s)
                if self._closed:
                    return
                frame, ahead_s = None, self.offset.ahead_s
                if self._is_free():
                    frame, self._waiting = self._waiting, None
                    self._on_way_s = self._clock()
            if frame is not None:
                body = frames.pack_frame(frame, ahead_s, self._jpeg_quality)
                self._send(Kind.FRAME, body)
            if self._clock() >= due_s:
                self._send(Kind.PING, frames.PING.pack(self._clock()))
                due_s = self._clock() + _ASK_S

    def _is_free(self) -> bool:
        """Whether a frame waits, and no other is on its way."""
        on_way = self._on_way_s
        is_free = on_way is None or self._clock() >= on_way + _AGAIN_S
        return self._waiting is not None and is_free

    def _check(self) -> None:
        if self._failure is not None:
            raise DeviceLostError(self._failure)
        silent = self._clock() - self._last_s
        if silent > self._lost_s:
            self._failure = (
                f"policy at {self._endpoint}: silent for {silent:.2f} s; look to the "
                "network, and whether 'mi-nerfattack car serve' runs there"
            )
            raise DeviceLostError(self._failure)

    def _send(self, kind: Kind, body: bytes) -> None:
        """Send a message; of one thread at a time."""
        self._link.send(self._sealed(kind, body))

    def _sealed(self, kind: Kind, body: bytes) -> bytes:
        self._sent += 1
        message = Message(kind, self._id, self._session, self._sent, body)
        return self._sealer.seal(message)

    def _receive(self, raw: bytes) -> None:
        """Take up a message; what is not the server's is left alone."""
        now = self._clock()
        message = self._sealer.open(raw)
        if message is None or message.is_from_car or message.link != self._id:
            return
        with self._changed:
            is_new = message.session != self._session
            if is_new and self._session != NO_SESSION:
                return
            if message.count <= self._heard:
                return
            self._heard, self._last_s = message.count, now
            if message.kind == Kind.FAILED:
                text = message.body.decode("utf-8", "replace")
                self._failure = f"policy at {self._endpoint}: {text}"
            elif message.kind == Kind.WELCOME:
                self._session = message.session
            else:
                try:
                    self._heed(message, now)
                except struct.error:
                    self._failure = (
                        f"policy at {self._endpoint}: a message of {len(message.body)} "
                        "bytes that says nothing; run the same version on both sides"
                    )
            self._changed.notify_all()

    def _heed(self, message: Message, now: float) -> None:
        if message.kind == Kind.PONG:
            asked, received, answered = frames.PONG.unpack(message.body)
            self._offset.add(asked, received, answered, now)
            return
        sent = SentDecision.unpack(message.body)
        self._on_way_s = None
        offset = self._offset.best
        if offset is not None:
            ahead = offset.ahead_s
            self.delays = Delays(
                sent.received_s - ahead - sent.time_s,
                sent.decided_s - sent.received_s,
                now + ahead - sent.decided_s,
                offset,
            )
        self._decision = Decision(sent.control, sent.index, sent.time_s, now)
