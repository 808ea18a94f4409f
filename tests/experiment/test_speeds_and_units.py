"""What `check` doubts: a blurred field, speeds that differ, units that nothing says."""

from __future__ import annotations

import re

import pytest

from mi_nerfattack.experiment.checks.before_attack import (
    fit_findings,
    speed_findings,
    unit_findings,
)
from mi_nerfattack.fields import load_field, save_field
from mi_nerfattack.scenario.scenario import load_scenario
from mi_nerfattack.scenario.world import build_world

pytestmark = pytest.mark.usefixtures("variant", "no_results")

CAR = """\
import drjit as dr

def car(state, control):
    _, _, theta, speed = state
    return speed * dr.cos(theta), speed * dr.sin(theta), control, speed - speed


def forced(state, control):
    *moved, _ = car(state, control[0])
    return *moved, control[1]


def commanded(state, control):
    theta = state[2]
    return control[1] * dr.cos(theta), control[1] * dr.sin(theta), control[0]
"""
CUSTOM = """[vehicle]
kind = "custom"
function = "car.py:car"
trust_code = true
state_size = 4
control_limit = 1.5
rest_state = [9.0]
"""
FORCED = CUSTOM.replace("car.py:car", "car.py:forced") + "controls = 2\n"
COMMANDED = """[vehicle]
kind = "custom"
function = "car.py:commanded"
trust_code = true
control_limit = 9.0
controls = 2
"""


@pytest.mark.parametrize(
    ("vehicle", "drive", "numbers"),
    [
        ("", "horizon = 4", []),
        ("[vehicle]\nspeed_ms = 8", "horizon = 4", ["8", "5", "4", "3.2", "4", "2.0"]),
        ("[vehicle]\nspeed_ms = 8", "length_m = 4", ["8", "5", "5", "4.0", "8", "4.0"]),
        (CUSTOM, "length_m = 4", ["9", "5", "8", "7.2", "8", "4.0"]),
        (FORCED, "length_m = 4", ["9", "5", "8", "7.2", "8", "4.0"]),
        (CUSTOM.replace("9.0", "5.0"), "length_m = 4", []),
        (COMMANDED, "length_m = 4", []),  # its state has no speed
    ],
)
def test_speeds_of_vehicle_and_route(scenario_folder, vehicle, drive, numbers):
    """Speeds, then periods and metres of a drive and of one at the route's speed."""
    (scenario_folder / "car.py").write_text(CAR)
    text = (scenario_folder / "scenario.toml").read_text()
    assert "horizon = 4" in text
    path = scenario_folder / "speeds.toml"
    if vehicle in (FORCED, COMMANDED):
        text = text.replace("[policy]", "[policy]\noutput = [0, 1]")
    path.write_text(text.replace("horizon = 4", drive) + vehicle)
    scenario, _ = load_scenario(path)
    message = " ".join(speed_findings(build_world(scenario, scenario.build_policy())))
    message = message.replace("routes.json", "").replace("'line'", "")
    assert re.findall(r"\d+(?:\.\d+)?", message) == numbers


@pytest.mark.parametrize(
    ("keys", "vehicle", "named"),
    [
        ("", "", []),  # PilotNet's file says it, and so does the vehicle's kind
        ("control_scale = 2.0", "", ["policy"]),
        ('control_scale = 2.0\ncontrol_unit = "rad/s"', "", []),
        ("", CUSTOM, ["vehicle"]),
        ("control_scale = 2.0", CUSTOM, ["policy", "vehicle"]),
        ("", f'{CUSTOM}control_unit = "rad/s"', []),
    ],
)
def test_units_that_nothing_says(scenario_folder, keys, vehicle, named):
    (scenario_folder / "car.py").write_text(CAR)
    text = (scenario_folder / "scenario.toml").read_text()
    path = scenario_folder / "units.toml"
    path.write_text(text.replace("[policy]", f"[policy]\n{keys}") + vehicle)
    scenario, _ = load_scenario(path)
    findings = list(unit_findings(build_world(scenario, scenario.build_policy())))
    keys = " and ".join(f"{name}.control_unit" for name in named)
    assert [line.partition(":")[0] for line in findings] == [keys] * bool(named)


@pytest.mark.parametrize(
    ("psnr", "doubted"), [("23.9", True), ("24.0", False), (None, False)]
)
def test_a_field_that_was_fitted_too_little_is_doubted(
    scenario_folder, tmp_path, psnr, doubted
):
    scene = load_field(scenario_folder / "scene.safetensors")
    scene.info |= {"fit.psnr_heldout_db": psnr} if psnr else {}
    save_field(tmp_path / "fitted.safetensors", scene)
    change = [f"scene.field={tmp_path / 'fitted.safetensors'}"]
    scenario, _ = load_scenario(scenario_folder / "scenario.toml", settings=change)
    findings = list(fit_findings(build_world(scenario, scenario.build_policy())))
    assert [f"{psnr} dB on average" in line for line in findings] == [True] * doubted
