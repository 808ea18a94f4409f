"""The policy of a scenario: the guide's examples, every kind, refusals."""

from __future__ import annotations

import re
import sys
import threading
import warnings
from http.server import BaseHTTPRequestHandler, HTTPServer, ThreadingHTTPServer
from pathlib import Path
from types import SimpleNamespace

import mitsuba as mi
import numpy as np
import pytest
import torch
from safetensors.torch import save_file
from torch import nn

from mi_nerfattack import files
from mi_nerfattack.errors import InputError
from mi_nerfattack.policy.adapter import TorchPolicy
from mi_nerfattack.policy.http_policy import HttpPolicy
from mi_nerfattack.policy.load import load_differentiable, load_policy, policy_kind
from mi_nerfattack.policy.pilotnet import PilotNet
from mi_nerfattack.scenario import load_scenario, portable_text
from mi_nerfattack.sections import PolicySection

pytestmark = pytest.mark.usefixtures("variant")

GUIDE = Path(__file__).parents[1] / "docs" / "policy.md"
SCENARIO = """\
name = "test"
[scene]
field = "bundled:intersection/field.safetensors"
deployment = "bundled:intersection/scene.xml"
routes = "bundled:intersection/routes.json"
route = "right"
[[objects]]
id = "hydrant"
field = "bundled:hydrant/field.safetensors"
position_m = [6.0, -6.2, 0.12]
"""


def section(**keys):
    return PolicySection.model_validate(keys)


def camera(n, rng):
    return mi.TensorXf(rng.random((n, 66, 200, 3), dtype=np.float32))


@pytest.fixture(autouse=True)
def no_proxy(monkeypatch):
    monkeypatch.setenv("no_proxy", "*")


# --- the guide ------------------------------------------------------------------------


def chapters():
    """Yield the guide's examples: title, Python blocks, scenario text."""
    text = GUIDE.read_text("utf-8")
    for chapter in re.split(r"(?m)^##+ ", text)[1:]:
        blocks = re.findall(r"(?s)```(\w+)\n(.*?)```", chapter)
        toml = [body for kind, body in blocks if kind == "toml"]
        if toml:
            python = [body for kind, body in blocks if kind == "python"]
            yield pytest.param(python, toml[0], id=chapter.partition("\n")[0])


def run_blocks(blocks, folder, monkeypatch):
    """Save the blocks that begin with a file name, and run the others in order."""
    monkeypatch.chdir(folder)
    monkeypatch.syspath_prepend(str(folder))
    for block in blocks:
        name = re.match(r"# (\w+\.py)\n", block)
        if name:
            (folder / name[1]).write_text(block)
            continue
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", "`torch.jit", DeprecationWarning)
            exec(compile(block, "guide", "exec"), {"__name__": "guide"})


@pytest.fixture
def served():
    """Serve with a handler on a free port until the test ends."""
    servers = []

    def start(handler):
        handler.log_message = lambda *_: None
        server = ThreadingHTTPServer(("127.0.0.1", 0), handler)
        threading.Thread(target=server.serve_forever, daemon=True).start()
        servers.append(server)
        return f"http://127.0.0.1:{server.server_port}"

    yield start
    for server in servers:
        server.shutdown()
        server.server_close()


@pytest.mark.parametrize(("blocks", "toml"), list(chapters()))
def test_examples_of_the_guide(blocks, toml, tmp_path, monkeypatch, served, rng):
    if any("import onnx" in block for block in blocks):
        pytest.importorskip("onnx", reason="the extra onnx is not installed")
    before = set(sys.modules)
    run_blocks(blocks, tmp_path, monkeypatch)
    if (tmp_path / "server.py").exists():
        scope = {"__name__": "server"}
        exec((tmp_path / "server.py").read_text(), scope)
        toml = toml.replace("http://127.0.0.1:8000", served(scope["Handler"]))
    path = tmp_path / "scenario.toml"
    path.write_text(SCENARIO + toml)
    scenario, _ = load_scenario(path)
    assert scenario.digest(tmp_path) == load_scenario(path)[0].digest(tmp_path)
    policy = load_policy(scenario.policy, tmp_path)
    image, memory = camera(2, rng), policy.initial_memory(2)
    for _ in range(2):
        control, after = policy.step(image, 1, memory)
        assert control.numpy().shape == (2,) and np.isfinite(control.numpy()).all()
        if policy.differentiable:
            d_image, d_memory = policy.step_vjp(image, 1, memory, mi.Float(1, 1), ())
            assert d_image.shape == image.shape and np.any(d_image.numpy())
            assert len(d_memory) == len(memory)
        memory = after
    for name in set(sys.modules) - before:
        if getattr(sys.modules[name], "__file__", None) and str(tmp_path) in str(
            sys.modules[name].__file__
        ):
            del sys.modules[name]


def test_the_guide_lists_every_key():
    text = GUIDE.read_text("utf-8")
    for model in (PolicySection, type(section(file="a.pt").preprocess)):
        for key in model.model_fields:
            assert re.search(rf"`{key}`|{key} = |policy\.{key}\]", text), key


# --- exported programs ----------------------------------------------------------------


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
    policy = load_policy(section(file=name), tmp_path)
    assert not any(p.requires_grad for p in policy.module.parameters())
    image, weight = camera(3, rng), mi.Float(1, -2, 0.5)
    leaf = torch.from_numpy(image.numpy()).double().requires_grad_(True)
    expected = network.double()(leaf.permute(0, 3, 1, 2))[:, 0]
    torch.autograd.backward(expected, torch.tensor([1, -2, 0.5]).double())
    for _ in range(3):  # TorchScript optimises what it sees for the third time
        control, gradient = policy.vjp(image, 0, weight)
        np.testing.assert_allclose(control, expected.detach(), atol=1e-5)
        np.testing.assert_allclose(gradient, leaf.grad, atol=1e-5)
    tangent = rng.normal(size=(3, 66, 200, 3)).astype("f4")
    t_control, _ = policy.step_jvp(image, 0, (), mi.TensorXf(tangent), ())
    products = gradient.numpy().astype(float) * tangent
    assert np.dot(t_control, weight) == pytest.approx(
        products.sum(), abs=1e-5 * np.abs(products).sum()
    )


def test_programs_for_one_image_serve_several(tmp_path, rng):
    network = small()
    write_exported(network, tmp_path / "net.pt2", 1, free=False)
    policy = load_policy(section(file="net.pt2"), tmp_path)
    image = camera(3, rng)
    with torch.no_grad():
        expected = network(torch.from_numpy(image.numpy()).permute(0, 3, 1, 2))[:, 0]
    np.testing.assert_allclose(policy.control(image, 0), expected, atol=1e-5)
    write_exported(network, tmp_path / "two.pt2", 2, free=False)
    with pytest.raises(InputError, match="two.pt2: takes exactly 2 images"):
        load_policy(section(file="two.pt2"), tmp_path)


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
        policy = load_policy(section(**keys, **extra), tmp_path)
        memory = policy.initial_memory(3)
        for _ in range(2):
            control, memory = policy.step(image, 2, memory)
        results.append((control.numpy(), memory[0].numpy()))
    np.testing.assert_allclose(results[0][0], results[1][0])
    np.testing.assert_allclose(results[0][1], results[1][1])


# --- refusals -------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ({"file": "net.bin"}, "suffix tells no kind"),
        ({"file": "net.onnx", "kind": "http"}, "a url belongs to"),
        ({"url": "http://x", "kind": "onnx"}, "a url belongs to"),
        ({"url": "ftp://x"}, "policy.url: 'ftp://x'; must be http"),
        ({"file": "net.pt", "weights_file": "w.pt"}, "weights_file.*torchscript"),
        ({"file": "net.pt", "retries": 1}, "policy.retries: 1"),
        ({"url": "http://x", "batch": 1}, "policy.batch: 1"),
        ({"url": "http://x", "goal": "integer", "goals": 3}, "policy.goal: integer"),
        ({"file": "net.py"}, "must have the form FILE.py:NAME"),
        ({"file": "absent.py:Net"}, "absent.py.*does not exist"),
        ({"file": "absent.pt"}, "absent.pt.*does not exist"),
        ({"file": "absent.pt2"}, "absent.pt2.*does not exist"),
        ({"file": "absent.safetensors"}, "absent.safetensors.*does not exist"),
    ],
)
def test_keys_and_files_that_do_not_fit(keys, message, tmp_path):
    with pytest.raises(InputError, match=message):
        load_policy(section(**keys), tmp_path)


@pytest.mark.parametrize(
    ("lines", "key"),
    [
        ('file = "a.pt"\nurl = "http://x"', "policy.file: give either"),
        ('kind = "onnx"', "policy.file: give either"),
        ('file = "a.pt"\ngoal = "one_hot"', "policy.goals: is missing"),
        ('file = "a.pt"\ngoals = 2', "policy.goals: needs goal"),
        ('file = "a.pt"\nkind = "keras"', "policy.kind"),
        ('file = "a.pt"\nbatch = 2', "policy.batch"),
        (
            'file = "a.pt"\n[policy.preprocess]\nresize = [1, 2]',
            "policy.preprocess.resize: unknown key; allowed: crop_px",
        ),
        (
            'file = "a.pt"\n[policy.preprocess]\ncrop_px = [1, 2, 3, 4]\n'
            "crop_fraction = [0.1, 0.0, 0.0, 0.0]",
            "policy.preprocess.crop_fraction: stands beside crop_px",
        ),
    ],
)
def test_the_scenario_file_is_checked(lines, key, tmp_path):
    path = tmp_path / "scenario.toml"
    path.write_text(f"{SCENARIO}[policy]\n{lines}\n")
    with pytest.raises(InputError, match=re.escape(key)) as caught:
        load_scenario(path)
    assert re.search(r"scenario.toml:\d+: policy", str(caught.value))


@pytest.mark.parametrize(
    ("code", "message"),
    [
        ("def Net(): return 3", "gives a int; a torch.nn.Module is needed"),
        ("def Net(size): return 3", "calling it without arguments raises TypeError"),
        ("import nothing_like_this", "net.py.*nothing_like_this"),
        ("Other = 3", "net.py.*'Net'"),
        ("Net = (", "net.py:1"),
    ],
)
def test_python_files_that_do_not_fit(code, message, tmp_path):
    (tmp_path / "net.py").write_text(code)
    with pytest.raises(InputError, match=message):
        load_policy(section(file="net.py:Net"), tmp_path)


MODULE = (
    "from torch import nn\n"
    "def make(): return nn.Sequential(nn.Flatten(), nn.Linear(39600, 1))\n"
)


def test_weights_of_a_module(tmp_path, rng):
    (tmp_path / "net.py").write_text(MODULE)
    network = nn.Sequential(nn.Flatten(), nn.Linear(39600, 1))
    torch.save(network.state_dict(), tmp_path / "w.pt")
    save_file(network.state_dict(), tmp_path / "w.safetensors")
    image = camera(1, rng)
    with torch.no_grad():
        expected = network(torch.from_numpy(image.numpy()).permute(0, 3, 1, 2))[0]
    for name in ("w.pt", "w.safetensors"):
        keys = {"file": "net.py:make", "weights_file": name}
        policy = load_policy(section(**keys), tmp_path)
        np.testing.assert_allclose(policy.control(image, 0), expected, atol=1e-6)


@pytest.mark.parametrize(
    ("state", "message"),
    [
        (SimpleNamespace(a=1), "is no state dict of plain tensors"),
        ([1, 2], "holds a list"),
        ({"1.weight": 3}, "'1.weight' is no tensor"),
        ({"1.weight": torch.full((1, 39600), torch.nan)}, "no tensor of finite"),
        ({"1.weight": torch.zeros(1, 39600)}, "Missing key.*1.bias"),
        (
            {"1.weight": torch.zeros(1, 7), "1.bias": torch.zeros(1)},
            "size mismatch",
        ),
    ],
)
def test_weights_that_do_not_fit(state, message, tmp_path):
    (tmp_path / "net.py").write_text(MODULE)
    torch.save(state, tmp_path / "w.pt")
    keys = {"file": "net.py:make", "weights_file": "w.pt"}
    with pytest.raises(InputError, match=f"(?s)w.pt: .*{message}"):
        load_policy(section(**keys), tmp_path)


@pytest.mark.parametrize("name", ["net.pt", "net.pt2"])
def test_other_files_are_no_programs(name, tmp_path):
    torch.save({"a": torch.zeros(2)}, tmp_path / name)
    with pytest.raises(InputError, match=f"{name}: (is|holds) no"):
        load_policy(section(file=name), tmp_path)
    (tmp_path / name).write_bytes(b"nothing of the kind")
    with pytest.raises(InputError, match=f"{name}: is no"):
        load_policy(section(file=name), tmp_path)


class Marker:
    """Writes a file when it is unpickled."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return Path.touch, (self.path,)


def test_programs_with_pickled_objects_are_refused_unread(tmp_path):
    import io
    import zipfile

    write_exported(small(), tmp_path / "good.pt2")
    buffer, mark = io.BytesIO(), tmp_path / "mark"
    torch.save((Marker(mark), {}), buffer)
    with (
        zipfile.ZipFile(tmp_path / "good.pt2") as good,
        zipfile.ZipFile(tmp_path / "bad.pt2", "w") as bad,
    ):
        for name in good.namelist():
            sample = "sample_inputs" in name
            bad.writestr(name, buffer.getvalue() if sample else good.read(name))
    with pytest.raises(InputError, match="bad.pt2: .*sample_inputs.*pickled objects"):
        load_policy(section(file="bad.pt2"), tmp_path)
    assert not mark.exists()


def test_input_sizes_that_do_not_fit(tmp_path, rng):
    (tmp_path / "net.py").write_text(MODULE)
    policy = load_policy(section(file="net.py:make"), tmp_path)
    image = mi.TensorXf(rng.random((2, 10, 20, 3), dtype=np.float32))
    message = r"net.py:make: fails on an input of shape \(2, 3, 10, 20\).*preprocess"
    with pytest.raises(InputError, match=f"(?s){message}"):
        policy.step(image, 0, ())


# --- the default and the digest -------------------------------------------------------


def test_pilotnet_stays_as_it_was(tmp_path, rng):
    network = PilotNet()
    network.save(tmp_path / "policy.safetensors")
    assert policy_kind(section(file="policy.safetensors")) == "pilotnet"
    policy = load_policy(section(file="policy.safetensors"), tmp_path)
    image, weight = camera(2, rng), mi.Float(1, -1)
    one, other = (
        policy.vjp(image, 1, weight),
        TorchPolicy(network).vjp(image, 1, weight),
    )
    for a, b in zip(one, other, strict=True):
        np.testing.assert_array_equal(a, b)


def test_digest_and_portable_text_know_the_files(tmp_path):
    (tmp_path / "net.py").write_text(MODULE)
    (tmp_path / "w.pt").write_bytes(b"1")
    text = SCENARIO + '[policy]\nfile = "net.py:make"\nweights_file = "w.pt"\n'
    path = tmp_path / "scenario.toml"
    path.write_text(text)

    def digest():
        return load_scenario(path)[0].digest(tmp_path)

    first = digest()
    portable = portable_text(text, tmp_path)
    assert f'"{tmp_path}/net.py:make"' in portable and f"{tmp_path}/w.pt" in portable
    path.write_text(portable)
    assert digest() == first
    (tmp_path / "w.pt").write_bytes(b"2")
    second = digest()
    (tmp_path / "net.py").write_text(MODULE + "\n")
    assert len({first, second, digest()}) == 3
    path.write_text(portable.replace("net.py:make", "net.py:other"))
    assert digest() not in (first, second)


# --- black boxes ----------------------------------------------------------------------


def test_black_boxes_refuse_gradients_by_name(tmp_path, rng):
    (tmp_path / "mine.py").write_text(
        "def drive(image, goal, step): return goal + step"
    )
    found = section(kind="callable", file="mine.py:drive", control_scale=0.5)
    policy = load_policy(found, tmp_path)
    image, memory = camera(2, rng), policy.initial_memory(2)
    for step in range(3):
        control, memory = policy.step(image, [0, 3], memory)
        np.testing.assert_allclose(control, [0.5 * step, 0.5 * (3 + step)])
    assert not policy.differentiable
    calls = [
        lambda: policy.vjp(image, 0, mi.Float(1)),
        lambda: policy.step_vjp(image, 0, memory, mi.Float(1), ()),
        lambda: policy.step_jvp(image, 0, memory, image, ()),
        lambda: load_differentiable(found, tmp_path),
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
    found = section(kind="callable", file="mine.py:drive", preprocess=preprocess)
    policy = load_policy(found, tmp_path)
    memory = policy.initial_memory(1)
    expected = [0.0, -0.25, -0.25]
    for level, control in zip((0.25, 0.5, 0.75), expected, strict=True):
        image = mi.TensorXf(np.full((1, 66, 200, 3), level, "f4"))
        seen, memory = policy.step(image, 0, memory)
        assert seen.numpy() == pytest.approx(control, abs=1e-6)
        assert policy.memory_bytes(memory) == 4 * 5 * 4


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
    policy = load_policy(section(kind="callable", file="mine.py:drive"), tmp_path)
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
    made, seen = handler((503, b"", 0), GOOD, (200, b"", 9), GOOD)
    policy = HttpPolicy(served(made), timeout_s=1.0, retries=1, control_scale=2.0)
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
        ([(500, b"", 0)] * 2, "status 500 Internal Server Error, after 2 attempts"),
        ([(200, b"", 9)] * 2, "no answer in 0.5 s, after 2 attempts"),
        ([(200, b"hello", 0)], "answers 'hello'.*must be JSON"),
        ([(200, b'{"steer": [1]}', 0)], "answers.*KeyError"),
        ([(200, b'{"control": "left"}', 0)], "answers.*must be JSON"),
        ([(200, b'{"control": [1]}', 0)], r"controls \(1,\) for 2 images"),
        ([(200, b'{"control": [1, NaN]}', 0)], "control nan for image 1"),
    ],
)
def test_http_errors(answers, message, served, rng, monkeypatch):
    monkeypatch.setattr("mi_nerfattack.policy.http_policy.PAUSE_S", 0.01)
    url = served(handler(*answers)[0])
    policy = HttpPolicy(url, timeout_s=0.5, retries=1)
    with pytest.raises(InputError, match=f"{url}: {message}"):
        policy.control(camera(2, rng), 0)


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
    found = section(
        kind="drjit",
        file="net.py:make",
        weights_file="w.safetensors",
        goal="one_hot",
        goals=3,
        output=1,
        preprocess={"resize_px": (5, 4)},
    )
    policy = load_policy(found, tmp_path)
    reference = nn.Sequential(nn.Linear(63, 8), nn.Tanh(), nn.Linear(8, 2)).double()
    names = ("0.weight", "0.bias", "2.weight", "2.bias")
    values = map(torch.from_numpy, tensors.values())
    reference.load_state_dict(dict(zip(names, values, strict=True)))
    image, weight = camera(3, rng), mi.Float(1, -2, 0.5)
    control, gradient = policy.vjp(image, [0, 1, 2], weight)
    leaf = torch.from_numpy(image.numpy()).double().requires_grad_(True)
    planes = policy.preprocess.stage(leaf).flatten(1)
    expected = reference(torch.cat([planes, torch.eye(3).double()], 1))[:, 1]
    torch.autograd.backward(expected, torch.tensor([1, -2, 0.5]).double())
    np.testing.assert_allclose(control, expected.detach(), atol=1e-5)
    np.testing.assert_allclose(gradient, leaf.grad, atol=1e-6)
    tangent = rng.normal(size=(3, 66, 200, 3)).astype("f4")
    t_control, _ = policy.step_jvp(image, [0, 1, 2], (), mi.TensorXf(tangent), ())
    products = leaf.grad.numpy() * tangent
    assert np.dot(t_control, weight) == pytest.approx(
        products.sum(), abs=1e-5 * np.abs(products).sum()
    )


def test_drjit_networks_that_do_not_fit(tmp_path, rng):
    (tmp_path / "net.py").write_text(DRJIT)
    files.write_safetensors(tmp_path / "w.safetensors", {"a": np.zeros(2, "f4")})
    keys = {"kind": "drjit", "file": "net.py:make", "preprocess": {"resize_px": (5, 4)}}
    with pytest.raises(InputError, match=r"\['a'\]; the network has \['layers.0.b"):
        load_policy(section(weights_file="w.safetensors", **keys), tmp_path)
    with pytest.raises(InputError, match="net.py:make: fails on an input of shape"):
        load_policy(section(**keys), tmp_path).control(camera(1, rng), 0)
