"""The attack: ascent, checkpoints, run folder, interruption."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time

import mitsuba as mi
import numpy as np
import pytest
from helpers.attack_jobs import run

from mi_nerfattack import cli
from mi_nerfattack.deploy import paste_layers
from mi_nerfattack.evaluation.metrics import validate
from mi_nerfattack.fields import load_grid
from mi_nerfattack.io import files
from mi_nerfattack.io.exr import read_layers
from mi_nerfattack.render.rays import March
from mi_nerfattack.rollout.drive import CASES
from mi_nerfattack.scenario.scenario import load_scenario
from mi_nerfattack.scenes import bundled

pytestmark = pytest.mark.usefixtures("variant")


def test_attack_writes_a_complete_run_folder(scenario_folder, tmp_path, capsys):
    output = tmp_path / "run"
    words = ["attack", str(scenario_folder / "scenario.toml"), "-o", str(output)]
    assert cli.main(words) == 0
    told = " ".join(capsys.readouterr().out.split())
    assert "attack" in told and str(output) in told
    document = json.loads((output / "metrics.json").read_text())
    validate(document)
    assert_counts(document)
    [(name, texture)] = document["textures"].items()
    assert name == "ball" and 0 < texture["l2"] <= texture["linf"] <= 1
    assert document["total_variation"] == texture["total_variation"] > 0
    page = (output / "report.html").read_text()
    assert any(flag.startswith("not converged: ") for flag in document["flags"])
    sentences = [*document["flags"], *document["verdict"]]
    for sentence in sentences:
        assert sentence in told
        assert sentence in page
    assert sorted(sentences, key=told.index) == sentences  # flags first
    shown = [
        read_layers(path)[0]["object"][..., 3].mean()
        for path in sorted(output.glob("frames/surrogate_own/*.exr"))
    ]
    assert texture["picture_share"] == pytest.approx(np.mean(shown), rel=0.2)
    assert_files(output, document["baseline"])
    attacked = load_grid(output / "objects" / "ball.safetensors")
    original = load_grid(scenario_folder / "object.safetensors")
    change = attacked.texture.numpy() - original.texture.numpy()
    assert np.abs(change).max() > 0.1
    density = attacked.parameters()["density"].numpy()
    assert np.array_equal(density, original.parameters()["density"].numpy())
    # another attack into the same folder is refused and changes nothing
    before = (output / "metrics.json").read_bytes()
    other = scenario_folder / "other.toml"
    text = (scenario_folder / "scenario.toml").read_text()
    other.write_text(text.replace("[drive]", "[drive]\nstart_m = 0.5"))
    assert cli.main(["attack", str(other), "-o", str(output)]) == 2
    assert "scenario.drive.start_m: " in capsys.readouterr().err
    assert (output / "metrics.json").read_bytes() == before


def assert_counts(document):
    """Check drives, random looks and rendered frames against each other."""
    route = document["routes"]["line"]
    baseline, cost = document["baseline"], document["cost"]
    count, few = baseline["textures"], baseline["deployment_textures"]
    multiple = cost["backward_s"] / cost["forward_s"]
    assert baseline["backward_multiple"] == pytest.approx(multiple)
    assert count == round(3 * (1 + multiple)) == len(baseline["objectives"])
    assert few == min(count, 8)
    for environment, drawn in (("surrogate", count), ("deployment", few)):
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


def assert_files(output, baseline):
    """Check the table of steps, frames, plots and page."""
    rows = (output / "steps.csv").read_text().splitlines()
    drawn = baseline["textures"] + baseline["deployment_textures"]
    assert len(rows) == 1 + 4 * (16 + drawn)
    for environment in ("surrogate", "deployment"):
        layers, metadata = read_layers(
            output / "frames" / f"{environment}_attack" / "0000.exr"
        )
        assert {"", "Z", "scene", "scene.Z", "object", "object.Z"} <= set(layers)
        assert metadata["scenario"] == "kill"
        bare = output / "frames" / f"{environment}_no_object" / "0000.exr"
        assert "object" not in read_layers(bare)[0]
    plots = ("overhead", "triptych", "errors", "convergence", "strip")
    for name in (*plots, "attribution", "attribution_object"):
        assert (output / f"{name}.png").stat().st_size > 5000
    assert "<title>kill</title>" in (output / "report.html").read_text()


@pytest.mark.slow
def test_interrupted_attack_resumes(scenario_folder, tmp_path):
    output, other = tmp_path / "run", scenario_folder / "scenario.toml"
    text = other.read_text().replace("max_iterations = 3", "max_iterations = 10")
    path = scenario_folder / "long.toml"
    path.write_text(text + "[baseline]\ntextures = 1\n")
    process = subprocess.Popen(
        [sys.executable, "-m", "mi_nerfattack.cli", "attack", path, "-o", output],
        cwd=tmp_path,
        stderr=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    checkpoint = output / "checkpoint.safetensors"
    deadline = time.monotonic() + 300
    while not checkpoint.exists() and time.monotonic() < deadline:
        time.sleep(0.05)
    process.send_signal(signal.SIGTERM)
    _, stderr = process.communicate(timeout=300)
    assert process.returncode == 130, stderr
    assert "Traceback" not in stderr and "interrupted" in stderr
    assert not list(output.glob("*.tmp*")) and not list(output.glob(".*"))
    assert not (output / "metrics.json").exists()
    # another scenario may not continue it, and changes nothing
    kept = (output / "scenario.toml").read_text()
    refused = run("attack", other, "-o", output, cwd=tmp_path, check=2)
    assert "checkpoint.safetensors" in refused.stderr
    assert (output / "scenario.toml").read_text() == kept
    # the text in the run folder replays the scenario
    again = output / "scenario.toml"
    run("attack", again, "-o", output, cwd=tmp_path, check=0)
    history = json.loads((output / "attack.json").read_text())
    assert [record["iteration"] for record in history] == list(range(10))
    assert (output / "metrics.json").exists()


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (("scene.safetensors", "absent.safetensors"), ["absent.safetensors"]),
        (("max_iterations = 3", "max_iteratons = 3"), ["max_iteratons", ":19"]),
        (('route = "line"', 'route = "loop"'), ["loop", "line"]),
        (("object.safetensors", "truncated.safetensors"), ["truncated.safetensors"]),
        (("object.safetensors", "nan.safetensors"), ["nan.safetensors", "texture"]),
        (("policy.safetensors", "object.safetensors"), ["object.safetensors"]),
        (
            ("[drive]", '[objective]\nkind="function"\nfunction="a.py:f"\n[drive]'),
            ["a.py", "does not exist"],
        ),
    ],
)
def test_bad_input_is_named(scenario_folder, tmp_path, capsys, change, words):
    raw = (scenario_folder / "object.safetensors").read_bytes()
    (scenario_folder / "truncated.safetensors").write_bytes(raw[: len(raw) // 2])
    tensors, metadata = files.read_safetensors(scenario_folder / "object.safetensors")
    tensors["texture"] = np.full_like(tensors["texture"], np.nan)
    files.write_safetensors(scenario_folder / "nan.safetensors", tensors, metadata)
    path = scenario_folder / "bad.toml"
    path.write_text((scenario_folder / "scenario.toml").read_text().replace(*change))
    assert cli.main(["attack", str(path), "-o", str(tmp_path / "run")]) == 2
    message = capsys.readouterr().err
    for word in words:
        assert word in message
    assert "Traceback" not in message
    assert not (tmp_path / "run").exists()


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


def test_bundled_demo_scenario_is_valid():
    scenario, _ = load_scenario(bundled("demo.toml"))
    assert scenario.scene.route in ("straight", "right", "left")
