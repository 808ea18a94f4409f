"""A found attack, searched around in deployment: what is kept, told and refused."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from mi_nerfattack import cli
from mi_nerfattack.attack.black_box.prior import PriorSearch
from mi_nerfattack.errors import InputError
from mi_nerfattack.experiment.refine.judge import EnvironmentJudge
from mi_nerfattack.experiment.refine.refine import Refinement, _basis
from mi_nerfattack.experiment.transfer.columns import Column, Condition
from mi_nerfattack.experiment.transfer.found import read_found
from mi_nerfattack.fields import load_grid
from mi_nerfattack.io import files
from mi_nerfattack.scenario.world import build_world

pytestmark = pytest.mark.usefixtures("variant")

DRIVES, CANDIDATES = 4, 3


def command(run: Path, output: Path, *more: str) -> list[str]:
    words = ["refine", str(run), "-o", str(output), "--drives", str(DRIVES), "--json"]
    words += ["--candidates", str(CANDIDATES), "--spp", "1", "--starts", "2"]
    return [*words, "--workers", "1", *more]


def read_texture(folder: Path) -> np.ndarray:
    return load_grid(folder / "objects" / "ball.safetensors").texture.numpy()


def test_the_middle_is_the_attack_and_it_is_driven_where_it_stands(found_run):
    """Its textures, from half precision and back through colours; and its drives."""
    [found] = read_found([found_run])
    column = Column("surrogate", Condition(), 1)
    task = Refinement(found, Column("mitsuba", Condition(), 1))
    world = build_world(found.scenario, found.scenario.policy.build())
    look = found.looks(world)["attack"]
    basis = _basis(task, world)
    [texture] = basis.propose(np.zeros(basis.count)).textures
    np.testing.assert_allclose(texture, look.textures[0], atol=2e-3)
    judge = EnvironmentJudge(world, found, column)
    judged = judge([texture])
    best = files.read_json(found_run / "metrics.json")["curve"]
    assert judged.frames == world.horizon * found.scenario.attack.poses
    assert judged.cross_track_mean_m == pytest.approx(
        best["cross_track_mean_m"][-1], rel=1e-3
    )
    assert judged.objective == -judged.cross_track_mean_m * world.horizon
    assert judge([0 * texture]).objective != judged.objective
    judge.close()


def test_the_command_searches_goes_on_and_drives_past_what_it_found(
    found_run, tmp_path, monkeypatch, capsys
):
    whole = tmp_path / "whole"
    assert cli.main(command(found_run, whole)) == 0
    document = json.loads(capsys.readouterr().out)
    assert document == files.read_json(whole / "refine.json")
    assert document["drives"] == DRIVES
    assert document["surrogate_drives"] == 1 + CANDIDATES * (DRIVES - 1)
    curve = document["curve"]
    assert curve["frames"] == [2, 4, 6, 8] and (np.diff(curve["objective"]) <= 0).all()
    surrogate, deployed = document["unseen"]
    assert (surrogate["environment"], deployed["environment"]) == (
        "surrogate",
        "mitsuba",
    )
    for row in (surrogate, deployed):
        means = [row[case]["cross_track_mean_m"] for case in ("found", "refined")]
        assert row["difference_m"] == pytest.approx(means[1] - means[0])
        assert row["found"]["n"] == row["refined"]["n"] == 2
    change = np.abs(read_texture(whole) - read_texture(found_run)).max()
    assert (change > 1e-3) == (curve["objective"][-1] < curve["objective"][0])

    # stopped in the midst of a search, of which fewer drives were wanted at first
    output, told = tmp_path / "stopped", PriorSearch.tell

    def stop(search, objective):
        told(search, objective)
        if len(search._told) == 3:
            raise KeyboardInterrupt

    monkeypatch.setattr(PriorSearch, "tell", stop)
    assert cli.main(command(found_run, output, "--drives", "3")) == 130
    monkeypatch.setattr(PriorSearch, "tell", told)
    kept, _ = files.read_safetensors(output / "search.safetensors")
    assert len(kept["history"]) == 2 and len(kept["guesses"]) == 1 + CANDIDATES
    capsys.readouterr()
    assert cli.main(command(found_run, output)) == 0
    assert json.loads(capsys.readouterr().out) == document
    np.testing.assert_array_equal(read_texture(output), read_texture(whole))
    # without --json, and with everything there
    assert cli.main([w for w in command(found_run, output) if w != "--json"]) == 0
    assert "(n = 2)" in capsys.readouterr().out
    # another search is not mixed with it
    assert cli.main(command(found_run, output, "--seed", "1")) == 2
    assert "refine.seed: 0 -> 1" in capsys.readouterr().err


def test_without_a_prior_nothing_is_driven_in_the_surrogate(
    found_run, tmp_path, capsys
):
    words = command(found_run, tmp_path / "out", "--prior", "none", "--starts", "1")
    assert cli.main(words) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["surrogate_drives"] == 0 and document["prior_scale"] is None
    assert document["unseen"][1]["difference_ci95_m"] is None  # of a single start


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (["--environment", "surrogate"], "surrogate, in which the attack was made"),
        (["--environment", "moon"], "--environments: 'moon'; one of"),
        (["--drives", "0"], "refine.drives: 0"),
        (["--coefficients", "65"], "refine.coefficients: 65"),
        (["--coefficients", "2"], "1 objects need at least 3"),
        (["--reach", "0"], "refine.reach: 0.0"),
        (["--starts", "0"], "refine.starts: 0"),
    ],
)
def test_options_that_do_not_fit_are_told(found_run, tmp_path, change, message, capsys):
    assert cli.main(command(found_run, tmp_path / "out", *change)) == 2
    assert message in capsys.readouterr().err
    assert not list(tmp_path.rglob("*.safetensors"))


def test_runs_without_textures_to_change_and_folders_in_use_are_refused(
    found_run, tmp_path, capsys
):
    assert cli.main(command(found_run, found_run)) == 2
    assert "is the folder of a run" in capsys.readouterr().err
    posed = tmp_path / "posed"
    shutil.copytree(found_run, posed)
    (posed / "checkpoint.safetensors").unlink()
    text = (posed / "scenario.toml").read_text().replace('"both"', '"pose"')
    text = text.replace("learning_rate = 0.5\n", "")
    (posed / "scenario.toml").write_text(text)
    [found] = read_found([posed])
    with pytest.raises(InputError, match="nothing to refine"):
        Refinement(found, Column("mitsuba", Condition(), 1))
