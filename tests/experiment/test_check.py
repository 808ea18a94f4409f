"""What ``check`` tells of a scenario, and the picture that it writes."""

from __future__ import annotations

import json
import re
import shlex
from types import SimpleNamespace
from typing import Any

import mitsuba as mi
import numpy as np
import pytest
from helpers.camera_scenes import block

from mi_nerfattack import cli
from mi_nerfattack.deploy.environment import CameraFrame
from mi_nerfattack.experiment.checks.check import duration
from mi_nerfattack.experiment.checks.ground import ground_findings, likeness_findings
from mi_nerfattack.io import files
from mi_nerfattack.render.camera.intrinsics import CameraMount, from_fov, mount_matrix
from mi_nerfattack.scenario.scenario import DriveSection
from mi_nerfattack.vehicle.route.route import Route

pytestmark = pytest.mark.usefixtures("variant")

POSITION = "position_m = [7.0, 4.2, 1.6]"


def check(folder, capsys, *change, options=()):
    path, picture = folder / "changed.toml", folder / "seen.png"
    path.write_text((folder / "scenario.toml").read_text().replace(*change))
    code = cli.main(["check", str(path), "-o", str(picture), *options])
    return code, capsys.readouterr(), picture


def test_the_next_command_can_be_given_as_it_is_told(scenario_folder, capsys):
    options = ["--no-drives"]
    (scenario_folder / "my scene.toml").write_text(
        (scenario_folder / "scenario.toml").read_text()
    )
    path = str(scenario_folder / "my scene.toml")
    picture = str(scenario_folder / "seen.png")
    assert cli.main(["check", path, "-o", picture, *options]) == 0
    last = capsys.readouterr().out.splitlines()[-1]
    words = ["mi-nerfattack", "attack", path, "-o", "runs/my scene"]
    assert shlex.split(last.removeprefix("next: ")) == words


def test_a_home_of_nobody_is_one_message(scenario_folder, capsys):
    change = '"object.safetensors"', '"~nosuchuser/object.safetensors"'
    code, told, _ = check(scenario_folder, capsys, *change)
    assert code == 2 and "~nosuchuser is no home here; give the path" in told.err


def test_a_sound_scenario(scenario_folder, capsys):
    """It is told what an attack costs, and how to begin one."""
    looks = "[baseline]\ntextures = 2\n[deployment]"
    code, told, picture = check(scenario_folder, capsys, "[deployment]", looks)
    assert code == 0, told.out
    assert files.read_image(picture).shape[1] == 1600
    first, cost, *_, last = told.out.splitlines()
    assert "route 'line' of 80.0 m, 4 control periods of 0.1 s; objects: ball" in first
    # 4 periods of: 3 iterations and the attribution's 3, two frames each; 2 looks and
    # the best judged; 4 cases of 2 drives and the looks in both worlds
    assert "at most 3 iterations, 2 random looks, 140 frames; about " in cost
    assert last.startswith("next: mi-nerfattack attack ") and "--anyway" not in last


def test_a_wrong_scenario(scenario_folder, capsys):
    """It hangs in the air; the picture is there all the same."""
    aloft = POSITION.replace("1.6", "4.6")
    options = ["--no-drives", "--json"]
    code, told, picture = check(
        scenario_folder, capsys, POSITION, aloft, options=options
    )
    document = json.loads(told.out)
    assert code == 1 and picture.is_file() and document["cost"] is None
    (line,) = document["refused"]
    assert line.startswith("ball is in the air of deployment.xml")
    assert document["objects"] == {"ball": [7.0, 4.2, 4.6]}


def test_a_scenario_that_does_not_load(scenario_folder, capsys):
    code, told, _ = check(scenario_folder, capsys, "[drive]", "[drive]\nlength = 3")
    assert code == 2 and "changed.toml:" in told.err and "drive.length" in told.err


def test_a_policy_whose_images_are_others(scenario_folder, capsys):
    """The error of a drive is a reason to refuse; the picture is there."""
    wide = "[camera]\nwidth = 40\nheight = 20\n[drive]"
    code, told, picture = check(scenario_folder, capsys, "[drive]", wide)
    assert code == 1 and picture.is_file()
    assert "refused: " in told.out and "40" in told.out


def world(points, length_m=20.0) -> Any:
    """Return as much of a world as the ground is compared with."""
    route = Route("line", 0, np.array(points))
    drive = DriveSection(horizon=round(length_m / 0.5))
    scenario = SimpleNamespace(vehicle=SimpleNamespace(dt_s=0.1), drive=drive)
    return SimpleNamespace(route=route, scenario=scenario)


@pytest.fixture(scope="module")
def street():
    """Ground 40 m long, half of it 0.5 m higher, with a house at x = 15."""
    mi.set_variant("llvm_ad_rgb")
    return mi.load_dict(
        {
            "type": "scene",
            "low": block([-10, 0, -1], [10, 9, 1]),
            "high": block([10, 0, -1], [10, 9, 1.5]),
            "house": block([15, 6, 2], [1, 1, 2]),
        }
    )


@pytest.mark.parametrize(
    ("points", "patterns"),
    [
        ([[-20.0, 0.0], [-0.1, 0.0]], []),
        ([[-10.0, 0.0], [10.0, 0.0]], ["lies 0.50 m above z = 0 .* 10.0 to 20.0 m"]),
        ([[0.5, 6.0], [19.5, 6.0]], ["above z = 0", "a surface of s.xml after 13"]),
        ([[-10.0, 0.0], [-10.0, 20.0]], ["no ground .* from 9.5 to 20.0 m along it"]),
        ([[-90.0, 0.0], [-60.0, 0.0]], [r"\(100 % of .* lie within x -20 to 20"]),
    ],
)
def test_route_and_ground(street, points, patterns):
    found = list(ground_findings(world(points), street, "s.xml"))
    assert len(found) == len(patterns), found
    for pattern, line in zip(patterns, found, strict=True):
        assert re.search(pattern, line), line


def test_two_worlds_of_other_scale():
    """A wall 20 m ahead, and the same scene 1.3 times as large."""
    camera = from_fov(40, 20, 90.0)
    pose = mount_matrix(np.zeros(3), CameraMount(1.4, 0.0, 0.0))[0]
    frames = []
    for scale in (1.0, 1.1, 1.3):
        v = (np.arange(20) + 0.5 - camera.cy) / camera.fy
        with np.errstate(divide="ignore"):
            floor = np.where(v > 0, 1.4 / v, np.inf)  # stays where it is
        along = np.minimum(floor, 20 * scale)[:, None] * np.ones((20, 40))
        u = (np.arange(40) + 0.5 - camera.cx) / camera.fx
        depth = along * np.sqrt(1 + u**2 + v[:, None] ** 2)
        frames.append(CameraFrame(np.zeros((20, 40, 3), np.uint8), depth, pose))
    one, near, far = frames
    assert not list(likeness_findings(camera, near, one, "deployment"))
    (line,) = likeness_findings(camera, far, one, "deployment")
    assert "surrogate and deployment do not show one place" in line
    assert "30 % or more" in line


@pytest.mark.parametrize(
    ("seconds", "told"), [(0.2, "1 s"), (89, "89 s"), (266, "4 min"), (9000, "2.5 h")]
)
def test_durations(seconds, told):
    assert duration(seconds) == told
