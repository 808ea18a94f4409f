"""What drive is told: files, options, and what follows from them."""

from __future__ import annotations

import math
from datetime import datetime
from pathlib import Path

import numpy as np
import pytest

from mi_nerfattack.errors import InputError
from mi_nerfattack.io import files
from mi_nerfattack.robot.drive.config import read_config
from mi_nerfattack.robot.vesc.calibration import Calibration, write_calibration


def test_options_come_before_the_file_whose_paths_start_from_its_folder(tmp_path):
    folder = tmp_path / "car"
    folder.mkdir()
    files.write_text(folder / "policy.toml", "")
    files.write_text(
        folder / "fence.toml", "points_m = [[-3, -3], [3, -3], [3, 3], [-3, 3]]"
    )
    files.write_text(
        folder / "drive.toml",
        'policy = "policy.toml"\nfence = "fence.toml"\nbutton = 4\nspeed_ms = 0.5\n'
        'camera = "video:seen.mp4"\ntracker = "replay:/logs/a.mcap"\n',
    )
    config = read_config(folder / "drive.toml", {"button": 7, "max_speed_ms": 0.4})
    assert config.policy == str(folder / "policy.toml") and config.button == 7
    assert config.camera == f"video:{folder / 'seen.mp4'}"
    assert config.tracker == "replay:/logs/a.mcap"
    plain = read_config(folder / "drive.toml", {"camera": "video:here.mp4"})
    assert plain.camera == "video:here.mp4"
    route = config.read_route()
    assert route.name == "square" and route.speed_ms == 0.4  # the limit
    settings = config.settings(route)
    np.testing.assert_array_equal(settings.judge.fence.points[2], (3.0, 3.0))
    assert settings.limits.speed_ms == 0.4 and settings.speed_ms == 0.4


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("buton = 4", r"drive.toml.buton: unknown key; allowed: .*button"),
        ("speed_ms = -1.0", r"drive.toml.speed_ms: .*greater than 0"),
        ("jpeg_quality = 96", r"drive.toml.jpeg_quality: .*less than or equal to 95"),
        ('control_unit = "deg"', r"drive.toml.control_unit: .*'rad'"),
        ("speed_ms = [", "must be valid TOML"),
        ('fence = "gone.toml"', "gone.toml: does not exist"),
        ('route = "round"', "no route 'round'; it has 'square'"),
    ],
)
def test_files_that_say_something_wrong(tmp_path, text, message):
    files.write_text(tmp_path / "drive.toml", text)
    with pytest.raises(InputError, match=message):
        config = read_config(tmp_path / "drive.toml", {})
        config.settings(config.read_route())


def test_a_calibration_of_another_wheelbase_is_refused(tmp_path):
    path = tmp_path / "car.toml"
    write_calibration(path, Calibration(timeout_ms=200))
    assert read_config(None, {"calibration": str(path)}).scales.timeout_ms == 200
    path = tmp_path / "measured.toml"
    write_calibration(path, Calibration(wheelbase_m=0.25))
    given = {"calibration": str(path), "wheelbase_m": 0.25}
    assert read_config(None, given).scales.wheelbase_m == 0.25
    with pytest.raises(InputError, match=r"measured\.toml: .* 0\.25 m, .* is 0\.325;"):
        assert read_config(None, {"calibration": str(path)}).scales


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({}, "--tracker: none; give vicon:ADDRESS"),
        ({"tracker": "replay:a.mcap"}, "replay:a.mcap: a recording does not see"),
        ({"tracker": "vicon:10.0.0.2", "camera": "video:a.mp4"}, "--on-block with"),
        (
            {"simulated": True, "policy": "expert", "control_unit": "rad/s"},
            "--control-unit rad/s: the expert steers in rad",
        ),
    ],
)
def test_drives_by_something_else_than_it_seems(given, message):
    with pytest.raises(InputError, match=message):
        read_config(None, given).check()


def test_what_drives_a_car_or_none():
    read_config(None, {"tracker": "vicon:10.0.0.2"}).check()
    read_config(None, {"tracker": "replay:a.mcap", "on_block": True}).check()
    read_config(None, {"policy": "expert", "simulated": True}).check()


def test_defaults_fence_the_route_and_take_twice_the_largest_control():
    config = read_config(None, {})
    route = config.read_route()
    judge = config.settings(route).judge
    assert judge.fence.holds(route.points) and judge.max_control == 0.68
    assert not judge.fence.holds(route.points + [0.6, 0.0])
    rate = read_config(None, {"control_unit": "rad/s"}).settings(route).judge
    assert rate.max_control == pytest.approx(2 * math.tan(0.34) / 0.325)
    assert config.log_path(datetime(2026, 5, 4, 3, 2, 1)) == Path(
        "runs/drives/20260504-030201.mcap"
    )


def test_a_speed_that_the_motor_does_not_hold_is_refused():
    given = {"policy": "p.toml", "speed_ms": 0.15}  # 900 / 4614 is 0.195 m/s
    config = read_config(None, given)
    with pytest.raises(InputError, match="speed_ms: 0.15; .* holds 0.2 m/s at least"):
        config.settings(config.read_route())
    config = read_config(None, given | {"simulated": True})
    assert config.settings(config.read_route()).speed_ms == 0.15
