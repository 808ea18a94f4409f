"""The way from frames to a policy."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest
import torch
from support.files.folders import write_shard
from support.worlds.places import PaintedSite, bent, small, straight

from mi_nerfattack.commands.train import Train
from mi_nerfattack.deploy.car import CAR, Control
from mi_nerfattack.deploy.roadside.rule import Roadside
from mi_nerfattack.errors import InputError
from mi_nerfattack.evaluation.evaluate import EvaluateSettings
from mi_nerfattack.io import files
from mi_nerfattack.policy.exported import export_program, load_exported
from mi_nerfattack.policy.pilotnet import IMAGE_SHAPE, PilotNet
from mi_nerfattack.report.pages.policy import training_facts
from mi_nerfattack.system.workers import InThisProcess
from mi_nerfattack.training import imitate as module
from mi_nerfattack.training.dataset import FrameDataset, find_shards
from mi_nerfattack.training.imitate import Imitated, imitate
from mi_nerfattack.training.presets import PRESETS, find_preset
from mi_nerfattack.training.record import (
    count_frames,
    read_record,
    training_record,
    write_trained,
)
from mi_nerfattack.training.settings import ImitationSettings
from mi_nerfattack.training.train import TrainSettings, fit_policy
from mi_nerfattack.training.validation import (
    DEPARTED,
    ERROR,
    AbstractValidation,
    ClosedLoop,
    Epoch,
    rank,
)

pytestmark = pytest.mark.usefixtures("variant")

SITE = PaintedSite("mitsuba", size_px=(200, 66))
LOCAL = InThisProcess()
DRIVE = EvaluateSettings(runs=1, objects=(), horizon=3)
SETTINGS = ImitationSettings(
    frames={"mitsuba": 64},
    dagger_frames={"mitsuba": 32},
    dagger_rounds=1,
    dagger_epochs=1,
    horizon=4,
    collecting=small(shard=8),
    training=TrainSettings(epochs=1, batch=32, held_out=0.3),
    validation=DRIVE,
    final=DRIVE,
)
LONGER = dataclasses.replace(SETTINGS, dagger_rounds=2)
ROUTES = [straight(), bent()]
#: Nothing is seen for a minute of a drive of 8 s.
UNSEEN = Roadside(view_s=60.0)


def test_imitation_runs_from_frames_to_card_and_resumes(tmp_path):
    stages: list[str] = []

    def note(stage, done, total, state):
        assert 0 <= done <= total
        if stage not in stages:
            stages.append(stage)

    first = imitate([SITE], ROUTES, SETTINGS, tmp_path, LOCAL, note)
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
    again = imitate([SITE], ROUTES, SETTINGS, tmp_path, LOCAL, note)
    assert "training 0" not in stages
    assert again.history == first.history
    weights = (item.module.state_dict().values() for item in (first, again))
    assert all(torch.equal(*pair) for pair in zip(*weights, strict=True))
    longer = imitate([SITE], ROUTES, LONGER, tmp_path, LOCAL)
    assert longer.history[:2] == first.history and len(longer.history) == 3
    with pytest.raises(InputError, match=r"checkpoint_0.*\n  start: .* -> .*\nrestore"):
        imitate([SITE], ROUTES, SETTINGS, tmp_path, LOCAL, start=PilotNet(2))


def rows(data: FrameDataset) -> set[tuple[bytes, float]]:
    frames = data.read_frames(np.arange(len(data)))[:, 0, 0]
    return {(f.tobytes(), c) for f, c in zip(frames, data.controls, strict=True)}


def test_rows_that_are_held_out_are_never_trained_on(monkeypatch, tmp_path):
    rounds: list[tuple[FrameDataset, FrameDataset]] = []

    def fit(module, data, *arguments, held_out, **keywords):
        rounds.append((data, held_out))
        return fit_policy(module, data, *arguments, held_out=held_out, **keywords)

    monkeypatch.setattr(module, "fit_policy", fit)
    result = imitate([SITE], ROUTES, LONGER, tmp_path, LOCAL)
    assert len(rounds) == 3 and len(result.shards) == (64 + 32 + 32) // 8
    trained = set().union(*(rows(data) for data, _ in rounds))
    for number, (data, held) in enumerate(rounds):
        assert len(data) + len(held) == 64 + 32 * number
        assert not trained & rows(held)
    # a row that was held out stays so
    assert rows(rounds[0][1]) <= rows(rounds[2][1])
    assert len(rounds[0][1]) >= 8


@pytest.mark.slow
def test_rounds_of_other_seeds_have_other_frames(tmp_path):
    frames, order = {}, {}
    for seed in (0, 1):
        settings = dataclasses.replace(SETTINGS, seed=seed)
        imitate([SITE], ROUTES, settings, tmp_path / f"{seed}", LOCAL)
        for number in (0, 1):
            shard = f"round_{number}/mitsuba/shard_0000"
            for name, seeds in ((shard, frames), (f"checkpoint_{number}", order)):
                path = tmp_path / f"{seed}" / f"{name}.safetensors"
                seeds[seed, number] = files.read_safetensors(path)[1]["settings.seed"]
    assert len(set(frames.values())) == len(set(order.values())) == 4


@pytest.mark.slow
def test_frames_of_rounds_that_are_left_out_are_not_recorded(tmp_path):
    data = tmp_path / "data"
    imitate([SITE], ROUTES, LONGER, data, LOCAL)
    every = imitate([SITE], ROUTES, SETTINGS, data, LOCAL).shards
    assert count_frames(data, every) == {"round_0/mitsuba": 64, "round_1/mitsuba": 32}
    assert count_frames(tmp_path, every[:1]) == {"data/round_0/mitsuba": 8}
    assert count_frames(tmp_path / "b", every[:1]) == {"earlier/mitsuba": 8}


def test_a_collection_of_its_own_is_held_out(tmp_path):
    settings = dataclasses.replace(
        SETTINGS, dagger_rounds=0, validation_frames={"mitsuba": 40}
    )
    stages = []
    imitate([SITE], ROUTES, settings, tmp_path, LOCAL, lambda *at: stages.append(at[0]))
    assert "held_out, mitsuba" in stages
    folders = tmp_path / "round_0", tmp_path / "held_out"
    one, other = (FrameDataset.from_shards(find_shards(at)) for at in folders)
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
    equal = {ERROR: 0.0301, DEPARTED: 0, "held_out_loss": 0.2}  # the loss decides
    assert rank({**equal, ERROR: 0.0304, "held_out_loss": 0.1}) < rank(equal)


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


def test_presets_are_known_by_name():
    with pytest.raises(InputError, match="preset: 'desktop'; one of laptop"):
        find_preset("desktop")
    assert Train(output="o", data="d").preset in PRESETS  # pyright: ignore


def drives(**changes):
    return dataclasses.replace(DRIVE, **changes)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"frames": {"moon": 3}}, "frames: of moon"),
        ({"frames": {"mitsuba": 0}}, "at least one frame"),
        ({"validate_in": ("moon",)}, "frames: of moon"),
        ({"frames": {"mitsuba": -1}}, "frames: .'mitsuba': -1."),
        ({"validate_every": 0}, "validate_every: 0"),
        ({"dagger_frames": {"mitsuba": 0}}, "dagger_rounds: 1 without dagger_frames"),
        ({"frames": {"mitsuba": 8}}, "frames: 8, .* up to 8"),
        # a lane of 3.5 m, a route of 40 m
        ({"final": drives(car_width_m=4.0)}, "'straight': .* 3.5 m wide, .* 4.0 m"),
        ({"final": drives(objects=(1,), roadside=UNSEEN)}, "'straight': .* 0 of 1 obj"),
        ({"collecting": small(roadside=UNSEEN)}, "'straight': .* 0 of 1 objects"),
    ],
)
def test_what_cannot_be_trained_is_refused(tmp_path, change, message):
    with pytest.raises(InputError, match=message):
        settings = dataclasses.replace(SETTINGS, **change)
        imitate([SITE], ROUTES, settings, tmp_path, LOCAL)
    assert not list(tmp_path.iterdir())  # told before the first frame


@dataclasses.dataclass(frozen=True)
class AcceleratedSite(PaintedSite):
    @property
    def car(self):
        controls = (Control("acceleration", "m/s^2", -8.0, 3.0),)
        limits = {"control_unit": "rad", "max_control": 0.6, "more_controls": controls}
        return dataclasses.replace(CAR, **limits)


def two_controls(folder):
    """Frames of a car that takes an acceleration, too."""
    frames = np.zeros((1, 66, 200, 3), np.uint8)
    return [write_shard(folder / "other", frames, [0], [[0.1, 1.0]])]


@dataclasses.dataclass(frozen=True)
class MissingSite(PaintedSite):
    def open(self, conditions):
        raise InputError("environment 'gone': pip install it")


def frames_of(size_px, goal):
    frames = np.zeros((1, size_px[1], size_px[0], 3), np.uint8)
    return lambda folder: [write_shard(folder / "other", frames, [goal], [0.0])]


def steered(folder):
    """Frames of a car that is steered by an angle."""
    (shard,) = frames_of((200, 66), 0)(folder)
    tensors, _ = files.read_safetensors(shard)
    files.write_safetensors(shard, tensors, {"site.car.control_unit": '"rad"'})
    return [shard]


BOTH = dataclasses.replace(SETTINGS, frames={"mitsuba": 64, "mujoco": 1})
MISSING = [SITE, MissingSite("mujoco", size_px=(200, 66))]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"routes": [dataclasses.replace(bent(), goal=1000)]}, "'left': goal 1000"),
        ({"sites": [PaintedSite("mitsuba", size_px=(100, 50))]}, "100 x 50 px; .* 66"),
        ({"sites": [AcceleratedSite("mitsuba", size_px=(200, 66))]}, "acceleration"),
        (
            {"earlier_shards": two_controls},
            "other.safetensors: controls: 2 of each frame",
        ),
        ({"start": PilotNet(2, unit="rad")}, r"start: .*\(2, 1.5, 'rad/s'\)"),
        (
            {"earlier_shards": frames_of((100, 50), 0)},
            "other.safetensors: .* 100 x 50 px",
        ),
        (
            {"earlier_shards": frames_of((200, 66), 2)},
            "other.safetensors: goals: 2 to 2",
        ),
        (
            {"earlier_shards": steered},
            "other.safetensors: controls in rad; .* in rad/s: leave",
        ),
        ({"sites": MISSING, "settings": BOTH}, "pip install it"),
    ],
)
def test_goals_cameras_frames_and_weights_must_fit(tmp_path, change, message):
    arguments = {"sites": [SITE], "routes": ROUTES, "settings": SETTINGS} | change
    if "earlier_shards" in change:
        arguments["earlier_shards"] = change["earlier_shards"](tmp_path)
    with pytest.raises(InputError, match=message):
        imitate(folder=tmp_path / "data", workers=LOCAL, **arguments)
    assert not any((tmp_path / "data").rglob("*"))  # told before the first frame


@pytest.mark.parametrize("goals", [(2, 1), (2, 2)])
def test_goals_are_numbers_of_manoeuvres_not_of_routes(tmp_path, goals):
    """They need not begin with 0, and routes may share one."""
    pairs = zip(ROUTES, goals, strict=True)
    routes = [dataclasses.replace(route, goal=goal) for route, goal in pairs]
    frames = {"mitsuba": 64, "surrogate": 0}  # whose site need not be there
    settings = dataclasses.replace(SETTINGS, dagger_rounds=0, frames=frames)
    # first weights may have more goals
    start = PilotNet(3) if goals[0] == goals[1] else None
    imitated = imitate([SITE], routes, settings, tmp_path, LOCAL, start=start)
    assert imitated.module.goals == 3
    data = FrameDataset.from_shards(find_shards(tmp_path))
    assert set(data.goals) == set(goals)


@pytest.mark.parametrize(
    "text",
    ['{"schema": "1.0"}', '{"training": true}', '{"schema": 2, "training": [1]}', "[]"],
)
def test_another_program_s_file_beside_a_policy_is_no_record(tmp_path, text):
    (tmp_path / "net.json").write_text(text)
    assert read_record(tmp_path / "net.json") is None


def test_a_training_writes_down_its_data_and_settings(tmp_path):
    folder = files.make_folder(tmp_path / "round_0" / "painted")
    frames = np.zeros((12, 2, 2, 3), np.uint8)
    shard = write_shard(folder / "shard_0000", frames, [0] * 12, [0.0] * 12)
    settings = ImitationSettings({"painted": 12}, seed=5)
    row = Epoch(train_loss=2.0, held_out_loss=1.0, held_out_error=0.1, measured=True)
    rows = [[row, {**row, "held_out_loss": 0.5}]]
    result = Imitated(PilotNet(2).eval(), rows, 0, {}, [shard])
    record = training_record(settings, [PaintedSite()], tmp_path, result, "train it")
    write_trained(tmp_path / "net.safetensors", result.module, record)
    stored = read_record(tmp_path / "net.json")
    assert stored and stored.model_dump() == record.model_dump(mode="json")
    nothing = training_record(settings, [], tmp_path / "empty", result, "")
    assert nothing.data == {"earlier/painted": 12}
    facts = training_facts(record)
    assert facts["command"] == "train it" and facts["seed"] == 5
    assert facts["augmentation"]["exposure_ev"] > 0
    assert facts["data"] == {"round_0/painted": 12}
    # those of the collections and trainings are others: theirs are overridden
    assert not {"frames", "seed"} & set(facts["settings"]["collecting"])
    assert "seed" not in facts["settings"]["training"]
    kinds = [item["kind"] for item in facts["settings"]["cloning"]["sources"]]
    assert kinds == ["scattered", "expert"]
    (first,) = facts["rounds"]
    assert first == {"epochs": 2, "held_out_loss": 0.5, "closed_loop_error_m": None}
