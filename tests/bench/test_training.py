"""The figures of training: DAgger against cloning, and workers against one."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from bench.driving import collect, dagger
from mi_nerfattack.errors import InputError
from mi_nerfattack.io import files

ERRORS = {"cloning": [[0.1, 0.3], [0.3, 0.3], [0.4, 0.4]], "DAgger": [[0.1], [0.1]]}


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
    document = dagger.to_document(dagger.Settings(), ERRORS, dict.fromkeys(ERRORS, 1))
    cloning = document["arms"]["cloning"]
    # means of the seeds: 0.2, 0.3, 0.4; their standard deviation is 0.1
    assert cloning["mean_m"] == pytest.approx(0.3)
    assert cloning["standard_error_m"] == pytest.approx(0.1 / np.sqrt(3))
    assert document["arms"]["DAgger"]["standard_error_m"] == 0
    assert (document["frames"], document["gradient_steps"]) == (1536, 528)


def test_figure_shows_both_sides(tmp_path):
    document = dagger.to_document(dagger.Settings(), ERRORS, dict.fromkeys(ERRORS, 0))
    dagger.write_figure(tmp_path / "dagger.png", document)
    image = files.read_image(tmp_path / "dagger.png").reshape(-1, 3).astype(int)
    assert 0.5 < (image == 255).all(1).mean() < 0.98
    # blue and orange dots
    assert ((image[:, 2] - image[:, 0]) > 60).sum() > 1000
    assert ((image[:, 0] - image[:, 2]) > 60).sum() > 1000


def test_results_of_other_settings_are_refused(tmp_path):
    dagger._claim(tmp_path, dagger.Settings())
    dagger._claim(tmp_path, dagger.Settings())
    with pytest.raises(InputError, match=r"settings.json: results of other settings"):
        dagger._claim(tmp_path, dagger.Settings(runs=4))


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


@pytest.mark.parametrize("change", [{"warm": 640}, {"workers": 1}])
def test_sizes_of_the_measurement_are_checked(change):
    with pytest.raises(InputError, match=next(iter(change))):
        dataclasses.replace(collect.Settings(), **change)
