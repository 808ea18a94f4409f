"""Seals, clocks, frames and places to listen, without a network."""

from __future__ import annotations

import numpy as np
import pytest

from mi_nerfattack.errors import InputError
from mi_nerfattack.robot.devices import Frame
from mi_nerfattack.robot.remote.frames import check_frame, pack_frame, unpack_frame
from mi_nerfattack.robot.remote.offset import ClockOffset
from mi_nerfattack.robot.remote.sealed import (
    Endpoint,
    Kind,
    Message,
    Sealer,
    draw_id,
    read_key,
)

KEY = b"0123456789abcdef"


def test_seals():
    message = Message(Kind.FRAME, draw_id(), draw_id(), 7, b"an image")
    raw = Sealer(KEY).seal(message)
    assert Sealer(KEY).open(raw) == message and message.is_from_car
    assert not Message(Kind.DECISION, draw_id(), draw_id(), 7, b"").is_from_car
    for key in (b"", KEY[:-1], KEY + b"0"):
        assert Sealer(key).open(raw) is None
    for place in range(len(raw)):
        for bit in (1, 128):
            changed = bytearray(raw)
            changed[place] ^= bit
            assert Sealer(KEY).open(bytes(changed)) is None
    for length in range(len(raw)):
        assert Sealer(KEY).open(raw[:length]) is None


def test_offset_by_hand():
    """Ways of 5 and 5 s, 2 and 8, 1 and 1 to a clock that is 100 s ahead."""
    clock = ClockOffset(window_s=50)
    assert clock.best is None
    for t0, there, back, ahead, error in (
        (0, 2, 8, 97, 5),  # half of the difference of the ways is wrong
        (20, 5, 5, 100, 5),
        (40, 1, 1, 100, 1),
        (60, 3, 3, 100, 1),  # the least round trip stays the best
        (95, 4, 4, 100, 3),  # but for the window: 40 is too old at 104
    ):
        sent = t0 + there + 100
        clock.add(t0, sent, sent + 1, t0 + there + 1 + back)
        assert clock.best is not None
        if t0 != 20:
            assert clock.best.ahead_s == ahead and clock.best.error_s == error
    best = clock.best
    clock.add(110, 230, 229, 120)  # the other clock runs backwards
    clock.add(110, 230, 290, 120)  # longer at the other side than away from here
    clock.add(110, 210, 211, 109)  # back before it was sent
    assert clock.best is best


def test_frames():
    image = np.random.default_rng(1).integers(0, 256, (6, 10, 3), dtype=np.uint8)
    body = pack_frame(Frame(image, 5.5, 42), 100.0, None)
    found = unpack_frame(body).decode()
    assert np.array_equal(found.image, image)
    assert (found.time_s, found.index) == (105.5, 42)
    smooth = np.full((16, 16, 3), [10, 120, 240], np.uint8)
    sent = unpack_frame(pack_frame(Frame(smooth, 0.0, 1), 0.0, 90))
    assert sent.is_jpeg and len(sent.data) < smooth.nbytes
    assert np.abs(sent.decode().image.astype(int) - smooth).max() <= 3
    for wrong, message in (
        (unpack_frame(body[:-1]), "frame 42: 179 bytes, said to be 6 x 10"),
        (unpack_frame(body[:-180]), "frame 42: 0 bytes"),
    ):
        with pytest.raises(InputError, match=message):
            wrong.decode()
    for image, message in (
        (np.zeros((4, 4), np.uint8), r"frame 1: uint8 \(4, 4\)"),
        (np.zeros((4, 4, 3)), "frame 1: float64"),
        (np.zeros((4, 0, 3), np.uint8), "frame 1: 0 x 4 px; from 1 to 16777216"),
    ):
        with pytest.raises(InputError, match=message):
            check_frame(Frame(image, 0.0, 1))


def test_places_to_listen():
    for text, host, port, own in (
        ("localhost", "localhost", 7447, True),
        ("127.0.0.5:80", "127.0.0.5", 80, True),
        ("[::1]:80", "::1", 80, True),
        ("[::]", "::", 7447, False),
        ("0.0.0.0:1", "0.0.0.0", 1, False),
        ("car.local:9000", "car.local", 9000, False),
    ):
        found = Endpoint.parse(text)
        assert (found.host, found.port, found.is_loopback) == (host, port, own)
        assert Endpoint.parse(str(found)) == found
    for text in ("", ":80", "a:b", "a:0", "a:65536", "a:-1", "a:1:2", "a b", "a/b:1"):
        with pytest.raises(InputError, match="is no place to listen"):
            Endpoint.parse(text)


def test_keys(tmp_path):
    here, there = Endpoint("127.0.0.1", 80), Endpoint("0.0.0.0", 80)
    assert read_key(None, here) == b""
    with pytest.raises(
        InputError, match="0.0.0.0:80: is not this computer alone; without --key"
    ):
        read_key(None, there)
    path = tmp_path / "key"
    path.write_bytes(KEY + b"\n")
    path.chmod(0o644)
    with pytest.raises(InputError, match="others may read the key; chmod 600"):
        read_key(path, there)
    path.chmod(0o600)
    assert read_key(path, there) == KEY == read_key(path, here)
    path.write_bytes(KEY[1:])
    with pytest.raises(InputError, match="a key of 15 bytes; at least 16"):
        read_key(path, there)
    with pytest.raises(InputError, match="does not exist"):
        read_key(tmp_path / "none", there)
