"""Attacks on where objects stand, from several initial poses."""

from __future__ import annotations

import json

import numpy as np
import pytest
from helpers import toy_loop as toy
from helpers.attack_jobs import run

from mi_nerfattack.attack.freedom import Freedom
from mi_nerfattack.attack.gradient import GradientAttack
from mi_nerfattack.errors import InputError
from mi_nerfattack.experiment.attribution import attribute
from mi_nerfattack.rollout.adjoint import KeptBackgrounds
from mi_nerfattack.rollout.function import Rollout
from mi_nerfattack.rollout.objective import StageSum

pytestmark = pytest.mark.usefixtures("variant")


def make_attack(freedom):
    """Return an attack on the toy loop that steers onto the line."""
    loop, _ = toy.make_loop()
    rollout = Rollout(loop, StageSum(toy.square_error), 8, adjoint=KeptBackgrounds())
    initial = loop.initial(np.array([[0.0, 0.35, 0.02]]))
    return GradientAttack(rollout, toy.ROUTE, initial, freedom)


def test_moving_an_object_lowers_the_cost_within_its_limits():
    freedom = Freedom(None, 0.05, ("x", "y", "yaw"), limit_m=0.12, limit_rad=0.1)
    attack = make_attack(freedom)
    before = attack.sensor.textures()[0].numpy().copy()
    for _ in range(6):
        attack.step()
    attack.measure()
    attack.restore_best()
    offsets = attack.sensor.objects[0].offset
    assert attack.best_objective < attack.history[0].objective
    assert np.abs(offsets[:2]).max() == pytest.approx(0.12)
    assert not offsets[2:5].any() and 0 < abs(offsets[5]) <= 0.1 + 1e-7
    np.testing.assert_array_equal(attack.sensor.textures()[0].numpy(), before)


def test_both_at_once_go_on_from_their_tensors(single_thread):
    freedom = Freedom(0.3, 0.02)
    whole, half = make_attack(freedom), make_attack(freedom)
    for _ in range(4):
        whole.step()
    for _ in range(2):
        half.step()
    resumed = make_attack(freedom)
    resumed.load_tensors({key: value.copy() for key, value in half.tensors().items()})
    for _ in range(2):
        resumed.step()
    assert resumed.history == whole.history
    for name, value in whole.tensors().items():
        np.testing.assert_array_equal(resumed.tensors()[name], value, name)
    assert whole.best_offsets.any()
    for wrong in (1.5, np.nan):
        damaged = {key: value.copy() for key, value in half.tensors().items()}
        damaged["best.0"][0, 0] = wrong
        with pytest.raises(
            InputError, match=r"best\.0: colours that the attack may not"
        ):
            make_attack(freedom).load_tensors(damaged)


@pytest.mark.slow
def test_a_run_says_where_the_objects_stand(scenario_folder, tmp_path):
    text = (scenario_folder / "scenario.toml").read_text()
    scenario = scenario_folder / "both.toml"
    scenario.write_text(text.replace("[attack]", '[attack]\nparameters = "both"'))
    run("attack", scenario, "-o", tmp_path / "run", cwd=tmp_path, check=0)
    document = json.loads((tmp_path / "run/metrics.json").read_text())
    pose = document["object_poses"]["ball"]
    shift = np.array(pose["shift_m"])
    assert shift[:2].any() and shift[2] == 0
    np.testing.assert_allclose(pose["position_m"], np.add([7.0, 4.2, 1.6], shift))


def test_attribution_says_that_the_texture_was_not_attacked():
    attack = make_attack(Freedom(None, 0.05))
    attack.measure()
    found = attribute(attack, ["ball"], 0.85)
    assert found.subject == "gradient by the unchanged texture"
    both = attribute(make_attack(Freedom(0.3, 0.05)), ["ball"], 0.85)
    assert both.subject == "gradient"


def test_nothing_to_change_is_refused():
    with pytest.raises(InputError, match="neither textures nor poses"):
        Freedom(None, None)
    with pytest.raises(InputError, match="axes: .'w'.; some of x, y"):
        Freedom(None, 0.1, ("w",))


def test_costs_of_the_poses_are_kept():
    """Each entry is that of a drive of its own; the objective is their mean."""
    loop, _ = toy.make_loop()
    rollout = Rollout(loop, StageSum(toy.square_error), 4)
    poses = np.array([[0.0, 0.35, 0.02], [0.5, -0.2, 0.0]])
    attack = GradientAttack(rollout, toy.ROUTE, loop.initial(poses))
    single = [rollout.run(loop.initial(pose[None])).value for pose in poses]
    record = attack.step()
    assert record.costs == pytest.approx(single, rel=1e-5)
    assert record.objective == pytest.approx(np.mean(record.costs))
    attack.step()
    resumed = GradientAttack(rollout, toy.ROUTE, loop.initial(poses))
    resumed.load_tensors(attack.tensors())
    assert resumed.history == attack.history
    longer = GradientAttack(rollout, toy.ROUTE, loop.initial(poses[:1]))
    longer.go_on_from(attack.tensors())
    longer.judge_best()
    longer.step()
    assert [len(entry.costs) for entry in longer.history] == [2, 2, 1]
