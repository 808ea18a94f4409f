"""Policies without derivatives, and Dr.Jit networks, from a scenario."""

from __future__ import annotations

import socket
import threading
import time
from http.server import BaseHTTPRequestHandler, HTTPServer

import mitsuba as mi
import numpy as np
import pytest
import torch
from helpers.policies import camera, policy_of, serving
from torch import nn

from mi_nerfattack.errors import InputError
from mi_nerfattack.io import files
from mi_nerfattack.policy.http_policy import HttpPolicy
from mi_nerfattack.scenario.policy import (
    PolicySection,
    build_differentiable,
)
from mi_nerfattack.scenario.section import read_section

pytestmark = pytest.mark.usefixtures("variant")


@pytest.fixture
def served(monkeypatch):
    monkeypatch.setenv("no_proxy", "*")
    with serving() as start:
        yield start


# --- black boxes ----------------------------------------------------------------------


def test_black_boxes_refuse_gradients_by_name(tmp_path, rng):
    (tmp_path / "mine.py").write_text(
        "def drive(image, goal, step): return goal + step"
    )
    found = {"kind": "callable", "file": "mine.py:drive", "trust_code": True}
    policy = policy_of(tmp_path, **found, control_scale=0.5)
    image, memory = camera(2, rng), policy.initial_memory(2)
    for step in range(3):
        control, memory = policy.step(image, [0, 3], memory)
        np.testing.assert_allclose(control, [0.5 * step, 0.5 * (3 + step)])
    assert not policy.differentiable
    calls = [
        lambda: policy.vjp(image, 0, mi.Float(1)),
        lambda: policy.step_vjp(image, 0, memory, mi.Float(1), ()),
        lambda: build_differentiable(
            read_section("policy", PolicySection, found, tmp_path)
        ),
    ]
    for call in calls:
        with pytest.raises(InputError, match="mine.py:drive: is a black box.*module, "):
            call()


def test_black_boxes_see_the_frame_stack(tmp_path, rng):
    (tmp_path / "mine.py").write_text(
        "def drive(image, goal, step):\n"
        "    assert image.shape == (1, 4, 5, 2), image.shape\n"
        "    return image[..., 0].mean((1, 2)) - image[..., 1].mean((1, 2))\n"
    )
    preprocess = {
        "resize_px": (5, 4),
        "colour": "grey",
        "frames": 2,
        "layout": "NHWC",
    }
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
        seen, memory = policy.step(image, 0, memory)
        assert seen.numpy() == pytest.approx(control, abs=1e-6)
        assert memory[1].numel() == 4 * 5


@pytest.mark.parametrize(
    ("answer", "message"),
    [
        ("[1.0]", r"controls \(1,\) for 2 images"),
        ("[1.0, float('nan')]", "control nan for image 1"),
        ("'left'", "raises ValueError"),
        ("1 / 0", "raises ZeroDivisionError on an image of shape"),
    ],
)
def test_wrong_answers_of_functions(answer, message, tmp_path, rng):
    (tmp_path / "mine.py").write_text(f"def drive(*_): return {answer}")
    policy = policy_of(tmp_path, kind="callable", file="mine.py:drive")
    with pytest.raises(InputError, match=f"mine.py:drive: {message}"):
        policy.control(camera(2, rng), 0)


def handler(*answers):
    """Make a handler that answers each request with the next status and body."""
    queue, seen = list(answers), []

    class Handler(BaseHTTPRequestHandler):
        def do_POST(self):
            body = self.rfile.read(int(self.headers["Content-Length"]))
            seen.append((self.headers, body))
            status, text, wait = queue.pop(0)
            threading.Event().wait(wait)
            try:
                self.send_response(status)
                self.end_headers()
                self.wfile.write(text)
            except OSError:
                pass  # the client has gone

    return Handler, seen


GOOD = (200, b'{"control": [0.5, -0.25]}', 0)


def test_http_protocol_and_retries(served, rng, monkeypatch):
    monkeypatch.setattr("mi_nerfattack.policy.http_policy.PAUSE_S", 0.01)
    made, seen = handler((503, b"", 0), GOOD, (502, b"", 0), GOOD)
    policy = HttpPolicy(served(made), retries=1, control_scale=2.0)
    image, memory = camera(2, rng), policy.initial_memory(2)
    for step in range(2):
        control, memory = policy.step(image, [0, 2], memory)
        np.testing.assert_array_equal(control, [1.0, -0.5])
        headers, body = seen[-1]
        assert (headers["X-Goal"], headers["X-Step"]) == ("0,2", str(step))
    assert body == seen[-2][1] and body.startswith(b"\x93NUMPY") and len(seen) == 4
    sent = np.frombuffer(body[-2 * 66 * 200 * 3 * 4 :], "f4").reshape(2, 3, 66, 200)
    np.testing.assert_array_equal(sent, image.numpy().transpose(0, 3, 1, 2))


@pytest.mark.parametrize(
    ("answers", "message"),
    [
        ([(404, b"", 0)], "status 404 Not Found, after 1 attempts"),
        ([(302, b"", 0)], "status 302 Found, after 1 attempts"),
        ([(500, b"", 0)] * 2, "status 500 Internal Server Error, after 2 attempts"),
        ([(200, b"", 9)] * 2, "no answer in 0.5 s, after 2 attempts"),
        ([(200, b"hello", 0)], "answers 'hello'.*must be JSON"),
        ([(200, b'{"steer": [1]}', 0)], "answers.*KeyError"),
        ([(200, b'{"control": "left"}', 0)], "answers.*must be JSON"),
        ([(200, b'{"control": [1]}', 0)], r"controls \(1,\) for 2 images"),
        ([(200, b'{"control": [1, NaN]}', 0)], "answers.*NaN is not a JSON number"),
    ],
)
def test_http_errors(answers, message, served, rng, monkeypatch):
    monkeypatch.setattr("mi_nerfattack.policy.http_policy.PAUSE_S", 0.01)
    url = served(handler(*answers)[0])
    slow = any(wait for _, _, wait in answers)
    policy = HttpPolicy(url, timeout_s=0.5 if slow else 20.0, retries=1)
    with pytest.raises(InputError, match=f"{url}: {message}"):
        policy.control(camera(2, rng), 0)


def raw_handler(*parts, pause=0.0):
    """Make a handler that sends bytes as they are, the last of them again and again."""

    class Raw(BaseHTTPRequestHandler):
        def do_POST(self):
            self.rfile.read(int(self.headers["Content-Length"]))
            try:
                for part in [*parts[:-1], *parts[-1:] * (100 if pause else 1)]:
                    self.wfile.write(part)
                    threading.Event().wait(pause)
            except OSError:
                pass  # the client has gone

    return Raw


HEAD = b"HTTP/1.1 200 OK\r\n"


@pytest.mark.parametrize(
    "parts",
    [
        [HEAD + b"X-Long: ", b"a"],
        [b"HTTP/1.1 100 Continue\r\n\r\n"],
        [HEAD + b"Transfer-Encoding: chunked\r\n\r\n5;", b"a=b;"],
        [HEAD + b"\r\n", b" "],
    ],
    ids=["headers", "continue", "extensions", "body"],
)
def test_the_timeout_is_of_everything_that_comes(parts, served, rng):
    url = served(raw_handler(*parts, pause=0.03))  # each in time
    before = time.monotonic()
    with pytest.raises(InputError, match="no answer in 0.2 s, after 1 attempts"):
        HttpPolicy(url, 0.2, retries=0).control(camera(1, rng), 0)
    assert time.monotonic() - before < 1.5


def test_the_timeout_is_of_a_connection_to_all_addresses(rng, monkeypatch):
    """And of sending, to a server that takes nothing."""
    calls = []

    def connect(address, timeout):
        calls.append(address)
        time.sleep(timeout)
        raise TimeoutError

    monkeypatch.setattr(socket, "create_connection", connect)
    found = [(2, 1, 6, "", (f"192.0.2.{i}", 80)) for i in range(5)]
    monkeypatch.setattr(socket, "getaddrinfo", lambda *_, **__: found)
    before = time.monotonic()
    with pytest.raises(InputError, match="no answer in 0.1 s, after 1 attempts"):
        HttpPolicy("http://a", 0.1, retries=0).control(camera(1, rng), 0)
    assert time.monotonic() - before < 0.4 and calls == [("192.0.2.0", 80)]


@pytest.mark.parametrize(
    ("body", "message"),
    [
        (b'{"control": ["0.5"]}', "holds what is no number"),
        (b'{"control": [true]}', "holds what is no number"),
        (b'{"control": [[0.5, null]]}', "holds what is no number"),
        (b'{"control": {"0": 0.5}}', "holds what is no number"),
        (b'{"control": [[1], [1, 2]]}', ""),
        (b'{"control": [1%s]}' % (b"0" * 400), ""),
        (b'{"control": [0], "control": [1]}', "key 'control' twice"),
        (b"\xff", ""),
        (b"[" * 5000, ""),
    ],
)
def test_answers_are_strict(body, message, served, rng):
    url = served(handler((200, body, 0))[0])
    with pytest.raises(InputError, match=f"answers .*{message}.*must be JSON"):
        HttpPolicy(url).control(camera(1, rng), 0)


@pytest.mark.parametrize(
    "parts",
    [
        b'Content-Length: 99\r\n\r\n{"control": [0.5]}',
        b'Transfer-Encoding: chunked\r\n\r\n11\r\n{"control": [0.5]}\r\n',
        b'Transfer-Encoding: chunked\r\n\r\n-1\r\n{"control": [0.5]}',
    ],
)
def test_a_truncated_answer_is_none(parts, served, rng):
    url = served(raw_handler(HEAD + parts))
    with pytest.raises(InputError, match="IncompleteRead.*after 1 attempts"):
        HttpPolicy(url, retries=0).control(camera(1, rng), 0)


@pytest.mark.parametrize(
    ("head", "message"),
    [
        (b"HTTP/1.1 500 \x1b[2J\x9bm%s\r\n\r\n" % (b"a" * 999), r"\\x1b\[2J\\x9bm"),
        (b"\x1b[2J\r\n\r\n", r"\\x1b\[2J"),
        (b"HTTP/1.1 302 Found\r\nLocation: http://[::1\r\n\r\n", "status 302 Found"),
    ],
)
def test_what_a_server_calls_its_errors(head, message, served, rng):
    with pytest.raises(InputError, match=message) as caught:
        HttpPolicy(served(raw_handler(head)), retries=0).control(camera(1, rng), 0)
    assert str(caught.value).isprintable() and len(str(caught.value)) < 400


def test_local_servers_are_asked_without_proxies(served, rng, monkeypatch):
    url = served(handler(GOOD)[0])
    monkeypatch.delenv("no_proxy")
    monkeypatch.setenv("http_proxy", "http://127.0.0.1:9")
    np.testing.assert_array_equal(
        HttpPolicy(url).control(camera(2, rng), 0), [0.5, -0.25]
    )


def test_functions_may_write_into_their_image(tmp_path, rng):
    (tmp_path / "mine.py").write_text(
        "def drive(image, goal, step):\n"
        "    image *= 0; goal += 1\n"
        "    return image.mean((1, 2, 3)) + goal\n"
    )
    policy = policy_of(tmp_path, kind="callable", file="mine.py:drive")
    for frames in (1, 2):
        policy.preprocess.frames = frames
        image = camera(2, rng)
        before, memory = image.numpy().copy(), policy.initial_memory(2)
        for _ in range(2):
            control, memory = policy.step(image, [0, 3], memory)
            np.testing.assert_array_equal(control, [1, 4])
        np.testing.assert_array_equal(image.numpy(), before)
        assert frames == 1 or memory[1].any()


def test_no_server(served, rng, monkeypatch):
    monkeypatch.setattr("mi_nerfattack.policy.http_policy.PAUSE_S", 0.01)
    with HTTPServer(("127.0.0.1", 0), BaseHTTPRequestHandler) as server:
        url = f"http://127.0.0.1:{server.server_port}"
    with pytest.raises(InputError, match="refused.*after 3 attempts; start the policy"):
        HttpPolicy(url).control(camera(1, rng), 0)


# --- Dr.Jit ---------------------------------------------------------------------------

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
        goal="one_hot",
        goals=3,
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
    with pytest.raises(InputError, match="net.py:make: fails on an input of shape"):
        policy_of(tmp_path, **keys).control(camera(1, rng), 0)
