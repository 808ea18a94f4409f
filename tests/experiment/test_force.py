"""Attacks that go on with another scenario, other files or versions."""

from __future__ import annotations

import shutil

import numpy as np
import pytest
from helpers.attack_jobs import checkpoint_of, contents, interrupt, job

from mi_nerfattack.errors import InputError
from mi_nerfattack.experiment import job as module
from mi_nerfattack.io import files, resumable
from mi_nerfattack.scenario.scenario import load_scenario

pytestmark = pytest.mark.usefixtures("variant")


@pytest.mark.usefixtures("no_results")
def test_changed_scenario_is_refused_with_a_diff_unless_forced(folder, tmp_path):
    output, notices = tmp_path / "run", []
    interrupt(folder, output, "surrogate: optimisation", 4 * 4 + 1)
    before = contents(output)
    change = ("learning_rate = 0.5", "learning_rate = 0.25\njitter = true")
    with pytest.raises(InputError) as refused:
        job(folder, output, change).run()
    message = str(refused.value)
    assert str(output / "checkpoint.safetensors") in message
    assert "scenario.attack.learning_rate: 0.5 -> 0.25" in message
    assert "scenario.attack.jitter: false -> true" in message
    assert "--force" in message and "seed" not in message
    assert contents(output) == before
    # forced, the attack goes on where it was, and the result says what was ignored
    first = []

    def watch(stage, done, total, remark):
        if stage == "surrogate: optimisation":
            first.append(done)

    run = job(folder, output, change, watch, notices)
    document = run.run(force=True)
    assert first[0] == 4 * 4 + 1 and len(checkpoint_of(output)["history"]) == 6
    line = "scenario.attack.learning_rate: 0.5 -> 0.25"
    assert line in document["ignored_changes"]
    assert document["curve"] is None  # of two learning rates
    assert any(line in notice for notice in notices)
    assert "learning_rate = 0.25" in (output / "scenario.toml").read_text()
    # from then on the run is that of the changed scenario, its drives too
    job(folder, output, change).run()
    with pytest.raises(InputError, match=r"learning_rate: 0\.25 -> 0\.5"):
        job(folder, output).run()


@pytest.mark.usefixtures("no_results")
def test_changed_file_and_version_are_named(folder, tmp_path, monkeypatch):
    output, mine = tmp_path / "run", tmp_path / "mine"
    shutil.copytree(folder, mine)
    interrupt(mine, output, "surrogate: optimisation", 4 * 3 + 1)
    # a field of another name and place but the same content is the same
    shutil.copy(mine / "object.safetensors", mine / "copy.safetensors")
    same = ('"object.safetensors"', '"copy.safetensors"')
    interrupt(mine, output, "surrogate: optimisation", 4 * 4 + 1, change=same)
    tensors, metadata = files.read_safetensors(mine / "object.safetensors")
    tensors["texture"] = tensors["texture"] + 1
    files.write_safetensors(mine / "object.safetensors", tensors, metadata)
    with pytest.raises(InputError) as refused:
        job(mine, output).run()
    assert "objects[0].field: copy.safetensors -> object.safetensors" in str(
        refused.value
    )
    files.write_safetensors(mine / "copy.safetensors", tensors, metadata)
    with pytest.raises(InputError, match=r"content of copy\.safetensors has changed"):
        job(mine, output, same).run()
    found = module.versions()
    changed = {**found, "drjit": "0.1"}
    monkeypatch.setattr(module, "versions", lambda: changed)
    with pytest.raises(InputError, match=f"drjit: {found['drjit']} -> 0.1"):
        job(folder, output).run()


@pytest.mark.usefixtures("no_results")
def test_object_of_another_size_does_not_fit_by_force(folder, tmp_path):
    output = tmp_path / "run"
    interrupt(folder, output, "surrogate: optimisation", 4 * 3 + 1)
    other = ('"object.safetensors"', '"scene.safetensors"')
    with pytest.raises(InputError, match=r"checkpoint\.safetensors: .*this run needs"):
        job(folder, output, other).run(force=True, anyway=True)


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


def run_forced(folder, output, change, **more):
    return job(folder, output, change, **more).run(force=True)


@pytest.mark.usefixtures("no_results")
def test_best_of_another_objective_is_measured_anew(folder, tmp_path):
    """Seconds in the lane are above minus any sum of distances, which was least."""
    output = tmp_path / "run"
    interrupt(folder, output, "surrogate: optimisation", 4 * 4 + 1)
    before = checkpoint_of(output)
    assert before["best_objective"] < 0
    change = ("[drive]", '[objective]\nkind = "departure_time"\n[drive]')
    document = run_forced(folder, output, change)
    after = checkpoint_of(output)
    assert np.array_equal(after["history"][:4], before["history"])
    measured = after["history"][4:, 1]
    assert (measured > 0).all()
    assert 0 < after["best_objective"] <= measured.min()
    assert document["ignored_changes"]


@pytest.mark.usefixtures("no_results")
def test_version_alone_keeps_the_best(folder, whole, tmp_path, monkeypatch):
    """The same objective gives the best parameters the value that they had."""
    output, found = tmp_path / "run", module.versions()
    shutil.copytree(whole[0], output)
    before = checkpoint_of(output)
    monkeypatch.setattr(module, "versions", lambda: {**found, "drjit": "0.1"})
    stages = set()
    run_forced(
        folder, output, ("", ""), on_progress=lambda stage, *_: stages.add(stage)
    )
    assert "surrogate: best so far" in stages
    document = job(folder, output).run()  # not measured a second time
    assert document["cost"]["processes"] == 3
    after = checkpoint_of(output)
    for name in ("best.0", "best_objective", "best_mean_m"):
        assert np.array_equal(after[name], before[name])


@pytest.mark.usefixtures("no_results")
@pytest.mark.parametrize(
    ("first", "then"),
    [("texture", "pose"), ("pose", "both"), ("both", "texture")],
)
def test_what_may_change_is_changed_by_force(
    folder, tmp_path, monkeypatch, first, then
):
    seen, work = [], module.Job._attack

    def watch(self, world, *arguments):
        before = world.appearance()
        attack = work(self, world, *arguments)
        seen.append((before, world.appearance(), attack))
        return attack

    line, output = "deterministic = true", tmp_path / "run"
    old, new = (f'{line}\nparameters = "{name}"' for name in (first, then))
    interrupt(folder, output, "surrogate: optimisation", 4 * 3 + 1, change=(line, old))
    monkeypatch.setattr(module.Job, "_attack", watch)
    run_forced(folder, output, (line, new))
    before, after, attack = seen[0]
    assert attack.iteration == 6
    assert np.array_equal(after.textures[0], attack.best[0])
    assert np.array_equal(after.offsets, attack.best_offsets)
    if then == "texture":
        assert np.array_equal(after.offsets, before.offsets)
    if then == "pose":
        assert np.array_equal(after.textures[0], before.textures[0])
    assert attack.best_objective <= min(r.objective for r in attack.history[3:])
