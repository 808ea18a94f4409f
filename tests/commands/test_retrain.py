"""Retraining by a user's command: of a policy of their own, and into any other."""

from __future__ import annotations

import json
import re
import shutil
import sys
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
import torch
from safetensors.torch import save_file

import mi_nerfattack as nf
from mi_nerfattack import cli
from mi_nerfattack.commands.retrain import Retrain
from mi_nerfattack.deploy.place import bundled_place
from mi_nerfattack.experiment.transfer.found import read_found
from mi_nerfattack.io import files
from mi_nerfattack.scenario.policy.kinds import HttpSection
from mi_nerfattack.scenario.user_code import load_function
from tests.faults import worlds

pytestmark = pytest.mark.usefixtures("variant")

EXAMPLE = Path(__file__).parents[2] / "docs/examples/retrain_user.py"
POLICY = """file = "mine.py:Net"
weights_file = "net.safetensors"
trust_code = true
control_unit = "rad/s"
"""
CHANGES = worlds.PILOTNET | {'file = "policy.safetensors"\n': POLICY}
COMMAND = f"'{sys.executable}' mine.py {{data}} {{out}} {{seed}} {{policy}}"
# another kind of policy, which no key of the attacked one describes
STILL = """
def train(data, out, seed):
    out.with_name("still.py").write_text(
        "def drive(image, goal, step):\\n    return [0.125] * len(image)\\n"
    )
    out.write_text(
        '[policy]\\nkind = "callable"\\nfile = "still.py:drive"\\ntrust_code = true\\n'
        "preprocess = { crop_px = [1, 1, 0, 0] }\\n"
    )
"""


@pytest.fixture(scope="module")
def world(tmp_path_factory) -> Path:
    """A folder with a finished run on the policy of the example, in `run`."""
    mi.set_variant("llvm_ad_rgb")
    folder = tmp_path_factory.mktemp("world")
    shutil.copy(EXAMPLE, folder / "mine.py")
    torch.manual_seed(0)
    save_file(load_function(EXAMPLE, "Net")().state_dict(), folder / "net.safetensors")
    worlds.attacked(folder, CHANGES)
    (folder / "still_training.py").write_text(STILL)
    return folder


def retrain(*arguments: object) -> int:
    words = ["retrain", "run", "--data", "data", "--workers", 1, "--runs", 1]
    words += ["--frames", "surrogate", 64, "--environments", "surrogate", *arguments]
    return cli.main([str(word) for word in words])


def figures(document: dict) -> tuple[float, float]:
    """Return the mean errors without objects before and after."""
    (row,) = document["table"][:1]
    before, after = (row[stage]["no_object"] for stage in ("before", "after"))
    return before["cross_track_mean_m"], after["cross_track_mean_m"]


def test_a_users_command_trains_a_users_policy(world, monkeypatch, capsys):
    monkeypatch.chdir(world)
    command = ["--command", COMMAND, "-o", "new.safetensors"]
    assert retrain(*command, "--json") == 0
    printed, shown = capsys.readouterr()
    assert shown.count("rms error") == 4
    document = files.read_json(world / "new-retrain.json")
    assert json.loads(printed).items() >= document.items()
    weights = world / "net.safetensors"
    assert document["policy"] == {"file": weights.name, "sha256": files.sha256(weights)}
    assert document["training"]["command"] == COMMAND
    assert document["training"]["frames"] == {"round_0/surrogate": 64}
    old, new = (files.read_safetensors(world / n)[0] for n in (weights, command[-1]))
    assert all(np.abs(new[name] - old[name]).max() > 0 for name in old)
    before, after = figures(document)
    assert before != after
    # some frames are of drives of the attacked policy, which begin beside the lane
    frames = nf.frames(world / "data/round_0")
    assert max(int(frames[row].step) for row in range(64)) > 8
    # again with an adaptive attack: nothing is trained again
    made = (world / "data/trained/policy.safetensors").stat().st_mtime_ns
    assert retrain(*command, "--adaptive") == 0
    assert "rms error" not in capsys.readouterr().err
    assert (world / "data/trained/policy.safetensors").stat().st_mtime_ns == made
    (cell,) = (world / "data/adaptive/cells").iterdir()
    (adaptive,), (run,) = read_found([cell]), read_found([world / "run"])
    assert adaptive.scenario.policy.weights_file.file == world / "new.safetensors"
    same = {"policy": run.scenario.policy}
    assert adaptive.scenario.model_copy(update=same).digest() == run.scenario.digest()
    assert cli.main(["report", "new-retrain.json", "-o", "page.html"]) == 0
    assert "Adaptive" in (world / "page.html").read_text()


def test_a_training_can_end_in_another_policy(world, monkeypatch, capsys):
    """The file with [policy] is what evaluate takes, wherever it lies."""
    monkeypatch.chdir(world)
    module = ["--module", "still_training.py:train", "--trust-code"]
    folder = files.make_folder(world / "results")
    assert retrain(*module, "-o", folder / "still.toml") == 0
    document = files.read_json(folder / "still-retrain.json")
    assert document["training"]["module"] == "still_training.py:train"
    (attack,) = read_found([world / "run"])
    drives = list((world / "data/old_after/drives").rglob("*.safetensors"))
    controls = [files.read_safetensors(path)[0]["controls"] for path in drives]
    held = [values for values in controls if (values == 0.125).all()]
    assert len(held) == 2  # alone and past the attack
    policy = (folder / "still.toml").read_text()
    assert str(world / "data/trained/still.py:drive") in policy
    capsys.readouterr()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("-o a.safetensors", "only PilotNet of .*; give your own training with --comm"),
        ("-o a.pt2 --command COMMAND", "-o: a.pt2; must end in .safetensors or .toml"),
        ("-o net.safetensors --command COMMAND", "is the policy that was attacked"),
        ("-o a.toml --command COMMAND --epochs 3", "--epochs: is of our training"),
        ("-o a.toml --command COMMAND --more data", "--more: is of our training"),
        ("-o none/a.toml --command COMMAND", "none/a.toml: no such folder|not exist"),
        ("-o a.toml --command mine.py", r"missing \{data\} \{out\}; allowed: \{data"),
        ("-o a.toml --module mine.py:train", "add --trust-code"),
    ],
)
def test_what_cannot_be_trained_is_refused_before_a_drive(
    world, tmp_path, monkeypatch, capsys, arguments, message
):
    monkeypatch.chdir(world)
    words = [COMMAND if word == "COMMAND" else word for word in arguments.split()]
    assert retrain("--data", tmp_path / "new", *words) == 2
    error = capsys.readouterr().err
    assert len([*re.finditer(message, error)]) == 1, error
    assert not (tmp_path / "new").exists()


def test_frames_and_starts_have_the_scale_of_the_car():
    """A lane of the room is narrower than the scatter of a full-size car."""
    policy = HttpSection(kind="http", url="http://127.0.0.1:1")
    for name, share in (("intersection", 1.0), ("room", 0.2)):
        place = bundled_place(name)
        settings = Retrain((), Path("new"), Path("data"))._settings(policy, place)
        frames, starts = settings.collecting.scatter, settings.final.scatter
        assert frames.lateral_max_m < share * 1.6 and starts.lateral_max_m < share * 1.6
        assert settings.final.car_width_m == place.car.width
        assert settings.collecting.shard == 32
