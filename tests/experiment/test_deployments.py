"""Attacks in bricks or in the field, verified in several environments."""

from __future__ import annotations

import csv
import json
import shutil

import numpy as np
import pytest
from support.devices.carla import Server
from support.pages.read import PageReader
from support.worlds import loops as toy
from support.worlds.attacks import (
    job,
    make_dense,
    write_scenario,
)
from support.worlds.views import write_transforms

from mi_nerfattack.deploy import drive, make_environment
from mi_nerfattack.deploy.carla import environment as carla_environment
from mi_nerfattack.deploy.place import Place
from mi_nerfattack.drives.store import read_drives
from mi_nerfattack.errors import InputError
from mi_nerfattack.evaluation.metrics import validate
from mi_nerfattack.experiment.finished import Finished
from mi_nerfattack.experiment.job import Job
from mi_nerfattack.fields import Occupancy, load_grid, save_field
from mi_nerfattack.fields.bricks import BrickField, Codes, vertex_count
from mi_nerfattack.fields.one_level import OneLevel
from mi_nerfattack.io.exr import read_layers
from mi_nerfattack.policy.torch_policy import TorchPolicy
from mi_nerfattack.render.camera.intrinsics import from_fov, mount_matrix
from mi_nerfattack.render.posed import PosedField
from mi_nerfattack.report.table import metrics_table
from mi_nerfattack.rollout.drive import CASES, Drive
from mi_nerfattack.rollout.loop import simulate
from mi_nerfattack.scenario.scenario import load_scenario
from mi_nerfattack.scenario.world import build_attack, build_rollout, build_world
from tests.experiment.conftest import CAMERA

pytestmark = pytest.mark.usefixtures("variant")

TABLE = "[deployment]\nspp = 1\n"
SEVERAL = """\
[[deployment]]
kind = "mujoco"
spp = 1
[[deployment]]
name = "lit"
spp = 1
objects = "built-in"
[[deployment]]
kind = "carla"
[[deployment]]
name = "tape"
kind = "replay"
recording = "recording"
"""


def with_recording(source, folder):
    """Copy a scenario, its object near and dense, and record a drive past it."""
    shutil.copytree(source, folder)
    make_dense(folder)
    camera = from_fov(toy.WIDTH, toy.HEIGHT, 90.0)
    states = np.array([[0.5 * k - 20, 0.1, 0.0] for k in range(3)])
    path = folder / "scenario.toml"
    path.write_text(path.read_text().replace("[7.0, 4.2, 1.6]", "[-15.0, 2.6, 1.6]"))
    scenario, _ = load_scenario(path)
    poses = mount_matrix(states, scenario.camera.build()[1])
    images = np.full((3, toy.HEIGHT, toy.WIDTH, 3), 90, np.uint8)
    write_transforms(folder / "recording", images, camera, poses)
    return folder


def test_the_surrogates_drives_are_those_of_the_environment(folder, uninterrupted):
    """Of the attack's loop, the registry's environment and the run folder, all bits."""
    scenario, _ = load_scenario(folder / "scenario.toml")
    policy = TorchPolicy(toy.SmoothPolicy())
    world = build_world(scenario, policy)
    drives = {(d.environment, d.case, d.run): d for d in uninterrupted[1]["drives"]}
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
    loop = world.loop(world.surrogate)
    for run, start in enumerate(world.initial):
        row = drives["surrogate", "own", run]
        driven = drive(environment, policy, world.route, start, 0, world.horizon)
        assert np.array_equal(driven.states, row.states)
        assert np.array_equal(driven.controls, row.controls)
        batch = simulate(loop, loop.initial(start), world.horizon)
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
    for environment in environments.values():
        assert {case: figures["n"] for case, figures in environment.items()} == cases
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
    assert (output / "controls_tape.png").is_file()
    reader = PageReader((output / "report.html").read_text())
    shown = {image["alt"] for image in reader.images}
    assert "Change of control in the recording, tape" in shown
    # each environment was driven past the attacked object, of as many layers
    for label, layer_count in (("mujoco", 6), ("carla", 6), ("tape", 6), ("lit", 2)):
        own, attacked = (
            read_layers(output / "frames" / f"{label}_{case}" / "0000.exr")[0]
            for case in ("own", "attack")
        )
        assert len(attacked) == layer_count + 3, label  # the policy's input
        assert abs(own[""] - attacked[""]).max() > 0.02, label
    # finished, it opens nothing again but for the results
    again = job(folder, output, (TABLE, SEVERAL)).run()
    assert again["routes"] == document["routes"]
    assert again["replay"] == document["replay"]


NAMED = ('field = "scene.safetensors"', 'field = "scene.safetensors"\nbricks = "b.st"')


@pytest.fixture
def bricks(tmp_path):
    """A scenario with bricks that look unlike its field."""
    changes = dict([NAMED, ("[drive]", CAMERA), ("= 30", "= 12"), ("= 4", "= 2")])
    folder = write_scenario(tmp_path / "bricks", changes)
    field, rng = load_grid(folder / "scene.safetensors"), np.random.default_rng(3)
    cells = np.ones((2, 2, 2), bool)
    divided = np.full(8, 2, np.uint8)
    words = rng.integers(0, 1 << 32, vertex_count(divided), np.uint32)
    structure = Occupancy(cells), divided, words, Codes(-6.0, -2.0), np.zeros((2, 4, 3))
    box = field.lower, field.upper
    save_field(folder / "b.st", BrickField(*box, *structure, field.step_m, field.cone))
    return folder


def test_iterations_see_bricks_and_drives_the_field(bricks, tmp_path):
    document = job(bricks, tmp_path / "in_bricks", frames=None).run(anyway=True)
    plain = job(bricks, tmp_path / "in_field", NAMED[::-1], frames=None)
    plain = plain.run(anyway=True)
    [cases], [expected] = (
        [routes["surrogate"] for routes in metrics["routes"].values()]
        for metrics in (document, plain)
    )
    assert cases["own"]["per_run"] == expected["own"]["per_run"]
    history, other = (
        json.loads((tmp_path / name / "attack.json").read_text())
        for name in ("in_bricks", "in_field")
    )
    assert history[0]["objective"] != other[0]["objective"]
    figures = document["bricks"]
    assert figures["file"] == "b.st" and "bricks" not in plain
    assert figures["cross_track_mean_m"] != figures["field_cross_track_mean_m"]
    least = min(history, key=lambda record: record["objective"])
    assert figures["cross_track_mean_m"] == pytest.approx(
        least["cross_track_mean_m"], rel=1e-4
    )
    assert document["cost"]["renders"] > plain["cost"]["renders"]


def test_iterations_march_one_level_and_drives_all(tmp_path, monkeypatch):
    changes = dict([("[drive]", CAMERA), ("= 30", "= 6"), ("= 4", "= 2")])
    folder, documents, marched = write_scenario(tmp_path / "scenario", changes), {}, {}
    march = OneLevel.eval
    for value in ("true", "false"):
        marched[value] = 0

        def count(self, *arguments, value=value):
            marched[value] += 1
            return march(self, *arguments)

        monkeypatch.setattr(OneLevel, "eval", count)
        line = f"method.one_level = {value}\nmethod.max_iterations"
        change = ("method.max_iterations", line)
        run = job(folder, tmp_path / value, change, frames=None)
        documents[value] = run.run(anyway=True)
    assert marched["true"] > 0 and marched["false"] == 0
    near, exact = documents["true"], documents["false"]
    figures = near["one_level"]
    exact_mean = pytest.approx(figures["field_cross_track_mean_m"], rel=0.05)
    assert figures["cross_track_mean_m"] == exact_mean and "one_level" not in exact
    [cases], [expected] = (
        [routes["surrogate"] for routes in document["routes"].values()]
        for document in (near, exact)
    )
    assert cases["own"]["per_run"] == expected["own"]["per_run"]


def test_objects_stand_alike_in_both(bricks):
    path = bricks / "moved.toml"
    text = (bricks / "scenario.toml").read_text()
    text = text.replace("learning_rate = 0.5\n", 'kind = "pose"\n')
    path.write_text(text)
    world = build_world(load_scenario(path)[0], TorchPolicy(toy.SmoothPolicy()))
    attack = build_attack(world)
    attack.step()
    attack.measure()
    assert world.appearance().offsets.any()
    world.show(world.appearance())
    assert world.surrogate.objects == world.optimised.objects


def test_bricks_of_a_mitsuba_scene_are_refused(bricks):
    path = bricks / "scenario.toml"
    text = path.read_text().replace('field = "scene', 'surrogate = "scene', 1)
    path.write_text(text)
    with pytest.raises(InputError, match="bricks"):
        load_scenario(path)


BRAKE = """\
import drjit as dr
import torch


def car(state, pedal):
    x, y, theta, speed = state
    slowing = 4 * pedal + 0.3 * (speed - 4)
    return speed * dr.cos(theta), speed * dr.sin(theta), 0 * pedal, -slowing


def keeps_going(state):
    return -state[3]


class Brake(torch.nn.Module):
    def forward(self, image, goal):
        red = image[..., 0] - image[..., 2]
        return 4 * torch.sigmoid(40 * (red - 0.25)).mean((1, 2)) + 0 * goal
"""
_TRUSTED = "trust_code = true\n"
PEDAL = {
    '[policy]\nfile = "policy.safetensors"\n': '[policy]\nfile = "rail.py:Brake"\n'
    f'{_TRUSTED}goal = {{ kind = "integer", count = 3 }}\n'
    f'[vehicle]\nkind = "custom"\nfunction = "rail.py:car"\n{_TRUSTED}'
    "state_size = 4\ncontrol_limit = 1.0\nrest_state = [4.0]\n"
    f'[[objective.term]]\nkind = "function"\nfunction = "rail.py:keeps_going"\n'
    f"{_TRUSTED}",
    "[drive]": CAMERA,
    "horizon = 2": "horizon = 8",
    "method.max_iterations = 30": "poses = 4\nmethod.max_iterations = 12",
    "[7.0, 4.2, 1.6]": "[-11.0, 3.4, 1.2]",
    "scale = 1.5": "scale = 2.0",
}


def test_a_verdict_says_that_an_attack_removed_the_braking(tmp_path):
    """The object is red, the scene is not; the attack makes the object less red."""
    folder = write_scenario(tmp_path / "scenario", PEDAL)
    make_dense(folder)
    item = load_grid(folder / "object.safetensors")
    red = np.array([[1.0, -1.0, -1.0]], np.float32)
    item.set_parameter("texture", np.repeat(red, item.n_vertices, 0))
    save_field(folder / "object.safetensors", item)
    scene = load_grid(folder / "scene.safetensors")
    scene.set_parameter("texture", np.repeat(-red / 2, scene.n_vertices, 0))
    save_field(folder / "scene.safetensors", scene)
    (folder / "rail.py").write_text(BRAKE)
    scenario, text = load_scenario(folder / "scenario.toml")
    policy, output = scenario.build_policy(), tmp_path / "run"
    document = Job(scenario, text, policy, output, frames=None).run(anyway=True)
    name = {"name": "rail.py:keeps_going", "missing": {}}
    assert document["objective"] == name
    drives = {(d.environment, d.case, d.run): d for d in read_drives(output / "drives")}
    for environment, cases in document["routes"]["line"].items():
        for case, figures in cases.items():
            costs = [run["objective"] for run in figures["per_run"]]
            assert figures["objective"] == pytest.approx(np.mean(costs))
            for run, cost in enumerate(costs):
                speeds = drives[environment, case, run].states[1:, 3]
                assert cost == pytest.approx(-speeds.sum(), abs=1e-9)
        own, attack = (cases[case]["objective"] for case in ("own", "attack"))
        none = cases["no_object"]["objective"]
        assert none < own - 1 and attack < own - 0.6 * (own - none)
    # the attack's own objective, of the same drives
    world = build_world(scenario, policy)
    rollout, _ = build_rollout(world)
    costs = rollout.measure(rollout.loop.initial(world.initial)).costs
    cases = document["routes"]["line"]["surrogate"]
    own = [run["objective"] for run in cases["own"]["per_run"]]
    np.testing.assert_allclose(own, costs, rtol=1e-12)
    lane, _, attack, transfer, *_ = document["verdict"]
    assert "0 of 2 drives in surrogate" in lane and "to spare" in lane
    assert attack.startswith("The attack beats random textures in the surrogate")
    assert transfer.startswith("It transfers to mitsuba")
    for sentence, environment in ((attack, "surrogate"), (transfer, "mitsuba")):
        cases = document["routes"]["line"][environment]
        values = (f"{cases[case]['objective']:.2f}" for case in ("attack", "own"))
        assert all(value in sentence for value in values), sentence
        assert "the attack removes" in sentence
    with open(output / "steps.csv") as lines:
        assert {float(row["state_3"]) > 0 for row in csv.DictReader(lines)} == {True}
    [*_, column] = [
        c for c in metrics_table(document).figures if c.header == "objective"
    ]
    assert column.plain(cases["own"]) == f"{cases['own']['objective']:.4g}"


def test_an_objective_of_other_rows_has_no_value(tmp_path, monkeypatch):
    """MuJoCo's car has a speed where the model has its steering angle."""
    first, *others = PEDAL
    model = PEDAL[first].partition("[vehicle]")[0]
    changes = {first: model} | {key: PEDAL[key] for key in others}
    term = '[[objective.term]]\nkind = "function"\nfunction = "rail.py:keeps_going"\n'
    changes[TABLE] = f"{SEVERAL.partition('[[deployment]]' + chr(10) + 'name')[0]}"
    changes["[drive]"] = f'[vehicle]\nkind = "ackermann_rate"\n{term}{_TRUSTED}{CAMERA}'
    folder = write_scenario(tmp_path / "scenario", changes)
    (folder / "rail.py").write_text(BRAKE)
    scenario, _ = load_scenario(folder / "scenario.toml")
    world = build_world(scenario, TorchPolicy(toy.SmoothPolicy()))
    rows = {"surrogate": 4, "mujoco": 6}
    times = np.arange(1, 9) / 10
    drives = [
        Drive(name, "line", "own", 0, 1, np.ones((9, m)), times, times, times)
        for name, m in rows.items()
    ]
    short = Drive("surrogate", "line", "own", 1, 1, np.ones((3, 4)), *[times[:2]] * 3)
    old = Drive("surrogate", "line", "own", 2, 1, np.ones((9, 3)), *[times] * 3)
    made = [*drives, short, old]
    done = Finished(world, made, build_attack(world), {}, [], {}, [])
    assert list(done.costs.values()) == [-8.0, None, None, None]
    assert set(done.uncosted) == {"mujoco", "surrogate"}
    assert "4 rows" in done.uncosted["mujoco"]
    assert "ended before" in done.uncosted["surrogate"]
    done = Finished(world, [old], build_attack(world), {}, [], {}, [])
    assert "older version recorded 3" in done.uncosted["surrogate"]
    kind = type(world.objective)
    monkeypatch.setattr(kind, "costs", lambda *_: np.array([np.inf]))
    done = Finished(world, made, build_attack(world), {}, [], {}, [])
    assert list(done.costs.values()) == [None] * 4
    assert done.uncosted["surrogate"] == "it is inf for a drive"
