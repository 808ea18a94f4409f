"""The policy of a scenario: the guide's examples, every kind, refusals."""

from __future__ import annotations

import re
import sys
import warnings
from pathlib import Path
from types import SimpleNamespace
from typing import get_args

import mitsuba as mi
import numpy as np
import pytest
import torch
from helpers.policies import camera, policy_of, serving
from helpers.scenario_text import HEAD, write_named_files
from safetensors.torch import save_file
from torch import nn

from mi_nerfattack.errors import InputError
from mi_nerfattack.io.strict_toml import parse_toml
from mi_nerfattack.policy.pilotnet import PilotNet
from mi_nerfattack.policy.torch_policy import TorchPolicy
from mi_nerfattack.scenario.policy import PolicySection, PreprocessSection
from mi_nerfattack.scenario.scenario import load_scenario, portable_text

pytestmark = pytest.mark.usefixtures("variant")

GUIDE = Path(__file__).parents[2] / "docs" / "policy.md"
SCENARIO = HEAD.partition("[policy]")[0]

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
def served(monkeypatch):
    monkeypatch.setenv("no_proxy", "*")
    with serving() as start:
        yield start


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
    write_named_files(tmp_path)
    path = tmp_path / "scenario.toml"
    path.write_text(SCENARIO + toml)
    scenario, _ = load_scenario(path)
    assert scenario.digest() == load_scenario(path)[0].digest()
    policy = scenario.policy.build()
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
    kinds = get_args(get_args(PolicySection)[0])
    for model in (*kinds, PreprocessSection):
        for key in model.defaults():
            assert re.search(rf"`{key}`|{key} = |policy\.{key}\]", text), key


# --- refusals -------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ({"file": "net.bin"}, "suffix tells no kind"),
        ({"file": "mypkg.policy:Net"}, "code is given as FILE.py:NAME"),
        (
            {"file": "net.onnx", "kind": "http"},
            'policy.file: has no meaning with kind = "http"; (?s:.*)policy.url: ',
        ),
        ({"url": "http://x", "kind": "onnx"}, 'policy.url: .*, or set kind to "http"'),
        ({"url": "ftp://x"}, "policy.url: 'ftp://x'; must be http"),
        ({"file": "net.pt", "weights_file": "w.pt"}, "weights_file.*torchscript"),
        ({"file": "net.pt", "retries": 1}, "policy.retries: .*torchscript.*http"),
        ({"url": "http://x", "batch": 1}, "policy.batch: has no .*http"),
        ({"url": "http://x", "goal": "integer", "goals": 3}, "policy.goal: .*http"),
        ({"file": "net.py"}, "must have the form FILE.py:NAME"),
        ({"file": "absent.py:Net"}, "absent.py.*does not exist"),
        ({"file": "absent.pt"}, "absent.pt.*does not exist"),
        ({"file": "absent.pt2"}, "absent.pt2.*does not exist"),
        ({"file": "absent.safetensors"}, "absent.safetensors.*does not exist"),
    ],
)
def test_keys_and_files_that_do_not_fit(keys, message, tmp_path):
    with pytest.raises(InputError, match=message):
        policy_of(tmp_path, **keys)


@pytest.mark.parametrize(
    ("lines", "key"),
    [
        ('file = "a.pt"\nurl = "http://x"', "policy.file: give either"),
        ('kind = "onnx"', "policy.file: give either"),
        ('file = "a.pt"\ngoal = "one_hot"', "policy.goals: is missing"),
        (
            'file = "a.pt"\ngoals = 2',
            "policy.goals: has no meaning without goal; leave",
        ),
        ('file = "a.pt"\nkind = "keras"', "policy.kind"),
        ('file = "a.pt"\nbatch = 2', "policy.batch"),
        ('file = "a.pt"\ncontrol_scale = 0.0', "policy.control_scale"),
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
        policy_of(tmp_path, file="net.py:Net")


MODULE = (
    "from torch import nn\n"
    "def make(): return nn.Sequential(nn.Flatten(), nn.Linear(39600, 1))\n"
)


def test_random_weights_are_refused(tmp_path, rng):
    """Of one layer of several, too; not those that the file sets."""
    (tmp_path / "net.py").write_text(
        MODULE + "import torch\n"
        "def half():\n"
        "    net = make()\n"
        "    nn.init.zeros_(net[1].weight)\n"
        "    return net\n"
        "def loaded():\n"
        "    net = half()\n"
        "    net.load_state_dict({'1.weight': torch.zeros(1, 39600),"
        " '1.bias': torch.ones(1)})\n"
        "    return net\n"
        "net = make()\n"
    )
    for name, tensor in (("make", "1.weight"), ("half", "1.bias"), ("net", "1.weight")):
        message = f"net.py:{name}: .*random: '{tensor}' .*policy.weights_file"
        with pytest.raises(InputError, match=message):
            policy_of(tmp_path, file=f"net.py:{name}")
    image = camera(2, rng)
    policy = policy_of(tmp_path, file="net.py:loaded")
    np.testing.assert_array_equal(policy.control(image, 0), [1, 1])


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
        policy = policy_of(tmp_path, **keys)
        np.testing.assert_allclose(policy.control(image, 0), expected, atol=1e-6)


@pytest.mark.parametrize(
    ("state", "message"),
    [
        (SimpleNamespace(a=1), "is no state dict of plain tensors"),
        ([1, 2], "holds a list"),
        (
            {"state_dict": {"1.bias": torch.zeros(1)}, "epoch": 3},
            r"checkpoint of state_dict, epoch; save its 'state_dict' alone",
        ),
        ({"1.weight": torch.zeros(1, 39600)}, "the very module that policy.file"),
        ({"1.weight": 3, "1.bias": torch.zeros(1)}, "received <class 'int'>"),
        (
            {"1.weight": torch.full((1, 39600), torch.nan), "1.bias": torch.zeros(1)},
            "'1.weight' is no tensor of finite",
        ),
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
        policy_of(tmp_path, **keys)


SHAPES = """
import torch
from torch import nn
class Net(nn.Module):
    shape = {}
    def __init__(self):
        super().__init__()
        torch.manual_seed(0)
        self.head = nn.Linear(torch.tensor(self.shape).prod(), 1)
    def forward(self, image):
        assert tuple(image.shape[1:]) == self.shape
        return self.head(image.flatten(1))
"""


@pytest.mark.parametrize(
    ("shape", "keys"),
    [
        ((3, 66, 200), "resize_px = [200, 66]"),
        ((66, 200, 3), 'resize_px = [200, 66], layout = "NHWC"'),
        ((1, 64, 64), 'resize_px = [64, 64], colour = "grey"'),
    ],
)
def test_images_of_another_shape_are_refused_with_a_remedy_that_helps(
    shape, keys, tmp_path, rng
):
    (tmp_path / "net.py").write_text(SHAPES.format(shape))
    image = mi.TensorXf(rng.random((2, 10, 20, 3), dtype=np.float32))
    message = (
        f"net.py:Net: takes images of shape {(2, *shape)}, and gets (2, 3, 10, 20) of "
        f"the camera and policy.preprocess; write {keys} in [policy.preprocess]"
    )
    with pytest.raises(InputError, match=re.escape(message)):
        policy_of(tmp_path, file="net.py:Net").control(image, 0)
    preprocess = parse_toml("keys", re.sub(r", (?=[a-z])", "\n", keys))
    policy = policy_of(tmp_path, file="net.py:Net", preprocess=preprocess)
    assert np.isfinite(policy.control(image, 0)).all()


def test_images_that_no_usual_shape_explains_are_told_with_the_module_s_words(
    tmp_path, rng
):
    (tmp_path / "net.py").write_text(SHAPES.format((3, 7, 9)))
    message = r"net.py:Net: fails on an input of shape \(2, 3, 66, 200\).*preprocess"
    with pytest.raises(InputError, match=message):
        policy_of(tmp_path, file="net.py:Net").control(camera(2, rng), 0)


# --- the default and the digest -------------------------------------------------------


def test_pilotnet_stays_as_it_was(tmp_path, rng):
    network = PilotNet()
    network.save(tmp_path / "policy.safetensors")
    policy = policy_of(tmp_path, file="policy.safetensors")
    image, weight = camera(2, rng), mi.Float(1, -1)
    one, other = (
        policy.vjp(image, 1, weight),
        TorchPolicy(network).vjp(image, 1, weight),
    )
    for a, b in zip(one, other, strict=True):
        np.testing.assert_array_equal(a, b)


def test_digest_and_portable_text_know_the_files(tmp_path):
    write_named_files(tmp_path)
    (tmp_path / "net.py").write_text(MODULE)
    (tmp_path / "w.pt").write_bytes(b"1")
    text = SCENARIO + '[policy]\nfile = "net.py:make"\nweights_file = "w.pt"\n'
    path = tmp_path / "scenario.toml"
    path.write_text(text)

    def digest():
        return load_scenario(path)[0].digest()

    first = digest()
    portable = portable_text(*load_scenario(path))
    assert f'"{tmp_path}/net.py:make"' in portable and f"{tmp_path}/w.pt" in portable
    path.write_text(portable)
    assert digest() == first
    (tmp_path / "w.pt").write_bytes(b"2")
    second = digest()
    (tmp_path / "net.py").write_text(MODULE + "\n")
    assert len({first, second, digest()}) == 3
    path.write_text(portable.replace("net.py:make", "net.py:other"))
    assert digest() not in (first, second)
