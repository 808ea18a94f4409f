"""The server of a policy: tokens, memories, damaged requests."""

from __future__ import annotations

import io
import socket
import threading
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing, contextmanager

import mitsuba as mi
import numpy as np
import pytest
import torch
from support.faults.injected import free_port
from support.faults.refusals import refusals
from torch import nn

from mi_nerfattack.errors import InputError
from mi_nerfattack.io.network import Endpoint, read_token
from mi_nerfattack.policy.action import Action
from mi_nerfattack.policy.http import server as http_server
from mi_nerfattack.policy.http.client import PolicyClient
from mi_nerfattack.policy.http.policy import HttpPolicy
from mi_nerfattack.policy.http.server import PolicyServer
from mi_nerfattack.policy.torch_policy import TorchPolicy

pytestmark = pytest.mark.usefixtures("variant")
TOKEN = "0123456789abcdef"


class Sum(nn.Module):
    """Returns the sum of the mean images of a drive, and the goal."""

    goals = 9

    def forward(self, image, goal, hidden):
        hidden = hidden + image.mean((1, 2, 3))[:, None]
        if goal.max() == 7:
            raise ValueError("too bright\nby far")
        return hidden[:, 0] + goal, hidden


def summing() -> TorchPolicy:
    return TorchPolicy(Sum(), recurrent=[(-1, 1)])


@contextmanager
def serving(policy=None, token=TOKEN):
    server = PolicyServer(
        Endpoint("127.0.0.1", free_port()), policy or summing(), token
    )
    with closing(server):
        thread = threading.Thread(target=server.serve_forever, args=(0.01,))
        thread.start()
        try:
            yield server, f"http://127.0.0.1:{server.server_port}"
        finally:
            server.shutdown()
            thread.join()


def grey(level: float) -> np.ndarray:
    return np.full((1, 3, 4, 5), level, np.float32)


def asked(client: PolicyClient, level: float, step: int, goal: int = 0) -> float:
    return float(client.ask(grey(level), [goal], step)[0])


def test_memories_are_of_a_client_and_repetitions_change_nothing():
    with serving() as (_, url):
        one, two = PolicyClient(url, TOKEN), PolicyClient(url, TOKEN)
        assert asked(one, 0.25, 0) == 0.25
        assert asked(two, 0.5, 0, goal=3) == 3.5
        assert asked(one, 0.125, 1) == 0.375
        for _ in range(2):
            assert asked(one, 0.125, 1) == 0.375  # as a client that heard no answer
        assert asked(two, 0.125, 1) == 0.625
        assert asked(one, 0.5, 2) == 0.875
        for step, images in ((1, 1), (4, 1), (3, 2)):
            with pytest.raises(
                InputError, match=f"409 step {step} of {images} .* 2 of"
            ):
                one.ask(np.repeat(grey(0.5), images, 0), [0] * images, step)
        assert asked(one, 0.5, 0) == 0.5
        image = np.full((1, 3, 4, 5), 51, np.uint8)
        assert one.ask(image, [0], 0) == pytest.approx([0.2])  # bytes are of 255


class Both(nn.Module):
    def forward(self, image):
        level = image.mean((1, 2, 3))
        return torch.stack([level, -2 * level, 0 * level], 1)


def test_several_controls_of_each_image_are_a_list():
    """Served by one policy, and asked for by another that swaps them."""
    images = np.concatenate([grey(0.25), grey(0.5)])
    with serving(TorchPolicy(Both(), action=Action((0, 1)))) as (_, url):
        answer = PolicyClient(url, TOKEN).ask(images, [0, 0], 0)
        np.testing.assert_allclose(answer, [[0.25, -0.5], [0.5, -1.0]])
        action = Action((1, 0), (1.0, 2.0))
        policy = HttpPolicy(url, action=action, token=TOKEN)
        rows = policy.control(mi.TensorXf(images.transpose(0, 2, 3, 1)), 0)
        np.testing.assert_allclose(rows, [[-0.5, -1.0], [0.5, 1.0]])


def test_memories_and_connections_are_limited(monkeypatch):
    monkeypatch.setattr(http_server, "MAX_CLIENTS", 2)
    with serving() as (_, url):
        clients = [PolicyClient(url, TOKEN) for _ in range(3)]
        for client in clients:
            asked(client, 0.5, 0)
        with pytest.raises(InputError, match="409 step 1 .* none"):
            asked(clients[0], 0.5, 1)
        assert asked(clients[1], 0.5, 1) == 1.0
        monkeypatch.setattr(http_server, "MAX_THREADS", 0)
        with pytest.raises(InputError, match="after 1 attempts"):
            asked(PolicyClient(url, TOKEN, retries=0), 0.5, 0)


@pytest.mark.parametrize("token", ["", TOKEN[1:], TOKEN + "0", "\xff" * 16])
def test_strangers_get_status_401(token):
    large = np.zeros((1, 3, 600, 800), np.float32)  # more than a socket takes at once
    with serving() as (server, url):
        with pytest.raises(InputError, match="status 401 .* 1 att"):
            PolicyClient(url, token).ask(large, [0], 0)
        figures = server.figures()
        assert (figures["strangers"], figures["decisions"]) == (1, 0)
        assert asked(PolicyClient(url, TOKEN), 0.5, 0) == 0.5


def test_a_server_that_closes_answers_first():
    began, go = threading.Event(), threading.Event()

    class Waiting(nn.Module):
        def forward(self, image):
            began.set()
            assert go.wait(10)
            return image.mean((1, 2, 3))

    with ThreadPoolExecutor() as pool:
        with serving(TorchPolicy(Waiting())) as (server, url):
            answer = pool.submit(asked, PolicyClient(url, TOKEN), 0.5, 0)
            assert began.wait(10)
            threading.Timer(0.3, go.set).start()
        assert server.figures()["decisions"] == 1  # before `close` returned
        assert answer.result() == 0.5


def token_of(text: str, mode: int = 0o600):
    def read(folder):
        (folder / "token").write_text(text)
        (folder / "token").chmod(mode)
        return read_token(folder / "token")

    return read


def test_a_token_is_a_line_of_a_file(tmp_path):
    assert token_of(f"{TOKEN}\n")(tmp_path) == TOKEN


NO_PLACES = ("", ":80", "a:b", "a:0", "a:65536", "a:-1", "a:1:2", "a b", "a/b:1")


def listen_twice() -> None:
    with serving() as (server, _):
        PolicyServer(Endpoint("127.0.0.1", server.server_port), summing(), TOKEN)


def listen(host: str):
    return lambda: PolicyServer(Endpoint(host, free_port()), summing(), "")


test_other_computers_need_a_token = refusals(
    (listen("0.0.0.0"), "--token-file"),
    (listen_twice, "cannot listen there"),
    (lambda folder: read_token(folder / "none"), "does not exist"),
    (token_of(TOKEN, 0o644), "chmod 600"),
    (token_of(TOKEN[1:]), "15 characters; at least 16"),
    (token_of(TOKEN + " 0"), "ASCII"),
    (token_of(TOKEN + "\u00e9"), "ASCII"),
    *((lambda t=t: Endpoint.parse(t), "is no place to listen") for t in NO_PLACES),
)


def test_what_the_policy_says_of_an_image():
    broken = TorchPolicy(Sum(), recurrent=[(-1, 1)], action=Action(scale=float("inf")))
    with serving() as (_, url), serving(broken) as (_, other):
        client = PolicyClient(url, TOKEN, retries=0)
        with pytest.raises(InputError, match="status 422 .*too bright by"):
            asked(client, 0.5, 0, goal=7)
        with pytest.raises(InputError, match=r"status 422 .*\[inf\]"):
            asked(PolicyClient(other, TOKEN), 0.5, 0)
        assert asked(client, 0.5, 0) == 0.5


def npy(image: np.ndarray) -> bytes:
    body = io.BytesIO()
    np.save(body, image)
    return body.getvalue()


HEADERS = {
    "Authorization": f"Bearer {TOKEN}",
    "Content-Type": "application/x-npy",
    "X-Goal": "0",
    "X-Step": "0",
}


def request(body: bytes, **headers: object) -> bytes:
    """Return the bytes of a request; a header that is None is left out."""
    named = {key.replace("_", "-"): value for key, value in headers.items()}
    fields = {**HEADERS, "Content-Length": len(body), **named}
    lines = [f"{key}: {value}" for key, value in fields.items() if value is not None]
    return "\r\n".join(["POST / HTTP/1.1", *lines, "", ""]).encode() + body


GOOD = npy(grey(0.5))


@pytest.mark.parametrize(
    ("raw", "status"),
    [
        (request(GOOD), 200),
        (request(GOOD, Authorization=None), 401),
        (request(GOOD, Content_Length=None), 411),
        (request(GOOD, Transfer_Encoding="chunked"), 411),
        (request(GOOD, Content_Length=1 << 27), 413),
        (request(GOOD[:-1]), 400),
        (request(npy(grey(np.nan))), 400),
        (request(GOOD, X_Goal="99"), 422),
        (b"\0" * 70000 + b"\n", 414),
    ],
)
def test_requests_are_strict(raw, status):
    with serving() as (_, url):
        port = int(url.rpartition(":")[2])
        with socket.create_connection(("127.0.0.1", port), 20) as sock:
            sock.sendall(raw)
            sock.shutdown(socket.SHUT_WR)
            answer = b"".join(iter(lambda: sock.recv(1 << 16), b""))
        assert answer.split()[1] == str(status).encode()
        assert status != 200 or answer.endswith(b'{"control": [0.5]}')


def test_a_silent_connection_keeps_nobody_waiting(monkeypatch):
    monkeypatch.setattr(http_server._Handler, "timeout", 0.2)
    with serving() as (_, url):
        port = int(url.rpartition(":")[2])
        with socket.create_connection(("127.0.0.1", port), 20) as silent:
            silent.sendall(request(GOOD)[:-1])
            client = PolicyClient(url, TOKEN)
            assert asked(client, 0.5, 0) == 0.5
            assert silent.recv(1 << 16) == b""  # closed, without a control


def test_places_to_listen():
    for text, expected in (
        ("localhost", ("localhost", 8000, True)),
        ("127.0.0.5:80", ("127.0.0.5", 80, True)),
        ("[::1]:80", ("::1", 80, True)),
        ("[::]", ("::", 8000, False)),
        ("car.local:9000", ("car.local", 9000, False)),
    ):
        endpoint = Endpoint.parse(text)
        assert (endpoint.host, endpoint.port, endpoint.is_loopback) == expected
        assert Endpoint.parse(str(endpoint)) == endpoint
