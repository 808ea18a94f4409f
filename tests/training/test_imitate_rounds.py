"""Rounds of an imitation: who drives where, and which rows are never trained on."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from helpers.roadside import PaintedSite, bent, small, straight

from mi_nerfattack.errors import InputError
from mi_nerfattack.evaluation.evaluate import EvaluateSettings
from mi_nerfattack.io import files
from mi_nerfattack.policy.pilotnet import PilotNet
from mi_nerfattack.system.workers import InThisProcess
from mi_nerfattack.training import imitate as module
from mi_nerfattack.training.dataset import FrameDataset
from mi_nerfattack.training.imitate import imitate
from mi_nerfattack.training.record import count_frames
from mi_nerfattack.training.settings import ImitationSettings
from mi_nerfattack.training.train import TrainSettings, fit_policy

pytestmark = pytest.mark.usefixtures("variant")

SITE = PaintedSite("mitsuba", size_px=(200, 66))
HERE = InThisProcess()
ROUTES = [straight(), bent()]
DRIVE = EvaluateSettings(runs=1, objects=(), horizon=2)
SETTINGS = ImitationSettings(
    frames={"mitsuba": 48},
    dagger_frames={"mitsuba": 24},
    dagger_rounds=2,
    dagger_epochs=1,
    horizon=4,
    collecting=small(shard=4),
    training=TrainSettings(epochs=1, batch=64, held_out=0.3),
    validation=DRIVE,
    final=DRIVE,
)


@pytest.fixture
def rounds(monkeypatch) -> list[tuple[FrameDataset, FrameDataset]]:
    """Data of every training and of its held-out loss."""
    seen = []

    def fit(module, data, *arguments, held_out, **keywords):
        seen.append((data, held_out))
        return fit_policy(module, data, *arguments, held_out=held_out, **keywords)

    monkeypatch.setattr(module, "fit_policy", fit)
    return seen


def rows(data: FrameDataset) -> set[tuple[bytes, float]]:
    frames = data.read_frames(np.arange(len(data)))[:, 0, 0]
    return {(f.tobytes(), c) for f, c in zip(frames, data.controls, strict=True)}


def test_rows_that_are_held_out_are_never_trained_on(rounds, tmp_path):
    result = imitate([SITE], ROUTES, SETTINGS, tmp_path, HERE)
    assert len(rounds) == 3
    trained = set().union(*(rows(data) for data, _ in rounds))
    for number, (data, held) in enumerate(rounds):
        assert len(data) + len(held) == 48 + 24 * number
        assert not trained & rows(held)
    # a row that was held out stays so
    assert rows(rounds[0][1]) <= rows(rounds[2][1])
    assert len(rounds[0][1]) >= 4
    assert len(result.shards) == (48 + 24 + 24) // 4


@pytest.mark.slow
def test_rounds_of_other_seeds_have_other_frames(tmp_path):
    frames, order = {}, {}
    for seed in (0, 1):
        settings = dataclasses.replace(SETTINGS, seed=seed, dagger_rounds=1)
        imitate([SITE], ROUTES, settings, tmp_path / f"{seed}", HERE)
        for number in (0, 1):
            shard = f"round_{number}/mitsuba/shard_0000.safetensors"
            for name, seeds in (
                (shard, frames),
                (f"checkpoint_{number}.safetensors", order),
            ):
                _, about = files.read_safetensors(tmp_path / f"{seed}" / name)
                seeds[seed, number] = about["settings.seed"]
    assert len(set(frames.values())) == len(set(order.values())) == 4


def test_weights_to_start_with_are_not_those_of_the_run_before(tmp_path):
    settings = dataclasses.replace(SETTINGS, dagger_rounds=0)
    imitate([SITE], ROUTES, settings, tmp_path, HERE)
    with pytest.raises(InputError, match=r"checkpoint_0.*\n  start: .* -> .*\nrestore"):
        imitate([SITE], ROUTES, settings, tmp_path, HERE, start=PilotNet(2))


@pytest.mark.slow
def test_frames_of_rounds_that_are_left_out_are_not_recorded(tmp_path):
    imitate([SITE], ROUTES, SETTINGS, tmp_path / "data", HERE)
    fewer = dataclasses.replace(SETTINGS, dagger_rounds=1)
    result = imitate([SITE], ROUTES, fewer, tmp_path / "data", HERE)
    every, first = result.shards, result.shards[:1]
    data = tmp_path / "data"
    assert count_frames(data, every) == {"round_0/mitsuba": 48, "round_1/mitsuba": 24}
    assert count_frames(tmp_path, first) == {"data/round_0/mitsuba": 4}
    assert count_frames(tmp_path / "b", first) == {"earlier/mitsuba": 4}
