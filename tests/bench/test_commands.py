"""Each benchmark from its command to its file."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest

from bench.__main__ import COMMANDS, main
from bench.attack import memory, scaling
from bench.attack.table import memory_table, time_table
from bench.attack.table import remarks as attack_remarks
from bench.driving import circle, experts
from bench.fit.table import remarks as fit_remarks
from bench.render import steps
from mi_nerfattack import cli
from mi_nerfattack.io import files

pytestmark = pytest.mark.usefixtures("variant")


def test_every_benchmark_starts_and_composite_ends(tmp_path, capsys):
    for name in COMMANDS:
        assert main([name, "--help"]) == 0
        assert f"python -m bench {name}" in capsys.readouterr().out
    assert main(["render", "--sizes", "200"]) == cli.EXIT_INPUT
    assert "--sizes: '200'" in capsys.readouterr().err
    path = tmp_path / "composite.png"
    arguments = ["composite", "--size", "48x24", "--json", "-o", str(path)]
    assert main(arguments) == 0
    document = json.loads(capsys.readouterr().out)
    by_height = {row["height_m"]: row for row in document["heights"]}
    assert by_height[0.8]["largest"] < 1 / 255  # apart, both composites are exact
    assert by_height[-0.75]["largest"] > by_height[0.8]["largest"]
    assert files.read_image(path).shape[2] in (3, 4)


@pytest.mark.slow
def test_steps_tell_errors_that_fall(capsys):
    assert main(["steps", "--size", "32x16", "--repeats", "1", "--json"]) == 0
    rows = json.loads(capsys.readouterr().out)["rows"]
    for view in steps.VIEWS:
        mine = [row for row in rows if row["view"] == view]
        errors = [row["psnr_db"] for row in mine[: len(steps.FACTORS)]]
        assert errors == sorted(errors)
        assert min(row["forward_s"] for row in mine) > 0


@pytest.mark.slow
def test_render_prints_its_table_and_writes_its_numbers(capsys, tmp_path):
    size = ["--sizes", "16x8", "--repeats", "1"]
    output = tmp_path / "results"
    command = ["render", "--quick", *size, "-o", str(output)]
    assert main(command) == 0
    [written] = output.iterdir()
    document = json.loads(written.read_text())
    assert document["kernels_compiled_after_warmup"] == 0
    assert list(document["sizes"]) == ["16x8"]
    row = document["sizes"]["16x8"]
    for side in ("", "torch_", "torch_tuned_"):
        for key in ("forward_samples_per_s", "backward_samples_per_s", "frame_ms"):
            assert 0 < row[side + key] < math.inf
    assert row["peak_memory_mb"] > 0
    assert row["samples"] == pytest.approx(row["torch_samples"], rel=0.02)
    assert set(document["memory_by_samples_per_ray"]) == {"64", "1024", "change"}
    assert document["object_grid"]["ratio"] > 0
    assert written.name.startswith(document["date"])


@pytest.mark.slow
def test_fit_prints_the_promised_keys(capsys, tmp_path):
    path = tmp_path / "fit.json"
    command = ["fit", "--quick", "--json", "--repeats", "1", "-o", str(path)]
    assert main(command) == 0
    result = json.loads(capsys.readouterr().out)
    assert len(fit_remarks(result)) > len(
        result["steps"]
    )  # all that they need is there
    assert json.loads(path.read_text()) == result
    assert [row["stage"] for row in result["steps"]] == ["early", "late"]
    for row in result["steps"]:
        assert row["torch_ratio"] > 0
        assert row["torch_samples_per_step"] == pytest.approx(
            row["samples_per_step"], rel=0.1
        )
        assert row["torch_samples_per_step"] == row["torch_tuned_samples_per_step"]
    assert result["ratio"] == min(row["torch_ratio"] for row in result["steps"])


@pytest.mark.slow
def test_attack_prints_the_promised_keys(capsys, tmp_path):
    path = tmp_path / "attack.json"
    command = [
        "attack",
        "--quick",
        "--json",
        "--sizes",
        "32x16",
        "--repeats",
        "1",
        "-o",
        str(path),
    ]
    assert main(command) == 0
    document = json.loads(capsys.readouterr().out)
    assert json.loads(path.read_text()) == document
    row = document["32x16"]
    for key in (
        *("iteration_over_rollout", "replay_over_rollout", "torch_memory_ratio"),
        *("torch_time_ratio", "torch_tuned_time_ratio", "torch_cpu_ratio"),
        *("iteration_ms", "replay_iteration_ms", "baked_iteration_ms", "rollout_ms"),
        *("torch_iteration_ms", "torch_tuned_iteration_ms", "bake_mb", "bake_psnr_db"),
    ):
        assert row[key] > 0
    assert list(row["peak_memory_mb_by_horizon"]) == ["1", "2"]
    assert row["kernels_compiled_after_warmup"] == 0
    kept = row["kept_backgrounds"]["stated_mb_per_step"]
    assert kept == pytest.approx(2 * 20 * 32 * 16 / 1e6)  # scene and object
    assert row["batch"]["poses"] == 2
    single = row["launches_per_step"]["kept_backgrounds"]
    batch = row["batch"]["launches_per_step"]
    assert batch["rollout_over_pixels"] == single["rollout_over_pixels"]
    assert time_table(document).row_count == 7
    assert memory_table(document).row_count == 6
    assert len(attack_remarks(document)) == 4


def test_memory_is_written_row_by_row_and_goes_on(capsys, monkeypatch, tmp_path):
    path, driven = tmp_path / "memory.json", []

    def peak(job):
        driven.append((job.poses, job.horizon))
        if len(driven) == 2:
            raise KeyboardInterrupt
        return 500.0 + job.poses + (6 if job.horizon == 9 else 0)

    monkeypatch.setattr(memory, "_peak_mb", peak)
    command = ["memory", "--size", "32x16", "-o", str(path), "--horizons", "3", "9"]
    assert main(command) == cli.EXIT_INTERRUPTED
    assert json.loads(path.read_text())["rows"] == [
        {"poses": 1, "horizon": 3, "peak_memory_mb": 501.0}
    ]
    assert main(command) == 1  # by more than 1 %
    assert driven == [(1, 3), (4, 3), (4, 3), (1, 9), (4, 9)]
    assert "1.20%" in capsys.readouterr().out
    assert main(command) == 1  # with nothing left to measure
    assert "1.20%" in capsys.readouterr().out
    assert len(driven) == 5
    assert main([*command, "--poses", "1"]) == cli.EXIT_INPUT
    assert "name another file" in capsys.readouterr().err
    assert main([*command, "--poses", "0"]) == cli.EXIT_INPUT
    assert "poses: (0,); must be a whole number of at" in capsys.readouterr().err


def test_scaling_is_written_row_by_row_and_goes_on(capsys, monkeypatch, tmp_path):
    path, measured = tmp_path / "scaling.json", []

    def row(job, repeats):
        measured.append(job)
        if len(measured) == 2:
            raise KeyboardInterrupt
        cost = float(job.width * job.poses**0.5)
        names = ("iteration_ms", "iteration_mb")
        names += tuple(f"replay_{name}" for name in names)
        return {"job": job.arguments(), **dict.fromkeys(names, cost)}

    monkeypatch.setattr(scaling, "_measure", row)
    command = ["scaling", "--sizes", "32x16", "64x16", "--poses", "1", "4"]
    command += ["--objects", "1", "--horizons", "3", "-o", str(path)]
    assert main(command) == cli.EXIT_INTERRUPTED
    assert len(json.loads(path.read_text())["rows"]) == 1
    assert main(command) == 0
    assert [job.poses for job in measured] == [1, 1, 1, 4]
    assert "0.50" in capsys.readouterr().out
    assert main(["scaling", "--sizes", "32x16", "16x32"]) == cli.EXIT_INPUT
    assert "two of as many pixels" in capsys.readouterr().err
    powers = json.loads(path.read_text())["exponents"]
    assert powers["pixels"]["iteration_ms"] == pytest.approx(1)
    assert powers["poses"]["iteration_mb"] == pytest.approx(0.5)


@pytest.mark.slow
def test_circle_command(tmp_path, monkeypatch, capsys):
    cases = circle.CASES[1:2] + circle.CASES[6:7]
    monkeypatch.setattr(circle.run, "__defaults__", (cases,))
    figure = tmp_path / "circle.png"
    assert main(["circle", "-o", str(figure), "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    held, slid = document["circles"]
    assert abs(held["error"]) < 0.05
    assert slid["error"] > 0.05 and slid["friction_demand"] > 1
    assert min(files.read_image(figure).shape[:2]) > 500


@pytest.mark.slow
def test_experts_prints_a_row_for_each_route(monkeypatch, capsys):
    drives = experts.Drives("mujoco", "left", "PIDExpert", 0.1, 0.1, 0.02, 0.01, np.inf)
    monkeypatch.setattr(experts, "run", lambda show: [drives])
    assert main(["experts"]) == 0
    assert "never" in capsys.readouterr().out
    assert main(["experts", "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["drives"][0]["recovered_s"] is None
    assert document["limit_m"] == 0.1
