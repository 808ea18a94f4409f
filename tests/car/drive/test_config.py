"""The configuration of a drive: files, options, and what follows from them."""

from __future__ import annotations

import math
from datetime import datetime
from pathlib import Path

import numpy as np
import pytest

from mi_nerfattack.car.drive.config import read_config
from mi_nerfattack.car.drive.safety.fence import Fence
from mi_nerfattack.car.vesc.calibration import (
    Calibration,
    read_calibration,
    write_calibration,
)
from mi_nerfattack.errors import InputError
from mi_nerfattack.io import files


def test_options_come_before_the_file_whose_paths_start_from_its_folder(tmp_path):
    folder = tmp_path / "car"
    folder.mkdir()
    files.write_text(folder / "policy.toml", "")
    corners = "[[-3, -3], [3, -3], [3, 3], [-3, 3]]"
    files.write_text(folder / "fence.toml", f"points_m = {corners}")
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
    assert settings.judge.fence.holds(np.zeros((1, 2)))
    assert settings.limits.speed_ms == 0.4 and settings.speed_ms == 0.4


@pytest.mark.parametrize(
    ("name", "is_file"),
    [
        ("gone.toml", True),
        ("net.py:Net", True),
        ("expert_net.onnx", True),
        ("expert", False),
        ("http://10.0.0.2:8000", False),
        ("bundled:room.toml", False),
    ],
)
def test_a_policy_is_looked_for_in_the_folder_that_names_it(tmp_path, name, is_file):
    path = tmp_path / "drive.toml"
    files.write_text(path, f'policy = "{name}"')
    files.write_text(tmp_path / "expert", "")
    expected = str(tmp_path / name) if is_file else name
    assert read_config(path, {}).policy == expected


def test_the_command_line_undoes_what_the_file_says(tmp_path):
    path = tmp_path / "drive.toml"
    text = 'simulated = true\non_block = true\ncalibration = "racecar-j"\n'
    files.write_text(path, text)
    settings = ["simulated=false", "on_block=false"]
    config = read_config(path, {"simulated": None}, settings)
    assert not config.simulated and not config.on_block
    assert config.calibration == "racecar-j" and config.scales == Calibration()


def settings_of(config):
    return config.settings(config.read_route())


READERS = {
    "drive": lambda path: settings_of(read_config(path, {})),
    "fence": Fence.from_file,
    "car": read_calibration,
}


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("drive", "buton = 4", r"drive.toml.buton: unknown key; allowed: .*button"),
        ("drive", "speed_ms = -1.0", r"drive.toml.speed_ms: .*greater than 0"),
        ("drive", 'control_unit = "deg"', r"drive.toml.control_unit: .*'rad'"),
        ("drive", "speed_ms = [", "must be valid TOML"),
        ("drive", 'fence = "gone.toml"', "gone.toml: does not exist"),
        ("drive", 'route = "round"', "no route 'round'; it has 'square'"),
        ("fence", "points_m = [[0, 0], [1, 0]]", "at least 3 corners"),
        ("fence", "points_m = [[0, 0], [1, 0], [2, 0]]", "must enclose an area"),
        ("fence", "points_m = [[0, 0], [3, 1], [1, 0], [0, 2]]", "sides cross"),
        ("fence", "points_m = [[0, 0], [inf, 0], [1, 1]]", "must be finite"),
        ("fence", "points_m = 'x'", "needs corners"),
        ("fence", "points = [[0, 0], [1, 0], [1, 1]]", "needs points_m alone"),
        ("car", "timeout_ms = 149", r"timeout_ms: .* 150 \(is 149\)"),
        ("car", "timeout_ms = 1000", r"timeout_ms: .* 300 \(is 1000\)"),
        ("car", "brake_current_a = 0.0", r"brake_current_a: .* greater .*0\.0"),
        ("car", "erpm_per_ms = nan", "erpm_per_ms"),
        ("car", "servo_per_rad = 0.01", "servo_per_rad: 0.01: the servo hardly mo"),
        ("car", "servo_centre = 0.9", "servo_centre: 0.9 is not within 0.15 to 0.85"),
        ("car", "erpm_per_m = 4614.0", "erpm_per_m: unknown key; allowed: erpm_per_ms"),
        ("car", "erpm_least = 9228", "erpm_least: 9228 is not below erpm_most"),
        ("car", "erpm_most = '9'", r"erpm_most: .*integer \(is '9'\)"),
    ],
)
def test_files_that_say_something_wrong(tmp_path, name, text, message):
    path = tmp_path / f"{name}.toml"
    files.write_text(path, text)
    with pytest.raises(InputError, match=message) as caught:
        READERS[name](path)
    assert caught.value.where.startswith(str(tmp_path)) or "route" in text


def test_a_calibration_of_another_wheelbase_is_refused(tmp_path):
    path = tmp_path / "measured.toml"
    write_calibration(path, Calibration(timeout_ms=200, wheelbase_m=0.25))
    settings = {"calibration": str(path), "wheelbase_m": 0.25}
    scales = read_config(None, settings).scales
    assert (scales.wheelbase_m, scales.timeout_ms) == (0.25, 200)
    with pytest.raises(InputError, match=r"measured\.toml: .* 0\.25 m, .* is 0\.325;"):
        assert read_config(None, {"calibration": str(path)}).scales


REAL = {"calibration": "racecar-j", "tracker": "vicon:10.0.0.2"}
SLOW = {"policy": "p.toml", "speed_ms": 0.15}  # 900 / 4614 is 0.195 m/s
FAST = {"speed_ms": 3.0, "max_speed_ms": 3.0}
TOKEN = {"policy": "p.toml", "token_file": "t", "simulated": True}


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"calibration": "racecar-j"}, "tracker: none; give vicon:ADDRESS"),
        (REAL | {"tracker": "replay:a.mcap"}, "replay:a.mcap: a recording does not"),
        (REAL | {"camera": "video:a.mp4"}, "--on-block with"),
        (REAL | {"calibration": None}, "calibration: none; give"),
        (TOKEN, "token_file: t, and policy p.toml is no"),
        (TOKEN | {"policy": "expert"}, "token_file: t, and policy expert is no"),
        (SLOW, "speed_ms: 0.15; .* holds 0.2 to 2 m/s"),
        (FAST, "speed_ms: 3; .* holds 0.2 to 2 m/s"),
    ],
)
def test_drives_that_would_not_be_what_they_seem(settings, message):
    config = read_config(None, settings)
    with pytest.raises(InputError, match=message):
        settings_of(config)
        config.check()


def test_what_drives_a_car_or_none():
    for settings in (
        REAL,
        REAL | {"tracker": "replay:a.mcap", "on_block": True},
        {"policy": "expert", "simulated": True},
        TOKEN | {"policy": "http://10.0.0.2:8000"},
    ):
        read_config(None, settings).check()
    config = read_config(None, SLOW | {"simulated": True})
    assert settings_of(config).speed_ms == 0.15


@pytest.mark.parametrize("setting", ["policy.goal.count=0", "policy=b.onnx"])
def test_a_key_beside_its_option_is_refused(setting):
    with pytest.raises(InputError, match="--set policy: --policy gives it, too"):
        read_config(None, {"policy": "a.onnx"}, [setting])


@pytest.mark.parametrize(
    ("settings", "said", "expected"),
    [
        ({}, ("rad/s", None), ("rad/s", 0.325)),
        ({}, ("rad", 0.25), ("rad", 0.25)),
        ({"control_unit": "rad/s"}, (None, None), ("rad/s", 0.325)),
        ({"control_unit": "rad"}, ("rad/s", None), "'rad', and p.onnx says 'rad/s'"),
        ({"wheelbase_m": 0.3}, ("rad", 0.325), "wheelbase_m: 0.3, and .* 0.325"),
        ({}, (None, None), "nobody says in which unit p.onnx steers"),
    ],
)
def test_unit_and_wheelbase_are_those_of_the_policy(settings, said, expected):
    config = read_config(None, {"policy": "p.onnx"} | settings)
    if isinstance(expected, str):
        with pytest.raises(InputError, match=expected):
            config.driven_by(*said)
    else:
        driven = config.driven_by(*said)
        assert (driven.control_unit, driven.car.wheelbase) == expected


def test_defaults_fence_the_route_and_take_twice_the_largest_control():
    config = read_config(None, {})
    route = config.read_route()
    judge = config.settings(route).judge
    assert judge.fence.holds(route.points) and judge.max_control == 0.68
    assert not judge.fence.holds(route.points + [0.6, 0.0])
    rate = read_config(None, {"control_unit": "rad/s"}).settings(route).judge
    assert rate.max_control == pytest.approx(2 * math.tan(0.34) / 0.325)
    path = config.log_path(datetime(2026, 5, 4, 3, 2, 1))
    assert path == Path("runs/drives/20260504-030201.mcap")
