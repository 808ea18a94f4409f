"""Server of a policy: answers requests of `PolicyClient` with controls.

Whoever has the token gets answers; all others get status 401. The server reads no
pickle and no request over `MAX_REQUEST_BYTES`. It keeps the memory of a policy for each
client, and the answer to the newest request, which a repeated request gets. A function
that remembers images by itself cannot serve several clients.
"""

from __future__ import annotations

import hashlib
import hmac
import json
import re
import socket
import threading
import time
from collections import deque
from contextlib import suppress
from dataclasses import dataclass
from http.server import BaseHTTPRequestHandler
from typing import Any

import mitsuba as mi
import numpy as np

from mi_nerfattack.errors import InputError, is_interrupt
from mi_nerfattack.io.network import Endpoint, HttpServer, require_token
from mi_nerfattack.policy.base import AbstractPolicy, Memory, Numbers

MAX_REQUEST_BYTES = 1 << 26
MAX_CLIENTS = 16  # whose memories are kept
MAX_THREADS = 100  # of the process; further connections are closed
IDLE_S = 30.0  # after which a silent connection ends
_DRAIN_S = 5.0
_MAX_TIMES = 100_000  # times of answers
#: Header of the .npy format, version 1, as NumPy writes it for (n, 3, height, width).
_NPY = re.compile(
    rb"\x93NUMPY\x01\x00..\{'descr': '(<f4|\|u1)', 'fortran_order': False, "
    rb"'shape': \(([1-9][0-9]{0,5}), 3, ([1-9][0-9]{0,5}), ([1-9][0-9]{0,5})\), \} *\n",
    re.DOTALL,
)
_GOALS = re.compile(r"-?[0-9]{1,9}(,-?[0-9]{1,9})*")
_STEP = re.compile(r"[0-9]{1,9}")
_NUMBERS = re.compile(r"[-+0-9.e]{1,24}([,;][-+0-9.e]{1,24}){0,4095}")


class RefusedError(Exception):
    """A request that gets no control.

    Args:
        status: of the answer.
        reason: one line for the client.
    """

    def __init__(self, status: int, reason: str) -> None:
        super().__init__(reason)
        self.status = status


@dataclass(frozen=True)
class _Drive:
    """The newest step of a client's drive, its answer, and the memory afterwards."""

    step: int
    request: bytes
    count: int
    controls: list[Any]
    after: Memory


class PolicyServer(HttpServer):
    """Serves a policy until its end; each connection has a thread.

    Args:
        endpoint: to listen at.
        policy: that decides; the server calls it from one thread at a time.
        token: that clients must send; empty on this computer alone.

    Raises:
        InputError: it cannot listen there, or other computers could without a token.
    """

    def __init__(self, endpoint: Endpoint, policy: AbstractPolicy, token: str) -> None:
        require_token(token, endpoint)
        super().__init__(endpoint, _Handler)
        self._policy, self._token = policy, token.encode()
        self._deciding, self._counting = threading.Lock(), threading.Lock()
        self._drives: dict[str, _Drive] = {}
        self._seconds: deque[float] = deque(maxlen=_MAX_TIMES)
        self._decisions = self._strangers = 0

    def process_request(self, request: Any, client_address: Any) -> None:
        """Start a thread for a connection, or close one too many."""
        if threading.active_count() > MAX_THREADS:
            self.shutdown_request(request)
        else:
            super().process_request(request, client_address)

    def admit(self, authorization: str) -> None:
        """Refuse a client without the token."""
        token = authorization.removeprefix("Bearer ").encode("utf-8", "replace")
        if self._token and not hmac.compare_digest(token, self._token):
            with self._counting:
                self._strangers += 1
            raise RefusedError(401, "the token is wrong or missing")

    def decide(
        self,
        client: str,
        request: bytes,
        images: np.ndarray,
        goals: list[int],
        step: int,
        numbers: np.ndarray | None = None,
    ) -> list[Any]:
        """Return the control of each image, a number, or a list of several.

        Args:
            client: whose drive it is.
            request: digest of images, goals and numbers.
            images: (n, height, width, 3) float32 in [0, 1].
            goals: (n,).
            step: images before these in the drive.
            numbers: (n, k) float32, the further numbers that the policy gets; None for
                none.
        """
        began = time.perf_counter()
        with self._deciding:
            last = self._drives.get(client)
            if last is not None and (last.step, last.request) == (step, request):
                return last.controls
            before = self._memory(client, len(images), step)
            try:
                rows = None if numbers is None else mi.TensorXf(numbers)
                row, after = self._policy.step(mi.TensorXf(images), goals, before, rows)
                controls = np.array(row, np.float64).T
            except InputError as err:
                raise RefusedError(422, str(err)) from err
            except Exception as err:  # a user's policy raises whatever it likes
                if is_interrupt(err):
                    raise
                raise RefusedError(
                    500, f"the policy raises {type(err).__name__}: {err}"
                ) from err
            if not np.isfinite(controls).all():
                raise RefusedError(422, f"the policy gives {controls.tolist()}")
            self._drives.pop(client, None)
            answer = controls.tolist()
            self._drives[client] = _Drive(
                step, request, len(images), controls=answer, after=after
            )
            if len(self._drives) > MAX_CLIENTS:
                del self._drives[next(iter(self._drives))]
        with self._counting:
            self._decisions += 1
            self._seconds.append(time.perf_counter() - began)
        return answer

    def _memory(self, client: str, count: int, step: int) -> Memory:
        """Return what the policy remembers of a client's drive before a step."""
        first = self._policy.initial_memory(count)
        if step == 0 or not first:
            return first
        drive = self._drives.get(client)
        if drive is not None and drive.count == count:
            if step == drive.step + 1:
                return drive.after
        newest = "none" if drive is None else f"{drive.step} of {drive.count} images"
        raise RefusedError(
            409, f"step {step} of {count} images after {newest}; start with step 0"
        )

    @property
    def numbers(self) -> Numbers:
        """The numbers that the policy gets besides images and goal."""
        return self._policy.numbers

    def figures(self) -> dict[str, Any]:
        """Return how many decisions the policy made, how quickly, and who was refused.

        The times are None where there was no decision.
        """
        with self._counting:
            times: list[Any] = [None, None]
            if self._seconds:
                times = np.quantile(self._seconds, [0.5, 0.95]).tolist()
            names = "decisions", "median_s", "within_s_95", "strangers"
            values = self._decisions, *times, self._strangers
        return dict(zip(names, values, strict=True))


class _Handler(BaseHTTPRequestHandler):
    """Reads one request after another from a connection."""

    protocol_version = "HTTP/1.1"
    timeout = IDLE_S
    disable_nagle_algorithm = True

    def do_POST(self) -> None:
        """Answer with controls, or refuse."""
        server = self.server
        assert isinstance(server, PolicyServer)
        try:
            server.admit(str(self.headers.get("Authorization", "")))
            body = self._body()
            images = _images(body)
            goals, step = self._goals(len(images)), self._step()
            numbers = self._numbers(len(images), server.numbers.size)
            client = str(self.headers.get("X-Client", ""))[:64]
            # of the bytes that came: fewer than those of the images that they become
            header = str(self.headers.get("X-Numbers", ""))
            request = hashlib.blake2b(body + f"{goals} {header}".encode()).digest()
            controls = server.decide(
                client, request, images, goals=goals, step=step, numbers=numbers
            )
            answer = {"control": controls}
        except RefusedError as refusal:
            self.close_connection = True  # whatever the client still sends
            self._answer(refusal.status, str(refusal), {"error": str(refusal)})
            self._drain()
        else:
            self._answer(200, "OK", answer)

    def _answer(self, status: int, phrase: str, document: Any) -> None:
        body = json.dumps(document).encode()
        line = " ".join(phrase.split())[:200].encode("ascii", "replace").decode()
        self.send_response(status, line)
        self.send_header("Content-Type", "application/json")
        self.send_header("Content-Length", str(len(body)))
        if status == 401:
            self.send_header("WWW-Authenticate", "Bearer")
        if self.close_connection:
            self.send_header("Connection", "close")
        self.end_headers()
        self.wfile.write(body)

    def _drain(self) -> None:
        """Read what the client still sends; otherwise it could not read the answer."""
        end = time.monotonic() + _DRAIN_S
        with suppress(OSError):
            self.connection.shutdown(socket.SHUT_WR)
            self.connection.settimeout(1.0)
            while time.monotonic() < end and self.rfile.read1(1 << 16):
                pass

    def _body(self) -> bytes:
        """Read the body, whose length the header tells."""
        length = str(self.headers.get("Content-Length", ""))
        if not _STEP.fullmatch(length) or "Transfer-Encoding" in self.headers:
            raise RefusedError(411, "give Content-Length, in bytes")
        if int(length) > MAX_REQUEST_BYTES:
            raise RefusedError(413, f"more than {MAX_REQUEST_BYTES} bytes")
        body = self.rfile.read(int(length))
        if len(body) < int(length):
            raise RefusedError(400, f"{len(body)} of {length} bytes came")
        return body

    def _goals(self, count: int) -> list[int]:
        text = str(self.headers.get("X-Goal", ""))
        goals = list(map(int, text.split(","))) if _GOALS.fullmatch(text) else []
        if len(goals) != count:
            raise RefusedError(400, f"X-Goal must have one integer for {count} images")
        return goals

    def _numbers(self, count: int, size: int) -> np.ndarray | None:
        """Read what the policy is told besides images, (n, k); None for nothing."""
        text = str(self.headers.get("X-Numbers", ""))
        if not size and not text:
            return None
        rows = [row.split(",") for row in text.split(";")]
        if not _NUMBERS.fullmatch(text) or [len(row) for row in rows] != [size] * count:
            raise RefusedError(
                400, f"X-Numbers must have {size} numbers for each of {count} images"
            )
        numbers = np.array(rows, np.float32)
        if not np.isfinite(numbers).all():
            raise RefusedError(400, "X-Numbers has values that are not finite")
        return numbers

    def _step(self) -> int:
        text = str(self.headers.get("X-Step", ""))
        if not _STEP.fullmatch(text):
            raise RefusedError(400, "X-Step must be the number of images before these")
        return int(text)

    def log_message(self, format: str, *args: Any) -> None:
        """Print no line for a request."""


def _images(body: bytes) -> np.ndarray:
    """Read images (n, height, width, 3), float32 in [0, 1], from a .npy file."""
    head = _NPY.match(body)
    if head is None:
        raise RefusedError(
            400, "the body must be a .npy file, (n, 3, h, w), float32 or uint8"
        )
    sizes = [int(size) for size in head.groups()[1:]]
    shape = (sizes[0], 3, *sizes[1:])
    kind = np.dtype(head.group(1).decode())
    if len(body) - head.end() != np.prod(shape, dtype=object) * kind.itemsize:
        raise RefusedError(400, f"{len(body)} bytes, for {kind} of shape {shape}")
    images = np.frombuffer(body, kind, offset=head.end()).reshape(shape)
    if kind == np.uint8:
        images = np.divide(images, 255, dtype=np.float32)
    if not np.isfinite(images).all():
        raise RefusedError(400, "the images have values that are not finite")
    return np.ascontiguousarray(images.transpose(0, 2, 3, 1))
