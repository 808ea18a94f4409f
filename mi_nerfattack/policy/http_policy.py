"""A policy behind a URL.

Every control period the images are posted, and the answer holds the controls::

    POST URL
    Content-Type: application/x-npy
    X-Goal: 0,0                the goal of each image
    X-Step: 3                  images before this one in the drive; 0 starts anew
    (body: one NumPy array in .npy format, float32, (n, c, h, w) or as declared)

    200 OK
    {"control": [0.12, -0.03]}

A request that fails for the network's or the server's reasons (no connection, no
answer in time, status 5xx) is sent again, unchanged; the server must answer it as it
would have the first time.

Of our own, over the standard library, because a drive needs a limit for the whole
answer, in time and size; common clients have one between two packets.
"""

from __future__ import annotations

import http.client
import io
import json
import time
import urllib.error
import urllib.parse
import urllib.request
from typing import Any

import numpy as np

from mi_nerfattack.errors import InputError
from mi_nerfattack.policy.black_box import AbstractBlackBox
from mi_nerfattack.policy.preprocess import Preprocess

MAX_ANSWER_BYTES = 1 << 20
#: Seconds before the first repetition; doubled for each further one.
PAUSE_S = 0.1
#: Hosts that are asked without a proxy, whatever the environment says.
LOCAL_HOSTS = ("localhost", "127.0.0.1", "::1")


class _NoRedirects(urllib.request.HTTPRedirectHandler):
    """Take a redirect for the error that it is: it would turn POST into GET."""

    def redirect_request(self, *args: Any, **kwargs: Any) -> None:
        """Follow no redirect."""
        del args, kwargs


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
        parts = urllib.parse.urlsplit(url)
        if parts.scheme not in ("http", "https") or not parts.hostname:
            raise InputError(f"policy.url: {url!r}; must be http://HOST... or https://")
        self.url, self.timeout_s, self.retries = url, timeout_s, retries
        handlers: list[urllib.request.BaseHandler] = [_NoRedirects()]
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
            except TimeoutError:
                reason = f"no answer in {self.timeout_s:g} s"
            except (OSError, http.client.HTTPException) as err:
                reason = str(getattr(err, "reason", err)) or type(err).__name__
        raise InputError(
            f"{self.url}: {reason}, after {attempt + 1} attempts; start the policy's "
            "server, or raise policy.timeout_s and policy.retries"
        )

    def _post(self, request: urllib.request.Request) -> bytes:
        """Send one request; the whole answer must be there in time."""
        end = time.monotonic() + self.timeout_s
        with self._opener.open(request, timeout=self.timeout_s) as response:
            parts, size = [], 0
            while size <= MAX_ANSWER_BYTES:
                if time.monotonic() > end:
                    raise TimeoutError
                part = response.read1(1 << 16)  # returns with what has come
                if not part:
                    break
                parts.append(part)
                size += len(part)
            return b"".join(parts)

    def _controls(self, raw: bytes) -> np.ndarray:
        """Read ``{"control": [numbers]}``."""
        try:
            if len(raw) > MAX_ANSWER_BYTES:
                raise ValueError(f"more than {MAX_ANSWER_BYTES} bytes")
            return np.array(json.loads(raw)["control"], np.float64)
        except (ValueError, KeyError, TypeError, RecursionError) as err:
            text = raw[:80].decode("utf-8", "replace")
            raise InputError(
                f"{self.url}: answers {text!r} ({type(err).__name__}: {err}); "
                'must be JSON, {"control": [one number for each image]}'
            ) from err
