"""Addresses of servers, and the tokens that admit to them."""

from __future__ import annotations

import ipaddress
import os
import socket
import sys
import threading
import time
from contextlib import suppress
from dataclasses import dataclass
from http.server import ThreadingHTTPServer
from pathlib import Path
from typing import Any

from mi_nerfattack.errors import InputError
from mi_nerfattack.io import files

DEFAULT_PORT = 8000
_END_S = 10.0  # in which a handler must return when its server closes
_TOKEN_SIZES = 16, 4096  # bytes
_MAKE_TOKEN = (
    "make one with 'openssl rand -hex 32 > policy.token; chmod 600 policy.token', and "
    "copy it to the other computer"
)


@dataclass(frozen=True)
class Endpoint:
    """Address at which a server listens.

    Attributes:
        host: name or address.
        port: TCP.
    """

    host: str
    port: int

    @classmethod
    def parse(cls, text: str) -> Endpoint:
        """Read ``HOST``, ``HOST:PORT`` or ``[IPV6]:PORT``.

        Raises:
            InputError: it is something else.
        """
        host, _, port = text.rpartition(":")
        if ":" not in text or text.endswith("]"):
            host, port = text, str(DEFAULT_PORT)
        bracketed = host.startswith("[") and host.endswith("]")
        host = host[1:-1] if bracketed else host
        number = int(port) if port.isascii() and port.isdigit() else 0
        wrong = "/#? []" if bracketed else "/#? []:"
        if not host or not 0 < number < 1 << 16 or any(c in host for c in wrong):
            raise InputError(
                f"{text!r}: is no place to listen; give HOST:PORT, as 127.0.0.1:"
                f"{DEFAULT_PORT}, IPv6 in brackets"
            )
        return cls(host, number)

    @property
    def is_loopback(self) -> bool:
        """Whether nothing but this computer gets there."""
        try:
            return ipaddress.ip_address(self.host).is_loopback
        except ValueError:
            return self.host == "localhost"

    def __str__(self) -> str:
        host = f"[{self.host}]" if ":" in self.host else self.host
        return f"{host}:{self.port}"


class HttpServer(ThreadingHTTPServer):
    """Server with one thread for each connection.

    Args:
        endpoint: to listen at.
        handler: class that answers requests.

    Raises:
        InputError: it cannot listen there.
    """

    def __init__(self, endpoint: Endpoint, handler: Any) -> None:
        if ":" in endpoint.host:
            self.address_family = socket.AF_INET6
        self._connections: dict[Any, threading.Thread] = {}
        try:
            super().__init__((endpoint.host, endpoint.port), handler)
        except OSError as error:
            raise InputError(
                f"{endpoint}: cannot listen there ({error.strerror}); give another "
                "--listen"
            ) from error

    def process_request(self, request: Any, client_address: Any) -> None:
        """Start a thread for a connection."""
        thread = threading.Thread(
            target=self.process_request_thread,
            args=(request, client_address),
            daemon=True,
        )
        self._connections[request] = thread
        thread.start()

    def shutdown_request(self, request: Any) -> None:
        """Close a connection."""
        self._connections.pop(request, None)
        super().shutdown_request(request)

    def close(self) -> None:
        """Let go of the port, answer what came, and wait for the threads.

        A thread that Python ends at its own exit, while C++ calls it, aborts the
        process. A handler that does not return within `_END_S` is left behind.
        """
        self.server_close()
        connections = list(self._connections.items())
        for request, _ in connections:
            with suppress(OSError):  # the client has left
                request.shutdown(socket.SHUT_RD)
        end = time.monotonic() + _END_S
        for _, thread in connections:
            if thread.is_alive():  # Ctrl-C may come before its start
                thread.join(max(end - time.monotonic(), 0.0))

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Print no error of a client that has left."""
        if not isinstance(sys.exc_info()[1], ConnectionError):
            super().handle_error(request, client_address)


def read_token(path: Path) -> str:
    """Read a token from a file that nobody else may read.

    Raises:
        InputError: it is too short, too long, no printable ASCII without spaces, or
            other users may read the file.
    """
    least, most = _TOKEN_SIZES
    token = files.read_bytes(path, most).decode("latin-1").strip()
    if len(token) < least:
        raise InputError(
            f"{path}: a token of {len(token)} characters; at least {least}: "
            f"{_MAKE_TOKEN}"
        )
    if not all("!" <= character <= "~" for character in token):
        raise InputError(
            f"{path}: a token of other characters than printable ASCII; {_MAKE_TOKEN}"
        )
    if os.name == "posix" and path.stat().st_mode & 0o077:
        raise InputError(f"{path}: others may read the token; chmod 600 {path}")
    return token


def require_token(token: str, endpoint: Endpoint) -> None:
    """Refuse to listen without a token where other computers can connect.

    Raises:
        InputError: there is no token, and the address is not of this computer alone.
    """
    if not token and not endpoint.is_loopback:
        raise InputError(
            f"{endpoint}: is not this computer alone; without --token-file everybody "
            f"in the network could use the policy: {_MAKE_TOKEN}"
        )
