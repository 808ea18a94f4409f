"""What an attack would cost, against what it keeps."""

from __future__ import annotations

from dataclasses import replace

import pytest

from mi_nerfattack.backend.arrays import allocated_bytes
from mi_nerfattack.experiment.checks import cost as module
from mi_nerfattack.experiment.checks.cost import backgrounds_mb, estimate
from mi_nerfattack.rollout.adjoint import KeptBackgrounds
from mi_nerfattack.rollout.function import Rollout
from mi_nerfattack.scenario.scenario import load_scenario
from mi_nerfattack.scenario.world import build_world

pytestmark = pytest.mark.usefixtures("variant")


def test_the_memory_of_kept_frames_is_told(scenario_folder):
    """It is what an iteration's drive keeps, but for the frames that are timed."""
    path = scenario_folder / "scenario.toml"
    options = ["drive.horizon=30", "attack.adjoint.kind=kept_backgrounds"]
    scenario, _ = load_scenario(path, settings=options)
    world = build_world(scenario, scenario.build_policy())
    loop = world.loop(world.optimised)
    rollout = Rollout(loop, world.objective, 30, adjoint=KeptBackgrounds())
    tape = rollout.run(loop.initial(world.initial[:1])).trajectory.tape
    truth = sum(allocated_bytes(record) for record, _ in tape) / 1e6
    assert backgrounds_mb(world) == pytest.approx(truth * 24 / 30, rel=0.3)
    other, _ = load_scenario(path, settings=["attack.adjoint.kind=replay"])
    assert backgrounds_mb(replace(world, scenario=other)) == 0


@pytest.mark.parametrize(
    "setting",
    [
        'objective.term=[{kind="cross_track", weights={kind="linear"}}]',
        'attack.method={kind="single_frame", frame=10}',
    ],
    ids=["weights", "frame"],
)
def test_a_drive_may_be_longer_than_what_is_timed(scenario_folder, setting):
    """Weights of 12 periods, and a frame of them, where fewer are timed."""
    path = scenario_folder / "scenario.toml"
    scenario, _ = load_scenario(path, settings=["drive.horizon=12", setting])
    world = build_world(scenario, scenario.build_policy())
    cost = estimate(world, {})
    assert cost.horizon == 12
    assert cost.period_s["forward"] > 0 and cost.period_s["backward"] > 0


def test_each_method_has_its_own_cost_of_a_backward_pass(scenario_folder, monkeypatch):
    """Times of drives come from another method of the place, those of passes do not."""
    scenario, _ = load_scenario(scenario_folder / "scenario.toml")
    world = build_world(scenario, scenario.build_policy())
    others = {"surrogate": 1.0, "forward": 1.0, "backward": 1.4}
    monkeypatch.setattr(module, "_iteration", lambda world: (1.0, 3.0, 0.0, 0.0))
    period_s = estimate(world, others).period_s
    assert period_s == {"surrogate": 1.0, "forward": 1.0, "backward": 3.0}
