"""Policies of files: programs of torch, functions, networks of Dr.Jit."""

from __future__ import annotations

import warnings
import zipfile
from functools import partial

import mitsuba as mi
import numpy as np
import pytest
import torch
from support.faults.refusals import refusals
from support.files.policies import camera, policy_of
from torch import nn

from mi_nerfattack.errors import InputError
from mi_nerfattack.io import files
from mi_nerfattack.policy import exported
from mi_nerfattack.policy.inputs import IntegerGoal
from mi_nerfattack.policy.one_image import OneImage
from mi_nerfattack.policy.torch_policy import TorchPolicy
from mi_nerfattack.scenario.policy.kinds import PolicySection, build_differentiable
from mi_nerfattack.scenario.section import read_section

pytestmark = pytest.mark.usefixtures("variant")


def small():
    head = nn.ELU(), nn.Flatten(), nn.Linear(4 * 8 * 25, 1)
    network = nn.Sequential(nn.Conv2d(3, 4, 5, stride=8), nn.BatchNorm2d(4), *head)
    network[0].weight.data.normal_()
    return network.eval()


def write_exported(network, path, count=2, free=True):
    shapes = [{0: torch.export.Dim("n", min=1)}] if free else None
    image = torch.zeros(count, 3, 66, 200)
    program = torch.export.export(network, (image,), dynamic_shapes=shapes)
    torch.export.save(program, path)


def write_script(network, path, trace=False):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # deprecated, and what a trace fixes
        if trace:
            inputs = torch.zeros(2, 3, 66, 200)
            script = torch.jit.trace(network, inputs, check_trace=False)
        else:
            script = torch.jit.script(network)
        torch.jit.save(script, path)


def write_for_one(network, path):
    write_exported(network, path, 1, free=False)


@pytest.mark.parametrize(
    ("name", "write"),
    [("net.pt2", write_exported), ("net.pt", write_script), ("one.pt2", write_for_one)],
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


def test_one_image_at_a_time_keeps_hidden_states_apart(rng):
    class Net(nn.Module):
        def forward(self, image, goal, hidden):
            hidden = hidden + (image.mean((1, 2, 3)) + goal)[None, :, None]
            return hidden[0, :, 0], hidden

    image, results = camera(3, rng), []
    for module in (Net(), OneImage(Net(), [(1, -1, 2)])):
        policy = TorchPolicy(module, IntegerGoal(3), recurrent=[(1, -1, 2)])
        memory = policy.initial_memory(3)
        for _ in range(2):
            control, memory = policy.step(image, 2, memory)
        results.append((control.numpy(), memory[0].numpy()))
    np.testing.assert_allclose(results[0][0], results[1][0])
    np.testing.assert_allclose(results[0][1], results[1][1])


def made(name, write=None, size=(66, 200), **keys):
    """Write a program and drive with it; without `write`, a file of tensors."""

    def drive(folder):
        if write:
            write(folder / name)
        else:
            torch.save({"a": torch.zeros(2)}, folder / name.partition(":")[0])
        image = mi.TensorXf(np.random.default_rng(0).random((2, *size, 3), np.float32))
        policy_of(folder, file=name, **keys).control(image, 0)

    return drive


def two(path):
    write_exported(small(), path, free=False)


def norm(path):
    network = nn.Sequential(*small(), nn.Flatten()).train()
    write = (
        write_exported if path.suffix == ".pt2" else partial(write_script, trace=True)
    )
    write(network, path)


def drop(path):
    layers = nn.Flatten(), nn.Dropout(0.5), nn.Linear(39600, 1)
    write_exported(nn.Sequential(*layers).train(), path)


def free(path):
    write_exported(small(), path)


CODE = ("net.pt", "net.pt2", "net.py:Net")
test_programs_that_are_refused = refusals(
    *((made(name), f"{name}: .*program") for name in CODE[:2]),
    *((made(n, trust_code=False), f"{n}: .*trust_code = true") for n in CODE),
    (made("free.pt2", free, (30, 40)), r"free.pt2: .*\(any, 3, 66, 200\).*\[200, 66\]"),
    (made("two.pt2", two), "two.pt2: .* 2 images"),
    *((made(n, norm), f"{n}: .*export network.eval") for n in CODE[:2]),
    (made("drop.pt2", drop), "drop.pt2: .*export network.eval"),
)


@pytest.mark.parametrize("name", CODE[:2])
def test_a_small_file_of_a_huge_program(name, tmp_path, monkeypatch):
    monkeypatch.setattr(exported, "MAX_PROGRAM_BYTES", 1 << 16)
    with zipfile.ZipFile(tmp_path / name, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("weights", bytes(1 << 17))
    with pytest.raises(InputError, match=f"{name}: unpacks to 131072 bytes"):
        policy_of(tmp_path, file=name)


def test_black_boxes_refuse_gradients_by_name(tmp_path, rng):
    (tmp_path / "mine.py").write_text(
        "def drive(image, goal, step):\n"
        "    image *= 0; goal += 0; result = goal + step; goal += 1; return result\n"
    )
    keys = {"kind": "callable", "file": "mine.py:drive", "trust_code": True}
    policy = policy_of(tmp_path, **keys, control_scale=0.5)
    image, memory = camera(2, rng), policy.initial_memory(2)
    before = image.numpy().copy()
    for step in range(3):  # it may write into what it is given
        control, memory = policy.step(image, [0, 3], memory)
        np.testing.assert_allclose(control, [0.5 * step, 0.5 * (3 + step)])
        np.testing.assert_array_equal(image.numpy(), before)
    assert not policy.differentiable
    section = read_section("policy", PolicySection, keys, tmp_path)
    for call in (
        lambda: policy.vjp(image, 0, mi.Float(1)),
        lambda: policy.step_vjp(image, 0, memory, mi.Float(1), ()),
        lambda: build_differentiable(section),
    ):
        with pytest.raises(InputError, match="mine.py:drive: is a black box"):
            call()


def test_black_boxes_see_the_frame_stack(tmp_path):
    (tmp_path / "mine.py").write_text(
        "def drive(image, goal, step):\n"
        "    assert image.shape == (1, 4, 5, 2), image.shape\n"
        "    return image[..., 0].mean((1, 2)) - image[..., 1].mean((1, 2))\n"
    )
    preprocess = {"resize_px": (5, 4), "colour": "grey", "frames": 2, "layout": "NHWC"}
    policy = policy_of(
        tmp_path, kind="callable", file="mine.py:drive", preprocess=preprocess
    )
    memory = policy.initial_memory(1)
    expected, before = [0.0, -0.25, -0.25], 0.25
    for level, control in zip((0.25, 0.5, 0.75), expected, strict=True):
        image = mi.TensorXf(np.full((1, 66, 200, 3), level, "f4"))
        planes = policy.planes(image, memory)
        assert planes.shape == (1, 2, 4, 5)
        assert planes[0, :, 1, 2] == pytest.approx([before, level], abs=1e-6)
        before = level
        actual, memory = policy.step(image, 0, memory)
        assert actual.numpy() == pytest.approx(control, abs=1e-6)
        assert memory[1].numel() == 4 * 5


@pytest.mark.parametrize(
    ("answer", "message"),
    [
        ("[1.0]", r"controls \(1,\) for 2 images"),
        ("[1.0, float('nan')]", "control nan for image 1"),
        ("'left'", "raises ValueError"),
        ("1 / 0", "raises ZeroDivisionError on arrays of the shapes"),
    ],
)
def test_wrong_answers_of_functions(answer, message, tmp_path, rng):
    (tmp_path / "mine.py").write_text(f"def drive(*_): return {answer}")
    policy = policy_of(tmp_path, kind="callable", file="mine.py:drive")
    with pytest.raises(InputError, match=f"mine.py:drive: {message}"):
        policy.control(camera(2, rng), 0)


DRJIT = """
import drjit.nn as nn
import mitsuba as mi
def make():
    net = nn.Sequential(nn.Linear(-1, 8), nn.Tanh(), nn.Linear(-1, 2))
    return net.alloc(mi.TensorXf, 3 * 4 * 5 + 3)
"""


def test_drjit_networks_are_torch_s_with_the_same_weights(tmp_path, rng):
    (tmp_path / "net.py").write_text(DRJIT)
    shapes = {"0.weights": (8, 63), "0.bias": 8, "2.weights": (2, 8), "2.bias": 2}
    shapes = {f"layers.{name}": shape for name, shape in shapes.items()}
    tensors = {k: rng.normal(0, 0.3, s).astype("f4") for k, s in shapes.items()}
    files.write_safetensors(tmp_path / "w.safetensors", tensors)
    policy = policy_of(
        tmp_path,
        kind="drjit",
        file="net.py:make",
        weights_file="w.safetensors",
        goal={"kind": "one_hot", "count": 3},
        output=1,
        preprocess={"resize_px": (5, 4)},
    )
    reference = nn.Sequential(nn.Linear(63, 8), nn.Tanh(), nn.Linear(8, 2)).double()
    names = ("0.weight", "0.bias", "2.weight", "2.bias")
    values = map(torch.from_numpy, tensors.values())
    reference.load_state_dict(dict(zip(names, values, strict=True)))
    image, weight = camera(3, rng), mi.Float(1, -2, 0.5)
    control, gradient = policy.vjp(image, [0, 1, 2], weight)
    leaf = torch.from_numpy(image.numpy()).double().requires_grad_(True)
    planes = policy.preprocess.transform(leaf).flatten(1)
    expected = reference(torch.cat([planes, torch.eye(3).double()], 1))[:, 1]
    torch.autograd.backward(expected, torch.tensor([1, -2, 0.5]).double())
    np.testing.assert_allclose(control, expected.detach(), atol=1e-5)
    np.testing.assert_allclose(gradient, leaf.grad, atol=1e-6)


def test_drjit_networks_that_do_not_fit(tmp_path, rng):
    (tmp_path / "net.py").write_text(DRJIT)
    files.write_safetensors(tmp_path / "w.safetensors", {"a": np.zeros(2, "f4")})
    keys = {"kind": "drjit", "file": "net.py:make", "preprocess": {"resize_px": (5, 4)}}
    with pytest.raises(InputError, match=r"\['a'\]; the network has \['layers.0.b"):
        policy_of(tmp_path, weights_file="w.safetensors", **keys)
    with pytest.raises(InputError, match="net.py:make: fails"):
        policy_of(tmp_path, **keys).control(camera(1, rng), 0)
