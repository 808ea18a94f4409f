"""Zenoh between exactly two computers: one listens, the other connects."""

from __future__ import annotations

import json
import threading
from collections.abc import Callable
from contextlib import suppress
from typing import Any

from mi_nerfattack.errors import InputError
from mi_nerfattack.robot.devices import DeviceLostError
from mi_nerfattack.robot.remote.sealed import Endpoint
from mi_nerfattack.system.extras import load_extra

TO_POLICY, TO_CAR = "mi_nerfattack/to_policy", "mi_nerfattack/to_car"
#: Largest message that is looked at.
MAX_BYTES = 1 << 26
_CLOSE_S = 1.0  # zenoh waits for 10 s where the other side has stopped


class ZenohLink:
    """A connection on which bytes go both ways.

    The car waits until what it sends is on its way, and so knows when the network is
    slow; the server drops what finds no room. Nothing is searched for in the network,
    and nothing else connected to.

    Args:
        endpoint: of the server.
        listens: whether this side is the server.
        on_bytes: called with what arrives, by a thread of zenoh's.
        timeout_s: longest wait for the connection.

    Raises:
        InputError: it cannot listen there.
        DeviceLostError: nobody listens there.
        SetupError: zenoh is not installed.
    """

    def __init__(
        self,
        endpoint: Endpoint,
        listens: bool,
        on_bytes: Callable[[bytes], None],
        timeout_s: float = 5.0,
    ) -> None:
        zenoh = load_extra("zenoh", "remote", "a policy on another computer")
        place = [f"tcp/{endpoint}"]
        config = zenoh.Config()
        for key, value in {
            "mode": "peer",
            "listen/endpoints": place if listens else [],
            "connect/endpoints": [] if listens else place,
            "connect/timeout_ms": round(1e3 * timeout_s),
            "connect/exit_on_failure": True,
            "scouting/multicast/enabled": False,
            "scouting/gossip/enabled": False,
            "transport/shared_memory/enabled": False,
        }.items():
            config.insert_json5(key, json.dumps(value))
        try:
            self._session: Any = zenoh.open(config)
        except zenoh.ZError as error:
            reason = str(error).partition(" at /")[0]
            if listens:
                raise InputError(
                    f"--listen {endpoint}: {reason}; end what listens there, or choose "
                    "another address of this computer or port"
                ) from error
            raise DeviceLostError(
                f"policy at {endpoint}: {reason}; start 'mi-nerfattack car serve' "
                "there, and look to address, port and firewall"
            ) from error

        def received(sample: Any) -> None:
            if len(sample.payload) <= MAX_BYTES:
                on_bytes(sample.payload.to_bytes())

        there, here = (TO_CAR, TO_POLICY) if listens else (TO_POLICY, TO_CAR)
        self._subscriber = self._session.declare_subscriber(here, received)
        control = zenoh.CongestionControl
        self._publisher = self._session.declare_publisher(
            there,
            congestion_control=control.DROP if listens else control.BLOCK,
            express=True,
        )
        self._error: type[Exception] = zenoh.ZError

    def send(self, raw: bytes) -> None:
        """Send; nothing is raised where nobody listens.

        The server's are dropped after a millisecond; the car's may wait for 5 s.
        """
        with suppress(self._error):
            self._publisher.put(raw)

    def close(self, farewell: bytes | None = None) -> None:
        """End the connection, within a second; more than once does no harm.

        Args:
            farewell: sent before.
        """

        def end() -> None:
            if farewell is not None:
                self.send(farewell)
            with suppress(self._error):
                self._session.close()

        thread = threading.Thread(target=end, daemon=True)
        thread.start()
        thread.join(_CLOSE_S)
