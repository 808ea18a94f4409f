"""ONNX files as policies: derivatives, and what is refused."""

from __future__ import annotations

import re
import sys

import mitsuba as mi
import numpy as np
import pytest
import torch

from mi_nerfattack.errors import InputError, SetupError
from mi_nerfattack.policy.goals import OneHotGoal
from mi_nerfattack.policy.torch_policy import TorchPolicy
from mi_nerfattack.system.extras import install_hint

onnx = pytest.importorskip("onnx", reason="the extra onnx is not installed")
pytest.importorskip("onnxruntime", reason="the extra onnx is not installed")

from helpers.onnx_models import FLOAT, both, check, model  # noqa: E402
from onnx import helper  # noqa: E402

from mi_nerfattack.policy.onnx.network import OnnxNetwork, load_onnx  # noqa: E402


def driving_network(rng, batch="n"):
    """Convolution, pooling, batch norm, a one-hot goal, ELU, tanh."""

    def normal(*shape):
        return rng.normal(0, 0.2, shape).astype("f4")

    nodes = [
        helper.make_node("Conv", ["image", "w0", "b0"], ["a"], strides=[2, 2]),
        helper.make_node("BatchNormalization", ["a", "s", "s", "b0", "s"], ["b"]),
        helper.make_node("Elu", ["b"], ["c"]),
        helper.make_node("AveragePool", ["c"], ["d"], kernel_shape=[2, 2]),
        helper.make_node("Flatten", ["d"], ["e"]),
        helper.make_node("Concat", ["e", "goal"], ["f"], axis=1),
        helper.make_node("Gemm", ["f", "w1"], ["g"]),
        helper.make_node("Tanh", ["g"], ["control"]),
    ]
    constants = {
        "w0": normal(4, 3, 3, 3),
        "b0": normal(4),
        "s": rng.uniform(0.5, 1, 4).astype("f4"),
        "w1": normal(4 * 2 * 3 + 2, 1),
    }
    inputs = {"image": (FLOAT, [batch, 3, 8, 10]), "goal": (FLOAT, [batch, 2])}
    return model(nodes, inputs, {"control": (FLOAT, [batch, 1])}, constants)


def test_a_driving_network_and_its_derivatives(rng, variant, tmp_path):
    made = driving_network(rng)
    path = tmp_path / "net.onnx"
    onnx.save(made, path)
    network = load_onnx(path)
    assert network.batch is None and not list(network.parameters())
    image = rng.random((3, 8, 10, 3)).astype("f4")
    goal = np.float32([[1, 0], [0, 1], [0, 1]])
    check(made, image.transpose(0, 3, 1, 2).copy(), goal)
    policy = TorchPolicy(network, OneHotGoal(2))
    weight = mi.Float(1.0, -2.0, 0.5)
    control, gradient = policy.vjp(mi.TensorXf(image), [0, 1, 1], weight)
    expected, _ = both(made, image.transpose(0, 3, 1, 2).copy(), goal)
    np.testing.assert_allclose(control, expected[0][:, 0], atol=1e-6)
    policy = TorchPolicy(network.double(), OneHotGoal(2))
    direction = rng.normal(size=image.shape)

    def objective(step):
        moved = torch.from_numpy(image + step * direction).permute(0, 3, 1, 2)
        with torch.no_grad():
            result = network(moved, torch.from_numpy(goal))[0][:, 0]
        return float(result @ torch.tensor([1.0, -2.0, 0.5], dtype=torch.float64))

    numeric = (objective(1e-5) - objective(-1e-5)) / 2e-5
    products = gradient.numpy() * direction
    scale = np.abs(products).sum()
    assert np.sum(products) == pytest.approx(numeric, abs=1e-6 * scale)


def refused(made, tmp_path, match):
    path = tmp_path / "net.onnx"
    path.write_bytes(made.SerializeToString())
    with pytest.raises(InputError, match=match):
        load_onnx(path)


def test_unsupported_operators_are_named(tmp_path):
    node = helper.make_node("Hardmax", ["x"], ["z"])
    other = helper.make_node("Det", ["z"], ["y"])
    made = model([node, other], {"x": (FLOAT, [1, 3, 3])}, {"y": (FLOAT, [1])})
    refused(made, tmp_path, r"net.onnx: operators Det, Hardmax.*Conv")


def test_damaged_files_are_refused(tmp_path, rng):
    path = tmp_path / "net.onnx"
    path.write_bytes(b"no model at all")
    with pytest.raises(InputError, match=r"net.onnx: is no ONNX model"):
        load_onnx(path)
    with pytest.raises(InputError, match="absent.onnx.*does not exist"):
        load_onnx(tmp_path / "absent.onnx")
    whole = driving_network(rng).SerializeToString()
    path.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(InputError, match=r"net.onnx: is no ONNX model"):
        load_onnx(path)


def test_weights_in_other_files_are_refused(tmp_path, rng):
    path = tmp_path / "net.onnx"
    onnx.save(driving_network(rng), path, save_as_external_data=True, size_threshold=0)
    with pytest.raises(InputError, match="'w0' in another file"):
        load_onnx(path)


def test_wrong_inputs_are_named(rng):
    network = OnnxNetwork(driving_network(rng), "net.onnx")
    goal = torch.eye(2)
    with pytest.raises(InputError, match=r"\['image', 'goal'\].*are 1: set policy.go"):
        network(torch.rand(2, 3, 8, 10))
    with pytest.raises(InputError, match=r"\(any, 3, 8, 10\).*= \[10, 8\]"):
        network(torch.rand(2, 3, 9, 10), goal)
    assert OnnxNetwork(driving_network(rng, 1), "net.onnx").batch == 1


def test_without_the_extra(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "onnx", None)
    hint = re.escape(install_hint("onnx"))
    with pytest.raises(SetupError, match=f"net.onnx.*{hint}"):
        load_onnx(tmp_path / "net.onnx")


def test_data_of_constants_in_other_files_are_refused(tmp_path):
    value = onnx.numpy_helper.from_array(np.ones(2, "f4"), "k")
    value.ClearField("raw_data")
    value.data_location = onnx.TensorProto.EXTERNAL
    value.external_data.add(key="location", value="weights.bin")
    nodes = [
        helper.make_node("Constant", [], ["k"], value=value),
        helper.make_node("Mul", ["x", "k"], ["y"]),
    ]
    made = model(nodes, {"x": (FLOAT, [1, 2])}, {"y": (FLOAT, [1, 2])})
    refused(made, tmp_path, "'k' in another file")


def test_images_of_integers_are_refused(tmp_path):
    node = helper.make_node("Cast", ["image"], ["y"], to=FLOAT)
    uint8 = onnx.TensorProto.UINT8
    made = model([node], {"image": (uint8, [1, 3, 4, 4])}, {"y": (FLOAT, [1, 3, 4, 4])})
    refused(made, tmp_path, "'image', the image, is of integers.*preprocess.scale")
