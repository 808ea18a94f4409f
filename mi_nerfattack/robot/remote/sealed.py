"""Messages between a car and its policy, each under a seal that needs the key.

A message is a head, a body and the HMAC-SHA256 of both. The head names the kind, the
link (drawn by the car), the server's session (drawn by the server, zeros before the car
knows it) and a count, which rises: what was recorded of this link or another and is
sent again is told from what is new. Nothing is encrypted: who listens sees the images.

Of our own, because zenoh's user and password are asked by the side that is connected to
alone, and protect no message.
"""

from __future__ import annotations

import enum
import hashlib
import hmac
import ipaddress
import os
import secrets
import struct
from dataclasses import dataclass
from pathlib import Path

from mi_nerfattack.errors import InputError
from mi_nerfattack.io import files

_MAGIC = b"MNA1"
_HEAD = struct.Struct(">4sB16s16sQ")
_SEAL = hashlib.sha256().digest_size
NO_SESSION = bytes(16)
MAX_KEY_BYTES = 4096
MIN_KEY_BYTES = 16
_MAKE_KEY = (
    "make one with 'openssl rand -hex 32 > pilot.key; chmod 600 pilot.key', and copy "
    "it to the other side"
)
_NEEDS_KEY = f"without --key anybody there could steer: {_MAKE_KEY}"
DEFAULT_PORT = 7447


class Kind(enum.IntEnum):
    """What a message is; the car's first, then the server's."""

    HELLO = 1
    PING = 2
    FRAME = 3
    BYE = 4
    WELCOME = 11
    PONG = 12
    DECISION = 13
    FAILED = 14


_FROM_CAR = (Kind.HELLO, Kind.PING, Kind.FRAME, Kind.BYE)


@dataclass(frozen=True)
class Message:
    """A message whose seal was right.

    Attributes:
        kind: of it.
        link: 16 bytes, of the car.
        session: 16 bytes, of the server.
        count: higher than of those before it.
        body: the rest.
    """

    kind: Kind
    link: bytes
    session: bytes
    count: int
    body: bytes

    @property
    def is_from_car(self) -> bool:
        """Whether a car may say this."""
        return self.kind in _FROM_CAR


@dataclass(frozen=True)
class Endpoint:
    """Where a server listens.

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


class Sealer:
    """Seals and opens messages.

    Args:
        key: shared by both sides; empty on loopback alone.
    """

    def __init__(self, key: bytes) -> None:
        self._key = key

    @classmethod
    def at(cls, endpoint: Endpoint, key: bytes) -> Sealer:
        """Return one for a place to listen.

        Raises:
            InputError: it has no key, and not this computer alone gets there.
        """
        if not key and not endpoint.is_loopback:
            raise InputError(f"{endpoint}: is not this computer alone; {_NEEDS_KEY}")
        return cls(key)

    def seal(self, message: Message) -> bytes:
        """Return the bytes of a message."""
        head = message.kind, message.link, message.session, message.count
        text = _HEAD.pack(_MAGIC, *head) + message.body
        return text + hmac.digest(self._key, text, "sha256")

    def open(self, raw: bytes) -> Message | None:
        """Return the message; None where it is none, or its seal is wrong."""
        if len(raw) < _HEAD.size + _SEAL:
            return None
        text, seal = raw[:-_SEAL], raw[-_SEAL:]
        if not hmac.compare_digest(seal, hmac.digest(self._key, text, "sha256")):
            return None
        magic, kind, link, session, count = _HEAD.unpack_from(text)
        if magic != _MAGIC or kind not in set(Kind):
            return None
        return Message(Kind(kind), link, session, count, text[_HEAD.size :])


def draw_id() -> bytes:
    """Draw 16 bytes that nobody can guess."""
    return secrets.token_bytes(16)


def read_key(path: Path | None, endpoint: Endpoint) -> bytes:
    """Read the key that both sides share.

    Args:
        path: of the file; None without one.
        endpoint: where the server listens.

    Returns:
        the key; nothing on loopback without a file.

    Raises:
        InputError: another computer is meant, and there is no file; or it is too
            short, too long, or others may read it.
    """
    if path is None:
        Sealer.at(endpoint, b"")
        return b""
    key = files.read_bytes(path, MAX_KEY_BYTES).strip()
    if len(key) < MIN_KEY_BYTES:
        raise InputError(
            f"{path}: a key of {len(key)} bytes; at least {MIN_KEY_BYTES}: {_MAKE_KEY}"
        )
    if os.name == "posix" and path.stat().st_mode & 0o077:
        raise InputError(f"{path}: others may read the key; chmod 600 {path}")
    return key
