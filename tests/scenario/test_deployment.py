"""The tables of deployments: labels, conditions, and what they build in."""

from __future__ import annotations

import math

import numpy as np
import pytest
from support.files.runs import HEAD, write_named_files
from support.worlds.fields import homogeneous

from mi_nerfattack.deploy.built_in import make_built_in, paint, shell_of
from mi_nerfattack.deploy.car import CAR
from mi_nerfattack.deploy.place import Conditions, bundled_place
from mi_nerfattack.render.camera.pose import Pose
from mi_nerfattack.render.posed import PosedField
from mi_nerfattack.scenario import deployment
from mi_nerfattack.scenario.deployment import Deployment, deployments, labelled
from mi_nerfattack.scenario.named_file import portable_text
from mi_nerfattack.scenario.scenario import load_scenario
from mi_nerfattack.scenario.vehicle import AckermannSection

TABLE, TABLES = "[deployment]\n", "[[deployment]]\n"


@pytest.fixture
def load(tmp_path):
    write_named_files(tmp_path)

    def inner(text):
        path = tmp_path / "scenario.toml"
        path.write_text(HEAD + text)
        return load_scenario(path)

    return inner


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("", ["mitsuba"]),
        (f"{TABLE}spp = 4\n", ["mitsuba"]),
        (f"{TABLES}spp = 4\n", ["mitsuba"]),
        (f'{TABLE}name = "lit"\n', ["lit"]),
        (f'{TABLES}{TABLES}name = "dusk"\n', ["mitsuba", "dusk"]),
        (f'{TABLE}kind = "mujoco_gl"\n', ["mujoco_gl"]),
    ],
)
def test_environments_are_called_by_name(load, tmp_path, text, expected):
    scenario, read = load(text)
    assert [label for label, _ in labelled(scenario.deployment)] == expected
    (tmp_path / "portable.toml").write_text(portable_text(scenario, read))
    again, _ = load_scenario(tmp_path / "portable.toml")
    assert again.deployment == scenario.deployment
    if not text:
        assert scenario.model_dump(mode="json")["deployment"]["spp"] == 16


def test_conditions_are_those_of_the_table(load):
    conditions = {"sky": "noon", "exposure_ev": -0.5, "blur_px": 0.5, "noise_sd": 0.1}
    keys = "\n".join(f"{name} = {value!r}" for name, value in conditions.items())
    for kind, samples in (('"mitsuba"\nspp = 4', {"spp": 4}), ('"mujoco_gl"', {})):
        section = load(f"{TABLE}kind = {kind}\n{keys}\n")[0].deployment
        (environment,) = deployments(section, bundled_place()).values()
        assert environment.conditions == Conditions(**conditions, **samples)


def test_the_car_with_wheels_is_the_vehicles_size(load):
    assert load("")[0].vehicle.car() == CAR
    small = AckermannSection(
        kind="ackermann", width_m=0.3, wheelbase_m=0.325, max_steer_deg=20.0
    ).car()
    assert small.control_unit == "rad" and small.wheelbase == 0.325
    assert small.max_control == small.max_steer == pytest.approx(math.radians(20))
    sizes = np.array([small.track, small.wheel_radius, small.length])
    full = np.array([CAR.track, CAR.wheel_radius, CAR.length])
    assert np.allclose(sizes / full, 0.3 / 1.8)


@pytest.mark.usefixtures("variant")
def test_a_look_is_built_in_once(monkeypatch):
    baked, laid_out, opened = [], [], []

    def baking(shell, field, pose):
        baked.append(pose)
        return paint(shell, field, pose)

    def laying_out(field):
        laid_out.append(field)
        return shell_of(field)

    monkeypatch.setattr(deployment, "_SHELLS", {})
    monkeypatch.setattr(deployment, "paint", baking)
    monkeypatch.setattr(deployment, "shell_of", laying_out)
    monkeypatch.setattr(
        deployment,
        "make_environment",
        lambda name, place, conditions, settings: opened.append(conditions.built_in),
    )
    field, there = homogeneous(400.0), Pose.upright((5.0, 1.0, 1.0), 0.5)
    texture = field.texture.numpy().copy()
    target = Deployment("mitsuba", bundled_place("intersection"), Conditions(), True)
    target.open([PosedField(field)])
    target.open([PosedField(field, there)])
    assert len(baked) == 1 and opened[1][0].pose.yaw == pytest.approx(0.5)
    field.set_parameter("texture", 2 * texture)
    target.open([PosedField(field)])
    field.set_parameter("texture", texture)
    target.open([PosedField(field)])
    field.set_parameter("density", field.parameters()["density"].numpy() / 2)
    target.open([PosedField(field)])
    assert len(baked) == 3 and len(laid_out) == 2  # of two densities
    images = [item.image for (item,) in opened]
    assert np.array_equal(images[0], images[3])
    assert not np.array_equal(images[0], images[2])
    (alone,) = opened[3]
    fresh = make_built_in(homogeneous(400.0), Pose.identity())
    np.testing.assert_array_equal(alone.image, fresh.image)
    for _ in range(9):
        texture = texture + 0.1
        field.set_parameter("texture", texture)
        target.open([PosedField(field)])
    assert len(deployment._BUILT[field]) == 4
    before = len(laid_out)
    target.open([PosedField(homogeneous(400.0)), PosedField(homogeneous(400.0))])
    assert len(laid_out) == before  # such a field was there
    target.open([PosedField(homogeneous(300.0)), PosedField(homogeneous(300.0))])
    assert len(laid_out) == before + 1
