"""The object stream against a sender of its own: the right pose, or none."""

from __future__ import annotations

import math
import random
import struct

import numpy as np
import pytest
from fuzz.mutations import number_bytes, of_bytes
from scipy.spatial.transform import Rotation
from support.devices.car import FIRST, ITEM_BYTES, NUMBERS, datagrams, item_bytes

from mi_nerfattack.car.tracker.object_stream import ObjectStream, read_datagram
from mi_nerfattack.errors import InputError

SIZES = 256, 512, 1024
BODIES = [f"body{number}" for number in range(14)]


def scene(frame: int, count: int = 14):
    """Bodies on circles: names, millimetres and radians."""
    angle = 0.01 * (frame % 600)
    return [
        (name, [1e3 * math.cos(angle), 100.0 * k, 50.0], [0.0, 0.0, angle])
        for k, name in enumerate(BODIES[:count])
    ]


def check(stream: ObjectStream, name: str, frame: int) -> None:
    """Check that the newest pose is that of a frame."""
    pose, k, angle = stream.newest(name), BODIES.index(name), 0.01 * (frame % 600)
    assert pose is not None and pose.index == frame
    cosine, sine = math.cos(angle), math.sin(angle)
    rows = [cosine, -sine, 0, cosine], [sine, cosine, 0, 0.1 * k]
    expected = [*rows, [0, 0, 1, 0.05], [0, 0, 0, 1]]
    assert pose.body_to_world == pytest.approx(np.array(expected), abs=1e-12)


def test_the_documented_bytes_are_read():
    item = item_bytes(("racecar", [1000, 0, 0], [0, 0, 0]))
    head = bytes.fromhex("e8 03 00 00 02 00 48 00 72 61 63 65 63 61 72 00")
    raw = head + item[11:] + item_bytes(("cube", [0, 0, -1], [0, 0, 0]))
    assert len(raw) == 155
    block = read_datagram(raw.ljust(256, b"\0"))
    assert block.frame == 1000
    assert block.objects == {
        "racecar": (1000, 0, 0, 0, 0, 0),
        "cube": (0, 0, -1, 0, 0, 0),
    }


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("padding", [b"\0", b"\xff\x00\x48\x00body1\0"])
def test_frames_of_any_number_of_bodies_are_merged(size, padding):
    stream = ObjectStream()
    for frame, count in enumerate((0, 1, 2, 3, 4, 6, 7, 13, 14), 1):
        for k, raw in enumerate(datagrams(frame, scene(frame, count), size, padding)):
            assert len(raw) == size
            assert stream.take(raw, frame + 0.001 * k)
        for name in BODIES[:count]:
            check(stream, name, frame)
            pose = stream.newest(name)
            assert pose is not None and pose.time_s == frame  # of the first block
    assert stream.newest("body") is None


def test_items_are_stepped_over_by_their_own_size():
    other = struct.pack("<BH", 7, 30) + bytes(30)
    longer = struct.pack("<BH", 0, 80) + item_bytes(scene(5)[1])[3:] + bytes(8)
    first = item_bytes(scene(5)[0])
    raw = struct.pack("<IB", 5, 3) + other + longer + first
    stream = ObjectStream()
    assert stream.take(raw.ljust(256, b"\0"), 0.0)
    check(stream, "body0", 5)
    assert stream.newest("body1") is None


@pytest.mark.parametrize("length", [0, 4, 5, 155, 255, 257, 1500])
def test_datagrams_of_other_sizes_are_none(length):
    stream = ObjectStream()
    assert not stream.take(datagrams(1, scene(1), 1024)[0].ljust(1500)[:length], 0.0)
    assert f"{length} bytes" in stream.explain("body0")


def test_a_lost_body_keeps_its_last_time():
    stream = ObjectStream()
    for frame in range(1, 21):
        # seen until frame 10, then repeated, as Tracker does
        items = [scene(min(frame, 10), 1)[0], scene(frame, 2)[1]]
        stream.take(datagrams(frame, items)[0], float(frame))
    lost, visible = stream.newest("body0"), stream.newest("body1")
    assert lost is not None and visible is not None
    assert (lost.time_s, visible.time_s) == (13, 20)  # three repetitions count
    assert "repeats bit for bit" in stream.explain("body0")
    stream.take(datagrams(21, scene(21, 2))[0], 21.0)
    check(stream, "body0", 21)
    # zeros, and not in the frame at all
    stream.take(datagrams(22, [("body0", [0, 0, 0], [0, 0, 0])])[0], 22.0)
    assert "does not see" in stream.explain("body0")
    check(stream, "body0", 21)
    check(stream, "body1", 21)
    assert "frame 21 of 22" in stream.explain("body1")
    assert "body0, body1, not 'car'" in stream.explain("car")
    stream.take(datagrams(23, [("body1", [0, math.nan, 0], [0, 0, 0])])[0], 23.0)
    assert "not finite" in stream.explain("body1")
    check(stream, "body1", 21)


def test_late_and_doubled_frames_are_dropped():
    stream, rng = ObjectStream(), random.Random(1)
    order = list(range(1, 200)) + [rng.randrange(1, 200) for _ in range(50)]
    order.sort(key=lambda frame: frame + rng.uniform(0, 5))
    newest = 0
    for count, frame in enumerate(order):
        newest = max(newest, frame)
        for raw in rng.sample(blocks := datagrams(frame, scene(frame, 4)), len(blocks)):
            stream.take(raw, 0.01 * count)
        check(stream, "body0", newest)
        check(stream, "body3", newest)


def test_a_restart_of_tracker_is_followed():
    stream = ObjectStream()
    stream.take(datagrams(70000, scene(70000, 1))[0], 0.0)
    for frame in range(100):
        stream.take(datagrams(frame, scene(frame, 1))[0], 0.02 * (frame + 1))
        pose = stream.newest("body0")
        assert pose is not None
        if frame < 24:
            assert (pose.index, pose.time_s) == (70000, 0.0)
        else:
            check(stream, "body0", frame)


def mutate(rng: random.Random, raw: bytes) -> bytes:
    """Damage a datagram anywhere, more often where its structure is."""
    if rng.random() < 0.5:
        return of_bytes(rng, raw)
    data = bytearray(raw)
    start = FIRST + ITEM_BYTES * rng.randrange(len(raw) // ITEM_BYTES)
    at = rng.choice((0, 4, start, start + 1, start + 2, start + 3, start + NUMBERS))
    if rng.random() < 0.5:
        data[at] = rng.choice((0, 1, 2, 71, 73, 75, 147, 150, 255))
    else:
        data[at : at + 4] = (number_bytes(rng) * 4)[:4]
    return bytes(data[: len(raw)])


@pytest.mark.parametrize("count", [6000, pytest.param(100_000, marks=pytest.mark.slow)])
def test_damaged_datagrams_give_the_right_pose_or_none(count):
    rng, changed, accepted = random.Random(2), 0, 0
    for number in range(count):
        size = SIZES[number % 3]
        frame = rng.randrange(1 << 32)
        items = scene(frame, rng.choice((1, 2, 3, 4, 14)))
        stream, sent = ObjectStream(), rng.choice(datagrams(frame, items, size))
        damaged = mutate(rng, sent)
        stream.take(damaged, 0.0)
        changed += damaged != sent
        # where Tracker put each body, and what stands there, if it is still there
        starts = [FIRST + ITEM_BYTES * place for place in range(sent[4])]
        names = [damaged[at + 3 : at + 27].split(b"\0")[0] for at in starts]
        for name in BODIES:
            pose = stream.newest(name)
            if pose is None:
                continue
            at = starts[names.index(name.encode())] + NUMBERS
            *place_mm, a, b, c = struct.unpack_from("<6d", damaged, at)
            assert pose.body_to_world[:3, 3].tolist() == [1e-3 * v for v in place_mm]
            turned = Rotation.from_euler("XYZ", (a, b, c)).as_matrix()
            assert pose.body_to_world[:3, :3] == pytest.approx(turned, abs=1e-9)
            assert pose.index == struct.unpack_from("<I", damaged)[0]
            accepted += 1
    assert changed > 0.9 * count and accepted > 0.3 * count


def test_a_rotation_vector_turns_about_itself():
    stream = ObjectStream("rotation-vector")
    third = 2 * math.pi / 3 / math.sqrt(3)  # a third of a turn permutes the axes
    stream.take(datagrams(1, [("car", [1, 2, 3], [third] * 3)])[0], 0.0)
    pose = stream.newest("car")
    assert pose is not None
    expected = np.array([[0, 0, 1], [1, 0, 0], [0, 1, 0]])
    assert pose.body_to_world[:3, :3] == pytest.approx(expected, abs=1e-12)
    with pytest.raises(InputError, match="euler, rotation-vector"):
        ObjectStream("quaternion")  # pyright: ignore[reportArgumentType]
