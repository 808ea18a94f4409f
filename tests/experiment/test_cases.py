"""The cases of a run: equal starts, fair random looks, seconds of the clock."""

from __future__ import annotations

import re
import shutil

import numpy as np
import pytest
from helpers.attack_jobs import job

from mi_nerfattack.commands.shared.progress import StageBars
from mi_nerfattack.experiment import results
from mi_nerfattack.io import files
from mi_nerfattack.rollout.drive import CASES

pytestmark = pytest.mark.usefixtures("variant")

POSES = 'parameters = "pose"\npose_limit_m = 0.5\npose_learning_rate = 0.1'


def test_all_cases_drive_from_the_same_starts(whole):
    drives = whole[1]["drives"]
    starts = {}
    for drive in drives:
        starts.setdefault(drive.run, []).append(drive.states[0])
    assert {drive.case for drive in drives} == set(CASES)
    for found in starts.values():
        assert len(found) == 10  # five cases in two environments
        assert np.ptp(found, axis=0).max() == 0
    assert not np.array_equal(starts[0][0], starts[1][0])


def test_best_random_is_the_look_of_least_objective(whole):
    folder, document = whole
    drives = {(d.environment, d.case, d.run): d for d in document["drives"]}
    kept = [
        files.read_safetensors(folder / f"drives/surrogate_random_{k:04d}.safetensors")
        for k in (0, 1)
    ]
    pattern = r'"objective":\s*(-?[\d.e+-]+)'
    found = [float(re.search(pattern, meta["kept.record"])[1]) for _, meta in kept]
    assert found[0] != found[1]
    best = int(np.argmin(found))
    # of two looks and two starts: look k drives from start k
    for label in ("surrogate", "deployment"):
        one, other = (drives[label, case, best] for case in ("random", "best_random"))
        assert np.array_equal(one.states, other.states)


@pytest.mark.usefixtures("no_results")
def test_random_poses_are_compared_with_attacks_on_poses(folder, tmp_path, monkeypatch):
    seen = {}

    def only_looks(output, done, *more):
        seen.update(done.looks)
        return {}

    monkeypatch.setattr(results, "write_results", only_looks)
    job(folder, tmp_path / "run", ("iterations = 6", f"iterations = 1\n{POSES}")).run()
    assert list(seen) == ["no_object", "own", "attack", "random", "best_random"]
    assert seen["no_object"] is None
    for case in ("random", "best_random", "attack"):
        look = seen[case]
        assert np.array_equal(look.textures[0], seen["own"].textures[0])
        shift = np.abs(look.offsets[0])
        assert shift[:2].max() <= 0.5 and not shift[2:5].any()
        assert case == "attack" or shift[:2].min() > 0


@pytest.mark.usefixtures("no_results")
def test_best_random_is_driven_again_where_the_attack_is_lost(folder, whole, tmp_path):
    output, driven = tmp_path / "run", set()
    shutil.copytree(whole[0], output)
    (output / "checkpoint.safetensors").unlink()

    def watch(stage, done, total, remark):
        if remark != "kept":
            driven.add(stage)

    job(folder, output, on_progress=watch).run()
    assert driven == {"surrogate: optimisation"} | {
        f"{label}: {case}"
        for label in ("surrogate", "deployment")
        for case in ("best_random", "attack")
    }


@pytest.mark.usefixtures("no_results")
def test_seconds_are_those_since_the_command_began(folder, tmp_path, capsys):
    change = ("iterations = 6", "iterations = 1")
    begun = job(folder, tmp_path / "run", change)
    begun.started -= 1000
    assert begun.run()["cost"]["wall_s"] > 1000
    with StageBars(begun.started) as bars:
        bars.show("attack", 1, 1, "")
    assert int(capsys.readouterr().err.split()[0]) >= 1000
