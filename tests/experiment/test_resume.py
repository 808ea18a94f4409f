"""Attacks that go on, also as another scenario; the deterministic mode."""

from __future__ import annotations

import random
import shutil
import signal

import drjit as dr
import numpy as np
import pytest
import torch
from support.faults.refusals import refused_at
from support.worlds.attacks import (
    ROBUST,
    assert_same_drives,
    assert_same_state,
    checkpoint_of,
    contents,
    interrupt,
    job,
)

from mi_nerfattack.attack.gradient import Adam
from mi_nerfattack.backend import determinism
from mi_nerfattack.backend.interrupts import held_interrupts
from mi_nerfattack.errors import InputError, SetupError
from mi_nerfattack.experiment import job as module
from mi_nerfattack.io import files, resumable
from mi_nerfattack.rollout.function import Rollout
from mi_nerfattack.scenario.scenario import load_scenario

pytestmark = pytest.mark.usefixtures("variant", "no_results")

FIFTY = (  # without converging before
    "max_iterations = 6\nfreedom.learning_rate = 0.5",
    "max_iterations = 50\nfreedom.learning_rate = 0.02" + ROBUST,
)


def test_interrupted_deterministic_run_ends_bit_for_bit_as_the_whole(folder, tmp_path):
    uninterrupted, output = tmp_path / "whole", tmp_path / "run"
    expected = job(folder, uninterrupted, FIFTY).run()
    # 4 steps an iteration: in the drive, and in the derivative
    for step in (4 * 17 + 1, 4 * 32 + 3):
        interrupt(folder, output, "surrogate: optimisation", step, change=FIFTY)
        iteration = len(checkpoint_of(output)["history"])
        assert iteration == step // 4
    result = job(folder, output, FIFTY).run()
    assert len(checkpoint_of(output)["history"]) == 50
    assert_same_state(output, uninterrupted)
    assert_same_drives(result["drives"], expected["drives"])
    assert result["curve"] == expected["curve"]
    assert len(result["curve"]["frames"]) == 51  # what the last update gave, too
    assert result["cost"]["processes"] == 3
    assert 0 < result["cost"]["checkpoint_s"] < result["cost"]["wall_s"]


def test_what_is_finished_is_not_repeated(folder, uninterrupted, tmp_path):
    output, reports = tmp_path / "run", []
    interrupt(folder, output, "surrogate: random textures", 3)  # in the second of 2
    assert len(list(output.glob("looks/*"))) == 1
    # 2 of each of 5 cases twice, of 2 steps each; in the last
    interrupt(folder, output, "drives", 2 * 20 - 1)
    before = checkpoint_of(output)

    def watch(*state):
        reports.append(state[:3])

    document = job(folder, output, on_progress=watch).run()
    job(folder, output, on_progress=watch).run()  # of which nothing is left
    assert reports == [("drives", 39, 40), ("drives", 40, 40)]
    for name, value in checkpoint_of(output).items():
        assert np.array_equal(value, before[name], equal_nan=True), name
    # 2 of each case, twice, 2 judged, the attack; drives that were cut short too
    assert document["cost"]["renders"] >= 2 * (10 + 10 + 2) + 6 * 2 * 2
    assert_same_drives(document["drives"], uninterrupted[1]["drives"])


def test_error_within_an_update_keeps_the_checkpoint_before(
    folder, uninterrupted, tmp_path, monkeypatch
):
    original, calls = Adam.step, []

    def fail_after(self, *arguments, **options):
        original(self, *arguments, **options)
        calls.append(1)
        if len(calls) == 5:
            raise MemoryError

    with monkeypatch.context() as patch:
        patch.setattr(Adam, "step", fail_after)
        with pytest.raises(MemoryError):
            job(folder, tmp_path).run()
    assert len(checkpoint_of(tmp_path)["history"]) == 3
    job(folder, tmp_path).run()
    assert_same_state(tmp_path, uninterrupted[0])


def test_gradient_that_is_not_finite_costs_no_iteration(folder, tmp_path, monkeypatch):
    original, calls = Rollout.gradient, []

    def spoil(self, *arguments, **options):
        gradient = original(self, *arguments, **options)
        calls.append(1)
        if len(calls) == 6:
            gradient.textures[0][:] = float("nan")
        return gradient

    monkeypatch.setattr(Rollout, "gradient", spoil)
    with pytest.raises(InputError, match=r"iteration 5: .* object 0"):
        job(folder, tmp_path).run()
    assert len(checkpoint_of(tmp_path)["history"]) == 5  # checkpoint_every = 3


def test_held_interrupt_waits_for_a_good_place():
    reached = []
    for count, has_check in ((1, True), (1, False), (2, False)):
        with pytest.raises(KeyboardInterrupt), held_interrupts() as check:
            for _ in range(count):
                signal.raise_signal(signal.SIGINT)
            reached.append("after the signal")  # of one that waits
            if has_check:
                check()
                reached.append("after the check")
    assert reached == ["after the signal"] * 2
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_handlers_of_others_are_not_held():
    heard = []
    before = signal.signal(signal.SIGTERM, lambda *_: heard.append("told"))
    try:
        with held_interrupts():
            signal.raise_signal(signal.SIGTERM)
            assert heard == ["told"]
    finally:
        signal.signal(signal.SIGTERM, before)


def test_random_generators_go_on_where_they_were():
    random.gauss(0, 1)
    np.random.normal()
    states = determinism.random_states()

    def draw():
        numpy = np.random.normal(size=3).tolist()
        return random.gauss(0, 1), random.random(), numpy, torch.rand(3).tolist()

    expected = draw()
    assert draw() != expected
    determinism.restore_random_states(states)
    assert draw() == expected


def test_deterministic_mode_is_of_one_thread_and_ends():
    before = dr.thread_count(), torch.get_num_threads()
    with determinism.deterministic():
        assert (dr.thread_count(), torch.get_num_threads()) == (1, 1)
        assert torch.are_deterministic_algorithms_enabled()
    assert (dr.thread_count(), torch.get_num_threads()) == before
    assert not torch.are_deterministic_algorithms_enabled()


def test_deterministic_mode_refuses_a_gpu(monkeypatch):
    monkeypatch.setattr(dr, "backend_v", lambda _: dr.JitBackend.CUDA)
    with pytest.raises(SetupError, match="deterministic"), determinism.deterministic():
        pass


OPTIMISATION = "surrogate: optimisation"


def test_changed_scenario_is_refused_with_a_diff_unless_forced(folder, tmp_path):
    output, notices, first = tmp_path / "run", [], []
    interrupt(folder, output, OPTIMISATION, 4 * 4 + 1)
    before = contents(output)
    change = ("learning_rate = 0.5", "learning_rate = 0.25\njitter = true")
    line = "scenario.attack.freedom.learning_rate: 0.5 -> 0.25"
    with pytest.raises(InputError) as refused:
        job(folder, output, change).run()
    assert refused.value.where == str(output / "checkpoint.safetensors")
    assert line in str(refused.value) and "seed" not in str(refused.value)
    assert "scenario.attack.jitter: false -> true" in str(refused.value)
    assert "--force" in str(refused.value) and contents(output) == before

    # forced, the attack goes on where it was, and the result says what was ignored
    def watch(stage, done, total, remark):
        first.extend([done] * (stage == OPTIMISATION))

    document = job(folder, output, change, watch, notices).run(force=True)
    assert first[0] == 4 * 4 + 1 and len(checkpoint_of(output)["history"]) == 6
    assert line in document["ignored_changes"]
    assert document["curve"] is None  # of two learning rates
    assert any(line in notice for notice in notices)
    # from then on the run is that of the changed scenario, its drives too
    job(folder, output, change).run()
    with pytest.raises(InputError, match=r"learning_rate: 0\.25 -> 0\.5"):
        job(folder, output).run()


def test_changed_file_and_version_are_named(folder, tmp_path, monkeypatch):
    output, mine = tmp_path / "run", tmp_path / "mine"
    shutil.copytree(folder, mine)
    interrupt(mine, output, OPTIMISATION, 4 * 3 + 1)
    # a field of another name and place but the same content is the same
    shutil.copy(mine / "object.safetensors", mine / "copy.safetensors")
    same = ('"object.safetensors"', '"copy.safetensors"')
    interrupt(mine, output, OPTIMISATION, 4 * 4 + 1, change=same)
    tensors, metadata = files.read_safetensors(mine / "object.safetensors")
    tensors["texture"] = tensors["texture"] + 1
    files.write_safetensors(mine / "copy.safetensors", tensors, metadata)
    with pytest.raises(InputError, match=r"objects\[0\]\.field: .*copy\.safetensors"):
        job(mine, output, same).run()
    versions = module.versions()
    monkeypatch.setattr(module, "versions", lambda: {**versions, "drjit": "0.1"})
    with pytest.raises(InputError, match=f"drjit: {versions['drjit']} -> 0.1"):
        job(folder, output).run()


def test_object_of_another_size_does_not_fit_by_force(folder, tmp_path):
    interrupt(folder, tmp_path, OPTIMISATION, 4 * 3 + 1)
    other = ('"object.safetensors"', '"scene.safetensors"')
    with refused_at(tmp_path / "checkpoint.safetensors"):
        job(folder, tmp_path, other).run(force=True, anyway=True)


def test_scene_counts_with_the_meshes_that_it_names(folder, tmp_path):
    mine = tmp_path / "mine"
    shutil.copytree(folder, mine)
    mesh = mine / "road.ply"
    mesh.write_text("one")
    xml = (mine / "deployment.xml").read_text()
    shape = '<shape type="ply"><string name="filename" value="road.ply"/></shape>'
    (mine / "deployment.xml").write_text(xml.replace("<emitter", f"{shape}<emitter"))
    scenario, _ = load_scenario(mine / "scenario.toml")
    before = scenario.identity()
    mesh.write_text("other")
    assert resumable.differences(before, scenario.identity()) == [
        "scenario.scene.deployment: the content of deployment.xml has changed"
    ]


def test_best_of_another_objective_is_measured_anew(folder, tmp_path):
    """Seconds in the lane are above minus any sum of distances, which was least."""
    output = tmp_path / "run"
    interrupt(folder, output, OPTIMISATION, 4 * 4 + 1)
    before = checkpoint_of(output)
    assert before["best_objective"] < 0
    change = ("[drive]", '[[objective.term]]\nkind = "departure_time"\n[drive]')
    document = job(folder, output, change).run(force=True)
    after = checkpoint_of(output)
    assert np.array_equal(after["history"][:4], before["history"])
    measured = after["history"][4:, 1]
    assert (measured > 0).all()
    assert 0 < after["best_objective"] <= measured.min()
    assert document["ignored_changes"]


def test_version_alone_keeps_the_best(folder, uninterrupted, tmp_path, monkeypatch):
    """The same objective gives the best parameters the value that they had."""
    output, versions, stages = tmp_path / "run", module.versions(), set()
    shutil.copytree(uninterrupted[0], output)
    before = checkpoint_of(output)
    monkeypatch.setattr(module, "versions", lambda: {**versions, "drjit": "0.1"})
    job(folder, output, on_progress=lambda *state: stages.add(state[0])).run(force=True)
    assert "surrogate: best so far" in stages
    document = job(folder, output).run()  # not measured a second time
    assert document["cost"]["processes"] == 3
    for name in ("best.0", "best_objective", "best_mean_m"):
        assert np.array_equal(checkpoint_of(output)[name], before[name])


@pytest.mark.parametrize(
    ("first", "then"),
    [("texture", "pose"), ("pose", "both"), ("both", "texture")],
)
def test_what_may_change_is_changed_by_force(
    folder, tmp_path, monkeypatch, first, then
):
    observations, work = [], module.Job._attack

    def watch(self, world, *arguments, **keywords):
        before = world.appearance()
        attack = work(self, world, *arguments, **keywords)
        observations.append((before, world.appearance(), attack))
        return attack

    line, output = "deterministic = true", tmp_path / "run"
    old, new = (f'{line}\nfreedom.kind = "{name}"' for name in (first, then))
    interrupt(folder, output, OPTIMISATION, 4 * 3 + 1, change=(line, old))
    monkeypatch.setattr(module.Job, "_attack", watch)
    job(folder, output, (line, new)).run(force=True)
    before, after, attack = observations[0]
    assert attack.iteration == 6
    assert np.array_equal(after.textures[0], attack.best[0])
    assert np.array_equal(after.offsets, attack.best_offsets)
    if then == "texture":
        assert np.array_equal(after.offsets, before.offsets)
    if then == "pose":
        assert np.array_equal(after.textures[0], before.textures[0])
    assert attack.best_objective <= min(r.objective for r in attack.history[3:])
