"""Small ONNX models, and what onnxruntime makes of them; needs the extra onnx."""

from __future__ import annotations

import numpy as np
import onnxruntime as runtime
import torch
from onnx import TensorProto, helper, numpy_helper

from mi_nerfattack.policy.onnx.network import OnnxNetwork

FLOAT, INT64 = TensorProto.FLOAT, TensorProto.INT64


def model(nodes, inputs, outputs, constants=None, opset=17):
    """Make a model; inputs and outputs are names with (type, shape)."""
    graph = helper.make_graph(
        nodes,
        "test",
        [helper.make_tensor_value_info(n, *v) for n, v in inputs.items()],
        [helper.make_tensor_value_info(n, *v) for n, v in outputs.items()],
        [numpy_helper.from_array(v, n) for n, v in (constants or {}).items()],
    )
    return helper.make_model(
        graph, opset_imports=[helper.make_opsetid("", opset)], ir_version=8
    )


def both(made, *arguments):
    """Run a model in onnxruntime and here; return both lists of outputs."""
    options = runtime.SessionOptions()
    options.log_severity_level = 3
    session = runtime.InferenceSession(
        made.SerializeToString(), options, providers=["CPUExecutionProvider"]
    )
    names = [item.name for item in session.get_inputs()]
    expected = session.run(None, dict(zip(names, arguments, strict=True)))
    with torch.no_grad():
        actual = OnnxNetwork(made, "net.onnx")(*map(torch.from_numpy, arguments))
    return expected, [value.numpy() for value in actual]


def check(made, *arguments, tolerance=1e-5):
    """Compare all outputs with those of onnxruntime."""
    expected, actual = both(made, *arguments)
    assert len(expected) == len(actual)
    for one, other in zip(expected, actual, strict=True):
        assert one.shape == other.shape
        np.testing.assert_allclose(other, one, rtol=tolerance, atol=tolerance)
