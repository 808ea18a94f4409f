"""Scenarios with a policy of openpilot's form: the guide's example, and its checks."""

from __future__ import annotations

import re
from pathlib import Path
from types import SimpleNamespace

import mitsuba as mi
import numpy as np
import pytest
from support.files.openpilot import Pair
from support.files.runs import HEAD, write_named_files

from mi_nerfattack.experiment.checks.before_attack import period_findings
from mi_nerfattack.scenario.scenario import load_scenario

pytestmark = pytest.mark.usefixtures("variant")

GUIDE = Path(__file__).parents[2] / "docs/howto/policy_openpilot.md"
TEXT = GUIDE.read_text("utf-8")
POLICY, CAMERAS = re.findall(r"(?s)```toml\n(.*?)```", TEXT)
(SHOW,) = re.findall(r"(?s)```python\n(.*?)```", TEXT)
PAIR = Pair(hypotheses=5)


@pytest.fixture
def text(tmp_path, monkeypatch):
    """A scenario of the guide's policy, with the slices of a synthetic pair."""
    monkeypatch.chdir(tmp_path)
    write_named_files(tmp_path)
    PAIR.save(tmp_path)
    policy = re.sub(r"features = \[.*\]", f"features = {list(PAIR.features)}", POLICY)
    policy = re.sub(r"plan = \[.*\]", f"plan = {list(PAIR.plan)}", policy)
    return HEAD.partition("[policy]")[0] + policy + CAMERAS


def load(text):
    Path("scenario.toml").write_text(text)
    return load_scenario("scenario.toml")[0]


def test_the_guides_example(text, rng):
    scenario = load(text)
    assert scenario.policy.unit() == "rad/s" and scenario.vehicle.dt_s == 0.05
    assert scenario.rig().layout.size == (1024, 256)
    policy = scenario.build_policy()
    image, speeds = (
        mi.TensorXf(rng.random((2, 256, 1024, 3))),
        mi.TensorXf([[5], [6.0]]),
    )
    memory = policy.initial_memory(2)
    for _ in range(2):
        inputs, before = (image, 0, memory), memory
        control, memory = policy.step(*inputs, speeds)
    d_image, d_memory, d_speed = policy.step_vjp(*inputs, mi.Float(1, 1), (), speeds)
    assert np.isfinite(control).all() and np.all(np.array(d_speed) != 0)
    assert np.array(d_image).any((1, 2, 3)).all()
    assert [d.shape for d in d_memory] == [m.shape for m in before]
    assert all(part.any() for part in d_memory)


def test_the_slices_are_shown_and_no_pickle_is_run(text, capsys):
    exec(compile(SHOW, "guide", "exec"), {})
    shown = capsys.readouterr().out
    for name, (start, stop) in (("hidden_state", PAIR.features), ("plan", PAIR.plan)):
        assert re.search(rf"(?s){name}.*?{start}\n.*?{stop}\n", shown)


@pytest.mark.parametrize(("period", "count"), [(0.05, 0), (0.1, 1)])
def test_check_tells_of_another_period(period, count, text):
    scenario = load(text.replace("dt_s = 0.05", f"dt_s = {period}"))
    lines = list(period_findings(SimpleNamespace(scenario=scenario)))
    assert len(lines) == count and all("0.05 s between" in line for line in lines)


def test_a_key_and_a_weight_change_the_digest(text):
    digests = {
        load(text).digest(),
        load(text.replace("[policy.t", "stride = 2\n[policy.t")).digest(),
    }
    digests |= {load(text.replace("[policy.t", 'traffic = "left"\n[policy.t')).digest()}
    Path("driving_vision.onnx").write_bytes(b"another")
    assert len(digests | {load(text).digest()}) == 4
