"""Client of a policy behind a URL; it needs NumPy and the standard library alone.

Every control period the client posts the images::

    POST URL
    Authorization: Bearer TOKEN   where a token is given
    Content-Type: application/x-npy
    X-Client: 5f0c...             a random number of the client
    X-Goal: 0,0                   the goal of each image
    X-Step: 3                     images before this one in the drive; 0 starts a drive
    X-Numbers: 5.1,9.8,0.2;4.9,9.7,0.1   where the policy is told speed, points of the
                                  route, time: those of each image, as in `Numbers`
    (body: a NumPy array in .npy format, (n, c, h, w) or as declared; float32, or uint8
    of a car's camera, for value/255)

    200 OK
    {"control": [0.12, -0.03]}

The control is one JSON number for each image, or a list of `k` for each, positions
too; the client reads no other key. It sends a request again, unchanged, when the
network or the server fails (no connection, no whole answer in time, status 5xx). The
server must answer it as it would have the first time.
"""

from __future__ import annotations

import http.client
import io
import secrets
import socket
import ssl
import threading
import time
import urllib.parse
import weakref
from collections.abc import Sequence
from contextlib import suppress
from typing import Any

import numpy as np

from mi_nerfattack.errors import InputError
from mi_nerfattack.io.strict import parse_json

MAX_ANSWER_BYTES = 1 << 20
#: Seconds before the first repetition; doubled for each further one.
PAUSE_S = 0.1
_ERRORS = (OSError, http.client.HTTPException)

_REMEDY = "start the policy's server; one that is slow needs more time or attempts"
_SERVER = "look into the output of the policy's server"
_REMEDIES = {401: "give the server's token", 409: "begin the drive again"}


class PolicyClient:
    """Asks a policy behind a URL, over one connection that it keeps.

    Args:
        url: http or https.
        token: that the server wants; none by default.
        timeout_s: longest wait for a whole answer, from the connection on.
        retries: how often a failed request is repeated.

    Raises:
        InputError: the URL is none.
    """

    def __init__(
        self, url: str, token: str = "", timeout_s: float = 10.0, retries: int = 2
    ) -> None:
        try:
            address = urllib.parse.urlsplit(url)
            usable = address.scheme in ("http", "https") and address.port != 0
            usable = usable and url.isascii() and url.isprintable() and " " not in url
            (address.hostname or "").encode("idna")  # raises where a label is too long
        except ValueError as err:
            raise InputError(f"policy.url: {url!r}: {err}") from err
        if address.username is not None or address.password is not None:
            raise InputError(
                "policy.url: has a name or password, which logs show; give a token"
            )
        if not usable or not address.hostname:
            raise InputError(f"policy.url: {url!r}; must be http://HOST... or https://")
        self.url, self.timeout_s, self.retries = url, timeout_s, retries
        self._path = address.path or "/"
        if address.query:
            self._path += f"?{address.query}"
        self._headers = {
            "Content-Type": "application/x-npy",
            "X-Client": secrets.token_hex(8),
        }
        if token:
            self._headers["Authorization"] = f"Bearer {token}"
        self._tls: ssl.SSLContext | None = None
        self._http = http.client.HTTPConnection(address.hostname, address.port or 80)
        if address.scheme == "https":
            self._tls = ssl.create_default_context()
            self._http = http.client.HTTPSConnection(
                address.hostname, address.port or 443, context=self._tls
            )
        self._socket: socket.socket | None = None  # the newest
        self._lock = threading.Lock()
        weakref.finalize(self, self._http.close)

    def ask(
        self,
        image: np.ndarray,
        goals: Sequence[int],
        step: int,
        numbers: np.ndarray | None = None,
    ) -> np.ndarray:
        """Post images; repeat a request that fails on its way.

        Args:
            image: see the module.
            goals: (n,).
            step: number of images before this one in the drive.
            numbers: (n, k), the further numbers that the policy gets; None for none.

        Returns:
            (n,) or (n, k) numbers as the server gives them, float64.

        Raises:
            InputError: no answer, or one that is not as the module says.
        """
        body = io.BytesIO()
        np.save(body, image, allow_pickle=False)
        headers = self._headers | {
            "X-Goal": ",".join(map(str, goals)),
            "X-Step": str(step),
        }
        if numbers is not None:
            rows = (",".join(f"{x:.9g}" for x in row) for row in numbers)
            headers["X-Numbers"] = ";".join(rows)
        reason, attempt, remedy = "", 0, _REMEDY
        for attempt in range(self.retries + 1):
            if attempt:
                time.sleep(PAUSE_S * 2 ** (attempt - 1))
            try:
                with self._lock:
                    status, phrase, raw = self._exchange(body.getvalue(), headers)
            except _ERRORS as err:
                reason = str(err) or type(err).__name__
                continue
            if 200 <= status < 300:
                return self._controls(raw)
            reason, remedy = f"status {status} {phrase}", _REMEDIES.get(status, _SERVER)
            if status < 500:
                break
        shown = reason[:200].encode("unicode_escape").decode()  # of a server's words
        raise InputError(f"{self.url}: {shown}, after {attempt + 1} attempts; {remedy}")

    def _exchange(self, body: bytes, headers: dict[str, str]) -> tuple[int, str, bytes]:
        """Send a request, and return status, reason and body of the answer.

        The timeout of a socket limits each packet, and a server can send an answer byte
        by byte; so a timer ends the connection when the time for all of them is over.
        """
        over = threading.Event()
        end = time.monotonic() + self.timeout_s

        def give_up() -> None:
            over.set()
            if self._socket is not None:
                with suppress(OSError):  # of the socket beneath TLS
                    socket.socket.shutdown(self._socket, socket.SHUT_RDWR)

        timer = threading.Timer(self.timeout_s, give_up)
        timer.daemon = True
        timer.start()
        try:
            is_new = self._http.sock is None
            try:
                return self._send(body, headers, end)
            except _ERRORS:
                self._http.close()
                if is_new or over.is_set():
                    raise
                return self._send(body, headers, end)  # the server closed an idle one
        except _ERRORS as err:
            self._http.close()
            if over.is_set() or isinstance(err, TimeoutError):
                raise TimeoutError(f"no answer in {self.timeout_s:g} s") from err
            raise
        finally:
            timer.cancel()

    def _send(
        self, body: bytes, headers: dict[str, str], end: float
    ) -> tuple[int, str, bytes]:
        sock = self._http.sock or self._connect(end)
        sock.settimeout(_left(end))
        self._http.request("POST", self._path, body, headers)
        with self._http.getresponse() as response:
            try:
                raw = response.read(MAX_ANSWER_BYTES + 1)
            except ValueError as err:  # of a chunk with a negative length
                raise http.client.IncompleteRead(b"") from err
            if response.length and len(raw) <= MAX_ANSWER_BYTES:
                raise http.client.IncompleteRead(raw, response.length)
            if len(raw) > MAX_ANSWER_BYTES or not 200 <= response.status < 300:
                self._http.close()
        _left(end)  # what a connection without a length ends with may not be all
        return response.status, response.reason, raw

    def _connect(self, end: float) -> socket.socket:
        """Connect to the first address of the host that answers."""
        host, port = self._http.host, self._http.port
        problem = OSError(f"{host} has no address")
        for entry in socket.getaddrinfo(host, port, type=socket.SOCK_STREAM):
            try:
                sock = socket.create_connection((str(entry[4][0]), port), _left(end))
            except OSError as err:
                problem = err
                continue
            sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            self._http.sock = self._socket = sock
            if self._tls is not None:
                sock = self._tls.wrap_socket(sock, server_hostname=host)
                self._http.sock = self._socket = sock
            return sock
        raise problem

    def _controls(self, raw: bytes) -> np.ndarray:
        """Read ``{"control": [numbers]}``."""
        try:
            if len(raw) > MAX_ANSWER_BYTES:
                raise ValueError(f"more than {MAX_ANSWER_BYTES} bytes")
            control = parse_json("answer", raw.decode())["control"]
            if not _are_numbers(control):
                raise ValueError("the control holds what is no number")
            return np.array(control, np.float64)
        except (ValueError, LookupError, TypeError, ArithmeticError) as err:
            text = raw[:80].decode("utf-8", "replace")
            raise InputError(
                f"{self.url}: answers {text!r} ({type(err).__name__}: {err}); "
                'must be JSON, {"control": [one number, or a list, for each image]}'
            ) from err


def _left(end: float) -> float:
    """Return the seconds until `end`, by `time.monotonic`."""
    left = end - time.monotonic()
    if left <= 0:
        raise TimeoutError
    return left


def _are_numbers(value: Any) -> bool:
    """Tell a list of numbers, or of lists of numbers; a truth value is none."""
    rows = value if isinstance(value, list) else [None]
    flat = [x for row in rows for x in (row if isinstance(row, list) else [row])]
    return all(type(x) in (int, float) for x in flat)
