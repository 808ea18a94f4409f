"""PilotNet, the bridge between Dr.Jit and torch, and training."""

from __future__ import annotations

import dataclasses
import os
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import torch
from helpers.shards import write_shard

from mi_nerfattack.backend.colour import srgb_to_linear_numpy
from mi_nerfattack.errors import InputError
from mi_nerfattack.io import files
from mi_nerfattack.policy.pilotnet import IMAGE_SHAPE, PilotNet
from mi_nerfattack.policy.torch_policy import TorchPolicy
from mi_nerfattack.training.augment import Augmentation
from mi_nerfattack.training.dataset import FrameDataset, divide_shards
from mi_nerfattack.training.train import TrainSettings, fit_policy

pytestmark = pytest.mark.usefixtures("variant")


def images(n, rng):
    return rng.random((n, *IMAGE_SHAPE, 3), dtype=np.float32)


def test_shapes_and_parameter_count():
    network = PilotNet(goals=3)
    image = torch.rand(2, 3, *IMAGE_SHAPE)
    assert network.features(image).shape == (2, 1152)
    assert network(image, torch.tensor([0, 2])).shape == (2,)
    convolutions = [(3, 24, 25), (24, 36, 25), (36, 48, 25), (48, 64, 9), (64, 64, 9)]
    linear = [(1155, 1000), (1000, 256), (256, 256), (256, 10), (10, 1)]
    expected = sum((i * k + 1) * o for i, o, k in convolutions)
    expected += sum((i + 1) * o for i, o in linear)
    assert sum(p.numel() for p in network.parameters()) == expected


def test_control_is_limited_and_depends_on_the_goal():
    network = PilotNet(goals=2, max_control=0.7)
    with torch.no_grad():
        network.head[-1].bias.fill_(50.0)
        image = torch.rand(1, 3, *IMAGE_SHAPE)
        assert network(image, torch.tensor([0])).item() == pytest.approx(0.7)
        network.head[-1].bias.fill_(0.0)
        pair = network(image.expand(2, -1, -1, -1), torch.tensor([0, 1]))
    assert pair[0] != pair[1]


def test_save_and_load(tmp_path):
    network = PilotNet(goals=4, max_control=1.25, unit="rad").eval()
    network.save(tmp_path / "policy.safetensors")
    loaded = PilotNet.load(tmp_path / "policy.safetensors")
    assert (loaded.goals, loaded.max_control, loaded.unit) == (4, 1.25, "rad")
    assert not loaded.training
    for name, value in network.state_dict().items():
        assert torch.equal(value, loaded.state_dict()[name])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda t, m: t.pop("head.0.bias"), r"missing \['head.0.bias'\]"),
        (lambda t, m: t.update(more=np.zeros(2, "f4")), r"unknown \['more'\]"),
        (lambda t, m: t.update({"head.0.bias": np.zeros(2, "f4")}), r"\(1000,\)"),
        (lambda t, m: t.update({"head.0.bias": np.zeros(1000)}), "float64"),
        (lambda t, m: t["head.0.bias"].fill(np.nan), "not finite"),
        (lambda t, m: m.update(goals="2"), r"head.0.weight"),
        (lambda t, m: m.update(goals="-1"), "metadata"),
        (lambda t, m: m.update(goals="true"), "metadata"),
        (lambda t, m: m.update(goals="{"), "metadata"),
        (lambda t, m: m.update(max_control="NaN"), "max_control"),
        (lambda t, m: m.pop("max_control"), "metadata"),
        (lambda t, m: m.update(architecture="other"), "'other'"),
    ],
)
def test_load_errors(tmp_path, change, message):
    path = tmp_path / "policy.safetensors"
    PilotNet().save(path)
    tensors, metadata = files.read_safetensors(path)
    tensors = {name: value.copy() for name, value in tensors.items()}
    change(tensors, metadata)
    files.write_safetensors(path, tensors, metadata)
    with pytest.raises(InputError, match=message):
        PilotNet.load(path)


@pytest.mark.parametrize(
    "arguments", [{"goals": 0}, {"max_control": float("inf")}, {"unit": "deg"}]
)
def test_rejects_parameters(arguments):
    with pytest.raises(InputError, match=next(iter(arguments))):
        PilotNet(**arguments)


def test_vjp_equals_float64_reference(rng):
    network = PilotNet()
    policy = TorchPolicy(network)
    values, weight = images(3, rng), rng.normal(size=3).astype(np.float32)
    control, gradient = policy.vjp(mi.TensorXf(values), [0, 1, 2], mi.Float(weight))
    reference = PilotNet().double()
    reference.load_state_dict(network.state_dict())
    leaf = torch.tensor(values, dtype=torch.float64).permute(0, 3, 1, 2)
    leaf.requires_grad_(True)
    expected = reference(leaf, torch.tensor([0, 1, 2]))
    (expected * torch.tensor(weight)).sum().backward()
    np.testing.assert_allclose(control.numpy(), expected.detach(), atol=1e-6)
    exact = leaf.grad.permute(0, 2, 3, 1).numpy()
    assert gradient.shape == (3, *IMAGE_SHAPE, 3)
    assert np.linalg.norm(gradient.numpy() - exact) < 1e-5 * np.linalg.norm(exact)
    np.testing.assert_array_equal(
        policy.control(mi.TensorXf(values), [0, 1, 2]).numpy(), control.numpy()
    )


class Constant(torch.nn.Module):
    """Policy whose derivative is zero everywhere but exists."""

    goals = 1

    def forward(self, image, goal):
        return 0 * image.mean(dim=(1, 2, 3)) + 0.5


def test_results_are_evaluated_and_parameters_frozen(rng):
    policy = TorchPolicy(Constant())
    for n in (1, 2):
        image = mi.TensorXf(images(n, rng))
        dr.enable_grad(image)
        control, gradient = policy.vjp(image, 0, dr.full(mi.Float, 1, n))
        assert control.state == dr.VarState.Evaluated
        assert gradient.array.state == dr.VarState.Evaluated
        assert not dr.grad_enabled(control, gradient)
        np.testing.assert_array_equal(control.numpy(), 0.5)
        np.testing.assert_array_equal(gradient.numpy(), 0)
    network = PilotNet()
    TorchPolicy(network)
    assert not network.training
    assert not any(p.requires_grad for p in network.parameters())


def test_images_reach_pilotnet_without_a_copy(rng):
    seen = []

    class Spy(PilotNet):
        def forward(self, image, goal):
            seen.append(image.data_ptr())
            return super().forward(image, goal)

    image = mi.TensorXf(images(1, rng))
    TorchPolicy(Spy()).control(image, mi.UInt32(0))
    assert seen == [dr.detach(image).torch().data_ptr()]


@pytest.mark.parametrize(
    ("goal", "cotangent", "message"),
    [
        (3, [1, 1], "below 3"),
        (-1, [1, 1], "at least 0"),
        ([0, 1, 2], [1, 1], r"\(3,\) for 2 images"),
        (0, [1, 1, 1], r"\(3,\) for \(2,\)"),
    ],
)
def test_adapter_errors(rng, goal, cotangent, message):
    with pytest.raises(InputError, match=message):
        TorchPolicy(PilotNet()).vjp(
            mi.TensorXf(images(2, rng)), goal, mi.Float(cotangent)
        )


def test_adapter_rejects_modules_and_images(rng):
    with pytest.raises(InputError, match="height, width, 3"):
        TorchPolicy(Constant()).control(mi.TensorXf(images(2, rng)[0]), 0)


# Frames whose mean colour tells the control: learnt in a few epochs.


def coloured(n, rng):
    control = rng.uniform(-1, 1, n).astype(np.float32)
    level = np.stack([0.5 + 0.4 * control, 0.5 - 0.4 * control, 0 * control + 0.5], 1)
    frames = np.broadcast_to(level[:, None, None], (n, *IMAGE_SHAPE, 3))
    return (frames * 255).astype(np.uint8), rng.integers(0, 3, n), control


SETTINGS = TrainSettings(epochs=4, batch=16, held_out=0.2, seed=3)


@pytest.fixture
def data(tmp_path, rng):
    sizes = {"a": 70, "b": 58}
    return FrameDataset.from_shards(
        [write_shard(tmp_path / name, *coloured(n, rng)) for name, n in sizes.items()]
    )


def test_dataset_reads_across_shards(tmp_path, rng):
    parts = [coloured(n, rng) for n in (5, 1, 7)]
    data = FrameDataset.from_shards(
        [write_shard(tmp_path / str(i), *part) for i, part in enumerate(parts)]
    )
    rows = np.array([12, 0, 5, 4, 6])
    whole = np.concatenate([part[0] for part in parts])
    np.testing.assert_array_equal(data.read_frames(rows), whole[rows])
    np.testing.assert_array_equal(
        data.controls, np.concatenate([part[2] for part in parts])
    )


@pytest.mark.skipif(not Path("/proc/self/fd").exists(), reason="needs /proc")
def test_many_shards_need_no_more_descriptors(tmp_path, rng):
    """Else 192,000 frames in shards of 64 exceed the usual 1,024 of a process."""
    shards = [write_shard(tmp_path / str(i), *coloured(1, rng)) for i in range(20)]
    before = len(os.listdir("/proc/self/fd"))
    data = FrameDataset.from_shards(shards)
    assert data.read_frames(np.arange(20)).any() and data.digest
    assert len(os.listdir("/proc/self/fd")) <= before  # others may be collected


def test_split_keeps_blocks_together():
    n = 1000
    data = FrameDataset(
        (np.zeros((n, 1, 1, 3), np.uint8),), np.zeros(n, int), np.zeros(n, np.float32)
    )
    train, held = data.split(0.25, seed=1, block=50)
    assert len(held) == 250 and len(train) == 750
    np.testing.assert_array_equal(np.sort(np.concatenate([train, held])), range(n))
    assert set(np.unique(held // 50, return_counts=True)[1]) == {50}


def tiny_shards(count, folder, rng):
    shards = []
    for number in range(count):
        frames, *columns = coloured(3, rng)
        shards.append(write_shard(folder / f"{number}", frames[:, :2, :2], *columns))
    return shards


def test_shards_are_held_out_by_themselves(tmp_path, rng):
    shards = tiny_shards(60, tmp_path, rng)
    train, held = divide_shards(shards, 0.25)
    # 60 draws: 15 are expected, with a standard deviation of 3.4
    assert 5 <= len(held) <= 25
    assert sorted(train + held) == sorted(shards)
    parts = [divide_shards([shard], 0.25) for shard in shards]
    assert [item for _, part in parts for item in part] == held
    assert divide_shards(shards, 0.0) == (shards, [])


@pytest.mark.parametrize("fraction", [0.0, 0.999])
def test_the_first_shards_are_never_all_on_one_side(tmp_path, rng, fraction):
    shards = tiny_shards(3, tmp_path, rng)
    train, held = divide_shards(shards, fraction, least=1)
    assert (len(train), len(held)) == ((2, 1) if fraction == 0 else (1, 2))


def test_dataset_errors(tmp_path, rng):
    frames, goals, controls = coloured(4, rng)
    with pytest.raises(InputError, match="as many of each"):
        write_shard(tmp_path / "x", frames, goals[:2], controls)
    with pytest.raises(InputError, match="row 1 is nan"):
        write_shard(tmp_path / "x", frames, goals, [0, np.nan, 0, 0])
    with pytest.raises(InputError, match="no shards"):
        FrameDataset.from_shards([])
    with pytest.raises(InputError, match=r"absent.*does not exist"):
        FrameDataset.from_shards([tmp_path / "absent"])
    path = write_shard(tmp_path / "x", frames, goals, controls)
    path.write_bytes(path.read_bytes()[:5000])
    with pytest.raises(InputError, match=r"x.safetensors: damaged or truncated"):
        FrameDataset.from_shards([path])
    whole = {"frames": frames, "goals": goals, "controls": controls}
    for change, message in (
        ({"frames": frames.astype(np.float32)}, r"frames F32.*U8 of shape"),
        ({"goals": goals.astype(np.int32)}, "goals int32"),
        ({"goals": goals[:2]}, "4 frames, but 2 goals and 4 controls"),
    ):
        files.write_safetensors(path, whole | change)
        with pytest.raises(InputError, match=message):
            FrameDataset.from_shards([path])
    files.write_safetensors(path, {"goals": goals})
    with pytest.raises(InputError, match="no tensor 'frames'"):
        FrameDataset.from_shards([path])


def test_augmentation_limits_and_identity():
    levels = torch.randint(0, 256, (8, 12, 16, 3), dtype=torch.uint8)
    generator = torch.Generator().manual_seed(1)
    same = Augmentation(0.0, 1.0, 1.0, 0.0, 0.0).apply(levels, generator)
    expected = levels.permute(0, 3, 1, 2) / 255
    torch.testing.assert_close(same, expected, atol=1e-6, rtol=0)
    grey = torch.full((4000, 2, 2, 3), 128, dtype=torch.uint8)
    noisy = Augmentation(0.0, 1.0, 1.0, 0.0, 0.1).apply(grey, generator) - 128 / 255
    # sd is uniform in [0, 0.1]: its mean square is 0.01 / 3.
    assert noisy.square().mean().item() == pytest.approx(0.01 / 3, rel=0.05)
    assert noisy.mean().abs() < 0.002


def test_exposure_and_gain_act_on_linear_light():
    grey = torch.full((4000, 2, 2, 3), 128, dtype=torch.uint8)
    generator = torch.Generator().manual_seed(2)
    brighter = Augmentation(0.5, 1.0, 1.0, 1.0, 0.0).apply(grey, generator)
    light = srgb_to_linear_numpy(brighter.numpy())
    factor = light / srgb_to_linear_numpy(np.float32(128 / 255))
    assert 2**-0.5 <= factor.min() < 0.72 and 1.39 < factor.max() <= 2**0.5 + 1e-5
    # one factor for all pixels and channels of an image, uniform in powers of two
    assert np.ptp(factor, axis=(1, 2, 3)).max() < 1e-4
    assert np.log2(factor).mean() == pytest.approx(0, abs=0.02)
    tinted = Augmentation(0.0, 1.1, 1.0, 0.0, 0.0).apply(grey, generator)
    assert np.ptp(tinted.numpy(), axis=1).max() > 0.03


def test_noise_of_images_differs_and_blur_keeps_the_mean():
    generator = torch.Generator().manual_seed(3)
    grey = torch.full((6, 8, 8, 3), 128, dtype=torch.uint8)
    noisy = Augmentation(0.0, 1.0, 1.0, 0.0, 0.2).apply(grey, generator)
    assert not any(torch.equal(noisy[0], other) for other in noisy[1:])
    levels = torch.randint(60, 200, (1, 40, 40, 3), dtype=torch.uint8)
    before = levels.permute(0, 3, 1, 2) / 255
    blurred = Augmentation(0.0, 1.0, 1.0, 1.0, 0.0).apply(levels, generator)
    assert blurred.var() < 0.9 * before.var()
    assert blurred.mean().item() == pytest.approx(before.mean().item(), abs=0.01)


def train(data, settings=SETTINGS, **arguments):
    torch.manual_seed(7)
    network = PilotNet()
    return network, fit_policy(network, data, settings, **arguments)


def test_training_learns_and_continues_after_an_interruption(data, tmp_path):
    whole, history = train(data)
    assert len(history) == 4 and not whole.training
    # Guessing zero is off by 0.5 on average.
    assert min(row["held_out_error"] for row in history) < 0.15
    path = tmp_path / "state.safetensors"

    def interrupt(progress):
        if (progress.epoch, progress.step) == (3, 2):
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train(data, checkpoint=path, progress=interrupt)
    steps = []
    resumed, continued = train(data, checkpoint=path, progress=steps.append)
    assert (steps[0].epoch, steps[-1].epoch) == (3, 4)
    assert continued == history
    for one, other in zip(whole.parameters(), resumed.parameters(), strict=True):
        assert torch.equal(one, other)
    with pytest.raises(InputError, match=r"settings.seed: 3 -> 4"):
        train(data, dataclasses.replace(SETTINGS, seed=4), checkpoint=path)
    frames = 255 - data.read_frames(np.arange(len(data)))
    other = dataclasses.replace(data, frames=(frames,))
    with pytest.raises(InputError, match=r"\n  rows: .*\n  held_out: .*\n"):
        train(other, checkpoint=path)
    with pytest.raises(InputError, match=r"\n  start: .*\n"):
        fit_policy(PilotNet(), data, SETTINGS, checkpoint=path)


def test_training_errors(data):
    bad = dataclasses.replace(data, goals=data.goals + 1)
    with pytest.raises(InputError, match="below 3"):
        train(bad)
    bad = dataclasses.replace(data, controls=data.controls * 3)
    with pytest.raises(InputError, match="at most 1.5"):
        train(bad)
    with pytest.raises(InputError, match="held_out"):
        train(data, dataclasses.replace(SETTINGS, held_out=1.0))
