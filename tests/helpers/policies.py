"""Policies of a scenario file, images for them, and servers that live a test long."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import mitsuba as mi
import numpy as np

from mi_nerfattack.scenario.policy import load_policy


def policy_of(folder, **keys):
    """Load the policy of a section whose code is trusted."""
    return load_policy({"trust_code": True} | keys, folder)


def camera(n, rng):
    """Return random images of n vehicles."""
    return mi.TensorXf(rng.random((n, 66, 200, 3), dtype=np.float32))


@contextmanager
def serving() -> Iterator[Callable[[type[BaseHTTPRequestHandler]], str]]:
    """Give a function that serves with a handler and returns the URL."""
    servers = []

    def start(handler: type[BaseHTTPRequestHandler]) -> str:
        handler.log_message = lambda *_: None
        server = ThreadingHTTPServer(("127.0.0.1", 0), handler)
        poll_s = (0.01,)  # how often it looks for its end, which a test waits for
        serve = threading.Thread(target=server.serve_forever, args=poll_s, daemon=True)
        serve.start()
        servers.append(server)
        return f"http://127.0.0.1:{server.server_port}"

    yield start
    for server in servers:
        server.shutdown()
        server.server_close()
