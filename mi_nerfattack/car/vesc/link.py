"""The serial port to a VESC, and the thread that listens there."""

from __future__ import annotations

import os
import select
import time
from threading import Condition, Event, Lock, Thread
from typing import NamedTuple

import serial
from serial.tools import list_ports

from mi_nerfattack.car.devices import DeviceLostError
from mi_nerfattack.car.vesc.messages import Id
from mi_nerfattack.car.vesc.packet import FrameDecoder, encode_frame
from mi_nerfattack.errors import InputError

BAUDRATE = 115_200
PAUSE_S = 0.05  # longer than any between two bytes of a frame
WRITE_S = 0.1  # until a port that takes nothing is lost


class Answer(NamedTuple):
    """A payload, and when it was whole, :func:`time.monotonic`."""

    payload: bytes
    time_s: float


class SerialLink:
    """A serial port with a VESC at its other end.

    Its thread listens and never sends: a command comes from whoever calls `send`, and
    from nobody when nobody calls.

    Args:
        port: name of the port, such as ``/dev/ttyACM0``.
        baudrate: of a UART; a USB port takes any.

    Raises:
        InputError: there is no such port, it may not be opened, or it is in use.
    """

    def __init__(self, port: str, baudrate: int = BAUDRATE) -> None:
        self.port = port
        try:
            self._serial = serial.Serial(
                port, baudrate, timeout=PAUSE_S, exclusive=True
            )
        except (serial.SerialException, OSError, ValueError) as err:
            ports = ", ".join(sorted(p.device for p in list_ports.comports()))
            raise InputError(
                f"{port}: {err}; plug the controller in, close other programs that use "
                f"it, join the group of the port (dialout); ports: {ports or 'none'}"
            ) from err
        self._newest: dict[int, Answer] = {}
        self._heard, self._writing, self._closing = Condition(), Lock(), Event()
        self._lost = ""
        self._thread = Thread(target=self._listen, name=f"VESC {port}", daemon=True)
        self._thread.start()

    def send(self, *payloads: bytes) -> None:
        """Send payloads, one right behind the other; from any thread.

        It tries even where nothing can be heard any more: a brake may still arrive.

        Raises:
            DeviceLostError: the port is gone, or takes nothing.
        """
        raw = b"".join(map(encode_frame, payloads))
        with self._writing:
            try:
                self._write(raw)
            except Exception as err:  # pyserial has no common class of its own
                raise DeviceLostError(f"{self.port}: {err}; check its cable") from err

    def _write(self, raw: bytes) -> None:
        """Write all; a busy computer's pause is no fault of the port.

        pyserial's own time limit also refuses what has long gone out.
        """
        while raw:
            if not select.select([], [self._serial.fileno()], [], WRITE_S)[1]:
                raise TimeoutError(f"takes nothing for {WRITE_S:g} s")
            raw = raw[os.write(self._serial.fileno(), raw) :]

    def newest(self, kind: Id) -> Answer | None:
        """Return the newest answer of a kind; None before the first.

        Raises:
            DeviceLostError: the port is gone.
        """
        with self._heard:
            self.check()
            return self._newest.get(kind)

    def ask(self, question: bytes, within_s: float, tries: int = 1) -> Answer:
        """Send a question and wait for the answer, whose first byte is the same.

        Args:
            question: payload.
            within_s: longest wait, seconds.
            tries: how often to ask, where a line may be noisy.

        Raises:
            DeviceLostError: no answer, or the port is gone.
        """
        kind = question[0]
        with self._heard:
            self._newest.pop(kind, None)
        for _ in range(tries):
            self.send(question)
            with self._heard:
                self._heard.wait_for(
                    lambda: self._lost or kind in self._newest, within_s
                )
                self.check()
                if kind in self._newest:
                    return self._newest[kind]
        raise DeviceLostError(
            f"{self.port}: no answer to {Id(kind).name} within {tries * within_s:g} s; "
            "is it a VESC that is switched on, and its baud rate right?"
        )

    def close(self) -> None:
        """Let go of the port; more than once does no harm."""
        self._closing.set()
        self._thread.join()
        self._serial.close()

    def check(self) -> None:
        """Check that answers can be heard.

        Raises:
            DeviceLostError: the port is gone.
        """
        if self._lost:
            raise DeviceLostError(self._lost)

    def _listen(self) -> None:
        decoder = FrameDecoder()
        try:
            while not self._closing.is_set():
                data = self._serial.read(self._serial.in_waiting or 1)
                payloads = decoder.feed(data) if data else decoder.flush()
                with self._heard:
                    for payload in payloads:
                        self._newest[payload[0]] = Answer(payload, time.monotonic())
                    self._heard.notify_all()
        except Exception as err:  # termios.error and TypeError, too, of a port gone
            with self._heard:
                self._lost = f"{self.port}: {err}; check its cable and its battery"
                self._heard.notify_all()
