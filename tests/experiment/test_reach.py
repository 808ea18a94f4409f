"""How far objects move a control, against policies whose farthest image is known."""

from __future__ import annotations

import json
from dataclasses import replace

import mitsuba as mi
import numpy as np
import pandas as pd
import pytest
import torch
from support.worlds import loops as toy

from bench.__main__ import main
from mi_nerfattack import cli
from mi_nerfattack.attack.texture.constraints import MARGIN
from mi_nerfattack.errors import InputError
from mi_nerfattack.experiment.checks.reach import PixelSearch, measure_reach
from mi_nerfattack.policy.action import Action
from mi_nerfattack.policy.base import AbstractPolicy
from mi_nerfattack.policy.torch_policy import TorchPolicy
from mi_nerfattack.rollout.sensor import AbstractDifferentiableSensor
from mi_nerfattack.scenario.scenario import load_scenario
from mi_nerfattack.scenario.world import World, build_world
from tests.experiment.conftest import write_found

pytestmark = pytest.mark.usefixtures("variant")

SHAPE = 2, 6, 9, 3
HORIZON = 5


class Linear(torch.nn.Module):
    """Two controls, each a sum of the pixels."""

    def __init__(self, weights: np.ndarray) -> None:
        super().__init__()
        self.weights = torch.nn.Parameter(torch.tensor(weights, dtype=torch.float32))

    def forward(self, image: torch.Tensor) -> torch.Tensor:
        return torch.einsum("nchw,khwc->nk", image, self.weights)


class TwoMaxima(torch.nn.Module):
    """Its control is 0.1 where the mean pixel is 0.1, and 0.7 where all are 1."""

    def forward(self, image: torch.Tensor) -> torch.Tensor:
        mean = image.mean((1, 2, 3))
        hump = 0.1 * torch.exp(-(((mean - 0.1) / 0.05) ** 2))
        return hump + (mean - 0.3).clamp(min=0)


def test_the_reach_of_a_linear_policy_is_exact(rng):
    """The sum over the pixels of each one's range times the size of its weight."""
    weights = rng.normal(size=(2, *SHAPE[1:]))
    low = rng.uniform(0, 0.4, SHAPE)
    span = rng.uniform(0, 0.6, SHAPE) * (rng.random(SHAPE) < 0.3)  # objects, the rest
    image = low + span * rng.random(SHAPE)
    policy = TorchPolicy(Linear(weights), action=Action((0, 1)))
    signs = np.array([[1.0, 0.0], [-1.0, 0.0]])
    limits = low.astype(np.float32), (low + span).astype(np.float32)
    search = PixelSearch(starts=1, steps=1)
    extreme, most = search.run(policy, 0, image.astype(np.float32), limits, signs)
    steered = signs[:, :1, None, None] * weights[0]
    expected = (steered * low + np.maximum(steered, 0) * span).sum((1, 2, 3))
    assert most == pytest.approx(expected, rel=1e-5)
    outside = span == 0
    np.testing.assert_allclose(extreme[outside], image[outside], rtol=1e-6)
    assert (extreme >= limits[0]).all() and (extreme <= limits[1]).all()


def test_other_starts_leave_the_nearest_maximum():
    low, high = np.zeros(SHAPE, np.float32), np.ones(SHAPE, np.float32)
    image, up = low + np.float32(0.12), np.ones((2, 1))
    policy = TorchPolicy(TwoMaxima())
    near, far = (
        PixelSearch(starts=count, steps=1).run(policy, 0, image, (low, high), up)[1]
        for count in (1, 2)
    )
    assert near == pytest.approx(2 * [0.1 * np.exp(-0.16)], rel=1e-5)
    assert far == pytest.approx([0.7, 0.7], rel=1e-5)


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    """A scenario whose object is in view of the toy's policy."""
    mi.set_variant("llvm_ad_rgb")
    return write_found(tmp_path_factory.mktemp("scenario"))


@pytest.fixture
def world(path) -> World:
    scenario, _ = load_scenario(path, settings=(f"drive.horizon={HORIZON}",))
    return build_world(scenario, scenario.build_policy())


def first_images(world: World, colours: list[float]) -> list[np.ndarray]:
    """Return the first image with the object in each of some grey colours."""
    sensor, images = world.optimised, []
    assert isinstance(sensor, AbstractDifferentiableSensor)
    pose = world.route.pose_at(world.scenario.drive.start_m)
    original = world.appearance()
    for colour in colours:
        # what a level of one value gives is that value everywhere
        (item,) = world.fields
        texture = np.zeros((item.n_vertices, 3), np.float32)
        texture[item.levels()[0].vertices] = np.log(colour / (1 - colour))
        world.set_textures([texture])
        images.append(sensor.observe(world.loop(sensor).initial(pose), 0).image.numpy())
    world.show(original)
    return images


def test_objects_reach_what_their_pixels_allow(world):
    before = world.appearance().digest
    reach = measure_reach(world)
    assert world.appearance().digest == before
    low, high = first_images(world, [MARGIN, 1 - MARGIN])
    weight = toy.SmoothPolicy().weight.detach().numpy().transpose(0, 2, 3, 1)
    steered = np.stack([weight, -weight])
    farthest = np.maximum(steered * (high - 0.4), steered * (low - 0.4))
    expected = np.tanh(farthest.sum((1, 2, 3, 4))) * [1, -1]
    assert reach.limits[:, 0] == pytest.approx(expected, rel=1e-4)
    changed = np.abs(high - low).max(-1) >= 0.1
    assert reach.pixels[0] == changed.sum() > 10
    # the other drives go to both sides of the first one
    original, up, down = reach.cross_track_m
    assert original.shape == (HORIZON,)
    assert up[-1] > original[-1] > down[-1]
    assert reach.moved.shape == (HORIZON,) and (reach.moved > 0.01).all()


def test_no_texture_moves_a_frame_farther(world, rng):
    reach = measure_reach(world)
    images = []
    for _ in range(4):
        (item,) = world.fields
        world.set_textures([rng.normal(0, 2, (item.n_vertices, 3)).astype(np.float32)])
        pose = world.route.pose_at(world.scenario.drive.start_m)
        state = world.loop(world.optimised).initial(pose)
        images.append(world.optimised.observe(state, 0).image)
    controls = [float(world.policy.control(image, 0)[0]) for image in images]
    high, low = reach.limits[:, 0]
    assert low < min(controls) < max(controls) < high
    assert np.ptp(controls) > 0.01


class Remembering(torch.nn.Module):
    def forward(self, image, hidden):
        return image.mean((1, 2, 3)), hidden


def test_a_policy_with_a_memory_is_refused(world):
    policy: AbstractPolicy = TorchPolicy(Remembering(), recurrent=[(-1, 2)])
    with pytest.raises(InputError, match="without memory"):
        measure_reach(replace(world, policy=policy))


def test_the_command_prints_a_row(path, capsys):
    words = ["reach", str(path), "--set", f"drive.horizon={HORIZON}"]
    assert main([*words, "--json"]) == 0
    (row,) = json.loads(capsys.readouterr().out)["places"]
    assert row["place"] == path.stem and row["in_view"] == row["frames"] == HORIZON
    assert row["most_moved"] >= row["moved"] > 0
    assert row["up_m"] != row["original_m"]
    assert main(words) == 0
    assert f"{HORIZON} of {HORIZON}" in capsys.readouterr().out


def test_a_table_of_places_goes_on(path, tmp_path, capsys):
    output = tmp_path / "reach.csv"
    words = ["reach", str(path), "--set", f"drive.horizon={HORIZON}", "-o", str(output)]
    assert main([*words, "--json"]) == 0
    (row,) = json.loads(capsys.readouterr().out)["places"]
    (line,) = pd.read_csv(output).to_dict("records")
    assert line["place"] == row["place"]
    assert line["up_m"] == pytest.approx(row["up_m"], rel=1e-5)
    output.write_text(output.read_text().replace(path.stem, "another"))
    assert main([*words, "--json"]) == 0  # the place has no row again
    assert len(json.loads(capsys.readouterr().out)["places"]) == 2
    begun = output.stat().st_mtime_ns
    assert main(words) == 0 and output.stat().st_mtime_ns == begun


def test_a_row_of_another_scenario_is_replaced(path, tmp_path, capsys):
    output = tmp_path / "reach.csv"
    words = ["reach", str(path), "-o", str(output), "--json", "--set"]
    digests = []
    for horizon in (2, 3):
        assert main([*words, f"drive.horizon={horizon}"]) == 0
        (row,) = json.loads(capsys.readouterr().out)["places"]
        assert row["frames"] == horizon and row["source"]
        digests.append(row["scenario"])
    assert digests[0] != digests[1]
    older = pd.read_csv(output).drop(columns=["scenario", "source"])
    older.assign(frames=99).to_csv(output, index=False)  # by a program before digests
    assert main([*words, "drive.horizon=3"]) == 0
    (row,) = json.loads(capsys.readouterr().out)["places"]
    assert row["frames"] == 3 and row["scenario"] == digests[1]


def test_what_belongs_to_the_other_kind_of_file_is_refused(path, tmp_path, capsys):
    grid = tmp_path / "grid.toml"
    grid.write_text(f'scenario = "{path}"\n')
    for word, options in (("--only", ["no-place"]), ("--set", ["seed=1"])):
        assert main(["reach", str(grid), word, *options]) == cli.EXIT_INPUT
        assert word[:5] in capsys.readouterr().err
