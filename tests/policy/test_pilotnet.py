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
from support.faults.refusals import refusals
from support.files.folders import write_shard

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


def test_save_and_load(tmp_path):
    network = PilotNet(goals=4, max_control=1.25, unit="rad").eval()
    network.save(tmp_path / "policy.safetensors")
    loaded = PilotNet.load(tmp_path / "policy.safetensors")
    assert (loaded.goals, loaded.max_control, loaded.unit) == (4, 1.25, "rad")
    assert not loaded.training
    for name, value in network.state_dict().items():
        assert torch.equal(value, loaded.state_dict()[name])
    with torch.no_grad():
        image, goals = torch.rand(1, 3, *IMAGE_SHAPE), torch.tensor([0, 1])
        pair = loaded(image.expand(2, -1, -1, -1), goals)
        assert pair[0] != pair[1]
        loaded.head[-1].bias.fill_(50.0)  # the control is limited
        assert loaded(image, goals[:1]).item() == pytest.approx(1.25)


def test_images_are_not_copied_and_derivatives_are_evaluated(rng):
    addresses = []

    class Spy(PilotNet):
        def forward(self, image, goal):
            addresses.append(image.data_ptr())
            return super().forward(image, goal)

    policy, image = TorchPolicy(Spy()), mi.TensorXf(images(3, rng))
    assert not any(p.requires_grad for p in policy.module.parameters())
    dr.enable_grad(image)
    control, gradient = policy.vjp(image, [0, 1, 2], mi.Float(1, -2, 0.5))
    assert control.state == gradient.array.state == dr.VarState.Evaluated
    assert not dr.grad_enabled(control, gradient)
    leaf = torch.tensor(image.numpy()).double().permute(0, 3, 1, 2).requires_grad_(True)
    expected = PilotNet().double()
    expected.load_state_dict(policy.module.state_dict())
    expected = expected(leaf, torch.tensor([0, 1, 2]))
    torch.autograd.backward(expected, torch.tensor([1, -2, 0.5]).double())
    np.testing.assert_allclose(control.numpy(), expected.detach(), atol=1e-6)
    exact = leaf.grad.permute(0, 2, 3, 1).numpy()
    assert np.linalg.norm(gradient.numpy() - exact) < 1e-5 * np.linalg.norm(exact)
    one = mi.TensorXf(image.numpy()[:1])
    np.testing.assert_allclose(policy.control(one, [0]), control[0], atol=1e-6)
    assert addresses[-1] == dr.detach(one).torch().data_ptr()


def coloured(n, rng):
    """Make frames whose mean colour tells the control: learnt in a few epochs."""
    control = rng.uniform(-1, 1, n).astype(np.float32)
    level = np.stack([0.5 + 0.4 * control, 0.5 - 0.4 * control, 0 * control + 0.5], 1)
    frames = np.broadcast_to(level[:, None, None], (n, *IMAGE_SHAPE, 3))
    return (frames * 255).astype(np.uint8), rng.integers(0, 3, n), control


SETTINGS = TrainSettings(epochs=4, batch=16, held_out=0.2, seed=3)


def test_dataset_reads_across_shards(tmp_path, rng):
    """Without an open file per shard: 192,000 frames in shards of 64 are too many."""
    batches = [coloured(n, rng) for n in (5, 1, 7, *[1] * 20)]
    shards = [write_shard(tmp_path / str(i), *batch) for i, batch in enumerate(batches)]
    opened = Path("/proc/self/fd")
    before = len(os.listdir(opened)) if opened.exists() else 0
    data = FrameDataset.from_shards(shards)
    assert not opened.exists() or len(os.listdir(opened)) <= before
    rows = np.array([12, 0, 5, 4, 6, 32])
    frames, controls = (np.concatenate([batch[i] for batch in batches]) for i in (0, 2))
    np.testing.assert_array_equal(data.read_frames(rows), frames[rows])
    np.testing.assert_array_equal(data.controls, controls)


def test_split_keeps_blocks_together():
    frames, zeros = np.zeros((1000, 1, 1, 3), np.uint8), np.zeros(1000, np.float32)
    data = FrameDataset((frames,), zeros.astype(int), zeros)
    train, held = data.split(0.25, seed=1, block=50)
    assert len(held) == 250
    np.testing.assert_array_equal(np.sort(np.concatenate([train, held])), range(1000))
    assert set(np.unique(held // 50, return_counts=True)[1]) == {50}


def test_shards_are_held_out_by_themselves(tmp_path, rng):
    frames, goals = np.zeros((3, 2, 2, 3), np.uint8), [0] * 3
    names = [tmp_path / f"{number}" for number in range(60)]
    shards = [write_shard(name, frames, goals, rng.random(3)) for name in names]
    train, held = divide_shards(shards, 0.25)
    # 60 draws: 15 are expected, with a standard deviation of 3.4
    assert 5 <= len(held) <= 25 and sorted(train + held) == sorted(shards)
    divisions = [divide_shards([shard], 0.25) for shard in shards]
    assert [item for _, part in divisions for item in part] == held
    assert divide_shards(shards, 0.0) == (shards, [])
    for fraction, sizes in ((0.0, (2, 1)), (0.999, (1, 2))):  # never on one side
        train, held = divide_shards(shards[:3], fraction, least=1)
        assert (len(train), len(held)) == sizes


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
    assert not any(torch.equal(noisy[0], other) for other in noisy[1:9])
    before = torch.rand(1, 3, 40, 40) * 0.5 + 0.2
    levels = (255 * before).to(torch.uint8).permute(0, 2, 3, 1).contiguous()
    blurred = Augmentation(0.0, 1.0, 1.0, 1.0, 0.0).apply(levels, generator)
    assert blurred.var() < 0.9 * before.var()
    assert blurred.mean().item() == pytest.approx(before.mean().item(), abs=0.01)


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


def train(data, settings=SETTINGS, **arguments):
    torch.manual_seed(7)
    network = PilotNet()
    return network, fit_policy(network, data, settings, **arguments)


def test_training_learns_and_continues_after_an_interruption(rng, tmp_path):
    batches = [(name, coloured(n, rng)) for name, n in (("a", 70), ("b", 58))]
    data = FrameDataset.from_shards(
        [write_shard(tmp_path / name, *batch) for name, batch in batches]
    )
    trained, history = train(data)
    assert len(history) == 4 and not trained.training
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
    for one, other in zip(trained.parameters(), resumed.parameters(), strict=True):
        assert torch.equal(one, other)
    frames = 255 - data.read_frames(np.arange(len(data)))
    other = dataclasses.replace(data, frames=(frames,))
    seed, start = dataclasses.replace(SETTINGS, seed=4), PilotNet()
    for call, message in (
        (lambda: train(data, seed, checkpoint=path), "settings.seed: 3 -> 4"),
        (lambda: train(other, checkpoint=path), r"\n  rows: .*\n  held_out: .*\n"),
        (lambda: fit_policy(start, data, SETTINGS, checkpoint=path), r"\n  start: "),
    ):
        with pytest.raises(InputError, match=message):
            call()
    for change, message in (
        ({"goals": data.goals + 1}, "below 3"),
        ({"controls": data.controls * 3}, "at most 1.5"),
    ):
        with pytest.raises(InputError, match=message):
            train(dataclasses.replace(data, **change))


def shard_of(**others):
    """Read a shard with other tensors, or without those that are None."""

    def read(folder):
        frames, goals, controls = coloured(4, np.random.default_rng(0))
        tensors = {"frames": frames, "goals": goals, "controls": controls} | others
        tensors = {name: value for name, value in tensors.items() if value is not None}
        files.write_safetensors(folder / "x.safetensors", tensors)
        FrameDataset.from_shards([folder / "x.safetensors"])

    return read


def shard(controls, count=4):
    frames = np.zeros((4, *IMAGE_SHAPE, 3), np.uint8)
    return lambda at: write_shard(at / "x", frames, [0] * count, controls)


def changed(change):
    def load(folder):
        PilotNet().save(folder / "policy.safetensors")
        tensors, metadata = files.read_safetensors(folder / "policy.safetensors")
        tensors = {name: value.copy() for name, value in tensors.items()}
        change(tensors, metadata)
        files.write_safetensors(folder / "policy.safetensors", tensors, metadata)
        PilotNet.load(folder / "policy.safetensors")

    return load


def asked(goal=0, cotangent=(1, 1), shape=(2, *IMAGE_SHAPE, 3)):
    def ask():
        image = mi.TensorXf(np.zeros(shape, np.float32))
        TorchPolicy(PilotNet()).vjp(image, goal, mi.Float(*cotangent))

    return ask


BIAS, SHORT = "head.0.bias", np.zeros(2, np.float32)
test_what_is_refused = refusals(
    (shard([0] * 4, count=2), "as many of each"),
    (shard([0, np.nan, 0, 0]), "row 1 is nan"),
    (lambda: FrameDataset.from_shards([]), "no shards"),
    (lambda folder: FrameDataset.from_shards([folder / "a"]), "a.*does not exist"),
    (shard_of(frames=np.zeros((4, 66, 200, 3), np.float32)), "frames F32.*U8"),
    (shard_of(goals=np.zeros(2, np.int64)), "4 frames, but 2 goals and 4 controls"),
    (shard_of(frames=None), "frames"),
    (changed(lambda t, m: t.pop(BIAS)), BIAS),
    (changed(lambda t, m: t.update({BIAS: SHORT})), r"\(1000,\)"),
    (changed(lambda t, m: t[BIAS].fill(np.nan)), "not finite"),
    (changed(lambda t, m: m.update(goals="2")), "head.0.weight"),
    (changed(lambda t, m: m.update(architecture="other")), "'other'"),
    (changed(lambda t, m: m.update(max_control="[" * 100_000)), "recursion"),
    (lambda: PilotNet(goals=0), "goals"),
    (lambda: PilotNet(max_control=float("inf")), "max_control"),
    (lambda: PilotNet(unit="deg"), "unit"),
    (asked(3), "below 3"),
    (asked(-1), "at least 0"),
    (asked([0, 1, 2]), r"\(3,\) for 2"),
    (asked(cotangent=(1, 1, 1)), r"\(3,\) for \(2,\)"),
    (asked(shape=(*IMAGE_SHAPE, 3)), "height, width, 3"),
)
