"""The server that a browser asks, on this computer alone unless told."""

from __future__ import annotations

import io
import socket
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stdout
from typing import TYPE_CHECKING

from mi_nerfattack.errors import InputError
from mi_nerfattack.system.extras import load_extra

if TYPE_CHECKING:
    import viser

LOOPBACK = "127.0.0.1"


@contextmanager
def serving(host: str, port: int) -> Iterator[viser.ViserServer]:
    """Serve an empty scene.

    Args:
        host: name or address to listen at.
        port: 0 for any that is free; `get_port` of the server tells it.

    Raises:
        InputError: nothing can listen there, as where something else does.
        SetupError: viser cannot be imported.
    """
    module = load_extra("viser", "view", "the viewer")
    _check_free(host, port)
    with _quiet():
        server = module.ViserServer(host, port, verbose=False)
    try:
        if port not in (0, server.get_port()):  # taken meanwhile: it takes the next
            raise _taken(host, port, "in use")
        # The browser's button would open the scene to the world.
        server.request_share_url = lambda verbose=True: None
        server.gui.configure_theme(
            control_width="large", show_logo=False, show_share_button=False
        )
        yield server
    finally:
        with _quiet():
            server.stop()


def _check_free(host: str, port: int) -> None:
    """Listen as the server will, which waits for ever where it cannot."""
    try:
        for family, kind, proto, _, address in socket.getaddrinfo(
            host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE
        ):
            with socket.socket(family, kind, proto) as tried:
                tried.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
                tried.bind(address)
                tried.listen()
    except (OSError, OverflowError, UnicodeError) as err:
        raise _taken(host, port, getattr(err, "strerror", None) or str(err)) from err


def _taken(host: str, port: int, cause: str) -> InputError:
    return InputError(
        f"--host {host} --port {port}: cannot listen there ({cause}); give another "
        f"port, 0 for one that is free, and an address of this computer ({LOOPBACK})"
    )


def _quiet() -> redirect_stdout[io.StringIO]:
    """Keep what viser prints to itself; the command tells where it listens."""
    return redirect_stdout(io.StringIO())
