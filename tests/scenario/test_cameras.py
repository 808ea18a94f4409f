"""Scenarios whose vehicle has several cameras: keys, evaluations, attacks."""

from __future__ import annotations

from pathlib import Path

import pytest
from support.files.runs import HEAD, write_named_files
from support.worlds.attacks import write_scenario

from mi_nerfattack import cli
from mi_nerfattack.commands.shared.evaluate_options import PlaceOptions
from mi_nerfattack.commands.shared.policy_file import PolicyFile, read_camera
from mi_nerfattack.deploy.car import CAR
from mi_nerfattack.errors import InputError
from mi_nerfattack.experiment.transfer.columns import make_columns
from mi_nerfattack.io import files
from mi_nerfattack.io.exr import read_layers
from mi_nerfattack.render.camera.intrinsics import CameraMount, from_fov
from mi_nerfattack.render.camera.rig import Rig
from mi_nerfattack.scenario.policy.kinds import PolicySection
from mi_nerfattack.scenario.scenario import Scenario, load_scenario
from mi_nerfattack.scenario.section import read_section
from mi_nerfattack.scenario.world import build_world

pytestmark = pytest.mark.usefixtures("variant")

CAMERAS = """
[[cameras]]
name = "front"
width = 24
height = 10
fov_x_deg = 70
[[cameras]]
name = "left"
width = 16
height = 12
fov_x_deg = 60.0
height_m = 1.2
left_m = 0.4
yaw_deg = 40.0
"""
RIG = Rig(
    ("front", "left"),
    (from_fov(24, 10, 70.0), from_fov(16, 12, 60.0)),
    (CameraMount(), CameraMount(height_m=1.2, left_m=0.4, yaw_deg=40.0)),
)
#: Turns to where it is brighter: to the left, or ahead.
BRIGHTER = """
def drive(front, left, goal, step):
    shapes = front.shape[1:], left.shape[1:]
    if shapes != ((3, 10, 24), (3, 12, 16)):
        raise ValueError(f"{front.shape}, {left.shape}")
    return [float(b.mean() - a.mean()) for a, b in zip(front, left)]
"""


def load(folder: Path, text: str) -> Scenario:
    write_named_files(folder)
    path = folder / "scenario.toml"
    path.write_text(text)
    return load_scenario(path)[0]


def test_one_table_for_one_camera_several_for_several(tmp_path):
    assert load(tmp_path, HEAD + CAMERAS).rig() == RIG
    alone = load(tmp_path, f"{HEAD}[camera]\nyaw_deg = -90.0\nleft_m = -0.5\n").rig()
    assert alone.mounts == (CameraMount(left_m=-0.5, yaw_deg=-90.0),)
    assert load(tmp_path, HEAD).rig().names == ("camera",)


def test_each_camera_counts_and_new_keys_count_where_they_are_set(tmp_path):
    plain = load(tmp_path, HEAD)
    known = {key for key in plain.identity() if "camera" in key}
    assert not {
        key for key in known if "left_m" in key or "yaw" in key or "rigs" in key
    }
    assert load(tmp_path, f"{HEAD}[camera]\nyaw_deg = 0.0\n").digest() == plain.digest()
    turned = load(tmp_path, f"{HEAD}[camera]\nyaw_deg = 1.0\n")
    several = load(tmp_path, HEAD + CAMERAS)
    moved = load(tmp_path, HEAD + CAMERAS.replace("left_m = 0.4", "left_m = 0.5"))
    assert len({s.digest() for s in (plain, turned, several, moved)}) == 4
    first, second = several.identity(), moved.identity()
    changed = {key for key in first if first[key] != second[key]}
    assert changed == {"scenario.cameras[1].left_m"}


def test_a_policys_file_has_cameras_too(tmp_path):
    path = tmp_path / "mine.toml"
    path.write_text(CAMERAS)
    assert PolicyFile.read(str(path)).rig == RIG
    place = PolicyFile.read(str(path)).place(PlaceOptions())
    assert place.rig == RIG and place.camera == RIG.cameras[0]
    with pytest.raises(InputError, match="cameras: several; the car has one"):
        read_camera(str(path))
    path.write_text(f"{CAMERAS}[camera]\nwidth = 10\n")
    with pytest.raises(InputError, match=r"cameras: stands beside \[camera\]"):
        PolicyFile.read(str(path))


def test_a_policy_that_reads_two_cameras_is_evaluated(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("brighter.py").write_text(BRIGHTER)
    head = '[policy]\nkind = "callable"\nfile = "brighter.py:drive"\n'
    Path("mine.toml").write_text(f"{head}trust_code = true\n{CAMERAS}")
    command = ["evaluate", "mine.toml", "--routes", "straight", "--runs", "1"]
    command += ["--environments", "surrogate", "mitsuba", "--objects", "0"]
    command += ["--horizon", "4", "--workers", "1", "-o", "card.json"]
    assert cli.main(command) == 0
    card = files.read_json("card.json")
    for name in ("surrogate", "mitsuba"):
        assert card[name]["straight"]["no_object"]["n"] == 1


NET = """
import torch

class Two(torch.nn.Module):
    goals = 1

    def __init__(self):
        super().__init__()
        generator = torch.Generator().manual_seed(3)
        sizes = (10, 24), (12, 16)
        weights = [torch.randn(1, 3, *size, generator=generator) for size in sizes]
        self.weights = torch.nn.ParameterList(0.02 * weight for weight in weights)

    def forward(self, front, left, goal):
        pairs = zip((front, left), self.weights)
        return torch.tanh(sum((image * w).sum((1, 2, 3)) for image, w in pairs))
"""
CHANGES = {
    '[policy]\nfile = "policy.safetensors"\n': """[policy]
file = "two.py:Two"
trust_code = true
goal = { kind = "integer", count = 1 }
""",
    "max_iterations = 30": "max_iterations = 2",
    "textures = 4": "textures = 1",
}


def write_attack(folder: Path) -> Path:
    """Write a scenario with two cameras and a policy that reads both."""
    (write_scenario(folder, CHANGES) / "two.py").write_text(NET)
    path = folder / "scenario.toml"
    path.write_text(path.read_text() + CAMERAS)
    return path


@pytest.mark.parametrize("name", ["surrogate", "mitsuba"])
def test_an_error_of_the_pitch_is_drawn_for_each_camera(name, tmp_path):
    scenario, _ = load_scenario(write_attack(tmp_path))
    world = build_world(scenario, scenario.build_policy())
    (column,) = make_columns([name], ["pitch:2"], 1)
    environment = column.open(world, world.surrogate.objects, 3)
    assert environment.rig.names == RIG.names
    pairs = zip(environment.rig.mounts, RIG.mounts, strict=True)
    first, second = (one.pitch_deg - other.pitch_deg for one, other in pairs)
    assert 0 != first != second != 0
    assert environment.rig.mounts[1].yaw_deg == 40.0
    assert environment.reset(world.route, None, 1).image.shape == (12, 40, 3)


def test_an_attack_on_a_policy_of_two_cameras(tmp_path):
    path, run = write_attack(tmp_path / "attack"), tmp_path / "run"
    assert cli.main(["check", str(path), "-o", str(tmp_path / "check.png")]) in (0, 1)
    command = ["attack", str(path), "-o", str(run), "--anyway", "--pictures", "1"]
    few = ["drive.runs=1", "baseline.deployment_textures=1"]
    command += ["--workers", "1", *(word for key in few for word in ("--set", key))]
    assert cli.main(command) == 0
    for label in ("surrogate", "mitsuba"):
        frames = run / "frames" / f"{label}_attack"
        image = files.read_image(frames / "0000.png")
        assert image.shape == (12, 40, 3) and not image[10:, :24].any()
        layers, _ = read_layers(frames / "0000.exr")
        assert layers[""].shape == (12, 40, 4)
        assert not (frames / "transforms.json").exists()
        if label == "surrogate":  # the policy's derivative reaches both cameras
            cost = layers["cost.dR"]
            assert cost[:10, :24].any() and cost[:, 24:].any()


def test_a_server_gets_all_cameras_side_by_side_and_numbers(tmp_path):
    def section(*inputs):
        keys = {"url": "http://127.0.0.1:8000", "inputs": list(inputs)}
        return read_section("policy", PolicySection, keys, tmp_path)

    both = section("speed", "front", "left")
    both.check_driven(RIG.views, CAR)
    assert both.build(RIG.views).sent == ("speed",)
    assert section().build(RIG.views).sent == ()
    assert section("image", "speed").build().sent == ("speed",)
    with pytest.raises(InputError, match="side by side; name front, left"):
        section("front", "speed").build(RIG.views)
