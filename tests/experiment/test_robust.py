"""Attacks over several poses, with jitter, exposure, blur and noise."""

from __future__ import annotations

import numpy as np
import pytest
from helpers import toy_loop as toy
from helpers.attack_jobs import ROBUST

from mi_nerfattack.backend.determinism import deterministic
from mi_nerfattack.policy.torch_policy import TorchPolicy
from mi_nerfattack.render.camera.disturbance import Disturbance
from mi_nerfattack.scenario.scenario import load_scenario
from mi_nerfattack.scenario.world import build_attack, build_world

pytestmark = pytest.mark.usefixtures("variant")


def attack_of(folder, seed, keys=ROBUST):
    text = (folder / "scenario.toml").read_text()
    text = text.replace("seed = 1", f"seed = {seed}")
    path = folder / "robust.toml"
    path.write_text(text.replace("[attack]", "[attack]" + keys))
    world = build_world(load_scenario(path)[0], TorchPolicy(toy.SmoothPolicy()))
    return build_attack(world), world


def test_the_seed_decides_all_that_is_drawn(folder):
    found = []
    with deterministic():
        for seed in (4, 4, 5):
            attack, world = attack_of(folder, seed)
            assert attack.rollout.loop.disturbance == Disturbance(0.5, 0.8, 0.02, seed)
            assert world.surrogate.camera.seed == seed
            attack.step()
            found.append([attack.tensors()["value.0"], np.array(attack.initial)])
    for a, b, c in zip(*found, strict=True):
        assert np.array_equal(a, b) and not np.array_equal(a, c)


def test_each_part_changes_the_attack_and_nothing_changes_the_drives(folder):
    _, keys = ROBUST.split("poses = 3\n")
    gradients = []
    for key in ("", *keys.splitlines()):
        attack, world = attack_of(folder, 1, f"\n{key}\n")
        assert not world.loop(world.surrogate).disturbance
        attack.step()
        gradients.append(attack.tensors()["first.0"])
    for i, one in enumerate(gradients):
        assert all(not np.array_equal(one, other) for other in gradients[:i])
