"""Programs of torch.export and TorchScript as policies."""

from __future__ import annotations

import warnings
import zipfile

import mitsuba as mi
import numpy as np
import pytest
import torch
from helpers.policies import camera, policy_of
from torch import nn

from mi_nerfattack.errors import InputError
from mi_nerfattack.policy.exported import load

pytestmark = pytest.mark.usefixtures("variant")


def small(batch_norm=True):
    network = nn.Sequential(
        nn.Conv2d(3, 4, 5, stride=8),
        nn.BatchNorm2d(4) if batch_norm else nn.Identity(),
        nn.ELU(),
        nn.Flatten(),
        nn.Linear(4 * 8 * 25, 1),
    )
    network[0].weight.data.normal_()
    return network.eval()


def write_exported(network, path, count=2, free=True):
    shapes = [{0: torch.export.Dim("n", min=1)}] if free else None
    image = torch.zeros(count, 3, 66, 200)
    program = torch.export.export(network, (image,), dynamic_shapes=shapes)
    torch.export.save(program, path)


def write_script(network, path):
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "`torch.jit", DeprecationWarning)
        torch.jit.save(torch.jit.script(network), path)


@pytest.mark.parametrize(
    ("name", "write"), [("net.pt2", write_exported), ("net.pt", write_script)]
)
def test_programs_have_the_module_s_derivatives(name, write, tmp_path, rng):
    network = small()
    write(network, tmp_path / name)
    policy = policy_of(tmp_path, file=name)
    assert not any(p.requires_grad for p in policy.module.parameters())
    image, weight = camera(3, rng), mi.Float(1, -2, 0.5)
    leaf = torch.from_numpy(image.numpy()).double().requires_grad_(True)
    expected = network.double()(leaf.permute(0, 3, 1, 2))[:, 0]
    torch.autograd.backward(expected, torch.tensor([1, -2, 0.5]).double())
    for _ in range(3):  # TorchScript optimises what it sees for the third time
        control, gradient = policy.vjp(image, 0, weight)
        np.testing.assert_allclose(control, expected.detach(), atol=1e-5)
        np.testing.assert_allclose(gradient, leaf.grad, atol=1e-5)


def test_programs_for_one_image_serve_several(tmp_path, rng):
    network = small()
    write_exported(network, tmp_path / "net.pt2", 1, free=False)
    policy = policy_of(tmp_path, file="net.pt2")
    image = camera(3, rng)
    with torch.no_grad():
        expected = network(torch.from_numpy(image.numpy()).permute(0, 3, 1, 2))[:, 0]
    np.testing.assert_allclose(policy.control(image, 0), expected, atol=1e-5)
    write_exported(network, tmp_path / "two.pt2", 2, free=False)
    with pytest.raises(InputError, match="two.pt2: takes exactly 2 images"):
        policy_of(tmp_path, file="two.pt2")


def test_one_image_at_a_time_keeps_hidden_states_apart(tmp_path, rng):
    (tmp_path / "net.py").write_text(
        "import torch\n"
        "class Net(torch.nn.Module):\n"
        "    def forward(self, image, goal, hidden):\n"
        "        new = image.mean((1, 2, 3)) + goal\n"
        "        hidden = hidden + new[None, :, None]\n"
        "        return hidden[0, :, 0], hidden\n"
    )
    keys = {
        "file": "net.py:Net",
        "recurrent": ((1, -1, 2),),
        "goal": "integer",
        "goals": 3,
    }
    image = camera(3, rng)
    results = []
    for extra in ({}, {"batch": 1}):
        policy = policy_of(tmp_path, **keys, **extra)
        memory = policy.initial_memory(3)
        for _ in range(2):
            control, memory = policy.step(image, 2, memory)
        results.append((control.numpy(), memory[0].numpy()))
    np.testing.assert_allclose(results[0][0], results[1][0])
    np.testing.assert_allclose(results[0][1], results[1][1])


@pytest.mark.parametrize("name", ["net.pt", "net.pt2"])
def test_other_files_are_no_programs(name, tmp_path):
    torch.save({"a": torch.zeros(2)}, tmp_path / name)
    with pytest.raises(InputError, match=f"{name}: .*program"):
        policy_of(tmp_path, file=name)
    (tmp_path / name).write_bytes(b"nothing of the kind")
    with pytest.raises(InputError, match=f"{name}: is no"):
        policy_of(tmp_path, file=name)


@pytest.mark.parametrize("name", ["net.pt", "net.pt2", "net.py:Net"])
def test_code_needs_the_word_of_trust(name, tmp_path):
    with pytest.raises(InputError, match=f"policy.file: {name}: .*trust_code = true"):
        policy_of(tmp_path, file=name, trust_code=False)


@pytest.mark.parametrize("name", ["net.pt", "net.pt2"])
def test_a_small_file_of_a_huge_program(name, tmp_path, monkeypatch):
    monkeypatch.setattr(load, "MAX_PROGRAM_BYTES", 1 << 16)
    with zipfile.ZipFile(tmp_path / name, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("weights", bytes(1 << 17))
    with pytest.raises(InputError, match=f"{name}: unpacks to 131072 bytes"):
        policy_of(tmp_path, file=name)


class Sizes(nn.Module):
    """Reshapes by computed sizes: its program is full of expressions."""

    def forward(self, image):
        rows = nn.functional.avg_pool2d(image, 3, stride=4)
        rows = rows[..., : image.shape[3] // 8]
        return rows.reshape(image.shape[0] * 3, -1).reshape(image.shape[0], -1).mean(1)


def test_programs_with_free_sizes_are_read(tmp_path, rng):
    free = torch.export.Dim.AUTO
    shapes = [{0: free, 2: free, 3: free}]
    program = torch.export.export(
        Sizes(), (torch.zeros(2, 3, 66, 200),), dynamic_shapes=shapes
    )
    torch.export.save(program, tmp_path / "net.pt2")
    policy = policy_of(tmp_path, file="net.pt2")
    image = camera(3, rng)
    expected = Sizes()(torch.from_numpy(image.numpy()).permute(0, 3, 1, 2))
    np.testing.assert_allclose(policy.control(image, 0), expected, rtol=1e-5)


def test_programs_of_another_size_are_told(tmp_path, rng):
    write_exported(small(), tmp_path / "net.pt2")
    policy = policy_of(tmp_path, file="net.pt2")
    image = mi.TensorXf(rng.random((2, 30, 40, 3), dtype=np.float32))
    message = r"net.pt2: takes .* \(any, 3, 66, 200\), .* resize_px = \[200, 66\]"
    with pytest.raises(InputError, match=message):
        policy.control(image, 0)


def test_programs_exported_in_training_mode_are_refused(tmp_path, rng):
    norm = nn.Sequential(*small(), nn.Flatten())
    drop = nn.Sequential(nn.Flatten(), nn.Dropout(0.5), nn.Linear(39600, 1))
    write_exported(norm.train(), tmp_path / "norm.pt2")
    write_exported(drop.train(), tmp_path / "drop.pt2")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        trace = torch.jit.trace(norm, torch.zeros(2, 3, 66, 200), check_trace=False)
        torch.jit.save(trace, tmp_path / "norm.pt")
    for name in ("norm.pt2", "drop.pt2", "norm.pt"):
        policy = policy_of(tmp_path, file=name)
        with pytest.raises(InputError, match=f"{name}: .*export network.eval"):
            policy.control(camera(2, rng), 0)
