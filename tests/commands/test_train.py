"""The command that trains: what it refuses, and what it says."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from mi_nerfattack import cli
from mi_nerfattack.commands.train import Train
from mi_nerfattack.deploy.place import bundled_place
from mi_nerfattack.io import files
from mi_nerfattack.rollout.drive import departure_limit
from mi_nerfattack.scenes import bundled
from mi_nerfattack.training.presets import find_preset
from mi_nerfattack.vehicle.route.route import load_routes

SCENE, ROUTES = (str(bundled(f"room/{name}")) for name in ("scene.xml", "routes.json"))

pytestmark = pytest.mark.usefixtures("variant")


def run_train(tmp_path, *arguments: str) -> int:
    base = ["train", "-o", str(tmp_path / "policy.safetensors")]
    return cli.main([*base, "--data", str(tmp_path / "data"), *arguments])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--preset", "desktop"], "preset: 'desktop'; one of laptop"),
        (["--frames", "moon", "3"], "environment: 'moon'; one of surrogate"),
        (["--scene", SCENE, "--routes", ROUTES], "no field; make one with"),
        (["--skies", "dusk"], "sky: 'dusk'"),
        (["--more", "{empty}"], "no frames in it"),
        (["--workers", "0"], "workers: 0"),
        (["--validate-every", "0"], "validate_every: 0;"),
        (["--preset", "intersection", "--dagger-rounds", "2"], "without dagger_frames"),
        (["--scene", "mine.xml"], "--scene: mine.xml; it needs its --routes"),
        (["--frames", "carla", "64"], "drive in CARLA with 'mi-nerfattack evaluate'"),
        (["--validate-in", "carla"], "environment: 'carla'; a server answers to one"),
        (["--frames", "replay", "64"], "a recording does not answer to a policy"),
    ],
)
def test_train_says_what_is_wrong(tmp_path, capsys, arguments, message):
    (tmp_path / "empty").mkdir()
    filled = [item.format(empty=tmp_path / "empty") for item in arguments]
    assert run_train(tmp_path, *filled) == 2
    captured = capsys.readouterr().err
    assert message in captured and captured.count("\n") == 1
    assert not (tmp_path / "policy.safetensors").exists()


@pytest.mark.parametrize("name", ["policy.safetensors", "policy.pt2", "policy.json"])
def test_what_cannot_be_written_is_told_before_the_first_frame(tmp_path, capsys, name):
    if name.endswith("tensors"):
        (tmp_path / name).symlink_to(tmp_path / "nowhere" / name)
    else:
        (tmp_path / name).mkdir()
    assert run_train(tmp_path, "--frames", "moon", "1") == 2
    assert str(tmp_path / name) in capsys.readouterr().err


def test_frames_of_rounds_that_are_not_done_need_no_environment():
    """The preset's rounds have surrogate frames, and this room has no field."""
    train = Train(Path("o"), Path("d"), frames={"mitsuba": 8}, dagger_rounds=0)
    preset, room = train._preset(), replace(bundled_place("room"), field=None)
    settings = train._settings(preset)
    assert [site.name for site in train._sites(preset, room, settings)] == ["mitsuba"]


def test_a_rooms_policy_is_validated_within_its_lane():
    settings = Train(Path("o"), Path("d"))._settings(find_preset("room"))
    (route,) = load_routes(bundled_place("room").routes)
    for chosen in (settings.validation, settings.final):
        assert departure_limit(route.lane_width_m, chosen.car_width_m) > 0.15
    assert settings.final.seed != settings.validation.seed


def test_train_names_a_missing_scene(tmp_path, capsys):
    routes = {"goal": 0, "lane_width_m": 3.5, "speed_ms": 5.0}
    routes["points_m"] = [[0, 0], [40, 0]]
    files.write_json(tmp_path / "routes.json", {"straight": routes})
    missing = str(tmp_path / "nowhere.xml")
    arguments = ["--scene", missing, "--field", missing, "--object", missing]
    arguments += ["--routes", str(tmp_path / "routes.json")]
    assert run_train(tmp_path, *arguments) == 2
    assert f"{missing}: does not exist" in capsys.readouterr().err
    assert not (tmp_path / "policy.safetensors").exists()
