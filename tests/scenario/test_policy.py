"""The policy of a scenario: the guide's examples, weights, shapes of images."""

from __future__ import annotations

import re
import sys
import warnings
from itertools import chain
from pathlib import Path
from types import SimpleNamespace
from typing import get_args

import mitsuba as mi
import numpy as np
import pytest
import torch
from safetensors.torch import save_file
from support.files.policies import camera, policy_of
from support.files.runs import HEAD, write_named_files
from torch import nn

from mi_nerfattack.errors import InputError
from mi_nerfattack.io.strict import parse_toml
from mi_nerfattack.policy.pilotnet import PilotNet
from mi_nerfattack.policy.torch_policy import TorchPolicy
from mi_nerfattack.scenario.policy.kinds import PolicySection
from mi_nerfattack.scenario.policy.parts import PreprocessSection
from mi_nerfattack.scenario.scenario import load_scenario

pytestmark = pytest.mark.usefixtures("variant")

DOCS = Path(__file__).parents[2] / "docs"
GUIDES = [*sorted((DOCS / "howto").glob("policy_*.md")), DOCS / "howto/your_policy.md"]
CHAPTER = re.compile(r"(?m)\A# |^##+ ")  # not the comments in code
REFERENCE = DOCS / "reference/policies.md"
SCENARIO = HEAD.partition("[policy]")[0]


def chapters():
    """Yield the examples of the guides: title, Python blocks, scenario text."""
    texts = [page.read_text("utf-8") for page in GUIDES]
    for chapter in chain.from_iterable(map(CHAPTER.split, texts)):
        blocks = re.findall(r"(?s)```(\w+)\n(.*?)```", chapter)
        toml = [body for kind, body in blocks if kind == "toml"]
        title = chapter.partition("\n")[0]
        if toml and not title.startswith("openpilot"):  # test_openpilot has its files
            python = [body for kind, body in blocks if kind == "python"]
            yield pytest.param(python, toml[0], id=title)


EXAMPLES = list(chapters())


def server_of_the_guide():
    """Return the code of the guide's server."""
    (blocks,) = (p.values[0] for p in chapters() if p.id == "A policy behind a URL")
    return next(block for block in blocks if block.startswith("# server.py"))


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


@pytest.mark.parametrize(("blocks", "toml"), EXAMPLES)
def test_examples_of_the_guide(blocks, toml, tmp_path, monkeypatch, served, rng):
    if any("import onnx" in block for block in blocks):
        pytest.importorskip("onnx", reason="the extra onnx is not installed")
    before = set(sys.modules)
    run_blocks(blocks, tmp_path, monkeypatch)
    if "url = " in toml:
        scope = {"__name__": "server"}
        exec(server_of_the_guide(), scope)
        toml = toml.replace("http://127.0.0.1:8000", served(scope["Handler"]))
    write_named_files(tmp_path)
    path = tmp_path / "scenario.toml"
    path.write_text(SCENARIO + toml)
    scenario, _ = load_scenario(path)
    assert scenario.digest() == load_scenario(path)[0].digest()
    rig, count = scenario.rig(), scenario.vehicle.build().control_size
    policy = scenario.policy.build(rig.views)
    image = mi.TensorXf(rng.random((2, *rig.size[::-1], 3), dtype=np.float32))
    memory, numbers = policy.initial_memory(2), None
    if size := policy.numbers.size:
        numbers = mi.TensorXf(rng.uniform(4, 6, (2, size)))
    for _ in range(2):
        control, after = policy.step(image, 1, memory, numbers)
        assert control.numpy().shape == ((2,) if count == 1 else (count, 2))
        assert np.isfinite(control.numpy()).all()
        if policy.differentiable:
            weight = 0 * control + 1
            d_image, d_memory, _ = policy.step_vjp(
                image, 1, memory, weight, (), numbers
            )
            assert d_image.shape == image.shape
            for part in rig.split(d_image.numpy()).values():
                assert np.any(part)  # each camera counts
            assert len(d_memory) == len(memory)
        memory = after
    for name in set(sys.modules) - before:
        if getattr(sys.modules[name], "__file__", None) and str(tmp_path) in str(
            sys.modules[name].__file__
        ):
            del sys.modules[name]


def test_the_reference_lists_every_key():
    text = REFERENCE.read_text("utf-8")
    kinds = get_args(get_args(PolicySection)[0])
    for model in (*kinds, PreprocessSection):
        for key in model.defaults():
            assert re.search(rf"`{key}`|{key} = |policy\.{key}\]", text), key


MODULE = """\
import torch
from torch import nn
def make(): return nn.Sequential(nn.Flatten(), nn.Linear(39600, 1))
def half():
    net = make()
    nn.init.zeros_(net[1].weight)
    return net
def loaded():
    net = half()
    net.load_state_dict({'1.weight': net[1].weight, '1.bias': torch.ones(1)})
    return net
net = make()
def number(): return 3
def sized(size): return 3
"""


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("make", "random: '1.weight' .*policy.weights_file"),
        ("half", "random: '1.bias' .*policy.weights_file"),  # one layer of several
        ("net", "random: '1.weight' .*policy.weights_file"),
        ("number", "gives a int; a torch.nn.Module is needed"),
        ("sized", "calling it without arguments raises TypeError"),
    ],
)
def test_modules_that_are_no_policy(tmp_path, rng, name, message):
    (tmp_path / "net.py").write_text(MODULE)
    with pytest.raises(InputError, match=f"net.py:{name}: .*{message}"):
        policy_of(tmp_path, file=f"net.py:{name}")
    policy = policy_of(tmp_path, file="net.py:loaded")
    np.testing.assert_array_equal(policy.control(camera(2, rng), 0), [1, 1])


WEIGHT = torch.zeros(1, 39600)


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
        ({"state_dict": {}, "epoch": 3}, "checkpoint of .*save its 'state_dict' alone"),
        ({"1.weight": WEIGHT}, "Missing key.*1.bias.*the very module that policy.file"),
        ({"1.weight": 3, "1.bias": torch.zeros(1)}, "received <class 'int'>"),
        (
            {"1.weight": torch.nan * WEIGHT, "1.bias": WEIGHT[0, :1]},
            "'1.weight' is no tensor of finite",
        ),
        ({"1.weight": WEIGHT[:, :7], "1.bias": torch.zeros(1)}, "size mismatch"),
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
        ((3, 7, 9), ""),  # which no usual shape explains
    ],
)
def test_images_of_another_shape_are_refused_with_a_remedy_that_helps(
    shape, keys, tmp_path, rng
):
    (tmp_path / "net.py").write_text(SHAPES.format(shape))
    image = mi.TensorXf(rng.random((2, 10, 20, 3), dtype=np.float32))
    needed = re.escape(f"{(2, *shape)}") if keys else ".*"
    message = (
        rf"net.py:Net: .*{needed}.*\(2, 3, 10, 20\).*{re.escape(keys)}.*preprocess"
    )
    with pytest.raises(InputError, match=message):
        policy_of(tmp_path, file="net.py:Net").control(image, 0)
    if keys:
        preprocess = parse_toml("keys", re.sub(r", (?=[a-z])", "\n", keys))
        policy = policy_of(tmp_path, file="net.py:Net", preprocess=preprocess)
        assert np.isfinite(policy.control(image, 0)).all()


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
