"""Whole attacks: the run folder, the calls in Python, the demo, files entered."""

from __future__ import annotations

import cProfile
import inspect
import io
import json
import signal
import subprocess
import sys
from contextlib import redirect_stdout
from dataclasses import dataclass
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
from support.faults.injected import signalled
from support.files.runs import PICTURES
from support.worlds.attacks import checkpoint_of

import mi_nerfattack as nf
from mi_nerfattack import cli, scenes
from mi_nerfattack.deploy import paste_layers
from mi_nerfattack.evaluation.flags import run_flags
from mi_nerfattack.evaluation.metrics import validate
from mi_nerfattack.fields import load_field, load_grid, save_field
from mi_nerfattack.io import files
from mi_nerfattack.io.exr import read_layers
from mi_nerfattack.render.rays import March
from mi_nerfattack.rollout.drive import CASES
from mi_nerfattack.scenario.scenario import load_scenario

pytestmark = pytest.mark.usefixtures("variant")


@dataclass(frozen=True)
class Finished:
    """An attack by the command line: its folder, what it printed, files it entered."""

    output: Path
    printed: str
    entered: set[Path]


@pytest.fixture(scope="module")
def finished(scenario_folder, tmp_path_factory) -> Finished:
    output = tmp_path_factory.mktemp("finished") / "run"
    path = str(scenario_folder / "scenario.toml")
    scene = load_field(scenario_folder / "scene.safetensors")
    scene.info["fit.psnr_heldout_db"] = "23.99"
    save_field(scenario_folder / "scene.safetensors", scene)
    printed, profile = io.StringIO(), cProfile.Profile(builtins=False)
    with redirect_stdout(printed), profile:
        assert cli.main(["attack", path, "-o", str(output), "--workers", "1"]) == 0
    functions = (entry.code for entry in profile.getstats())
    entered = {
        Path(code.co_filename)
        for code in functions
        if code.co_flags & inspect.CO_OPTIMIZED  # no module and no class
    }
    return Finished(output, " ".join(printed.getvalue().split()), entered)


def test_attack_writes_a_complete_run_folder(scenario_folder, finished):
    output, printed = finished.output, finished.printed
    document = files.read_json(output / "metrics.json")
    validate(document)
    assert_counts(document)
    [(name, texture)] = document["textures"].items()
    assert name == "ball" and 0 < texture["l2"] <= texture["linf"] <= 1
    assert document["total_variation"] == texture["total_variation"] > 0
    for name in ("blurred field: ", "not converged: "):
        assert any(flag.startswith(name) for flag in document["flags"])
    sentences = [*document["flags"], *document["verdict"]]
    assert sorted(sentences, key=printed.index) == sentences  # flags first
    shown = [
        read_layers(path)[0]["object"][..., 3].mean()
        for path in sorted(output.glob("frames/surrogate_own/*.exr"))
    ]
    assert texture["picture_share"] == pytest.approx(np.mean(shown), rel=0.2)
    baseline, rows = document["baseline"], (output / "steps.csv").read_text()
    drawn = baseline["textures"] + baseline["deployment_textures"]
    assert len(rows.splitlines()) == 1 + 4 * (16 + drawn)
    assert {path.stem for path in output.glob("*.png")} == set(PICTURES)
    assert "<title>kill</title>" in (output / "report.html").read_text()
    attacked = load_grid(output / "objects" / "ball.safetensors")
    original = load_grid(scenario_folder / "object.safetensors")
    change = attacked.texture.numpy() - original.texture.numpy()
    assert np.abs(change).max() > 0.1
    density = attacked.parameters()["density"].numpy()
    assert np.array_equal(density, original.parameters()["density"].numpy())
    # the text in the run folder replays the scenario
    words = ["-o", str(output), "--pictures", "none"]
    again = ["attack", str(output / "scenario.toml"), *words]
    assert cli.main(again) == 0


@pytest.mark.parametrize(("weight", "count"), [(0.0, 1), (0.1, 0)])
def test_random_textures_are_not_compared_with_a_penalised_objective(
    scenario_folder, weight, count
):
    """A curve that holds a penalty, and random textures judged without one."""
    path = scenario_folder / "scenario.toml"
    settings = [f"attack.freedom.total_variation={weight}"]
    scenario, _ = load_scenario(path, settings=settings)
    document = {
        "scenario": scenario.model_dump(mode="json"),
        "curve": {"frames": [10, 30], "objective": [0.0, -1.0]},
        "baseline": {"objectives": [-9.0, -9.0, -9.0]},
        "routes": {},
        "converged": True,
        "textures": {},
    }
    flags = [flag.partition(":")[0] for flag in run_flags(document, (), True)]
    assert flags == ["black box better"] * count


def assert_counts(document):
    """Check drives, random looks and rendered frames against each other."""
    route = document["routes"]["line"]
    baseline, cost = document["baseline"], document["cost"]
    count, few = baseline["textures"], baseline["deployment_textures"]
    multiple = cost["backward_s"] / cost["forward_s"]
    assert baseline["backward_multiple"] == pytest.approx(multiple)
    assert count == round(3 * (1 + multiple)) == len(baseline["objectives"])
    assert baseline["equal_textures"] == count
    assert few == min(count, 8)
    for environment, drawn in (("surrogate", count), ("mitsuba", few)):
        counts = {case: drawn if case == "random" else 2 for case in CASES}
        assert {k: v["n"] for k, v in route[environment].items()} == counts
    rows = [(run["seed"], run["steps"]) for run in route["surrogate"]["own"]["per_run"]]
    assert rows == [(1, 4), (2, 4)]
    # four cases of 2 twice, random looks judged, driven, deployed; 3 there and back
    assert cost["renders"] >= 4 * (16 + 2 * count + few + 6)
    curve, period = document["curve"], 4 * (1 + multiple)
    assert curve["frames"] == [round(4 + k * period) for k in range(4)]
    assert curve["objective"][-1] == baseline["attack_objective"]
    assert curve["objective"] == sorted(curve["objective"], reverse=True)
    assert document["converged"] is False  # in 3 iterations


def test_pasting_follows_depth_and_opacity():
    rgb = np.zeros((1, 4, 3), np.float32)
    depth = np.array([[5.0, 5.0, 1.0, np.inf]])
    opacity = np.array([1.0, 0.4, 1.0, 0.5], np.float32)
    layer = March(
        mi.Color3f(*[mi.Float(0.5 * opacity)] * 3),
        mi.Float(opacity),
        mi.Float(2.0 * opacity),
    )
    pasted, _, owner = paste_layers(rgb, depth, [layer])
    assert np.allclose(pasted[0, :, 0], [0.5, 0.0, 0.0, 0.5])
    assert owner.tolist() == [[1, 0, 0, 1]]


def test_attack_policy_returns_the_finished_run(scenario_folder, tmp_path):
    reports = []
    run = nf.attack_policy(
        scenario_folder / "scenario.toml",
        tmp_path / "run",
        frames=None,
        progress=lambda *report: reports.append(report),
    )
    assert run.metrics == files.read_json(run.folder / "metrics.json")
    assert nf.Run(run.folder) == run
    drives = run.drives[run.drives["case"] == "attack"]
    for environment, own in drives.groupby("environment"):
        figures = run.metrics["routes"]["line"][environment]["attack"]
        mean = own["cross_track_mean_m"].mean()
        assert mean == pytest.approx(figures["cross_track_mean_m"])
    assert run.frames == [] and np.array(run.plot()).ndim == 3
    stages = {stage for stage, *_ in reports}
    assert {"surrogate: optimisation", "drives"} <= stages
    assert not list(run.folder.glob("*.png"))  # frames=None


def test_evaluate_policy_returns_the_card(scenario_folder, tmp_path, capsys):
    scenario, reports = scenario_folder / "scenario.toml", []
    options = {"environments": ("surrogate",), "runs": 2, "horizon": 3}
    evaluation = nf.evaluate_policy(
        scenario,
        tmp_path / "drives",
        progress=lambda *report: reports.append(report),
        **options,
    )
    total = reports[-1][1]
    assert reports[-1] == (total, total)
    figures = evaluation.card["surrogate"]["line"]
    assert figures["no_object"]["n"] == 2
    card = tmp_path / "card.json"
    words = "--environments surrogate --runs 2 --horizon 3 --workers 1".split()
    folder = ["--drives", str(tmp_path / "drives"), "-o", str(card)]
    assert cli.main(["evaluate", str(scenario), *words, *folder]) == 0
    assert files.read_json(card) == evaluation.card
    capsys.readouterr()


def test_an_interrupted_demo_is_an_attack_that_can_go_on(
    scenario_folder, tmp_path, monkeypatch
):
    monkeypatch.setattr(scenes, "bundled", lambda _: scenario_folder / "scenario.toml")
    with signalled("surrogate: optimisation", signal.SIGTERM, at=10):  # of 24
        assert cli.main(["demo", "-o", str(tmp_path), "--anyway"]) == 130
    assert len(checkpoint_of(tmp_path)["history"]) == 1
    assert (tmp_path / "scenario.toml").is_file()


@pytest.mark.slow
def test_the_demo_beats_random_textures_and_transfers(tmp_path):
    output = tmp_path / "run"
    command = [sys.executable, "-m", "mi_nerfattack.cli", "demo", "-o", str(output)]
    done = subprocess.run([*command, "--json"], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    document = json.loads(done.stdout)
    assert document == files.read_json(output / "metrics.json")
    harmless = ("not converged", "texture at its bounds")  # it has few iterations
    assert [f for f in document["flags"] if not f.startswith(harmless)] == []
    for environment, least in (("surrogate", 3.0), ("mitsuba", 2.0)):
        cases = document["routes"]["right"][environment]
        attack, random = (
            cases[case]["cross_track_mean_m"] for case in ("attack", "random")
        )
        assert attack >= least * random
        assert cases["attack"]["drives_departed"] == cases["attack"]["n"] == 4


ROOT = Path(nf.__file__).parents[1]
OUTER = ("scenario", "evaluation", "experiment", "report", "commands")
MOST, MOST_OUTER = 145, 44  # aims: fewer than 130 and 45


def test_an_attack_enters_few_files(finished):
    """Which a reader of it must open."""
    sources = [
        x for x in finished.entered if x.is_relative_to(ROOT) and x.suffix == ".py"
    ]
    paths = [path.relative_to(ROOT) for path in sources]  # without templates of pages
    ours = [path for path in paths if path.parts[0] in ("mi_nerfattack", "plugins")]
    outer = sorted(str(path) for path in ours if path.parts[1] in OUTER)
    assert len(ours) <= MOST and len(outer) <= MOST_OUTER, outer
