"""A policy behind a URL.

Every control period the images are posted, and the answer holds the controls::

    POST URL
    Content-Type: application/x-npy
    X-Goal: 0,0                the goal of each image
    X-Step: 3                  images before this one in the drive; 0 starts anew
    (body: one NumPy array in .npy format, float32, (n, c, h, w) or as declared)

    200 OK
    {"control": [0.12, -0.03]}

The numbers are JSON's, one for each image, or a list of `k` for each; other keys are
left alone. A request that fails for the network's or the server's reasons (no
connection, no whole answer in time, status 5xx) is sent again, unchanged; the server
must answer it as it would have the first time.

Of our own, over the standard library, because a drive needs a limit for the whole
answer, in time and size; common clients have one between two packets.
"""

from __future__ import annotations

import http.client
import io
import socket
import time
import urllib.error
import urllib.parse
import urllib.request
from collections.abc import Callable
from typing import Any

import numpy as np

from mi_nerfattack.errors import InputError
from mi_nerfattack.io.strict_json import parse_json
from mi_nerfattack.policy.black_box import AbstractBlackBox
from mi_nerfattack.policy.preprocess import Preprocess

MAX_ANSWER_BYTES = 1 << 20
#: Seconds before the first repetition; doubled for each further one.
PAUSE_S = 0.1
#: Hosts that are asked without a proxy, whatever the environment says.
LOCAL_HOSTS = ("localhost", "127.0.0.1", "::1")


_SENT_BYTES = 1 << 14  # at once: a record of TLS


class _Received(io.RawIOBase):
    """What a socket receives while there is time left, and the file over it."""

    def __init__(self, sock: socket.socket, left: Callable[[], float]) -> None:
        self._socket, self._left = sock, left
        self._file = sock.makefile("rb", buffering=0)

    def makefile(self, mode: str) -> io.BufferedReader:
        del mode
        return io.BufferedReader(self)

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: Any) -> int | None:
        self._socket.settimeout(self._left())
        return self._file.readinto(buffer)

    def close(self) -> None:
        self._file.close()
        super().close()


class _Connection(http.client.HTTPConnection):
    """Connection whose timeout is of everything, from before it is made.

    The standard library's is of each packet, and a server may drip them: headers,
    ``100 Continue`` before the answer, extensions of chunks.
    """

    def __init__(self, *arguments: Any, **more: Any) -> None:
        super().__init__(*arguments, **more)
        self._end = time.monotonic() + (self.timeout or 0)
        self._create_connection = self._dial
        self.response_class: Any = self._response

    def send(self, data: Any) -> None:
        """Send bytes, or connect first."""
        if self.sock is None:
            self.connect()
        sock: Any = self.sock
        for start in range(0, len(data), _SENT_BYTES):
            sock.settimeout(self._left())
            super().send(data[start : start + _SENT_BYTES])

    def _left(self) -> float:
        left = self._end - time.monotonic()
        if left <= 0:
            raise TimeoutError
        return left

    def _dial(self, address: tuple[str, int], *_: Any) -> socket.socket:
        """Connect to the first address of a name that answers."""
        problem = OSError(f"{address[0]} has no address")
        for found in socket.getaddrinfo(*address, type=socket.SOCK_STREAM):
            host_and_port: Any = found[4][:2]
            try:
                made = socket.create_connection(host_and_port, self._left())
            except OSError as err:
                problem = err
            else:
                made.settimeout(self._left())  # of TLS
                return made
        raise problem

    def _response(self, sock: Any, *arguments: Any, **more: Any) -> Any:
        received: Any = _Received(sock, self._left)
        return http.client.HTTPResponse(received, *arguments, **more)


class _SecureConnection(http.client.HTTPSConnection, _Connection):
    """The same through TLS."""


class _Handler(urllib.request.HTTPSHandler, urllib.request.HTTPHandler):
    """Make such connections."""

    def http_open(self, req: urllib.request.Request) -> Any:
        return self.do_open(_Connection, req)

    def https_open(self, req: urllib.request.Request) -> Any:
        return self.do_open(_SecureConnection, req)


class _NoRedirects(urllib.request.HTTPRedirectHandler):
    """Take a redirect for the error that it is: it would turn POST into GET."""

    def http_error_302(self, req: Any, fp: Any, *more: Any, **others: Any) -> None:
        """Follow no redirect."""

    http_error_301 = http_error_303 = http_error_307 = http_error_308 = http_error_302


class HttpPolicy(AbstractBlackBox):
    """Policy behind a URL; see the module for the protocol.

    Args:
        url: http or https.
        timeout_s: longest wait for a whole answer.
        retries: how often a failed request is repeated.
        preprocess: as for `AbstractBlackBox`; the rest likewise.
    """

    def __init__(
        self,
        url: str,
        timeout_s: float = 10.0,
        retries: int = 2,
        preprocess: Preprocess | None = None,
        control_scale: float = 1.0,
        output: int | None = None,
    ) -> None:
        try:
            parts = urllib.parse.urlsplit(url)
            usable = parts.scheme in ("http", "https") and parts.port != 0
        except ValueError as err:
            raise InputError(f"policy.url: {url!r}: {err}") from err
        if not usable or not parts.hostname:
            raise InputError(f"policy.url: {url!r}; must be http://HOST... or https://")
        self.url, self.timeout_s, self.retries = url, timeout_s, retries
        handlers: list[urllib.request.BaseHandler] = [_Handler(), _NoRedirects()]
        if parts.hostname in LOCAL_HOSTS:
            handlers.append(urllib.request.ProxyHandler({}))
        self._opener = urllib.request.build_opener(*handlers)
        AbstractBlackBox.__init__(self, url, preprocess, control_scale, output)

    def answer(self, image: np.ndarray, goals: np.ndarray, step: int) -> np.ndarray:
        """Post the images; repeat what fails on the way."""
        body = io.BytesIO()
        np.save(body, image, allow_pickle=False)
        headers = {
            "Content-Type": "application/x-npy",
            "X-Goal": ",".join(map(str, goals.tolist())),
            "X-Step": str(step),
        }
        request = urllib.request.Request(self.url, body.getvalue(), headers)
        reason, attempt = "", 0
        for attempt in range(self.retries + 1):
            if attempt:
                time.sleep(PAUSE_S * 2 ** (attempt - 1))
            try:
                return self._controls(self._post(request))
            except urllib.error.HTTPError as err:
                with err:
                    reason = f"status {err.code} {err.reason}"
                if err.code < 500:
                    break
            except (OSError, http.client.HTTPException) as err:
                cause = getattr(err, "reason", err)
                reason = str(cause) or type(err).__name__
                if isinstance(cause, TimeoutError):
                    reason = f"no answer in {self.timeout_s:g} s"
        shown = reason[:200].encode("unicode_escape").decode()  # of a server's words
        raise InputError(
            f"{self.url}: {shown}, after {attempt + 1} attempts; start the policy's "
            "server, or raise policy.timeout_s and policy.retries"
        )

    def _post(self, request: urllib.request.Request) -> bytes:
        """Send one request; the whole answer must be there in time."""
        with self._opener.open(request, timeout=self.timeout_s) as response:
            parts, size = [], 0
            while size <= MAX_ANSWER_BYTES:
                part = response.read1(1 << 16)  # returns with what has come
                if not part:
                    break
                parts.append(part)
                size += len(part)
            if response.length and size <= MAX_ANSWER_BYTES:
                raise http.client.IncompleteRead(b"".join(parts), response.length)
            return b"".join(parts)

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
                'must be JSON, {"control": [one number for each image]}'
            ) from err


def _are_numbers(value: Any) -> bool:
    """Tell a list of numbers, or of lists of numbers; a truth value is none."""
    rows = value if isinstance(value, list) else [None]
    flat = [x for row in rows for x in (row if isinstance(row, list) else [row])]
    return all(type(x) in (int, float) for x in flat)
