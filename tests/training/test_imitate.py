"""The way from frames to a policy."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest
import torch
from helpers.roadside import PaintedSite, bent, small, straight
from helpers.shards import write_shard

from mi_nerfattack.commands.train import Train
from mi_nerfattack.deploy.roadside.rule import Roadside
from mi_nerfattack.errors import InputError
from mi_nerfattack.evaluation.evaluate import EvaluateSettings
from mi_nerfattack.io import files
from mi_nerfattack.io.locks import exclusive
from mi_nerfattack.policy.exported.load import load_exported
from mi_nerfattack.policy.exported.program import export_program
from mi_nerfattack.policy.pilotnet import IMAGE_SHAPE, PilotNet
from mi_nerfattack.system.workers import InThisProcess
from mi_nerfattack.training.collect import find_shards
from mi_nerfattack.training.dataset import FrameDataset
from mi_nerfattack.training.imitate import _check, imitate
from mi_nerfattack.training.presets import PRESETS, find_preset
from mi_nerfattack.training.settings import ImitationSettings
from mi_nerfattack.training.train import TrainSettings, fit_policy
from mi_nerfattack.training.validation import (
    DEPARTED,
    ERROR,
    AbstractValidation,
    ClosedLoop,
    rank,
)

pytestmark = pytest.mark.usefixtures("variant")

SITE = PaintedSite("mitsuba", size_px=(200, 66))
HERE = InThisProcess()
DRIVE = EvaluateSettings(runs=1, objects=(), horizon=3)
SETTINGS = ImitationSettings(
    frames={"mitsuba": 64},
    dagger_frames={"mitsuba": 32},
    dagger_rounds=1,
    dagger_epochs=1,
    collecting=small(shard=32),
    training=TrainSettings(epochs=1, batch=32),
    validation=DRIVE,
    final=DRIVE,
)
ROUTES = [straight(), bent()]
#: Nothing is seen for a minute of a drive of 8 s.
UNSEEN = Roadside(view_s=60.0)


def test_imitation_runs_from_frames_to_card_and_resumes(tmp_path):
    stages: list[str] = []

    def note(stage, done, total, state):
        assert 0 <= done <= total
        if stage not in stages:
            stages.append(stage)

    first = imitate([SITE], ROUTES, SETTINGS, tmp_path, HERE, note)
    assert stages == [
        "round_0, mitsuba",
        "training 0",
        "validation",
        "round_1, mitsuba",
        "training 1",
        "card",
    ]
    assert [len(rows) for rows in first.history] == [1, 1]
    assert set(first.card) == {"mitsuba"}
    assert set(first.card["mitsuba"]) == {"straight", "left"}
    ranks = [rank(rows[-1]) for rows in first.history]
    assert first.best_round == ranks.index(min(ranks))
    files.write_json(tmp_path / "card.json", first.card)
    stages.clear()
    again = imitate([SITE], ROUTES, SETTINGS, tmp_path, HERE, note)
    assert "training 0" not in stages
    assert again.history == first.history
    for one, other in zip(
        first.module.parameters(), again.module.parameters(), strict=True
    ):
        np.testing.assert_array_equal(one.numpy(force=True), other.numpy(force=True))
    longer = dataclasses.replace(SETTINGS, dagger_rounds=2)
    more = imitate([SITE], ROUTES, longer, tmp_path, HERE)
    assert more.history[:2] == first.history and len(more.history) == 3


def test_a_collection_of_its_own_is_held_out(tmp_path):
    settings = dataclasses.replace(
        SETTINGS, dagger_rounds=0, validation_frames={"mitsuba": 40}
    )
    stages = []
    imitate([SITE], ROUTES, settings, tmp_path, HERE, lambda *at: stages.append(at[0]))
    assert "held_out, mitsuba" in stages
    one, other = (
        FrameDataset.from_shards(find_shards(tmp_path / name))
        for name in ("round_0", "held_out")
    )
    assert not np.array_equal(one.controls, other.controls)


@dataclasses.dataclass(frozen=True)
class Scripted(AbstractValidation):
    """Measures what it is told, one epoch after the other."""

    rows: list[tuple[int, float]]
    every: int = 1
    weights: list[torch.Tensor] = dataclasses.field(default_factory=list)

    def measure(self, module) -> dict[str, Any]:
        departed, error = self.rows[len(self.weights)]
        self.weights.append(module.head[-1].weight.detach().clone())
        return {ERROR: error, DEPARTED: departed}

    def describe(self):
        return {}


@pytest.fixture
def data(rng) -> FrameDataset:
    frames = rng.integers(0, 256, (24, *IMAGE_SHAPE, 3), dtype=np.uint8)
    controls = rng.uniform(-1, 1, 24).astype(np.float32)
    return FrameDataset((frames,), np.zeros(24, np.int64), controls)


@pytest.mark.parametrize(
    ("rows", "best"),
    [
        ([(0, 0.05), (0, 0.03), (0, 0.04)], 1),
        ([(1, 0.01), (0, 0.30), (2, 0.01)], 1),  # fewer drives departed first
        ([(0, 0.2), (0, 0.1), (0, 0.0)], 2),
    ],
)
def test_best_epoch_is_that_of_the_closed_loop(data, rows, best):
    validation = Scripted(rows)
    module = PilotNet(1)
    settings = TrainSettings(epochs=3, batch=12)
    history = fit_policy(module, data, settings, validation=validation)
    assert torch.equal(module.head[-1].weight, validation.weights[best])
    assert [row[ERROR] for row in history] == [error for _, error in rows]


def test_loss_decides_among_equals_and_unmeasured_epochs_do_not_count():
    rows = [
        {ERROR: 0.0301, DEPARTED: 0, "held_out_loss": 0.2},
        {ERROR: 0.0304, DEPARTED: 0, "held_out_loss": 0.1},
    ]
    assert rank(rows[1]) < rank(rows[0])


def test_validation_every_second_epoch_and_after_the_last(data):
    validation = Scripted([(0, 0.1), (0, 0.2)], every=2)
    settings = TrainSettings(epochs=3, batch=24)
    history = fit_policy(PilotNet(1), data, settings, validation=validation)
    assert [row["measured"] for row in history] == [False, True, True]


def test_training_goes_on_after_a_closed_loop(data):
    environment = SITE.open(SITE.typical())
    loop = ClosedLoop([environment], [straight()], [], None, DRIVE, every=1)
    module = PilotNet(1)
    before = loop.measure(module)
    assert all(parameter.requires_grad for parameter in module.parameters())
    history = fit_policy(
        module, data, TrainSettings(epochs=2, batch=12), validation=loop
    )
    # 3 periods on a straight lane from a random start: the error is near the start's
    assert set(before["routes"]) == {"mitsuba straight no_object"}
    assert [row[DEPARTED] for row in history] == [0, 0]
    assert history[0]["train_loss"] != history[1]["train_loss"]


def test_exported_program_gives_the_modules_controls(tmp_path):
    torch.manual_seed(3)
    module = PilotNet(3).eval()
    export_program(module, tmp_path / "policy.pt2")
    program = load_exported(tmp_path / "policy.pt2")
    assert program.batch is None
    for count in (1, 3):
        image, goal = torch.rand(count, 3, *IMAGE_SHAPE), torch.arange(count) % 3
        torch.testing.assert_close(program(image, goal), module(image, goal))


def test_presets_have_the_figures_of_the_paper():
    assert find_preset("intersection").frames == {
        "mitsuba": 120_000,
        "surrogate": 60_000,
    }
    assert find_preset("intersection").validation_frames == {"surrogate": 12_000}
    assert find_preset("room").frames == {"mitsuba": 9_584, "surrogate": 12_000}
    laptop = find_preset("laptop")
    total = sum(laptop.frames.values())
    total += laptop.dagger_rounds * sum(laptop.dagger_frames.values())
    assert 9_000 <= total <= 11_000
    with pytest.raises(InputError, match="preset: 'desktop'; one of laptop"):
        find_preset("desktop")
    assert Train(output="o", data="d").preset in PRESETS  # pyright: ignore


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"frames": {"moon": 3}}, "frames: of moon"),
        ({"frames": {"mitsuba": 0}}, "at least one frame"),
        ({"validate_in": ("moon",)}, "frames: of moon"),
        ({"frames": {"mitsuba": -1}}, "frames: .'mitsuba': -1.; must be a whole"),
        (
            {"validate_every": 0},
            "validate_every: 0; must be a whole number",
        ),
        (
            {"dagger_epochs": 0},
            "dagger_epochs: 0; must be a whole number",
        ),
        (
            {"dagger_rounds": -1},
            "dagger_rounds: -1; must be a whole number",
        ),
        ({"dagger_rate": 0.0}, r"dagger_rate: 0.0; must be .* in \(0, 1\)"),
        ({"expert_share": 1.1}, r"expert_share: 1.1; must be .* in \[0, 1\]"),
        ({"dagger_frames": {"mitsuba": 0}}, "dagger_rounds: 1 without dagger_frames"),
        ({"frames": {"mitsuba": 32}}, "frames: 32, one shard of up to 32; at least"),
        # a lane of 3.5 m, a route of 40 m
        (
            {"final": dataclasses.replace(DRIVE, car_width_m=4.0)},
            "route 'straight': its lane is 3.5 m wide, the vehicle 4.0 m",
        ),
        (
            {"final": dataclasses.replace(DRIVE, objects=(1,), roadside=UNSEEN)},
            "route 'straight': places for 0 of 1 objects",
        ),
        (
            {"collecting": small(roadside=UNSEEN)},
            "route 'straight': places for 0 of 1 objects",
        ),
    ],
)
def test_what_cannot_be_trained_is_refused(tmp_path, change, message):
    with pytest.raises(InputError, match=message):
        settings = dataclasses.replace(SETTINGS, **change)
        imitate([SITE], ROUTES, settings, tmp_path, HERE)
    assert not list(tmp_path.iterdir())  # told before the first frame


@pytest.mark.parametrize(
    "change",
    [
        {"frames": {"mitsuba": 64, "surrogate": 0}},
        {"dagger_rounds": 0, "dagger_frames": {"surrogate": 8}},
    ],
)
def test_sites_without_frames_need_not_be_there(change):
    settings = dataclasses.replace(SETTINGS, **change)
    assert settings.sites == ("mitsuba",)
    _check([SITE], ROUTES, settings, [])


def test_goals_cameras_and_weights_must_fit(tmp_path):
    far = dataclasses.replace(bent(), goal=1000)
    with pytest.raises(InputError, match="'left': goal 1000; PilotNet has at most"):
        imitate([SITE], [far], SETTINGS, tmp_path, HERE)
    small_camera = PaintedSite("mitsuba", size_px=(100, 50))
    with pytest.raises(InputError, match=r"100 x 50 px; PilotNet takes 200 x 66"):
        imitate([small_camera], ROUTES, SETTINGS, tmp_path, HERE)
    with pytest.raises(InputError, match=r"start: .*\(2, 1.5, 'rad/s'\) are needed"):
        start = PilotNet(2, unit="rad")
        imitate([SITE], ROUTES, SETTINGS, tmp_path, HERE, start=start)
    assert not list(tmp_path.iterdir())  # told before the first frame


@pytest.mark.parametrize(
    ("size", "goal", "message"),
    [
        (
            (100, 50),
            0,
            "frames of 100 x 50 px; PilotNet takes 200 x 66",
        ),
        ((200, 66), 2, "goals: 2 to 2; at least 0 and below 2"),
    ],
)
def test_earlier_frames_must_fit(tmp_path, size, goal, message):
    frames = np.zeros((1, size[1], size[0], 3), np.uint8)
    other = write_shard(tmp_path / "other", frames, [goal], [0.0])
    with pytest.raises(InputError, match=f"other.safetensors: {message}"):
        imitate([SITE], ROUTES, SETTINGS, tmp_path / "data", HERE, more=[other])
    assert not (tmp_path / "data").exists()  # told before the first frame


@dataclasses.dataclass(frozen=True)
class MissingSite(PaintedSite):
    """Needs a package that is not there."""

    def open(self, conditions):
        raise InputError("environment 'gone': pip install it")


def test_an_environment_that_is_not_there_is_told_before_the_first_frame(tmp_path):
    missing = MissingSite("mujoco", size_px=(200, 66))
    settings = dataclasses.replace(SETTINGS, frames={"mitsuba": 64, "mujoco": 1})
    with pytest.raises(InputError, match="pip install it"):
        imitate([SITE, missing], ROUTES, settings, tmp_path, HERE)
    assert not list(tmp_path.iterdir())


def test_one_process_works_in_a_folder(tmp_path):
    partial = tmp_path / "round_0" / ".shard_0000.safetensors.0123456789ab.tmp"
    files.make_folder(partial.parent)
    partial.touch()  # of a killed writer
    with exclusive(tmp_path), pytest.raises(InputError, match="another process works"):
        imitate([SITE], ROUTES, SETTINGS, tmp_path, HERE)
    assert list(tmp_path.rglob("*")) == [partial.parent, partial]
    imitate([SITE], ROUTES, SETTINGS, tmp_path, HERE)
    assert not partial.exists()


@pytest.mark.parametrize("goals", [(2, 1), (2, 2)])
def test_goals_are_numbers_of_manoeuvres_not_of_routes(tmp_path, goals):
    """They need not begin with 0, and routes may share one."""
    pairs = zip(ROUTES, goals, strict=True)
    routes = [dataclasses.replace(route, goal=goal) for route, goal in pairs]
    settings = dataclasses.replace(SETTINGS, dagger_rounds=0)
    found = imitate([SITE], routes, settings, tmp_path, HERE)
    assert found.module.goals == 3
    data = FrameDataset.from_shards(find_shards(tmp_path))
    assert set(data.goals) == set(goals)


def test_first_weights_may_have_more_goals(tmp_path):
    """A policy for three manoeuvres goes on with routes of one."""
    settings = dataclasses.replace(SETTINGS, dagger_rounds=0)
    start = PilotNet(3)
    found = imitate([SITE], [straight()], settings, tmp_path, HERE, start=start)
    assert found.module.goals == 3
