"""What makes the figures honest: equal work on both sides, and its arithmetic."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from bench.attack.drive import SPEED_MS, Job
from bench.attack.peer import Tape
from bench.attack.run import memory_row
from bench.attack.scaling import Settings, exponents
from bench.driving import circle, collect, dagger
from bench.fit.table import remarks
from mi_nerfattack.errors import InputError

pytestmark = pytest.mark.slow
COLUMNS = ("cpu_ratio", "us_per_sample", "peak_memory_mb")


def test_all_horizons_drive_the_same_road():
    jobs = [Job(366, 188, 3, horizon) for horizon in (25, 400)]
    assert {SPEED_MS * job.dt * job.horizon for job in jobs} == {12.5}
    assert np.array_equal(*(job.initial() for job in jobs))
    planes = torch.rand(1, 3, 188, 366)
    for transform in jobs[0].transforms():
        planes = transform.apply(planes)
    assert planes.shape == (1, 3, 66, 200)
    assert jobs[0].arguments() == ["366", "188", "3", "25", "1"]


def test_exponents_are_those_of_powers():
    settings = Settings(((8, 8), (16, 8), (32, 8)), (1,), (1, 2), (5, 10, 40), 1)
    axes = settings.axes()
    axes = {name: axes[name] for name in ("pixels", "poses", "horizon")}
    assert list(axes["pixels"]) == [64, 128, 256]
    rows = {
        tuple(job.arguments()): {"ms": job.horizon * (job.width * job.height) ** 0.8}
        for jobs in axes.values()
        for job in jobs.values()
    }
    found = exponents(axes, [{"job": list(k), **row} for k, row in rows.items()])
    assert found == {
        "pixels": {"ms": pytest.approx(0.8)},
        "horizon": {"ms": pytest.approx(1.0)},
    }  # none of one size


def test_memory_is_extrapolated_along_a_line():
    peaks = {
        "replay": {"25": 500.0, "400": 505.0},
        "kept_backgrounds": {"25": 510.0, "100": 585.0},
        "tuned": {"25": 1000.0},
    }
    row = memory_row(peaks, {"replay": 0.1, "kept_backgrounds": 1.1, "tuned": 20.0})
    assert row["peak_memory_change"] == pytest.approx(0.01)
    assert row["kept_backgrounds"]["measured_mb_per_step"] == pytest.approx(1)
    assert row["kept_backgrounds"]["stated_mb_per_step"] == 1.1
    assert row["torch_peak_memory_mb_by_horizon"]["400"] == pytest.approx(8500)
    assert row["torch_memory_ratio"] == pytest.approx(8500 / 505)
    assert row["torch_measured_horizons"] == ["25"]
    assert row["torch_memory_ratio_by_horizon"]["25"] == pytest.approx(2)


def test_the_tape_is_counted_once_and_without_parameters():
    weight = torch.ones(1000, requires_grad=True)
    given = torch.ones(1000)
    tape = Tape([weight])
    with tape:
        (weight * given + weight * given).sum().backward()
    assert tape.size == 4000  # `given`, which both products keep


def test_unfair_comparisons_are_called_so():
    row = {"network": "small", "stage": "early", "rays": 9, "breakdown": {}}
    for prefix, samples, last in (
        ("", 1e3, 0.3),
        ("torch_", 1.1e3, 0.1),
        ("torch_tuned_", 1e3, 0.1),
    ):
        row[f"{prefix}samples_per_step"] = samples
        row |= {f"{prefix}loss_first": 0.2, f"{prefix}loss_last": last}
        row |= {f"{prefix}{key}": 1.0 for key in COLUMNS}
    document = {"data": "views", "ratio": 6.0, "tuned_ratio": 2.0, "steps": [row]}
    lines = "\n".join(remarks(document))
    assert "differ from ours by +10.0%" in lines
    assert "ours did not learn" in lines
    assert "PyTorch did not learn" not in lines


def test_both_sides_have_equally_many_frames_and_steps():
    for settings in (dagger.Settings(), dagger.Settings.quick()):
        sizes = [
            settings.first + k * settings.added for k in range(len(settings.epochs))
        ]
        rows = [
            n // settings.batch * e for n, e in zip(sizes, settings.epochs, strict=True)
        ]
        assert sum(rows) == settings.steps
        assert sizes[-1] == settings.frames
        assert settings.first % settings.collecting.shard == 0
    with pytest.raises(InputError, match="equally many steps"):
        dagger.Settings(cloning_epochs=21)
    with pytest.raises(InputError, match="multiples of the batch, 64"):
        dagger.Settings(first=1100)


def test_errors_are_averaged_by_seed():
    errors = {"cloning": [[0.1, 0.3], [0.3, 0.3], [0.4, 0.4]], "DAgger": [[0.1], [0.1]]}
    document = dagger.to_document(dagger.Settings(), errors, dict.fromkeys(errors, 1))
    cloning = document["arms"]["cloning"]
    # means of the seeds: 0.2, 0.3, 0.4; their standard deviation is 0.1
    assert cloning["mean_m"] == pytest.approx(0.3)
    assert cloning["standard_error_m"] == pytest.approx(0.1 / np.sqrt(3))
    assert document["arms"]["DAgger"]["standard_error_m"] == 0
    assert (document["frames"], document["gradient_steps"]) == (1536, 528)


def test_ratio_is_that_of_the_medians(monkeypatch):
    rates = iter([10.0, 18.0, 8.0, 20.0, 12.0, 30.0])
    turns = []

    def rate(settings, count, stage, show):
        turns.append(count)
        return next(rates)

    monkeypatch.setattr(collect, "_rate", rate)
    document = collect.run(collect.Settings(), lambda *at: None)
    assert turns == [1, 2, 1, 2, 1, 2]
    assert document["median"] == {"1": 10.0, "2": 20.0}
    assert document["ratio"] == 2.0


def test_circle_fit_is_exact_on_a_circle(rng):
    angle = rng.uniform(0, 2, 20)
    points = np.stack([3 + 4 * np.cos(angle), -1 + 4 * np.sin(angle)], axis=1)
    centre, radius = circle.fit_circle(points)
    np.testing.assert_allclose(centre, (3, -1), atol=1e-9)
    assert radius == pytest.approx(4)
