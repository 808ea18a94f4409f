"""Certificates of gradients: attached ones are true, and what is untrue is flagged."""

from __future__ import annotations

import json
import shutil

import mitsuba as mi
import numpy as np
import pandas as pd
import pytest
from support.faults.refusals import refused_at
from support.pages.read import drawn

from mi_nerfattack import cli
from mi_nerfattack.experiment.certify.directions import Ended
from mi_nerfattack.experiment.certify.gradient import certify_gradient, sentences
from mi_nerfattack.experiment.job import Job
from mi_nerfattack.io import files
from mi_nerfattack.report.certificate import gradient_table
from mi_nerfattack.report.plots.certificate import plot_gradient
from mi_nerfattack.rollout.objective import (
    StageSum,
    Terminal,
    WeightedSum,
    truncated,
)
from mi_nerfattack.scenario.scenario import load_scenario
from mi_nerfattack.system.workers import InThisProcess
from tests.experiment.conftest import write_found

pytestmark = pytest.mark.usefixtures("variant")

#: Textures alone, of smooth images, through the whole loop.
ATTACHED = {
    'freedom.kind = "both"\nfreedom.pose_limit_m = 0.2\n': "attached = true\n",
    "spp = 1\ndeployment": "spp = 9\ndeployment",
    "horizon = 2": "horizon = 6",
    "max_iterations = 2": "max_iterations = 1",
    "textures = 2": "textures = 1",
    "runs = 2": "runs = 1",
}


def attacked(folder, changes):
    path = write_found(folder)
    text = path.read_text()
    for old, new in changes.items():
        assert old in text, old
        text = text.replace(old, new)
    path.write_text(text)
    scenario, text = load_scenario(path)
    run = folder / "run"
    Job(scenario, text, scenario.build_policy(), run, frames=None).run(anyway=True)
    return run


@pytest.fixture(scope="module")
def attached_run(tmp_path_factory):
    mi.set_variant("llvm_ad_rgb")
    return attacked(tmp_path_factory.mktemp("attached"), ATTACHED)


@pytest.fixture(scope="module")
def certified(attached_run, tmp_path_factory):
    output = tmp_path_factory.mktemp("out") / "certificate"
    return output, certify_gradient(attached_run, output, 8, 0.05, InThisProcess())


def test_an_attached_gradient_is_true_over_the_whole_drive(certified):
    output, document = certified
    assert document["flags"] == [] and document["true_until_s"] == pytest.approx(0.6)
    assert [row["periods"] for row in document["rows"]] == [1, 2, 3, 4, 6]
    for row in document["rows"]:
        assert row["slope"] == pytest.approx(1, abs=0.05), row
        assert row["cosine"] > 0.99 and len(row["real"]) == 8
        ratio = row["along_real"] / row["along_predicted"]
        assert ratio == pytest.approx(1, abs=0.05)
    assert document["rows"][-1]["along_predicted"] < 0  # downhill
    table = pd.read_csv(output / "differences.csv")
    assert len(table) == 9 * 5 and set(table["direction"]) == set(range(9))
    assert document == files.read_json(output / "certificate.json")


def test_finished_differences_are_kept(attached_run, certified):
    output, document = certified
    before = {p: p.stat().st_mtime_ns for p in output.glob("differences/*")}
    assert len(before) == 1 + 9
    fewer = certify_gradient(attached_run, output, 5, 0.05, InThisProcess())
    after = {p: p.stat().st_mtime_ns for p in output.glob("differences/*")}
    assert len(after) == 1 + 6 and after.items() <= before.items()
    one, other = fewer["rows"][-1], document["rows"][-1]
    assert one["real"] == other["real"][:5]
    assert one["along_real"] == other["along_real"]


def test_a_gradient_of_another_drive_is_flagged(attached_run, tmp_path, monkeypatch):
    """The differences of drives that steer the other way: the slope turns its sign."""
    own = Ended.costs

    def mirrored(self, change, on_step=None):
        return own(self, {key: -value for key, value in change.items()}, on_step)

    monkeypatch.setattr(Ended, "costs", mirrored)
    document = certify_gradient(attached_run, tmp_path, 5, 0.05, InThisProcess())
    assert document["true_until_s"] == 0.0 and len(document["flags"]) == 1
    assert document["rows"][-1]["slope"] == pytest.approx(-1, abs=0.1)


def blind(monkeypatch, horizons, real=True, predicted=True):
    """Let objectives at some horizons (numbers) depend on nothing."""
    costs, gradient = Ended.costs, Ended.gradient

    def flat_costs(self, change, on_step=None):
        values = costs(self, change, on_step)
        values[horizons if real else []] = 0.0
        return values

    def flat_gradient(self, horizon, on_step=None):
        values = gradient(self, horizon, on_step)
        flat = predicted and self.horizons.index(horizon) in horizons
        return {key: 0 * value if flat else value for key, value in values.items()}

    monkeypatch.setattr(Ended, "costs", flat_costs)
    monkeypatch.setattr(Ended, "gradient", flat_gradient)


@pytest.mark.parametrize("horizons", [[0, 1], [2]])
def test_horizons_without_changes_are_not_judged(
    horizons, attached_run, tmp_path, monkeypatch
):
    blind(monkeypatch, horizons)
    document = certify_gradient(attached_run, tmp_path, 5, 0.05, InThisProcess())
    judged = [row["is_true"] for row in document["rows"]]
    assert judged == [None if k in horizons else True for k in range(5)]
    assert document["flags"] == [] and document["true_until_s"] == pytest.approx(0.6)
    cells = [cells[-1] for _, _, cells in gradient_table(document).body]
    assert [cell.text for cell in cells].count("–") == len(horizons)
    assert pd.read_csv(tmp_path / "certificate.csv")["is_true"].isna().sum() == len(
        horizons
    )


@pytest.mark.parametrize("real", [True, False])
def test_a_change_on_one_side_alone_is_untrue(
    real, attached_run, tmp_path, monkeypatch
):
    blind(monkeypatch, [1, 2], real=real, predicted=not real)
    document = certify_gradient(attached_run, tmp_path, 5, 0.05, InThisProcess())
    judged = [row["is_true"] for row in document["rows"]]
    assert judged == [True, False, False, True, True]
    assert document["true_until_s"] == pytest.approx(0.1) and document["flags"]


def test_without_any_change_nothing_is_said_to_be_true(
    attached_run, tmp_path, monkeypatch
):
    blind(monkeypatch, [0, 1, 2, 3, 4])
    document = certify_gradient(attached_run, tmp_path, 3, 0.05, InThisProcess())
    assert document["true_until_s"] == 0.0 and len(document["flags"]) == 1
    assert {row["is_true"] for row in document["rows"]} == {None}


def test_a_gradient_that_the_attack_did_not_follow_is_named(certified):
    _, document = certified
    assert document["levels"] == "all" and document["attack_follow"] == "always"
    assert document["attack_one_level"] is False and len(sentences(document)) == 1
    others = {"attack_one_level": True, "attack_follow": "in_turns"}
    assert len(sentences({**document, **others})) == 3


def test_objectives_end_with_the_horizon():
    states = np.random.default_rng(0).normal(size=(2, 6, 3))

    def square(rows):
        return rows[0] * rows[0]

    values = states[:, :, 0] ** 2
    weights = np.array([1.0, 2, 3, 4, 5, 6])
    weighted, end = StageSum(square, weights), Terminal(square)
    both = WeightedSum(((2.0, weighted), (1.0, end)))
    costs = truncated(both, 4).costs(states[:, :4], 0.1)
    expected = 2 * (weights[:4] * values[:, :4]).sum(1) + values[:, 3]
    assert costs == pytest.approx(expected, rel=1e-5)


def test_the_chart_has_slopes_cosines_and_changes(certified, monkeypatch):
    _, document = certified
    figures = drawn(monkeypatch)
    plot_gradient("certificate.png", document)
    left, right = figures[0].axes
    slopes, cosines = (c.lines[0].get_ydata() for c in left.containers)
    rows = document["rows"]
    assert slopes.tolist() == [row["slope"] for row in rows]
    assert cosines.tolist() == [row["cosine"] for row in rows]
    assert right.lines[0].get_ydata().tolist() == rows[-1]["real"]


def test_the_command_prints_the_document(attached_run, tmp_path, capfd):
    words = ["certify", "gradient", str(attached_run), "-o", str(tmp_path / "out")]
    words += ["--directions", "3", "--workers", "1", "--json"]
    assert cli.main(words) == 0
    document = json.loads(capfd.readouterr().out.splitlines()[-1])
    assert document == files.read_json(tmp_path / "out/certificate.json")
    assert document["attached"] is True


def test_refusals(attached_run, tmp_path):
    output = tmp_path / "out"

    def certify(run, directions=3, step=0.1):
        certify_gradient(run, output, directions, step, InThisProcess())

    with refused_at("--directions, --step", "2"):
        certify(attached_run, directions=2)
    with refused_at("--directions, --step", "0.0"):
        certify(attached_run, step=0.0)
    with refused_at(tmp_path, "metrics.json"):
        certify(tmp_path)
    run = shutil.copytree(attached_run, tmp_path / "run")
    (run / "checkpoint.safetensors").unlink()
    with refused_at(run / "checkpoint.safetensors", "missing"):
        certify(run)
    scenario = run / "scenario.toml"
    blocks = 'method.kind = "blocks"\nmethod.frames = 12'
    text = scenario.read_text().replace("method.max_iterations = 1", blocks)
    scenario.write_text(text)
    with refused_at(run, "blocks"):
        certify(run)
    assert not output.exists()
