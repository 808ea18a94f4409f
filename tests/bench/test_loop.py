"""Rollout and plain loop over `mi.render` give one gradient; the command shows it."""

from __future__ import annotations

import itertools
import json

import numpy as np
import pytest
from support.reference.derivatives import nothing_compiled

from bench.__main__ import main
from bench.loop import bench
from bench.loop.ways import PlainLoop, RolloutLoop

pytestmark = pytest.mark.usefixtures("variant")
FRAMES, SIZE = 3, (24, 12)


def test_both_ways_and_both_policies_give_one_gradient():
    runs = []
    for policy in bench.POLICIES:
        for way in (RolloutLoop("replay", policy, *SIZE), PlainLoop(policy, *SIZE)):
            loss = way.gradient(FRAMES)["loss"]
            runs.append((loss, way.by_colour().astype(np.float64)))
    assert np.abs(runs[0][1]).max() > 0
    for (loss, gradient), (other, expected) in itertools.combinations(runs, 2):
        assert loss == pytest.approx(other, rel=1e-6)
        difference = np.abs(gradient - expected).sum() / np.abs(expected).sum()
        assert difference < bench.AGREED


def test_the_plain_loop_compiles_no_kernel_for_more_frames():
    loop = PlainLoop("drjit", *SIZE)
    loop.gradient(4)
    with nothing_compiled():
        loop.gradient(6)


@pytest.fixture
def measured(monkeypatch, tmp_path) -> None:
    """Answer for the processes: each gradient is 1 % larger than the one before."""
    count = itertools.count()

    def measure(options, size, way, policy, path):
        del options, size, way, policy
        index = next(count)
        np.save(path, np.full((4, 3), 1.01**index, np.float32))
        keys = ("seconds", "cpu_seconds", "peak_memory_mb", "loss")
        return dict(zip(keys, (2.0 + index, 1.0, 500.0, 0.25), strict=True))

    monkeypatch.setattr(bench, "measure", measure)


def test_gradients_that_differ_are_an_error(measured, capsys, tmp_path):
    words = ["loop", "--frames", "3", "--size", "24x12", "-o", str(tmp_path), "--json"]
    assert main(words) == 1
    document = json.loads(capsys.readouterr().out)
    (file,) = tmp_path.glob("*-loop.json")
    assert json.loads(file.read_text()) == document
    assert document["frames"] == 3 and document["size"] == [24, 12]
    assert document["gradient_difference"] == pytest.approx(1 - 1.01**-5, rel=1e-4)
    assert document["loss_difference"] == 0


@pytest.mark.slow
def test_the_command_measures_in_processes(capsys):
    assert main(["loop", "--frames", "3", "--size", "24x12", "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["gradient_difference"] < bench.AGREED
    for row in document["rows"]:
        assert 0 < row["cpu_seconds"]
        assert row["peak_memory_mb"] > 100
