"""A receiver of VICON Tracker's UDP object stream."""

from __future__ import annotations

import math
import socket
import struct
import sys
import threading
import time
from contextlib import suppress

import numpy as np

from mi_nerfattack.car.devices import (
    AbstractTracker,
    Clock,
    DeviceLostError,
    TrackedPose,
)
from mi_nerfattack.car.tracker.object_stream import SIZES, Convention, ObjectStream
from mi_nerfattack.errors import InputError

PORT = 51001
_POLL_S = 0.1
_STEP_S = 0.05  # the wall clock may be slewed by as much between two datagrams
_SO_TIMESTAMPNS = 35  # of Linux; the socket module has no name for it
_TIMESPEC = struct.Struct("@qq")


class ViconTracker(AbstractTracker):
    """Listens to VICON Tracker's UDP object stream in a thread of its own.

    A pose's time is that of its datagram's arrival, on Linux as the kernel noted it, so
    that what waited while this process was busy does not pass for new. The kernel's
    note is by the wall clock: what waited while that was set is left out. Only one
    computer is listened to: the one that sent the first datagram of the stream.

    Args:
        host: address of this computer to listen at; "0.0.0.0" for all, which broadcasts
            need.
        port: as set in Tracker; 0 for any free one.
        convention: of the rotations, see `turns`.
        sender: address of Tracker's computer; None for the first that sends.
        clock: of the times.

    Attributes:
        address: host and port that it listens at.

    Raises:
        InputError: it cannot listen there.
    """

    def __init__(
        self,
        host: str = "127.0.0.1",
        port: int = PORT,
        convention: Convention = "euler",
        sender: str | None = None,
        clock: Clock = time.monotonic,
    ) -> None:
        self._stream, self._clock = ObjectStream(convention), clock
        self._sender = None if sender is None else _resolved(sender)
        self._others: set[str] = set()
        self._lock, self._is_closed = threading.Lock(), threading.Event()
        self._error, self._wall = "", _Wall()
        self._socket = _listening(host, port)
        self.address: tuple[str, int] = self._socket.getsockname()
        self._thread = threading.Thread(
            target=self._receive, name="vicon-receiver", daemon=True
        )
        self._thread.start()

    def newest(self, body: str) -> TrackedPose | None:
        """Return the newest pose of a body."""
        self._require_alive()
        with self._lock:
            return self._stream.newest(body)

    def rotation(self, body: str) -> np.ndarray | None:
        """Return the three numbers (3,) of the newest rotation, radians; None at first.

        Raises:
            DeviceLostError: no more will come.
        """
        self._require_alive()
        with self._lock:
            return self._stream.rotation(body)

    def explain(self, body: str) -> str:
        """Say why no new pose of a body comes."""
        host, port = self.address
        with self._lock:
            why = self._stream.explain(body) or (
                "no datagram has come: is Tracker's UDP object stream on, with this "
                "address and port, and does the firewall let it in?"
                + " Broadcasts need 0.0.0.0."
                * (host != "0.0.0.0")
            )
            if self._others:
                others = ", ".join(sorted(self._others))
                why += f"; left out what {others} sent, listening to {self._sender}"
        return f"VICON at {host}:{port}: {why}"

    def close(self) -> None:
        """Stop listening."""
        self._is_closed.set()
        self._thread.join()
        self._socket.close()

    def _require_alive(self) -> None:
        if not self._thread.is_alive():
            host, port = self.address
            closed = self._is_closed.is_set()
            why = self._error or f"the receiver {'is closed' if closed else 'failed'}"
            raise DeviceLostError(f"VICON at {host}:{port}: {why}")

    def _receive(self) -> None:
        while not self._is_closed.is_set():
            try:
                raw, time_s, sender = self._read()
            except TimeoutError:
                continue
            except OSError as error:
                self._error = f"receiving failed ({error}); start again"
                return
            with self._lock:
                if self._sender not in (None, sender):
                    if len(self._others) < 8:
                        self._others.add(sender)
                elif self._stream.take(raw, time_s):
                    self._sender = sender

    def _read(self) -> tuple[bytes, float, str]:
        """Wait for a datagram; return it, when it came, and who sent it.

        Raises:
            TimeoutError: none came, or nobody knows when.
        """
        if sys.platform != "linux":
            raw, sender = self._socket.recvfrom(2 * SIZES[-1])
            return raw, self._clock(), sender[0]
        space = socket.CMSG_SPACE(_TIMESPEC.size)
        raw, notes, _, sender = self._socket.recvmsg(2 * SIZES[-1], space)
        wall_s, is_set = self._wall.read()
        if is_set:
            self._drop_waiting()
            raise TimeoutError
        age_s = 0.0
        for level, kind, data in notes:
            if (level, kind) == (socket.SOL_SOCKET, _SO_TIMESTAMPNS):
                seconds, nanoseconds = _TIMESPEC.unpack(data[: _TIMESPEC.size])
                age_s = max(0.0, wall_s - seconds - 1e-9 * nanoseconds)
        return raw, self._clock() - age_s, sender[0]

    def _drop_waiting(self) -> None:
        self._socket.setblocking(False)
        with suppress(BlockingIOError):
            while True:
                self._socket.recv(1)
        self._socket.settimeout(_POLL_S)


class _Wall:
    """The wall clock, which may be set while others count on."""

    def __init__(self) -> None:
        self._ahead = -math.inf, math.inf
        self.read()

    def read(self) -> tuple[float, bool]:
        """Return its time, seconds, and whether it was set since the last reading."""
        before, wall, after = time.monotonic(), time.time(), time.monotonic()
        low, high = self._ahead
        self._ahead = wall - after, wall - before
        is_set = wall - before < low - _STEP_S or wall - after > high + _STEP_S
        return wall, is_set


def _listening(host: str, port: int) -> socket.socket:
    if not 0 <= port < 1 << 16:
        raise InputError(f"VICON: port {port}; 0 to 65535, {PORT} unless set otherwise")
    listener = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    try:
        listener.bind((_resolved(host), port))
        listener.settimeout(_POLL_S)
        if sys.platform == "linux":
            listener.setsockopt(socket.SOL_SOCKET, _SO_TIMESTAMPNS, 1)
    except OSError as error:
        listener.close()
        raise InputError(
            f"VICON: cannot listen at {host}:{port} ({error}); the address must be one "
            "of this computer or 0.0.0.0, and no other program may listen there"
        ) from error
    except InputError:
        listener.close()
        raise
    return listener


def _resolved(host: str) -> str:
    if not host:  # would stand for every address of this computer
        raise InputError("VICON: no host; 127.0.0.1, or 0.0.0.0 for all addresses")
    try:
        return socket.gethostbyname(host)
    except (OSError, UnicodeError) as error:
        raise InputError(f"VICON: {host!r} is no known host ({error})") from error
