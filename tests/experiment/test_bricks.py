"""Attacks that are optimised in bricks, and judged in the field."""

from __future__ import annotations

import json

import numpy as np
import pytest
from helpers import toy_loop as toy
from helpers.attack_jobs import (
    assert_same_state,
    job,
    write_scenario,
)

from mi_nerfattack.errors import InputError
from mi_nerfattack.fields import Occupancy, load_grid, save_field
from mi_nerfattack.fields.bricks import BrickField, Codes, vertex_count
from mi_nerfattack.policy.torch_policy import TorchPolicy
from mi_nerfattack.scenario.scenario import load_scenario
from mi_nerfattack.scenario.world import build_attack, build_world

pytestmark = pytest.mark.usefixtures("variant")
NAMED = ('field = "scene.safetensors"', 'field = "scene.safetensors"\nbricks = "b.st"')


@pytest.fixture
def folder(tmp_path):
    """A scenario with bricks that look unlike its field."""
    camera = f"[camera]\nwidth = {toy.WIDTH}\nheight = {toy.HEIGHT}\n[drive]"
    changes = dict([NAMED, ("[drive]", camera), ("= 30", "= 12"), ("= 4", "= 2")])
    folder = write_scenario(tmp_path / "bricks", changes)
    field, rng = load_grid(folder / "scene.safetensors"), np.random.default_rng(3)
    cells = np.ones((2, 2, 2), bool)
    divided = np.full(8, 2, np.uint8)
    words = rng.integers(0, 1 << 32, vertex_count(divided), np.uint32)
    parts = Occupancy(cells), divided, words, Codes(-6.0, -2.0), np.zeros((2, 4, 3))
    box = field.lower, field.upper
    save_field(folder / "b.st", BrickField(*box, *parts, field.step_m, field.cone))
    return folder


def test_iterations_see_bricks_and_drives_the_field(folder, tmp_path):
    document = job(folder, tmp_path / "in_bricks").run(anyway=True)
    plain = job(folder, tmp_path / "in_field", NAMED[::-1]).run(anyway=True)
    [cases], [expected] = (
        [routes["surrogate"] for routes in found["routes"].values()]
        for found in (document, plain)
    )
    assert cases["own"]["per_run"] == expected["own"]["per_run"]
    history, other = (
        json.loads((tmp_path / name / "attack.json").read_text())
        for name in ("in_bricks", "in_field")
    )
    assert history[0]["objective"] != other[0]["objective"]
    found = document["bricks"]
    assert found["file"] == "b.st" and "bricks" not in plain
    assert found["cross_track_mean_m"] != found["field_cross_track_mean_m"]
    least = min(history, key=lambda record: record["objective"])
    assert found["cross_track_mean_m"] == pytest.approx(
        least["cross_track_mean_m"], rel=1e-4
    )
    assert document["cost"]["renders"] > plain["cost"]["renders"]


def test_an_interrupted_attack_goes_on_in_bricks(folder, tmp_path):
    job(folder, tmp_path / "whole").run(anyway=True)
    output = tmp_path / "output"
    with pytest.raises(KeyboardInterrupt):
        interrupted = job(folder, output)
        steps = iter(range(40))

        def stop(stage, done, total, remark):
            del done, total, remark
            if stage == "surrogate: optimisation" and next(steps) == 30:
                raise KeyboardInterrupt

        interrupted.on_progress = stop
        interrupted.run(anyway=True)
    job(folder, output).run()
    assert_same_state(output, tmp_path / "whole")


def test_objects_stand_alike_in_both(folder):
    path = folder / "moved.toml"
    text = (folder / "scenario.toml").read_text()
    text = text.replace("learning_rate = 0.5\n", 'parameters = "pose"\n')
    path.write_text(text)
    world = build_world(load_scenario(path)[0], TorchPolicy(toy.SmoothPolicy()))
    attack = build_attack(world)
    attack.step()
    attack.measure()
    assert world.appearance().offsets.any()
    world.show(world.appearance())
    assert world.surrogate.objects == world.optimised.objects


def test_bricks_of_a_mitsuba_scene_are_refused(folder):
    path = folder / "scenario.toml"
    text = path.read_text().replace('field = "scene', 'surrogate = "scene', 1)
    path.write_text(text)
    with pytest.raises(InputError, match="bricks"):
        load_scenario(path)
