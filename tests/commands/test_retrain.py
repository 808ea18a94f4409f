"""The command that retrains among found attacks: what it makes, counts and refuses."""

from __future__ import annotations

import json
import shutil
import signal
from pathlib import Path

import mitsuba as mi
import pytest
from helpers import attack_jobs
from helpers.faults import full_disk, kill, short_of_memory, signalled

from mi_nerfattack import cli
from mi_nerfattack.experiment.job import Job
from mi_nerfattack.experiment.retrain.solvable import drive_expert
from mi_nerfattack.experiment.transfer.found import read_found
from mi_nerfattack.io import files, locks
from mi_nerfattack.policy.pilotnet import PilotNet
from mi_nerfattack.scenario.scenario import load_scenario
from mi_nerfattack.training.collect import find_shards

pytestmark = pytest.mark.usefixtures("variant")

CHANGES = {
    "horizon = 2": "horizon = 16",
    "max_iterations = 30": "max_iterations = 1",
    "textures = 4": "textures = 1",
    "runs = 2": "runs = 1",
    "[7.0, 4.2, 1.6]": "[-13.0, 3.4, 1.6]",
}


@pytest.fixture(scope="module")
def run(tmp_path_factory) -> Path:
    """The folder of a finished attack on PilotNet, without pictures."""
    mi.set_variant("llvm_ad_rgb")
    folder = attack_jobs.write_scenario(tmp_path_factory.mktemp("scenario"), CHANGES)
    routes = files.read_json(folder / "routes.json")
    routes["line"]["points_m"] = [[-20.0, 0.0], [-8.0, 0.0]]
    files.write_json(folder / "routes.json", routes)
    scenario, text = load_scenario(folder / "scenario.toml")
    job = Job(scenario, text, scenario.build_policy(), folder / "run", frames=None)
    job.run(anyway=True)
    return folder / "run"


def changed(run: Path, folder: Path, *changes: tuple[str, str]) -> Path:
    """Copy a run, with a changed scenario that no checkpoint contradicts."""
    shutil.copytree(run, folder)
    (folder / "checkpoint.safetensors").unlink()
    path = folder / "scenario.toml"
    text = path.read_text()
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    path.write_text(text)
    return folder


def words_of(folder: Path, *arguments: object) -> list[str]:
    words = ["retrain", "-o", folder / "new.safetensors", "--data", folder / "data"]
    words += ["--workers", 1, "--epochs", 1, "--runs", 1, "--starts", 1]
    words += [*arguments, "--environments", "surrogate"]
    return [str(word) for word in words]


def retrain(folder: Path, *arguments: object) -> int:
    return cli.main(words_of(folder, *arguments))


def test_a_policy_is_tuned_on_old_and_new_frames(run, tmp_path, capsys):
    """What is there is taken up; a scenario with a blocked lane does not count."""
    blocked = changed(run, tmp_path / "blocked", ("-13.0, 3.4", "-13.0, 0.4"))
    frames = ["--frames", "surrogate", 64, "--exposures-ev", 0]
    assert retrain(tmp_path, run, blocked, *frames) == 0
    told = capsys.readouterr()
    assert "blocked: left out: an object stands" in told.out
    assert "no --more" in told.err
    old = PilotNet.load(run.parent / "policy.safetensors")
    new = PilotNet.load(tmp_path / "new.safetensors")
    assert (new.goals, new.max_control) == (old.goals, old.max_control)
    pairs = zip(new.parameters(), old.parameters(), strict=True)
    steps = [float((a - b).abs().max().detach()) for a, b in pairs]
    assert 0 < max(steps) < 0.01  # a training of its own would be far away
    about = files.read_json(tmp_path / "new-retrain.json")
    assert [item["label"] for item in about["runs"]] == ["run"]
    assert list(about["left_out"]) == ["blocked"]
    assert about["policy"]["sha256"] == files.sha256(run.parent / "policy.safetensors")
    record = files.read_json(tmp_path / "new.json")
    assert record["data"] == {"round_0/surrogate": 64}
    shards = find_shards(tmp_path / "data")
    written = [path.stat().st_mtime_ns for path in shards]
    weights = (tmp_path / "new.safetensors").read_bytes()
    # the same command takes up what is there; other runs are other frames
    capsys.readouterr()
    assert retrain(tmp_path, run, blocked, *frames, "--json") == 0
    told, err = capsys.readouterr()
    assert json.loads(told).items() >= about.items() and "blocked: left out" in err
    assert [path.stat().st_mtime_ns for path in shards] == written
    assert (tmp_path / "new.safetensors").read_bytes() == weights
    near = changed(run, tmp_path / "near", ("-13.0, 3.4", "-12.0, 3.4"))
    capsys.readouterr()
    assert retrain(tmp_path, run, near, *frames) == 2
    assert "staging.found" in capsys.readouterr().err
    # old frames are trained on, too, and attacks driven that nothing was trained on
    other = tmp_path / "other"
    other.mkdir()
    more = ["--more", tmp_path / "data", "--held-out", run]
    assert retrain(other, near, *frames, *more) == 0
    check_table(files.read_json(other / "new-retrain.json"), other)
    record = files.read_json(other / "new.json")
    assert record["data"] == {"round_0/surrogate": 64, "earlier/surrogate": 64}
    check_adaptive(other, near, *frames, *more)
    page = other / "page.html"
    words = ["report", str(other / "new-retrain.json"), "-o", str(page), "--json"]
    capsys.readouterr()
    assert cli.main(words) == 0
    told = json.loads(capsys.readouterr().out)
    assert told == {"output": str(page), "bytes": page.stat().st_size}
    assert "Adaptive: the policy before past" in page.read_text()


def check_adaptive(folder: Path, run: Path, *arguments) -> None:
    """The new policy is attacked later, and not trained again."""
    weights = (folder / "new.safetensors").read_bytes()
    assert retrain(folder, run, *arguments, "--adaptive") == 0
    about = files.read_json(folder / "new-retrain.json")
    assert (folder / "new.safetensors").read_bytes() == weights
    check_table(about, folder, "adaptive")
    (cell,) = (folder / "data" / "adaptive" / "cells").iterdir()
    assert (cell / "_complete").exists()
    (found,), (old,) = read_found([cell]), read_found([run])
    assert found.scenario.policy.file.file == folder / "new.safetensors"
    same = {"policy": old.scenario.policy}
    assert found.scenario.model_copy(update=same).digest() == old.scenario.digest()
    (anew,) = about["adaptive"]
    assert anew["label"] == cell.name and anew["found_sha256"] == found.digest
    made = cell.stat().st_mtime_ns
    assert retrain(folder, run, *arguments, "--adaptive") == 0
    assert cell.stat().st_mtime_ns == made
    assert files.read_json(folder / "new-retrain.json") == about


def check_table(about: dict, folder: Path, *more: str) -> None:
    """Before and after are the drives of a transfer of each group by each policy."""
    rows = about["table"]
    assert [row["group"] for row in rows] == ["old", "held_out", *more]
    assert [item["label"] for item in about["held_out"]] == ["run"]
    for row in rows:
        for stage in ("before", "after"):
            group = row["group"]
            if group == "adaptive" and stage == "before":
                group = "old"
            kept = folder / "data" / f"{group}_{stage}" / "transfer.json"
            (column,) = files.read_json(kept)["columns"]
            assert row[stage] == column["cases"]
            figures = row[stage]["attack"]
            clean = row[stage]["no_object"]["cross_track_mean_m"]
            assert figures["drives"] == 1
            assert row["attack_to_clean"][stage] * clean == pytest.approx(
                figures["cross_track_mean_m"]
            )
        before, after = (row[s]["no_object"] for s in ("before", "after"))
        assert before["cross_track_mean_m"] != after["cross_track_mean_m"]
        ratio = after["cross_track_mean_m"] / before["cross_track_mean_m"]
        assert row["clean_ratio"] == pytest.approx(ratio)


FRAMES = ("--frames", "surrogate", 64, "--exposures-ev", 0)


@pytest.fixture(scope="module")
def whole(run, tmp_path_factory) -> Path:
    """What a retraining writes that nothing disturbs."""
    folder = tmp_path_factory.mktemp("whole")
    assert retrain(folder, run, *FRAMES) == 0
    return folder


def check_goes_on(run: Path, folder: Path, whole: Path) -> None:
    """The same command keeps frames and drives, and ends in the same figures."""
    kept = [*folder.rglob("shard_*"), *folder.rglob("start_*")]
    times = {path: path.stat().st_mtime_ns for path in kept}
    assert retrain(folder, run, *FRAMES) == 0
    assert not any(locks.is_partial(path) for path in (folder / "data").rglob(".*"))
    assert times and all(path.stat().st_mtime_ns == times[path] for path in kept)
    for name in ("new.safetensors", "new-retrain.json"):
        assert (folder / name).read_bytes() == (whole / name).read_bytes()


@pytest.mark.slow
def test_what_a_full_disk_left_goes_on(run, whole, tmp_path, capsys):
    for name in (
        "start_",
        "shard",
        "checkpoint",
        "new.safe",
        "new.json",
        "new-retrain",
    ):
        with full_disk(name):
            assert retrain(tmp_path, run, *FRAMES) == 2
        assert "no space left on the disk" in capsys.readouterr().err
        assert not any(locks.is_partial(path) for path in tmp_path.rglob(".*"))
    check_goes_on(run, tmp_path, whole)


@pytest.mark.slow
def test_too_little_memory_keeps_what_is_done(run, whole, tmp_path, capsys):
    for stage in ("round_0, surrogate", "training 0", "card", "after, old"):
        with short_of_memory(stage):
            assert retrain(tmp_path, run, *FRAMES) == 2
        assert "error: not enough memory: 249 TiB" in capsys.readouterr().err
    check_goes_on(run, tmp_path, whole)


@pytest.mark.slow
def test_what_a_killed_process_left_goes_on(run, whole, tmp_path):
    for name in ("shard", "checkpoint", "new.safe"):
        kill(words_of(tmp_path, run, *FRAMES), tmp_path, name)
    check_goes_on(run, tmp_path, whole)


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_what_was_interrupted_goes_on(run, whole, tmp_path, capsys, number):
    frames = "round_0, surrogate"
    for stage in ("before, old", frames, "training 0", "card", "after, old"):
        with signalled(stage, number):
            assert retrain(tmp_path, run, *FRAMES) == 130
        assert "mi-nerfattack: interrupted" in capsys.readouterr().err
    check_goes_on(run, tmp_path, whole)


def test_the_expert_decides_what_can_be_driven(run, tmp_path):
    (found,) = read_found([run])
    driven = drive_expert(found)
    assert driven.trouble == ""
    # a box 3 m wide around y = 3.4 m, and a car 1.8 m wide within 0.3 m of y = 0
    assert driven.gap_m == pytest.approx(3.4 - 1.5 - 0.9, abs=0.3)
    late = changed(run, tmp_path / "late", ("[drive]", "[drive]\nlateral_sd_m = 5.0"))
    (found,) = read_found([late])
    assert "leaves its lane" in drive_expert(found).trouble


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (("[policy]", "[policy]\ncontrol_scale = 0.5"), "only PilotNet of"),
        (("policy.safetensors", "other.safetensors"), "retrain one policy at a time"),
        (("[drive]", "[vehicle]\nwidth_m = 1.5\n[drive]"), "one place at a time"),
    ],
)
def test_runs_that_do_not_go_together_are_refused(
    run, tmp_path, change, message, capsys
):
    PilotNet(4).save(run.parent / "other.safetensors")
    other = changed(run, tmp_path / "other", change)
    assert retrain(tmp_path, run, other) == 2
    assert message in capsys.readouterr().err
    assert not (tmp_path / "data").exists()


def test_options_that_do_not_fit_are_told(run, tmp_path, capsys):
    assert retrain(tmp_path, run, "--frames", "carla", 8) == 2
    assert "--frames: 'carla'; of surrogate" in capsys.readouterr().err
    assert retrain(tmp_path, run, "--held-out", run) == 2
    assert "each once" in capsys.readouterr().err
    policy = run.parent / "policy.safetensors"
    before = policy.read_bytes()
    assert retrain(tmp_path, run, "-o", policy) == 2
    assert "is the policy that was attacked" in capsys.readouterr().err
    assert policy.read_bytes() == before
    blocked = changed(run, tmp_path / "blocked", ("-13.0, 3.4", "-13.0, 0.4"))
    assert retrain(tmp_path, blocked) == 2
    assert "none can be driven by the expert" in capsys.readouterr().err
