"""Everything of `make bench-gpu` up to the launch, without a GPU."""

from __future__ import annotations

import json
import sys
import time

import drjit as dr
import pytest
import torch
import tyro

from bench import gpu
from bench.__main__ import COMMANDS, main
from bench.gpu import PLAN, Step
from mi_nerfattack import cli
from mi_nerfattack.backend import variant as chosen

SIXTY = "import time; print('{\"a\": 1}', flush=True); time.sleep(60)"
DONE = "import json, os; print('noise'); print(json.dumps(dict(os.environ)))"
TESTS = "print('1 failed, 22 passed, 3 skipped, 9 deselected in 4.56s')"


def test_the_plan_is_of_what_there_is_and_ends_within_ten_minutes():
    assert sum(step.limit_s for step in PLAN) <= 590
    for step in PLAN:
        module, *words = step.arguments[1:]
        if module == "bench":
            arguments = tyro.extras.subcommand_cli_from_dict(COMMANDS, args=words)
            assert arguments.json


@pytest.mark.skipif(sys.platform == "win32", reason="groups of processes")
def test_steps_that_fail_or_take_too_long_leave_the_others():
    plan = (
        Step("done", ("-c", DONE), 60),
        Step("late", ("-c", SIXTY), 0.1),
        Step("wrong", ("-c", "raise SystemExit(3)"), 60),
        Step("tests", ("-c", TESTS + "; raise SystemExit(1)"), 60),
    )
    snapshots: list[str] = []
    start = time.monotonic()
    document = gpu.measure(plan, {"gpu": {}}, lambda d: snapshots.append(json.dumps(d)))
    assert time.monotonic() - start < 50  # nothing waits for what sleeps
    steps = document["steps"]
    assert [len(json.loads(text)["steps"]) for text in snapshots] == [1, 2, 3, 4]
    assert json.loads(snapshots[-1]) == document
    assert steps["done"]["result"][chosen.VARIABLE] == "cuda_ad_rgb"
    assert "0.1 s" in steps["late"]["error"] and " 3" in steps["wrong"]["error"]
    assert steps["tests"]["exit_code"] == 1
    assert steps["tests"]["result"] == {"failed": 1, "passed": 22, "skipped": 3}


@pytest.mark.skipif(dr.has_backend(dr.JitBackend.CUDA), reason="this machine has a GPU")
def test_without_a_gpu_it_is_refused(tmp_path, capsys, monkeypatch):
    assert main(["gpu", "-o", str(tmp_path / "out")]) == cli.EXIT_INPUT
    assert "Dr.Jit" in capsys.readouterr().err
    monkeypatch.setattr(dr, "has_backend", lambda backend: True)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert main(["gpu", "-o", str(tmp_path / "out")]) == cli.EXIT_INPUT
    assert "PyTorch" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_the_file_is_written(tmp_path, monkeypatch):
    device = {"name": "NVIDIA Z100", "memory_mb": 1.0, "torch_cuda": "13.0"}
    rows = [{"frames": 8, "frames_per_s": 80.0, "drjit_peak_memory_mb": 12.0}]
    figures = {"latency_ms": 2.0, "batches": rows}
    plan = (Step("frames", ("-c", f"import json; print(json.dumps({figures}))"), 60),)
    monkeypatch.setattr(gpu, "find_gpu", lambda: device)
    monkeypatch.setattr(gpu, "PLAN", plan)
    assert main(["gpu", "-o", str(tmp_path)]) == 0
    (path,) = tmp_path.iterdir()
    assert path.name.endswith("-nvidia-z100-gpu.json")
    document = json.loads(path.read_text())
    assert document["gpu"] == device and document["variant"] == "cuda_ad_rgb"
    assert document["steps"]["frames"]["result"] == figures


@pytest.mark.slow
def test_frames_are_counted(variant, capsys):
    words = ["frames", "--size", "32x16", "--batches", "1", "4", "--repeats", "2"]
    assert main([*words, "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["latency_ms"] > 0 and document["variant"] == variant
    assert [row["frames"] for row in document["batches"]] == [1, 4]
    one, four = document["batches"]
    assert four["frames_per_s"] == pytest.approx(4e3 / four["batch_ms"])
    assert four["drjit_peak_memory_mb"] > one["drjit_peak_memory_mb"]
