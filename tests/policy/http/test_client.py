"""The client of a policy behind a URL, against servers that answer as tests say."""

from __future__ import annotations

import socket
import threading
import time
from http.server import BaseHTTPRequestHandler, HTTPServer

import numpy as np
import pytest
from support.files.policies import camera

from mi_nerfattack.errors import InputError
from mi_nerfattack.policy.action import Action
from mi_nerfattack.policy.http.policy import HttpPolicy

pytestmark = pytest.mark.usefixtures("variant")


def handler(*answers):
    """Make a handler that answers each request with the next status and body."""
    queue, requests = list(answers), []

    class Handler(BaseHTTPRequestHandler):
        def do_POST(self):
            body = self.rfile.read(int(self.headers["Content-Length"]))
            requests.append((self.headers, body))
            status, text = queue.pop(0)
            self.send_response(status)
            self.end_headers()
            self.wfile.write(text)

    return Handler, requests


GOOD = (200, b'{"control": [0.5, -0.25]}')


def test_http_protocol_and_retries(served, rng, monkeypatch):
    monkeypatch.setattr("mi_nerfattack.policy.http.client.PAUSE_S", 0.01)
    made, requests = handler((503, b""), GOOD, (502, b""), GOOD)
    policy = HttpPolicy(served(made), retries=1, action=Action(scale=2.0))
    image, memory = camera(2, rng), policy.initial_memory(2)
    for step in range(2):
        control, memory = policy.step(image, [0, 2], memory)
        np.testing.assert_array_equal(control, [1.0, -0.5])
        headers, body = requests[-1]
        assert (headers["X-Goal"], headers["X-Step"]) == ("0,2", str(step))
    assert (
        body == requests[-2][1] and body.startswith(b"\x93NUMPY") and len(requests) == 4
    )
    sent = np.frombuffer(body[-2 * 66 * 200 * 3 * 4 :], "f4").reshape(2, 3, 66, 200)
    np.testing.assert_array_equal(sent, image.numpy().transpose(0, 3, 1, 2))


def raw_handler(*pieces, pause=0.0):
    """Make a handler that sends bytes as they are, the last of them again and again."""

    class Raw(BaseHTTPRequestHandler):
        def do_POST(self):
            self.rfile.read(int(self.headers["Content-Length"]))
            try:
                for piece in [*pieces[:-1], *pieces[-1:] * (100 if pause else 1)]:
                    self.wfile.write(piece)
                    threading.Event().wait(pause)
            except OSError:
                pass  # the client has gone

    return Raw


HEAD = b"HTTP/1.1 200 OK\r\n"
CHUNKED = HEAD + b"Transfer-Encoding: chunked\r\n\r\n"


def said(control: bytes) -> bytes:
    return HEAD + b'\r\n{"control": %s}' % control


@pytest.mark.parametrize(
    ("answer", "message"),
    [
        (b"HTTP/1.1 404 Not Found\r\n\r\n", "404 Not Found, after 1 attempts"),
        (b"HTTP/1.1 500 No\r\n\r\n", "500 No, after 2 attempts"),
        (b"HTTP/1.1 302 Found\r\nLocation: http://[::1\r\n\r\n", "302 Found, after 1 "),
        (b"HTTP/1.1 500 \x1b[2J\x9bm%s\r\n\r\n" % (b"a" * 999), r"\\x1b\[2J\\x9bm"),
        (HEAD + b"\r\nhello", "'hello'.*JSON"),
        (said(b"[1]"), r"controls \(1,\) for 2 images"),
        (said(b"[1, NaN]"), "NaN"),
        (said(b'[0], "control": [1]'), "'control' twice"),
        (CHUNKED + b'11\r\n{"control": [0.5]}\r\n', "IncompleteRead.*after 2 attempts"),
    ],
)
def test_answers_are_strict(answer, message, served, rng, monkeypatch):
    monkeypatch.setattr("mi_nerfattack.policy.http.client.PAUSE_S", 0.01)
    url = served(raw_handler(answer))
    with pytest.raises(InputError, match=f"{url}: .*{message}") as caught:
        HttpPolicy(url, retries=1).control(camera(2, rng), 0)
    assert str(caught.value).isprintable() and len(str(caught.value)) < 400


@pytest.mark.parametrize(
    "pieces",
    [
        [HEAD + b"X-Long: ", b"a"],
        [b"HTTP/1.1 100 Continue\r\n\r\n"],
        [HEAD + b"Transfer-Encoding: chunked\r\n\r\n5;", b"a=b;"],
        [HEAD + b"\r\n", b" "],
    ],
    ids=["headers", "continue", "extensions", "body"],
)
def test_the_timeout_is_of_everything_that_comes(pieces, served, rng):
    url = served(raw_handler(*pieces, pause=0.03))  # each in time
    before = time.monotonic()
    with pytest.raises(InputError, match="0.2 s, after 1 attempts"):
        HttpPolicy(url, 0.2, retries=0).control(camera(1, rng), 0)
    assert time.monotonic() - before < 1.5


def test_the_timeout_is_of_a_connection_to_all_addresses(rng, monkeypatch):
    """And of sending, to a server that takes nothing."""
    calls = []

    def connect(address, timeout):
        calls.append(address)
        time.sleep(timeout)
        raise TimeoutError

    monkeypatch.setattr(socket, "create_connection", connect)
    addresses = [(2, 1, 6, "", (f"192.0.2.{i}", 80)) for i in range(5)]
    monkeypatch.setattr(socket, "getaddrinfo", lambda *_, **__: addresses)
    before = time.monotonic()
    with pytest.raises(InputError, match="0.1 s, after 1 attempts"):
        HttpPolicy("http://a", 0.1, retries=0).control(camera(1, rng), 0)
    assert time.monotonic() - before < 0.4 and calls == [("192.0.2.0", 80)]


def test_local_servers_are_asked_without_proxies(served, rng, monkeypatch):
    monkeypatch.setattr("mi_nerfattack.policy.http.client.PAUSE_S", 0.01)
    url, image = served(handler(GOOD)[0]), camera(2, rng)
    monkeypatch.delenv("no_proxy")
    monkeypatch.setenv("http_proxy", "http://127.0.0.1:9")
    np.testing.assert_array_equal(HttpPolicy(url).control(image, 0), [0.5, -0.25])
    with HTTPServer(("127.0.0.1", 0), BaseHTTPRequestHandler) as server:
        url = f"http://127.0.0.1:{server.server_port}"
    with pytest.raises(InputError, match="refused.*after 3 attempts"):
        HttpPolicy(url).control(image, 0)
