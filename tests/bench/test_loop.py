"""Rollout and plain loop over `mi.render` give one gradient; the command shows it."""

from __future__ import annotations

import itertools
import json

import drjit as dr
import numpy as np
import pytest

from bench.__main__ import main
from bench.loop import run
from bench.loop.ways import PlainLoop, RolloutLoop
from mi_nerfattack.rollout.adjoint import Replay

pytestmark = pytest.mark.usefixtures("variant")
FRAMES, SIZE = 3, (24, 12)


def gradients() -> dict[tuple[str, str], tuple[float, np.ndarray]]:
    found = {}
    for policy in run.POLICIES:
        ways = {
            "rollout": RolloutLoop(Replay(), policy, *SIZE),
            "plain": PlainLoop(policy, *SIZE),
        }
        for way, loop in ways.items():
            loss = loop.gradient(FRAMES)["loss"]
            found[way, policy] = loss, loop.by_colour().astype(np.float64)
    return found


def test_both_ways_and_both_policies_give_one_gradient():
    found = gradients()
    assert np.abs(found["plain", "torch"][1]).max() > 0
    for (loss, gradient), (other, expected) in itertools.combinations(
        found.values(), 2
    ):
        assert loss == pytest.approx(other, rel=1e-6)
        difference = np.abs(gradient - expected).sum() / np.abs(expected).sum()
        assert difference < run.AGREED


def test_the_plain_loop_compiles_no_kernel_for_more_frames():
    loop = PlainLoop("drjit", *SIZE)
    loop.gradient(4)
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        loop.gradient(6)
        history = dr.kernel_history((dr.KernelType.JIT,))
    assert history
    assert all(entry["cache_hit"] for entry in history)


@pytest.fixture
def measured(monkeypatch, tmp_path) -> None:
    """Answer for the processes: each gradient is 1 % larger than the one before."""
    count = itertools.count()

    def measure(settings, way, policy, path):
        del settings, way, policy
        index = next(count)
        np.save(path, np.full((4, 3), 1.01**index, np.float32))
        keys = ("seconds", "cpu_seconds", "peak_memory_mb", "loss")
        return dict(zip(keys, (2.0 + index, 1.0, 500.0, 0.25), strict=True))

    monkeypatch.setattr(run, "_measure", measure)


def test_the_command_prints_a_row_for_each_way_and_policy(measured, capsys):
    assert main(["loop", "--frames", "3"]) == 1  # the gradients differ by 5 %
    lines = capsys.readouterr().out.splitlines()
    rows = [line for line in lines if line.startswith("| ")]
    cells = [[cell.strip() for cell in row.strip("|").split("|")] for row in rows]
    assert cells[0] == ["way", "policy", "CPU s", "wall s", "peak memory, MB"]
    expected = itertools.product(run.WAYS.values(), run.POLICIES.values())
    assert [tuple(row[:2]) for row in cells[1:]] == list(expected)
    assert cells[1][2:] == ["1.0", "2.0", "500"]
    assert "4.9e-02" in lines[-1]


def test_the_document_names_its_settings(measured, capsys):
    assert main(["loop", "--frames", "3", "--size", "24x12", "--json"]) == 1
    document = json.loads(capsys.readouterr().out)
    assert document["frames"] == 3
    assert document["size"] == [24, 12]
    assert document["gradient_difference"] == pytest.approx(1 - 1.01**-5, rel=1e-4)
    assert document["loss_difference"] == 0


@pytest.mark.slow
def test_the_command_measures_in_processes(capsys):
    assert main(["loop", "--frames", "3", "--size", "24x12", "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["gradient_difference"] < run.AGREED
    for row in document["rows"]:
        assert 0 < row["cpu_seconds"]
        assert row["peak_memory_mb"] > 100
