"""Frames and messages of a VESC by its firmware's description, and a calibration."""

from __future__ import annotations

import random
import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.devices.vesc import frame

from mi_nerfattack.car.devices import Command
from mi_nerfattack.car.vesc import messages, timeout
from mi_nerfattack.car.vesc.calibration import (
    Calibration,
    read_calibration,
    write_calibration,
)
from mi_nerfattack.car.vesc.packet import LONGEST, FrameDecoder, encode_frame
from mi_nerfattack.errors import InputError

VECTORS = {
    "fw_version": (b"\0", "02 01 00 00 00 03"),
    "get_values": (messages.get_values(), "02 01 04 40 84 03"),
    "alive": (b"\x1e", "02 01 1e f3 ff 03"),
    "get_appconf": (b"\x11", "02 01 11 02 10 03"),
    "rpm": (messages.set_rpm(4614), "02 05 08 00 00 12 06 07 fa 03"),
    "rpm back": (messages.set_rpm(-4614), "02 05 08 ff ff ed fa ae 56 03"),
    "rpm zero": (messages.set_rpm(0), "02 05 08 00 00 00 00 02 2d 03"),
    "current": (b"\x06\0\0\0\0", "02 05 06 00 00 00 00 cd 85 03"),
    "brake": (messages.set_current_brake(5.0), "02 05 07 00 00 13 88 21 74 03"),
    "duty": (b"\x05\0\0\x27\x10", "02 05 05 00 00 27 10 ae 17 03"),
    "servo": (messages.set_servo_position(500), "02 03 0c 01 f4 e9 cb 03"),
    "servo centre": (messages.set_servo_position(530), "02 03 0c 02 12 21 70 03"),
    "forward": (b"\x22\x07\x04", "02 03 22 07 04 31 b5 03"),
    "selective": (
        messages.get_values("erpm", "input_voltage_v", "fault", "status"),
        "02 05 32 00 20 81 80 77 8a 03",
    ),
}


@pytest.mark.parametrize("name", VECTORS)
def test_vectors_both_ways(name):
    payload, text = VECTORS[name]
    assert encode_frame(payload) == bytes.fromhex(text)
    assert FrameDecoder().feed(bytes.fromhex(text)) == [payload]


@given(payload=st.binary(min_size=1, max_size=LONGEST), cut=st.integers(0, LONGEST))
def test_frames_of_every_length_in_two_pieces(payload, cut):
    raw = encode_frame(payload)
    assert raw == frame(payload)
    decoder = FrameDecoder()
    assert decoder.feed(raw[:cut]) + decoder.feed(raw[cut:]) == [payload]


# More than the longest reply of a loop, and one that needs a length of two bytes.
SIZES = (1, 1, 3, 5, 5, 21, 74, 300)


def streams(rng: random.Random, count: int) -> list[list[bytes]]:
    """Draw payloads of streams.

    They are few: what follows a byte within a payload makes a whole frame with a right
    checksum by chance, for one byte in 2^24, if damage puts a start before it.
    """
    sizes = [rng.choices(SIZES, k=5) for _ in range(count)]
    return [[rng.randbytes(size) for size in five] for five in sizes]


def damage(raw: bytearray, rng: random.Random) -> None:
    """Damage a frame so that a checksum of 16 bits must show it.

    One burst of up to 16 bits is flipped, or one to four bytes are lost or put in.
    """
    at, many = rng.randrange(len(raw)), rng.randint(1, 4)
    kind = rng.random()
    if kind < 0.5:
        bit = rng.randrange(8 * len(raw))
        burst = rng.randrange(1, 1 << min(16, 8 * len(raw) - bit)) | 1
        number = int.from_bytes(raw, "little") ^ burst << bit
        raw[:] = number.to_bytes(len(raw), "little")
    elif kind < 0.75:
        del raw[at : at + many]
    else:
        raw[at:at] = rng.randbytes(many)


def check_stream(payloads: list[bytes], frames: list[bytes], rng: random.Random):
    """Damage one of five frames; all but it and the next must come, and no other."""
    hurt = rng.randrange(4)
    broken = bytearray(frames[hurt])
    damage(broken, rng)
    raw = b"".join([*frames[:hurt], broken, *frames[hurt + 1 :]])
    decoder, cut = FrameDecoder(), rng.randrange(len(raw))
    decoded = decoder.feed(raw[:cut]) + decoder.feed(raw[cut:]) + decoder.flush()
    if decoded == payloads[:hurt] + payloads[hurt + 1 :]:
        return
    remaining = iter(payloads)
    assert all(payload in remaining for payload in decoded), (raw.hex(), cut)
    sure = payloads[:hurt] + payloads[hurt + 2 :]
    remaining = iter(decoded)
    assert all(payload in remaining for payload in sure), (raw.hex(), cut)


def check_noise(frames: list[bytes], rng: random.Random) -> None:
    """Overwrite bytes anywhere: whatever comes has stood there with its checksum."""
    raw = bytearray(b"".join(frames))
    for _ in range(rng.randint(1, 30)):
        raw[rng.randrange(len(raw))] = rng.getrandbits(8)
    decoder = FrameDecoder()
    for payload in decoder.feed(bytes(raw)) + decoder.flush():
        assert frame(payload) in raw
        messages.parse_values(payload)


@pytest.mark.parametrize(
    ("seed", "count"),
    [
        (0, 10_000),
        *(pytest.param(k, 100_000, marks=[pytest.mark.slow]) for k in range(1, 11)),
    ],
)
def test_damaged_streams(seed, count):
    rng = random.Random(seed)
    drawn = streams(rng, 50)
    framed = [[encode_frame(payload) for payload in payloads] for payloads in drawn]
    for index in range(count):
        choice = rng.randrange(len(drawn))
        if index % 10:
            check_stream(drawn[choice], framed[choice], rng)
        else:
            check_noise(framed[choice], rng)


def test_the_decoder_holds_no_more_than_a_frame():
    decoder = FrameDecoder()
    for _ in range(100):
        decoder.feed(b"\x03\x01\xff" * 1000)
        assert len(decoder._held) <= LONGEST + 6
    assert decoder.feed(bytes(LONGEST + 6) + encode_frame(b"\x04")) == [b"\x04"]


def whole_answer() -> bytes:
    """Return an answer to GET_VALUES by the offsets of the description."""
    raw = bytearray(74)
    raw[0] = 4
    fields = [
        (1, ">h", -123), (3, ">h", 456), (5, ">i", -2050), (9, ">i", 75),
        (23, ">i", -4614), (27, ">h", 158), (45, ">i", -700), (49, ">i", 900),
        (53, ">B", 5), (73, ">B", 3),
    ]  # fmt: skip
    for offset, kind, value in fields:
        struct.pack_into(kind, raw, offset, value)
    return bytes(raw)


VALUES = messages.Values(
    fet_temperature_c=-12.3,
    motor_temperature_c=45.6,
    motor_current_a=-20.5,
    input_current_a=0.75,
    erpm=-4614,
    input_voltage_v=15.8,
    tachometer=-700,
    tachometer_absolute=900,
    fault=5,
    status=3,
)


def test_values_by_length():
    raw = whole_answer()
    assert messages.parse_values(raw) == VALUES
    assert VALUES.has_timed_out and VALUES.is_killed
    older = messages.parse_values(raw[:73])
    assert older.status is None and older.has_timed_out is None and older.fault == 5
    assert older.is_killed is None
    assert messages.parse_values(raw[:26]) == messages.Values(-12.3, 45.6, -20.5, 0.75)
    assert messages.parse_values(raw[:1]) == messages.Values()


def test_selected_values():
    raw = struct.pack(">BIihBB", 50, 0x00208180, 4614, 157, 0, 1)
    values = messages.parse_values(raw)
    assert values == messages.Values(erpm=4614, input_voltage_v=15.7, fault=0, status=1)


@pytest.mark.parametrize(
    ("before_a", "after_a", "braked"),
    [
        ([0.0, 3.0], -20.0, True),
        ([0.2], -4.0, False),  # less than a quarter of 20 A
        ([0.2], 6.0, True),
        ([0.2, 5.0], 6.0, False),  # hardly more than what turned the wheels
        ([], 6.0, True),  # the timeout had fired before the first value
    ],
)
def test_a_current_that_brakes(before_a, after_a, braked):
    readings = [messages.Values(motor_current_a=value, status=0) for value in before_a]
    readings.append(messages.Values(motor_current_a=after_a, status=1))
    assert timeout._is_braked(readings, 20.0) is braked


def test_faults_have_names():
    names = {0: "none", 2: "under voltage", 18: "unbalanced currents", 77: "fault 77"}
    assert {number: messages.fault_name(number) for number in names} == names


def test_firmware_that_is_too_old_is_refused():
    tail = b"410\0" + bytes(14)
    firmware = messages.parse_firmware(b"\0\x06\x05" + tail)
    assert firmware == messages.Firmware(6, 5, "410") and "6.05" in str(firmware)
    assert messages.parse_firmware(b"\0\x03\x28").minor == 40
    with pytest.raises(InputError, match=r"firmware 3\.39 on 410; .*update it"):
        messages.parse_firmware(b"\0\x03\x27" + tail)
    with pytest.raises(InputError, match=r"cut short \(00 05\)"):
        messages.parse_firmware(b"\0\x05")


FINITE = st.floats(allow_nan=False, allow_infinity=False)


def test_the_defaults_are_those_of_the_car():
    calibration = Calibration()
    assert calibration.encode(Command(1.0, 0.0)) == (4614, 530)
    assert calibration.encode(Command(-1.0, 0.0)) == (-4614, 530)
    assert calibration.encode(Command(0.0, 0.2)) == (0, 288)  # 0.5304 - 1.2135 * 0.2
    assert calibration.encode(Command(0.2, 0.0)) == (923, 530)
    assert calibration.encode(Command(0.19, 0.0)) == (0, 530)  # it would only roll
    assert calibration.encode(Command(9.0, 1.0)) == (9228, 150)
    assert calibration.encode(Command(-9.0, -1.0)) == (-9228, 850)


@given(speed=FINITE, steering=FINITE, gain=st.sampled_from([-1.2135, 0.9]))
def test_what_is_sent_is_within_the_limits(speed, steering, gain):
    calibration = Calibration(servo_per_rad=gain, servo_least=0.2001, servo_most=0.7999)
    erpm, servo = calibration.encode(Command(speed, steering))
    assert erpm == 0 or 900 <= abs(erpm) <= 9228
    assert 201 <= servo <= 799
    decoded = calibration.decode(erpm, servo)
    if 0.196 < abs(speed) < 2:
        assert abs(decoded.speed_ms - speed) <= 0.5 / 4614 + 1e-12
    if abs(steering) < 0.25:
        assert abs(decoded.steering_rad - steering) <= 0.0005 / abs(gain) + 1e-12


def test_the_file_keeps_every_value(tmp_path):
    path = tmp_path / "car.toml"
    values = {"erpm_per_ms": 4587.25, "erpm_least": 600, "erpm_most": 12_000}
    values |= {"servo_per_rad": 1.1, "servo_centre": 0.47, "wheelbase_m": 0.25}
    values |= {"servo_least": 0.2, "servo_most": 0.7, "steering_most_rad": 0.3}
    values |= {"brake_current_a": 12.5, "timeout_ms": 200, "battery_least_v": 9.6}
    assert values.keys() == Calibration.model_fields.keys()
    write_calibration(path, Calibration(**values))
    assert read_calibration(path) == Calibration(**values)
    write_calibration(path, Calibration())  # without a wheelbase
    assert read_calibration(path) == Calibration()
    path.write_text("timeout_ms = 150\n")
    assert read_calibration(path) == Calibration(timeout_ms=150)
