"""Attacks on where objects stand; several poses, jitter, exposure, blur and noise."""

from __future__ import annotations

import numpy as np
import pytest
from support.worlds import loops as toy
from support.worlds.attacks import ROBUST

from mi_nerfattack.attack.base import Freedom, distances
from mi_nerfattack.attack.gradient import GradientAttack
from mi_nerfattack.backend.determinism import deterministic
from mi_nerfattack.errors import InputError
from mi_nerfattack.policy.torch_policy import TorchPolicy
from mi_nerfattack.render.camera.disturbance import Disturbance
from mi_nerfattack.rollout.adjoint import KeptBackgrounds
from mi_nerfattack.rollout.function import Rollout
from mi_nerfattack.rollout.objective import StageSum
from mi_nerfattack.scenario.scenario import load_scenario
from mi_nerfattack.scenario.world import build_attack, build_world

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
    uninterrupted, half = make_attack(freedom), make_attack(freedom)
    for _ in range(4):
        uninterrupted.step()
    for _ in range(2):
        half.step()
    resumed = make_attack(freedom)
    resumed.load_tensors({key: value.copy() for key, value in half.tensors().items()})
    for _ in range(2):
        resumed.step()
    assert resumed.history == uninterrupted.history
    for name, value in uninterrupted.tensors().items():
        np.testing.assert_array_equal(resumed.tensors()[name], value, name)
    assert uninterrupted.best_offsets.any()
    for wrong in (1.5, np.nan, np.inf, -np.inf):
        damaged = {key: value.copy() for key, value in half.tensors().items()}
        damaged["best.0"][0, 0] = wrong
        with pytest.raises(
            InputError, match=r"best\.0: colours that the attack may not"
        ):
            make_attack(freedom).load_tensors(damaged)


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


def attack_of(folder, seed, keys=ROBUST):
    text = (folder / "scenario.toml").read_text()
    text = text.replace("seed = 1", f"seed = {seed}")
    path = folder / "robust.toml"
    path.write_text(text.replace("[attack]", "[attack]" + keys))
    world = build_world(load_scenario(path)[0], TorchPolicy(toy.SmoothPolicy()))
    return build_attack(world), world


def test_the_seed_decides_all_that_is_drawn(folder):
    drawn = []
    with deterministic():
        for seed in (4, 4, 5):
            attack, world = attack_of(folder, seed)
            loop = attack.rollout.loop
            assert loop.disturbance == Disturbance(
                0.5, 0.8, 0.02, seed, colour_ev_sd=0.1
            )
            assert world.surrogate.camera.seed == seed
            attack.step()
            drawn.append([attack.tensors()["value.0"], np.array(attack.initial)])
    for a, b, c in zip(*drawn, strict=True):
        assert np.array_equal(a, b) and not np.array_equal(a, c)


def test_each_part_changes_the_attack_and_nothing_changes_the_drives(folder):
    _, keys = ROBUST.split("poses = 3\n")
    gradients = []
    for key in ("", *keys.splitlines()):
        attack, world = attack_of(folder, 1, f"\n{key}\n")
        nominal = world.loop(world.surrogate)
        assert not nominal.disturbance and nominal.dynamics is world.motion.dynamics
        assert world.surrogate.camera.variation is None
        measured = attack.rollout.measure(attack.initial)
        mean = distances(world.route, measured).mean()
        assert attack.measure_through(world.surrogate) == pytest.approx(mean)
        assert world.renders == 2 * measured.trajectory.horizon
        attack.step()
        gradients.append(attack.tensors()["first.0"])
    for i, one in enumerate(gradients):
        assert all(not np.array_equal(one, other) for other in gradients[:i])
