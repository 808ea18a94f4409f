"""Whole experiments as two calls: what they return is what the commands write."""

from __future__ import annotations

import pytest

import mi_nerfattack as nf
from mi_nerfattack import cli
from mi_nerfattack.io import files

pytestmark = pytest.mark.usefixtures("variant")


def test_attack_policy_returns_the_finished_run(scenario_folder, tmp_path):
    reports = []
    run = nf.attack_policy(
        scenario_folder / "scenario.toml",
        tmp_path / "run",
        frames=None,
        progress=lambda *report: reports.append(report),
    )
    assert run.metrics == files.read_json(run.folder / "metrics.json")
    assert nf.Run.read(run.folder) == run
    stages = {stage for stage, *_ in reports}
    assert {"surrogate: optimisation", "deployment: attack"} <= stages
    assert not list(run.folder.glob("*.png"))  # frames=None
    again = nf.attack_policy(scenario_folder / "scenario.toml", run.folder, frames=None)
    assert again.metrics["routes"] == run.metrics["routes"]


def test_evaluate_policy_returns_the_card(scenario_folder, tmp_path, capsys):
    scenario, reports = scenario_folder / "scenario.toml", []
    how = {"environments": ("surrogate",), "runs": 2, "horizon": 3}
    found = nf.evaluate_policy(
        scenario,
        tmp_path / "drives",
        progress=lambda *report: reports.append(report),
        **how,
    )
    total = reports[-1][1]
    assert reports[-1] == (total, total)
    figures = found.card["surrogate"]["line"]
    assert figures["no_object"]["n"] == 2
    card = tmp_path / "card.json"
    words = "--environments surrogate --runs 2 --horizon 3 --workers 1".split()
    folder = ["--drives", str(tmp_path / "drives"), "-o", str(card)]
    assert cli.main(["evaluate", str(scenario), *words, *folder]) == 0
    assert files.read_json(card) == found.card
    capsys.readouterr()
