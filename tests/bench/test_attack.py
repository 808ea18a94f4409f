"""The closed loop in PyTorch agrees with ours; what `bench attack` prints."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers.small_fields import blob, small_ngp

from bench.__main__ import main
from bench.attack.drive import SPEED_MS, Job
from bench.attack.peer import Tape
from bench.attack.run import memory_row
from bench.attack.table import memory_table, remarks, time_table
from bench.full_ngp import NGPData
from bench.render.sides import pinhole_rays
from bench.torch.encoding import PlainHashGrid, TunedHashGrid
from bench.torch.loop import (
    Resized,
    TorchCamera,
    TorchLoop,
    TorchRoute,
    TorchVehicle,
    TorchView,
    compose,
)
from bench.torch.ngp import TorchNGP
from bench.torch.object import (
    BagLookup,
    ObjectData,
    ObjectView,
    SelectLookup,
    TorchObject,
)
from mi_nerfattack import cli
from mi_nerfattack.attack.objectives import CrossTrackDeviation
from mi_nerfattack.policy.preprocess import Crop, Preprocess, Resize
from mi_nerfattack.policy.torch_policy import TorchPolicy
from mi_nerfattack.render.camera.intrinsics import CameraMount, from_fov, mount_matrix
from mi_nerfattack.render.camera.pose import Pose
from mi_nerfattack.render.march import STOP
from mi_nerfattack.render.posed import PosedField
from mi_nerfattack.rollout.field_sensor import FieldSensor
from mi_nerfattack.rollout.function import Rollout
from mi_nerfattack.rollout.loop import ClosedLoop
from mi_nerfattack.rollout.objective import StageSum
from mi_nerfattack.vehicle.dynamics import Dubins
from mi_nerfattack.vehicle.integrators import RK4
from mi_nerfattack.vehicle.route.route import Route

pytestmark = pytest.mark.usefixtures("variant")
WIDTH, HEIGHT, HORIZON = 24, 14, 4
CAMERA = from_fov(WIDTH, HEIGHT, 80.0)
MOUNT = CameraMount(1.2, 0.3, 4.0)
POSE = Pose.upright((5.5, 0.7, 1.1), 0.3, 1.3)
ROUTE = Route("bend", 0, np.array([[-9.0, 0.0], [1.0, 0.1], [9.0, 2.0]]))
STAGES = [Crop(2, 2, 0, 0), Resize(16, 8)]
INITIAL = np.array([[0.0, 0.1, 0.05], [0.4, -0.2, 0.0], [-0.2, 0.3, -0.1]])


class Gain(torch.nn.Module):
    """A smooth functional of the image."""

    goals = 1

    def __init__(self) -> None:
        super().__init__()
        generator = torch.Generator().manual_seed(3)
        weight = torch.randn(1, 3, 8, 16, generator=generator)
        self.weight = torch.nn.Parameter(0.05 * weight)

    def forward(self, image: torch.Tensor, goal: torch.Tensor) -> torch.Tensor:
        return 1.4 * torch.tanh((image * self.weight).sum((1, 2, 3)))


@pytest.fixture(autouse=True)
def one_thread():
    """Let PyTorch's threads not wait for each other in tiny operations."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.fixture
def scene() -> NGPData:
    """Return fog of many colours all around, some of it in front of the object."""
    data = NGPData.of(small_ngp(cone=1 / 64))
    data.tensors["density_net.1"][0] *= 12
    corner = np.array([20.0, 20.0, 6.0])
    return replace(data, lower=-corner, upper=corner, step_m=0.4)


def peer(scene: NGPData, item: ObjectData, grid=TunedHashGrid, lookup=None):
    seen = TorchObject(item, lookup or BagLookup(), STOP)
    seen.texture.requires_grad_(True)
    ngp = TorchNGP(scene, grid(scene.layout), STOP)
    view = TorchView(ngp, seen, TorchCamera(CAMERA, MOUNT), 100)
    vehicle, route = TorchVehicle(5.0, 1.5, 0.1), TorchRoute(ROUTE.points, 0.05)
    return TorchLoop(view, Resized(Gain(), STAGES), 0, vehicle, route)


@pytest.mark.parametrize(
    ("grid", "lookup"), [(PlainHashGrid, BagLookup()), (TunedHashGrid, SelectLookup())]
)
def test_the_peer_drives_and_differentiates_as_we_do(rng, scene, grid, lookup):
    item = PosedField(blob(rng, peak=4.0), POSE)
    sensor = FieldSensor(PosedField(scene.field()), [item], CAMERA, MOUNT, stop=STOP)
    policy = TorchPolicy(Gain(), preprocess=Preprocess(STAGES))
    loop = ClosedLoop(sensor, policy, 0, Dubins(5.0, 1.5), RK4(), 0.1)
    rollout = Rollout(loop, StageSum(CrossTrackDeviation(ROUTE, 0.05)), HORIZON)
    evaluation = rollout.run(loop.initial(INITIAL))
    expected = rollout.gradient(evaluation).textures[0].numpy()

    other = peer(scene, ObjectData.of(item), grid, lookup)
    states = other.drive(torch.tensor(INITIAL), HORIZON)
    cost = other.objective(states)
    cost.backward()
    ours = evaluation.trajectory.states_numpy()[:, 1:].transpose(1, 0, 2)
    assert np.ptp(ours[-1, :, 2] - INITIAL[:, 2]) > 1e-3  # the images do steer
    assert np.abs(states.detach().numpy() - ours).max() < 1e-3
    assert cost.item() == pytest.approx(evaluation.value, abs=1e-3)
    found = other.view.item.texture.grad.numpy()
    assert np.linalg.norm(expected) > 1e-6
    assert np.linalg.norm(found - expected) < 1e-2 * np.linalg.norm(expected)


def test_a_frame_without_the_object_has_no_tape(rng, scene):
    loop = peer(scene, ObjectData.of(PosedField(blob(rng), POSE)))
    away = torch.tensor([[0.0, 0.0, np.pi]], dtype=torch.float64)
    assert not loop.view.image(away).requires_grad
    assert loop.view.image(torch.tensor(INITIAL)).requires_grad


def test_chunks_make_no_difference(rng, scene):
    view = peer(scene, ObjectData.of(PosedField(blob(rng), POSE))).view
    images = []
    for chunk in (37, 10_000):
        view.chunk = chunk
        images.append(view.image(torch.tensor(INITIAL)).detach())
    assert torch.allclose(*images, atol=1e-5)


def test_lookups_agree_with_a_loop_over_corners(rng):
    table = torch.tensor(rng.normal(size=(20, 3)), requires_grad=True)
    row = torch.tensor(rng.integers(0, 20, (5, 16)), dtype=torch.int32)
    weight = torch.tensor(rng.random((5, 16)))
    expected = np.zeros((5, 3))
    for i in range(5):
        for k in range(16):
            expected[i] += weight[i, k].item() * table[row[i, k]].detach().numpy()
    for lookup in (BagLookup(), SelectLookup()):
        table.grad = None
        found = lookup(table, row, weight)
        found.sum().backward()
        assert found.detach().numpy() == pytest.approx(expected)
        assert table.grad.sum().item() == pytest.approx(3 * weight.sum().item())
    assert SelectLookup()(table, row[:0], weight[:0]).shape == (0, 3)


def test_an_object_survives_a_file(rng, tmp_path):
    data = ObjectData.of(PosedField(blob(rng), POSE))
    data.write(tmp_path / "item.safetensors")
    back = ObjectData.read(tmp_path / "item.safetensors")
    for name, value in vars(data).items():
        assert np.array_equal(getattr(back, name), value)


def test_rays_are_those_of_the_mounted_camera():
    origin, direction = TorchCamera(CAMERA, MOUNT).rays(torch.tensor(INITIAL))
    for k, pose in enumerate(mount_matrix(INITIAL, MOUNT)):
        part = slice(k * WIDTH * HEIGHT, (k + 1) * WIDTH * HEIGHT)
        expected = pinhole_rays(WIDTH, HEIGHT, 80.0, pose)
        assert origin[part].numpy() == pytest.approx(expected[0], abs=1e-6)
        assert direction[part].numpy() == pytest.approx(expected[1], abs=1e-6)


def test_the_nearer_one_covers_the_other():
    def one(value: float) -> torch.Tensor:
        return torch.tensor([value])

    grey, sky = torch.full((1, 3), 0.3), torch.ones(1, 3)
    seen = ObjectView(torch.tensor([0]), torch.full((1, 3), 0.5), one(0.4), one(0.6))
    # at 1 m; the background, of opacity 0.5, at 2 m, then at 0.5 m
    behind = compose(seen, grey, one(0.5), one(1.0), sky)
    assert behind.tolist()[0] == pytest.approx([0.5 + 0.4 * 0.3 + 0.4 * 0.5] * 3)
    before = compose(seen, grey, one(0.5), one(0.25), sky)
    assert before.tolist()[0] == pytest.approx([0.3 + 0.5 * 0.5 + 0.4 * 0.5] * 3)
    nothing = compose(seen, 0 * grey, one(1.0), one(0.0), sky)
    assert nothing.tolist()[0] == pytest.approx([0.5 + 0.4] * 3)


def test_the_peer_measures_from_the_same_line(rng):
    """Beside segments, around the vertex, and beyond both ends."""
    states = np.concatenate([rng.uniform(-14, 14, (200, 2)), np.zeros((200, 1))], 1)
    found = TorchRoute(ROUTE.points, 0.05).cost(torch.tensor(states))
    error = ROUTE.cross_track_numpy(states)
    assert found.numpy() == pytest.approx(0.05 - np.hypot(error, 0.05), abs=1e-9)


def test_the_peer_drives_a_circle():
    vehicle = TorchVehicle(4.0, 100.0, 0.05)
    state = torch.zeros(1, 3, dtype=torch.float64)
    for _ in range(10):
        state = vehicle.step(state, torch.tensor([0.8]))
    turn = 0.8 * 0.5
    expected = [5 * np.sin(turn), 5 * (1 - np.cos(turn)), turn]
    assert state.tolist()[0] == pytest.approx(expected, abs=1e-6)


def test_all_horizons_drive_the_same_road():
    jobs = [Job(366, 188, 3, horizon) for horizon in (25, 400)]
    assert {SPEED_MS * job.dt * job.horizon for job in jobs} == {12.5}
    assert np.array_equal(*(job.initial() for job in jobs))
    planes = torch.rand(1, 3, 188, 366)
    for stage in jobs[0].stages():
        planes = stage.apply(planes)
    assert planes.shape == (1, 3, 66, 200)
    assert jobs[0].arguments() == ["366", "188", "3", "25"]


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


SIZE = ["--sizes", "32x16", "--repeats", "1"]


@pytest.mark.slow
def test_a_quick_benchmark_prints_the_promised_keys(capsys, tmp_path):
    path = tmp_path / "attack.json"
    command = ["attack", "--quick", "--json", *SIZE, "-o", str(path)]
    assert main(command) == 0
    document = json.loads(capsys.readouterr().out)
    assert json.loads(path.read_text()) == document
    row = document["32x16"]
    for key in (
        *("iteration_over_rollout", "replay_over_rollout", "torch_memory_ratio"),
        *("torch_time_ratio", "torch_tuned_time_ratio", "torch_cpu_ratio"),
    ):
        assert row[key] > 0
    assert list(row["peak_memory_mb_by_horizon"]) == ["1", "2"]
    assert row["kernels_compiled_after_warmup"] == 0
    kept = row["kept_backgrounds"]["stated_mb_per_step"]
    assert kept == pytest.approx(20 * 32 * 16 / 1e6)
    assert row["batch"]["poses"] == 2
    single = row["launches_per_step"]["kept_backgrounds"]
    batch = row["batch"]["launches_per_step"]
    assert batch["rollout_over_pixels"] == single["rollout_over_pixels"]
    assert time_table(document).row_count == 5
    assert memory_table(document).row_count == 6
    assert len(remarks(document)) == 4


def test_parts_that_were_not_measured_are_not_shown():
    assert time_table({"200x66": {}, "date": "today"}).row_count == 0
    assert memory_table({"200x66": {}}).row_count == 0
    assert remarks({"200x66": {}}) == []


@pytest.mark.parametrize(
    ("argument", "value"), [("--sizes", "200"), ("--repeats", "0")]
)
def test_bad_arguments_are_refused(capsys, argument, value):
    assert main(["attack", argument, value]) == cli.EXIT_INPUT
    message = capsys.readouterr().err
    assert argument in message
    assert value in message
