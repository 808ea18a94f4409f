"""The calibration of a car's motor and servo: its file, its limits."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from mi_nerfattack.errors import InputError
from mi_nerfattack.robot.devices import Command
from mi_nerfattack.robot.vesc.calibration import (
    Calibration,
    read_calibration,
    write_calibration,
)

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
    told = calibration.decode(erpm, servo)
    if 0.196 < abs(speed) < 2:
        assert abs(told.speed_ms - speed) <= 0.5 / 4614 + 1e-12
    if abs(steering) < 0.25:
        assert abs(told.steering_rad - steering) <= 0.0005 / abs(gain) + 1e-12


def test_the_file_keeps_every_value(tmp_path):
    path = tmp_path / "car.toml"
    calibration = Calibration(
        erpm_per_ms=4587.25,
        servo_per_rad=1.1,
        servo_centre=0.47,
        servo_least=0.2,
        servo_most=0.7,
        erpm_least=600,
        erpm_most=12_000,
        steering_most_rad=0.3,
        brake_current_a=12.5,
        timeout_ms=200,
        wheelbase_m=0.25,
    )
    write_calibration(path, calibration)
    assert read_calibration(path) == calibration
    path.write_text("timeout_ms = 150\n")
    assert read_calibration(path) == Calibration(timeout_ms=150)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("timeout_ms = 1000", r"car\.toml\.timeout_ms: .* 300 \(is 1000\)"),
        ("brake_current_a = 0.0", r"brake_current_a: .* greater .* \(is 0\.0\)"),
        ("erpm_per_ms = nan", "erpm_per_ms"),
        ("servo_per_rad = 0.01", "servo_per_rad: 0.01: the servo hardly moves"),
        ("servo_centre = 0.9", "servo_centre: 0.9 is not within 0.15 to 0.85"),
        ("erpm_per_m = 4614.0", "erpm_per_m: unknown key; allowed: erpm_per_ms, "),
        ("erpm_least = 9228", "erpm_least: 9228 is not below erpm_most"),
        ("erpm_most = '9'", r"erpm_most: .*integer \(is '9'\)"),
        ("erpm_most = ", "valid TOML"),
    ],
)
def test_files_that_are_refused(tmp_path, text, message):
    path = tmp_path / "car.toml"
    path.write_text(text)
    with pytest.raises(InputError, match=message):
        read_calibration(path)
