"""Policies, scenarios and vehicles that the command evaluates."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest
from helpers.painted_place import ROUTES, SCENE, make_place, with_policy
from helpers.scenario_text import HEAD, write_named_files

from mi_nerfattack import cli
from mi_nerfattack.deploy.registry import make_environment
from mi_nerfattack.evaluation import work as evaluate_work
from mi_nerfattack.io import files
from mi_nerfattack.policy.pilotnet import PilotNet

pytestmark = pytest.mark.usefixtures("variant")


@pytest.fixture
def place(tmp_path, monkeypatch) -> list[str]:
    return make_place(tmp_path, monkeypatch)


@pytest.mark.parametrize(
    ("policy", "message"),
    [
        ("nothing.safetensors", "nothing.safetensors: does not exist"),
        ("nothing.toml", "nothing.toml: does not exist"),
        ("empty.toml", "empty.toml: has no section [policy]"),
        ("key.toml", "key.toml: policy.colour"),
        ("small.py:Small", "small.py:Small: fails on an input of shape"),
        ("drawn.py:Drawn", "drawn.py:Drawn: its weights are random"),
        ("nan.py:Bad", "it must be finite"),
        ("noise.bin", "its suffix tells no kind"),
        ("noise.safetensors", "noise.safetensors"),
    ],
)
def test_policies_that_do_not_fit_are_one_message(place, capsys, policy, message):
    Path("empty.toml").write_text("[scene]\n")
    Path("key.toml").write_text('[policy]\nfile = "still.py:drive"\ncolour = "red"\n')
    Path("small.py").write_text(  # for images of 66 x 100 pixels
        "import torch\nfrom torch import nn\n\n\ndef Small():\n"
        "    torch.manual_seed(0)\n"
        "    return nn.Sequential(nn.Flatten(), nn.Linear(3 * 66 * 100, 1))\n"
    )
    Path("drawn.py").write_text(
        "from torch import nn\n\n\ndef Drawn():\n"
        "    return nn.Sequential(nn.Flatten(), nn.Linear(3 * 66 * 200, 1))\n"
    )
    Path("nan.py").write_text(
        "from torch import nn\n\n\nclass Bad(nn.Module):\n"
        "    def forward(self, image):\n"
        "        return image.mean((1, 2, 3)) * float('nan')\n"
    )
    Path("noise.bin").write_bytes(b"noise")
    Path("noise.safetensors").write_bytes(b"noise")
    place = with_policy(policy, place)
    place += ["--trust-code"] * policy.endswith((":Small", ":Drawn", ":Bad"))
    assert cli.main(place) == 2
    errors = capsys.readouterr().err
    assert message in errors and "Traceback" not in errors
    assert not Path("runs").exists()


def test_a_policy_of_another_unit_is_refused(capsys, tmp_path, monkeypatch):
    """The bundled policy gives heading rates, the room's car takes angles."""
    monkeypatch.chdir(tmp_path)
    room = ["evaluate", "--place", "room", "--environments", "mitsuba"]
    assert cli.main(room) == 2
    assert "gives rad/s, the car of the place takes rad" in capsys.readouterr().err


def test_the_experts_camera_suits_every_environment():
    """CARLA's cameras have square pixels."""
    camera = evaluate_work._EXPERT_CAMERA
    assert camera.fx == camera.fy


def test_a_toml_file_says_how_the_policy_is_called(place, capsys):
    Path("mine.toml").write_text(
        '[policy]\nkind = "callable"\nfile = "still.py:drive"\ntrust_code = true\n'
        "[policy.preprocess]\nresize_px = [10, 5]\n"
    )
    place = with_policy("mine.toml", place)
    assert cli.main([*place, "--json", "--horizon", "2"]) == 0
    assert (
        json.loads(capsys.readouterr().out)["mitsuba"]["straight"]["no_object"]["n"]
        == 2
    )
    assert cli.main([*place, "--goals", "3"]) == 2
    assert "mine.toml: says itself" in capsys.readouterr().err


def test_a_toml_file_can_bring_the_policy_s_camera(place, capsys):
    text = '[policy]\nfile = "seen.py:drive"\nkind = "callable"\ntrust_code = true\n'
    text += "[camera]\n"
    Path("mine.toml").write_text(text + "width = 40\nheight = 20\nfov_x_deg = 60.0\n")
    Path("seen.py").write_text(
        "def drive(image, goal, step):\n"
        "    assert image.shape[1:] == (3, 20, 40), image.shape\n"
        "    return [0.0] * len(image)\n"
    )
    place = with_policy("mine.toml", place)
    assert cli.main([*place, "--horizon", "2"]) == 0
    Path("mine.toml").write_text(text + "width = 0\n")
    capsys.readouterr()
    assert cli.main([*place, "--horizon", "2"]) == 2
    assert re.search(r"mine.toml: camera.width: .*\(is .*\)", capsys.readouterr().err)


TURNING = """
[policy]
kind = "callable"
file = "turn.py:drive"
trust_code = true
[camera]
width = 8
height = 4
[vehicle]
model = "ackermann"
speed_ms = 4.0
wheelbase_m = 2.0
width_m = 1.5
dt_s = 0.2
"""


def test_a_toml_file_brings_the_vehicle_whose_control_its_policy_gives(
    place, monkeypatch, capsys
):
    """Radians of steering turn by speed / wheelbase * tan, no heading rate does."""
    monkeypatch.setattr(evaluate_work, "make_environment", make_environment)
    Path("mine.toml").write_text(TURNING)
    Path("turn.py").write_text("def drive(image, goal, step):\n    return [0.2]\n")
    place = with_policy("mine.toml", place)
    assert cli.main([*place, "--horizon", "3", "--runs", "1", "--json"]) == 0
    figures = json.loads(capsys.readouterr().out)["mitsuba"]["straight"]["no_object"]
    assert figures["departure_limit_m"] == pytest.approx((3.5 - 1.5) / 2)
    path = next(Path("runs").rglob("no_object/run_0000.safetensors"))
    states = files.read_safetensors(path)[0]["states"][:, :3]
    turned = np.diff(states[:, 2])
    np.testing.assert_allclose(turned, 0.2 * 4 / 2 * np.tan(0.2), rtol=1e-4)
    driven = np.linalg.norm(np.diff(states[:, :2], axis=0), axis=1)
    np.testing.assert_allclose(driven, 0.2 * 4, rtol=1e-3)
    Path("mine.toml").write_text(TURNING.replace("2.0", "3.0"))
    monkeypatch.setattr(evaluate_work, "make_environment", None)  # other drives
    with pytest.raises(TypeError):
        cli.main([*place, "--horizon", "3", "--runs", "1"])


def test_a_scenario_is_driven_in_its_own_scene(place, monkeypatch, capsys):
    painted, seen = evaluate_work.make_environment, []

    def make(name, where, conditions=None):
        seen.append(where)
        return painted(name, where, conditions)

    monkeypatch.setattr(evaluate_work, "make_environment", make)
    write_named_files(Path())
    Path("deployment.xml").write_text(SCENE)
    files.write_json("routes.json", {**ROUTES, "lane": ROUTES["straight"]})
    policy = 'kind = "callable"\nfile = "still.py:drive"\ntrust_code = true'
    vehicle = '[vehicle]\nmodel = "ackermann"\n'
    text = HEAD.replace('file = "policy.safetensors"', policy) + vehicle
    Path("mine.toml").write_text(text)
    command = with_policy("mine.toml", place)
    own = [word for word in command if word not in ("--scene", "--routes-file")]
    own = [word for word in own if word not in ("scene.xml", "routes.json")]
    short = ["--horizon", "2", "--objects", "0", "--json"]
    assert cli.main([*own, *short]) == 0
    assert list(json.loads(capsys.readouterr().out)["mitsuba"]) == ["lane"]
    assert seen[0].scene.name == "deployment.xml"
    assert seen[0].field.name == "scene.safetensors"
    assert [path.name for path in seen[0].objects] == ["object.safetensors"]
    assert seen[0].car.control_unit == "rad" and seen[0].motion is not None
    seen.clear()
    assert cli.main([*command, *short]) == 0
    assert list(json.loads(capsys.readouterr().out)["mitsuba"]) == ["straight", "lane"]
    assert seen[0].scene.name == "scene.xml" and seen[0].car.control_unit == "rad"


def test_vehicles_that_do_not_fit_are_one_message(place, capsys):
    PilotNet(1, 0.6, "rad/s").save("net.safetensors")
    vehicle = '[vehicle]\nmodel = "ackermann"\n'
    Path("net.toml").write_text(f'[policy]\nfile = "net.safetensors"\n{vehicle}')
    assert cli.main(with_policy("net.toml", place)) == 2
    assert "gives rad/s, the car of the place takes rad" in capsys.readouterr().err
    Path("net.toml").write_text(
        f'[policy]\nfile = "net.safetensors"\n{vehicle}lag = 1\n'
    )
    assert cli.main(with_policy("net.toml", place)) == 2
    assert "net.toml: vehicle.lag: unknown key" in capsys.readouterr().err
    custom = 'model = "custom"\nfunction = "a.py:car"\ncontrol_limit = 1.0\n'
    Path("net.toml").write_text(
        f'[policy]\nfile = "net.safetensors"\n[vehicle]\n{custom}'
    )
    place = [*with_policy("net.toml", place), "--environments", "mujoco"]
    assert cli.main(place) == 2
    assert "mujoco drives a car with wheels" in capsys.readouterr().err
