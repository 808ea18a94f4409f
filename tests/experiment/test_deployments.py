"""Attacks that are verified in several environments, and one way of driving."""

from __future__ import annotations

import csv
import json
import shutil

import numpy as np
import pytest
from helpers import toy_loop as toy
from helpers.attack_jobs import job
from helpers.carla_stand_in import Server
from helpers.posed_folders import write_transforms

from mi_nerfattack.deploy import drive, make_environment
from mi_nerfattack.deploy.carla import environment as carla_environment
from mi_nerfattack.deploy.place import Place
from mi_nerfattack.evaluation.metrics import validate
from mi_nerfattack.fields import load_grid, save_field
from mi_nerfattack.io.exr import read_layers
from mi_nerfattack.policy.torch_policy import TorchPolicy
from mi_nerfattack.render.camera.intrinsics import from_fov, mount_matrix
from mi_nerfattack.render.posed import PosedField
from mi_nerfattack.rollout.drive import CASES
from mi_nerfattack.rollout.loop import simulate
from mi_nerfattack.scenario.scenario import load_scenario
from mi_nerfattack.scenario.world import build_world

pytestmark = pytest.mark.usefixtures("variant")

TABLE = "[deployment]\nspp = 1\n"
SEVERAL = """\
[[deployment]]
environment = "mujoco"
spp = 1
[[deployment]]
name = "lit"
spp = 1
objects = "built-in"
[[deployment]]
environment = "carla"
[[deployment]]
name = "tape"
environment = "replay"
recording = "recording"
"""


def with_recording(source, folder):
    """Copy a scenario, its object near and dense, and record a drive past it."""
    shutil.copytree(source, folder)
    item = load_grid(folder / "object.safetensors")
    dense = np.full(item.n_vertices, 3.0, np.float32)
    item.set_parameter("density", dense)
    save_field(folder / "object.safetensors", item)
    camera = from_fov(toy.WIDTH, toy.HEIGHT, 90.0)
    states = np.array([[0.5 * k - 20, 0.1, 0.0] for k in range(3)])
    path = folder / "scenario.toml"
    path.write_text(path.read_text().replace("[7.0, 4.2, 1.6]", "[-15.0, 2.6, 1.6]"))
    scenario, _ = load_scenario(path)
    poses = mount_matrix(states, scenario.camera.build()[1])
    images = np.full((3, toy.HEIGHT, toy.WIDTH, 3), 90, np.uint8)
    write_transforms(folder / "recording", images, camera, poses)
    return folder


def test_the_surrogates_drives_are_those_of_the_environment(folder, whole):
    """Of the attack's loop, the registry's environment and the run folder, all bits."""
    scenario, _ = load_scenario(folder / "scenario.toml")
    policy = TorchPolicy(toy.SmoothPolicy())
    world, kept = build_world(scenario, policy), whole[1]["drives"]
    camera, mount = scenario.camera.build()
    place = Place(
        scene=scenario.scene.deployment.file,
        field=scenario.scene.field.file,
        routes=scenario.scene.routes.file,
        objects=(),
        camera=camera,
        mount=mount,
        period=scenario.vehicle.dt_s,
        motion=world.motion,
    )
    environment = make_environment("surrogate", place)
    item = scenario.objects[0]
    environment.show([PosedField(load_grid(item.field.file), item.pose)])
    for run, start in enumerate(world.initial):
        (row,) = (
            d
            for d in kept
            if (d.environment, d.case, d.run) == ("surrogate", "own", run)
        )
        horizon = world.horizon
        found = drive(environment, policy, world.route, start, 0, horizon)
        assert np.array_equal(found.states, row.states)
        assert np.array_equal(found.controls, row.controls)
        loop = world.loop(world.surrogate)
        batch = simulate(loop, loop.initial(start), horizon)
        assert np.array_equal(batch.states_numpy()[0, :, :3], row.states)


@pytest.mark.slow
def test_an_attack_in_every_environment(folder, tmp_path, monkeypatch):
    folder = with_recording(folder, tmp_path / "scenario")
    server = Server()
    monkeypatch.setattr(carla_environment, "load_client", server.api)
    output = tmp_path / "run"
    document = job(folder, output, (TABLE, SEVERAL)).run()
    validate(document)
    assert server.is_as_before
    cases = dict.fromkeys(CASES, 2)
    environments = document["routes"]["line"]
    assert list(environments) == ["surrogate", "mujoco", "carla", "lit"]
    for found in environments.values():
        assert {case: figures["n"] for case, figures in found.items()} == cases
    replayed = document["replay"]["tape"]
    assert replayed["frames"] == 2 and replayed["control_unit"] == "rad/s"
    assert set(replayed["cases"]) == set(CASES) - {"own"}
    for case in ("no_object", "best_random", "attack"):
        assert replayed["cases"][case]["n"] == 1
        assert replayed["cases"][case]["control_change_mean_ci95"] is None
        assert replayed["cases"][case]["control_change_max"] > 1e-4
    assert "cross_track" not in json.dumps(document["replay"])
    with (output / "controls.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 2 * (4 + 2)
    assert all(float(r["change"]) == 0 for r in rows if r["case"] == "own")
    assert "tape" not in (output / "steps.csv").read_text()
    for name in ("strip", "overhead", "errors", "controls_tape"):
        assert (output / f"{name}.png").stat().st_size > 5000
    for label, parts in (("mujoco", 6), ("carla", 6), ("tape", 6), ("lit", 2)):
        layers, _ = read_layers(output / "frames" / f"{label}_attack" / "0000.exr")
        assert len(layers) == parts + 3, label  # the policy's input
    page = (output / "report.html").read_text()
    assert "Change of control in the recording, tape" in page
    # each environment was driven past the attacked object
    for label in ("mujoco", "lit", "carla", "tape"):
        images = [
            read_layers(output / "frames" / f"{label}_{case}" / "0000.exr")[0][""]
            for case in ("own", "attack")
        ]
        assert abs(images[0] - images[1]).max() > 0.02, label
    # finished, it opens nothing again but for the results
    again = job(folder, output, (TABLE, SEVERAL)).run()
    assert again["routes"] == document["routes"]
    assert again["replay"] == document["replay"]
