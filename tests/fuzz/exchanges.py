"""Requests to the server of a policy, and answers to its client, that are fuzzed.

Both sides run in this process. Each gets the bytes of a file,
and then the end of the connection.
"""

from __future__ import annotations

import json
import re
import socket
import threading
from collections.abc import Callable
from contextlib import closing, suppress
from pathlib import Path
from typing import Any

import numpy as np

TOKEN = "0123456789abcdef"
_SECONDS = 5.0
_STATUS = re.compile(rb"HTTP/1\.[01] ([0-9]{3}) ")
Targets = list[tuple[Path, Callable[[Path], Any]]]


def requests(folder: Path) -> Targets:
    """Requests with a token and an image, which a policy answers."""
    from support.faults.injected import free_port

    from mi_nerfattack.io.network import Endpoint
    from mi_nerfattack.policy.black_box import CallablePolicy
    from mi_nerfattack.policy.http import server as http_server

    policy = CallablePolicy(lambda image, goal, step: image.mean((1, 2, 3)), "mean")
    server = http_server.PolicyServer(Endpoint("127.0.0.1", free_port()), policy, TOKEN)
    rng = np.random.default_rng(0)
    floats = rng.random((2, 3, 4, 5), np.float32)
    images = {"floats": floats, "bytes": (255 * floats).astype(np.uint8)}
    for name, image in images.items():
        np.save(folder / f"{name}.npy", image)
        body = (folder / f"{name}.npy").read_bytes()
        head = (
            f"POST /policy HTTP/1.1\r\nHost: a\r\nAuthorization: Bearer {TOKEN}\r\n"
            f"Content-Type: application/x-npy\r\nContent-Length: {len(body)}\r\n"
            "X-Client: 1f\r\nX-Goal: 0,1\r\nX-Step: 0\r\n\r\n"
        )
        (folder / f"{name}.http").write_bytes(head.encode() + body)

    def read(path: Path) -> None:
        raw, decisions = path.read_bytes(), server.figures()["decisions"]
        ours, theirs = _connected()
        with closing(ours), closing(theirs):
            ours.settimeout(_SECONDS)
            _send(ours, raw)
            http_server._Handler(theirs, ("127.0.0.1", 1), server)
            theirs.close()
            answer = b""
            with suppress(ConnectionResetError):  # of what nobody read
                while part := ours.recv(1 << 16):
                    answer += part
        status = _STATUS.match(answer)
        # without a protocol of its own the request gets a page, and no status line
        assert status or not answer or answer.startswith(b"<!DOCTYPE"), answer[:80]
        if server.figures()["decisions"] > decisions:
            assert TOKEN.encode() in raw, "a decision without the token"
            body = answer.partition(b"\r\n\r\n")[2].decode("latin-1")
            control = json.JSONDecoder().raw_decode(body)[0]["control"]
            assert np.isfinite(control).all()
        if status and status[1] == b"500":
            raise AssertionError(answer[:200])

    return [(folder / f"{name}.http", read) for name in images]


def answers(folder: Path) -> Targets:
    """Answers, with and without a length or chunks, which the client reads."""
    from mi_nerfattack.policy.http.client import PolicyClient

    body = b'{"control": [0.25, -1e-3], "more": null}'
    heads = {
        "length": b"Content-Type: application/json\r\nContent-Length: %d" % len(body),
        "end": b"Connection: close",
        "chunks": b"Transfer-Encoding: chunked",
    }
    for name, head in heads.items():
        pieces = body[:9], len(body) - 9, body[9:]
        chunks = b"9\r\n%s\r\n%x;a=b\r\n%s\r\n0\r\n\r\n" % pieces
        raw = b"HTTP/1.1 200 OK\r\n" + head + b"\r\n\r\n"
        raw += chunks if name == "chunks" else body
        (folder / f"{name}.http").write_bytes(raw)
    image = np.zeros((2, 3, 4, 5), np.float32)

    def read(path: Path) -> None:
        client = PolicyClient("http://127.0.0.1:1", timeout_s=_SECONDS, retries=0)
        ours, theirs = _connected()
        with closing(ours), closing(theirs):
            _send(theirs, path.read_bytes())
            client._http.sock = client._socket = ours
            # the connection is no new one: the client would connect again
            client._connect = _lost
            controls = client.ask(image, [0, 1], 0)
        assert controls.dtype == np.float64

    return [(folder / f"{name}.http", read) for name in heads]


def _send(sock: socket.socket, raw: bytes) -> None:
    """Send bytes, then the end, while the other side reads: a buffer may fill."""

    def send() -> None:
        with suppress(OSError):  # the other side ended the connection
            sock.sendall(raw)
            sock.shutdown(socket.SHUT_WR)

    threading.Thread(target=send, daemon=True).start()


def _connected() -> tuple[socket.socket, socket.socket]:
    with socket.create_server(("127.0.0.1", 0)) as listening:
        ours = socket.create_connection(listening.getsockname())
        return ours, listening.accept()[0]


def _lost(end: float) -> socket.socket:
    del end
    raise ConnectionRefusedError("nobody listens")
