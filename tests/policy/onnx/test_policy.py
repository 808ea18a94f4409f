"""ONNX files as policies: derivatives, and what is refused."""

from __future__ import annotations

import re
import sys

import mitsuba as mi
import numpy as np
import pytest
import torch

from mi_nerfattack.errors import InputError, SetupError
from mi_nerfattack.extras import install_hint
from mi_nerfattack.policy.inputs import OneHotGoal
from mi_nerfattack.policy.torch_policy import TorchPolicy
from mi_nerfattack.scenario.policy.kinds import load_policy

onnx = pytest.importorskip("onnx", reason="the extra onnx is not installed")
pytest.importorskip("onnxruntime", reason="the extra onnx is not installed")

from onnx import helper  # noqa: E402
from support.faults.refusals import refusals  # noqa: E402
from support.files.policies import FLOAT, both, check, model  # noqa: E402

from mi_nerfattack.policy.onnx.network import OnnxNetwork, load_onnx  # noqa: E402


def driving_network(rng, batch="n"):
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
    assert OnnxNetwork(driving(1), "net.onnx").batch == 1
    image = rng.random((3, 8, 10, 3)).astype("f4")
    goal = np.float32([[1, 0], [0, 1], [0, 1]])
    check(made, image.transpose(0, 3, 1, 2).copy(), goal)
    policy = TorchPolicy(network, OneHotGoal(2))
    weight = np.array([1.0, -2.0, 0.5])
    control, gradient = policy.vjp(mi.TensorXf(image), [0, 1, 1], mi.Float(weight))
    expected, _ = both(made, image.transpose(0, 3, 1, 2).copy(), goal)
    np.testing.assert_allclose(control, expected[0][:, 0], atol=1e-6)
    network, direction = network.double(), rng.normal(size=image.shape)

    def objective(step):
        moved = torch.from_numpy(image + step * direction).permute(0, 3, 1, 2)
        with torch.no_grad():
            return network(moved, torch.from_numpy(goal))[0][:, 0].numpy() @ weight

    numeric = (objective(1e-5) - objective(-1e-5)) / 2e-5
    products = gradient.numpy() * direction
    scale = np.abs(products).sum()
    assert np.sum(products) == pytest.approx(numeric, abs=1e-6 * scale)


def two_outputs(rng):
    """An angle (n, 1) and a throttle (n, 2), in this order."""
    weights = {"a": rng.normal(0, 1, (12, 1)), "t": rng.normal(0, 1, (12, 2))}
    nodes = [
        helper.make_node("Flatten", ["image"], ["f"]),
        helper.make_node("MatMul", ["f", "a"], ["angle"]),
        helper.make_node("MatMul", ["f", "t"], ["throttle"]),
    ]
    outputs = {"angle": (FLOAT, ["n", 1]), "throttle": (FLOAT, ["n", 2])}
    values = {name: value.astype("f4") for name, value in weights.items()}
    inputs = {"image": (FLOAT, ["n", 3, 2, 2])}
    return model(nodes, inputs, outputs, values), values


@pytest.mark.parametrize(
    ("keys", "weight", "column"),
    [
        ({"output_name": "angle"}, "a", 0),
        ({"output_name": "throttle", "output": 1}, "t", 1),
    ],
)
def test_an_output_is_chosen_by_name(keys, weight, column, rng, variant, tmp_path):
    made, weights = two_outputs(rng)
    onnx.save(made, tmp_path / "net.onnx")
    policy = load_policy({"file": "net.onnx", **keys}, tmp_path)
    image = rng.random((3, 2, 2, 3)).astype("f4")
    flat = image.transpose(0, 3, 1, 2).reshape(3, 12)
    control, d_image = policy.vjp(mi.TensorXf(image), 0, mi.Float(0, 1, 0))
    np.testing.assert_allclose(control, flat @ weights[weight][:, column], rtol=1e-5)
    expected = weights[weight][:, column].reshape(3, 2, 2).transpose(1, 2, 0)
    np.testing.assert_allclose(d_image.numpy()[1], expected, rtol=1e-6)
    assert not d_image.numpy()[[0, 2]].any()


def test_several_outputs_are_several_controls(rng, variant, tmp_path):
    made, weights = two_outputs(rng)
    onnx.save(made, tmp_path / "net.onnx")
    names, columns = ["throttle", "angle"], [2, 0]  # of two throttles and an angle
    keys = {"output_name": names, "output": columns, "control_scale": [-2.0, 1.0]}
    policy = load_policy({"file": "net.onnx", **keys}, tmp_path)
    image = rng.random((3, 2, 2, 3)).astype("f4")
    flat = image.transpose(0, 3, 1, 2).reshape(3, 12)
    control, _ = policy.step(mi.TensorXf(image), 0, ())
    steer, pull = np.array(control)
    np.testing.assert_allclose(steer, -2 * flat @ weights["a"][:, 0], rtol=1e-5)
    np.testing.assert_allclose(pull, flat @ weights["t"][:, 0], rtol=1e-5)
    del keys["output"], keys["control_scale"]
    with pytest.raises(InputError, match=r"controls \(3, 3\)|2 controls"):
        load_policy({"file": "net.onnx", **keys, "control_scale": [1.0] * 3}, tmp_path)


def test_without_the_extra(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "onnx", None)
    hint = re.escape(install_hint("onnx"))
    with pytest.raises(SetupError, match=f"net.onnx.*{hint}"):
        load_onnx(tmp_path / "net.onnx")


def saved(make, **options):
    def load(folder):
        if options:
            onnx.save(make(), folder / "net.onnx", **options)
        else:
            (folder / "net.onnx").write_bytes(make().SerializeToString())
        return load_onnx(folder / "net.onnx")

    return load


def chosen(**keys):
    def load(folder):
        onnx.save(two_outputs(np.random.default_rng(0))[0], folder / "net.onnx")
        return load_policy({"file": "net.onnx", **keys}, folder)

    return load


def driving(batch="n"):
    return driving_network(np.random.default_rng(0), batch)


def one_node(operator="Mul", kind=FLOAT, constant=None, **attributes):
    """Make a model of one operator, whose second input may be in another file."""
    nodes = [helper.make_node(operator, ["image", "k"][: 1 + bool(constant)], ["y"])]
    nodes[0].attribute.extend(helper.make_attribute(*a) for a in attributes.items())
    if constant:
        value = onnx.numpy_helper.from_array(np.ones(2, "f4"), constant)
        value.ClearField("raw_data")
        value.data_location = onnx.TensorProto.EXTERNAL
        value.external_data.add(key="location", value="weights.bin")
        nodes.insert(0, helper.make_node("Constant", [], [constant], value=value))
    return lambda: model(nodes, {"image": (kind, [1, 2])}, {"y": (FLOAT, [1, 2])})


def applied(shape, *goal):
    return lambda: OnnxNetwork(driving(), "net.onnx")(torch.rand(shape), *goal)


UINT8 = onnx.TensorProto.UINT8
OTHERS = {"save_as_external_data": True, "size_threshold": 0}
TWO = "'angle', 'throttle'"
test_refused = refusals(
    (saved(one_node("Hardmax")), "net.onnx: operators Hardmax.*Conv"),
    (saved(driving, **OTHERS), "'w0' in another file"),
    (saved(one_node(constant="k")), "'k' in another file"),
    (saved(one_node("Cast", UINT8, to=FLOAT)), "'image', .*preprocess.scale"),
    (lambda folder: load_onnx(folder / "absent.onnx"), "absent.onnx.*does not exist"),
    (applied((2, 3, 8, 10)), r"\['image', 'goal'\].*policy.go"),
    (applied((2, 3, 9, 10), torch.eye(2)), r"\(any, 3, 8, 10\).*= \[10, 8\]"),
    (chosen(), f"{TWO}, and policy.output_name is \\[\\]"),
    (chosen(output_name="steer"), f"{TWO}.* is \\['steer'\\]"),
    (chosen(output_name="angle", recurrent=[[-1, 2]] * 2), "must be 2 hidden states"),
)
