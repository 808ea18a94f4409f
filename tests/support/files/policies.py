"""Policies of a scenario file, served or as ONNX, and images for them."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import mitsuba as mi
import numpy as np
import onnxruntime as runtime
import torch
from onnx import TensorProto, helper, numpy_helper

from mi_nerfattack.policy.onnx.network import OnnxNetwork
from mi_nerfattack.scenario.policy.kinds import load_policy


def policy_of(folder, **keys):
    return load_policy({"trust_code": True} | keys, folder)


def camera(n, rng):
    """Return random images of n vehicles."""
    return mi.TensorXf(rng.random((n, 66, 200, 3), dtype=np.float32))


@contextmanager
def serving() -> Iterator[Callable[[type[BaseHTTPRequestHandler]], str]]:
    """Give a function that serves with a handler and returns the URL."""
    servers = []

    def start(handler: type[BaseHTTPRequestHandler]) -> str:
        handler.log_message = lambda *_: None
        server = ThreadingHTTPServer(("127.0.0.1", 0), handler)
        poll_s = (0.01,)  # how often it looks for its end, which a test waits for
        serve = threading.Thread(target=server.serve_forever, args=poll_s, daemon=True)
        serve.start()
        servers.append(server)
        return f"http://127.0.0.1:{server.server_port}"

    yield start
    for server in servers:
        server.shutdown()
        server.server_close()


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
    expected, actual = both(made, *arguments)
    assert len(expected) == len(actual)
    for one, other in zip(expected, actual, strict=True):
        assert one.shape == other.shape
        np.testing.assert_allclose(other, one, rtol=tolerance, atol=tolerance)
