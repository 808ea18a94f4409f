"""Tiny attacks that are interrupted and resumed, and boxes with a colour a face."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
import torch
from support.worlds import loops as toy
from support.worlds.fields import empty_border, filled, vertices

from mi_nerfattack.fields import (
    GridField,
    GridLayout,
    Occupancy,
    load_grid,
    save_field,
)
from mi_nerfattack.io import files
from mi_nerfattack.policy.pilotnet import PilotNet
from mi_nerfattack.props.attacked import AttackedBox
from mi_nerfattack.render.camera.pose import Pose

#: Keys of `[attack]` by which everything that can be drawn is.
ROBUST = """
poses = 3
jitter = true
vary.light_ev_sd = 0.4
vary.light_colour_ev_sd = 0.2
vary.exposure_ev_sd = 0.5
vary.colour_ev_sd = 0.1
vary.blur_px_sd = 0.8
vary.noise_sd = 0.02
vary.pitch_deg_sd = 1.0
vary.height_sd = 0.1
vary.speed_sd = 0.1
vary.steering_sd = 0.1
vary.steering_lag_s_sd = 0.1
vary.delay_s_sd = 0.1
"""


def make_dense(folder):
    """Make the object of a scenario so dense that images show it."""
    item = load_grid(folder / "object.safetensors")
    item.set_parameter("density", np.full(item.n_vertices, 3.0, np.float32))
    save_field(folder / "object.safetensors", item)


def job(folder, output, change=("", ""), on_progress=None, notices=None, **options):
    from mi_nerfattack.experiment.job import Job
    from mi_nerfattack.policy.torch_policy import TorchPolicy
    from mi_nerfattack.scenario.scenario import load_scenario

    text = (folder / "scenario.toml").read_text()
    assert change[0] in text
    path = folder / "changed.toml"
    text = text.replace(*change)
    if 'freedom.kind = "pose"' in text:  # then the texture's rate has no meaning
        text = re.sub(r"(?m)^freedom.learning_rate = .*\n", "", text)
    path.write_text(text)
    scenario, text = load_scenario(path)
    policy = TorchPolicy(toy.SmoothPolicy())
    result = Job(scenario, text, policy, output, **options)
    result.on_progress = on_progress or result.on_progress
    result.on_notice = (notices if notices is not None else []).append
    return result


def stop_at(stage, step, stop=None):
    """Return a progress callback that interrupts at a step of a stage."""

    def on_progress(name, done, total, remark):
        if (name, done) == (stage, step):
            if stop is not None:
                stop()
            else:
                raise KeyboardInterrupt

    return on_progress


def interrupt(folder, output, stage, step, **options):
    with pytest.raises(KeyboardInterrupt):
        job(folder, output, on_progress=stop_at(stage, step), **options).run()


def checkpoint_of(output):
    tensors, _ = files.read_safetensors(output / "checkpoint.safetensors")
    return tensors


def contents(output):
    return {path: path.read_bytes() for path in output.rglob("*") if path.is_file()}


def assert_same_state(output, uninterrupted):
    expected, actual = checkpoint_of(uninterrupted), checkpoint_of(output)
    assert set(expected) == set(actual)
    for name, value in expected.items():
        assert np.array_equal(value, actual[name], equal_nan=True), name


def assert_same_drives(drives, expected):
    for one, other in zip(drives, expected, strict=True):
        assert (one.environment, one.case) == (other.environment, other.case)
        assert one.run == other.run
        assert np.array_equal(one.states, other.states)
        assert np.array_equal(one.controls, other.controls)


_POLICY = """\
file = "smooth.py:SmoothPolicy"
trust_code = true

[policy.goal]
kind = "integer"
count = 3
"""
COLOURS = {"front": (200, 30, 30), "right": (30, 200, 30), "back": (30, 30, 200)}
COLOURS |= {"left": (200, 200, 30), "top": (200, 30, 200), "bottom": (30, 200, 200)}


def flat_images(size: int = 8) -> dict[str, np.ndarray]:
    return {f: np.full((size, size, 3), c, np.uint8) for f, c in COLOURS.items()}


def made_box(images=None, extent=(1.0, 1.0, 1.0), pose=None) -> AttackedBox:
    """Return a box that stands on z = 0 of its own frame."""
    half = np.array(extent) / 2
    lower, upper = -half * [1, 1, 0], half * [1, 1, 2]
    pose = pose or Pose.identity()
    images = images or flat_images()
    return AttackedBox("cube", "first", "ab" * 32, lower, upper, pose, images)


def solid(inside, lower, upper) -> GridField:
    """Return a field that is opaque where `inside` (n, 3) -> (n,) is positive."""
    field = GridField(GridLayout(1, 24, 24), np.array(lower), np.array(upper))
    at = vertices(field)
    colour = np.clip(0.5 + 0.4 * at, 0.1, 0.9)
    raw = np.clip(400 * inside(at), -20, 6)
    return filled(field, raw, np.log(colour / (1 - colour)))


def cube_field(half: float = 0.5) -> GridField:
    """Return a cube in a field a tenth larger, as `asset` writes it."""
    field = solid(
        lambda at: (half - np.abs(at)).min(1), [-1.1 * half] * 3, [1.1 * half] * 3
    )
    for name, value in {"lower": -half, "upper": half}.items():
        field.info[f"provenance.object_{name}"] = f"{value} {value} {value}"
    return field


def attacked_run(folder: Path, field: GridField) -> Path:
    """Attack an object once, of scale 1.5 at (7, 4.2, 1.6), and return the folder."""
    from mi_nerfattack.experiment.job import Job
    from mi_nerfattack.scenario.scenario import load_scenario

    write_scenario(
        folder,
        {
            "max_iterations = 30": "max_iterations = 1",
            "textures = 4": "textures = 1",
            'file = "policy.safetensors"\n': _POLICY,
            "runs = 2": "runs = 1",
            "[drive]": "[camera]\nwidth = 24\nheight = 10\n[drive]",
            "[attack]\n": "[attack]\n"
            'freedom = { kind = "both", pose_limit_m = 0.2, learning_rate = 0.5 }\n',
            "freedom.learning_rate = 0.5\n": "",
        },
    )
    if field.window.is_open:
        empty_border(field)
    save_field(folder / "object.safetensors", field)
    (folder / "smooth.py").write_text("from support.worlds.loops import SmoothPolicy\n")
    scenario, text = load_scenario(folder / "scenario.toml")
    run = folder / "run"
    Job(scenario, text, scenario.build_policy(), run, frames=None).run(anyway=True)
    return run


SCENARIO = """\
name = "kill"
seed = 1
[scene]
field = "scene.safetensors"
spp = 1
deployment = "deployment.xml"
routes = "routes.json"
route = "line"
[[objects]]
id = "ball"
field = "object.safetensors"
position_m = [7.0, 4.2, 1.6]
scale = 1.5
[policy]
file = "policy.safetensors"
[drive]
horizon = 2
runs = 2
[attack]
method.max_iterations = 30
freedom.learning_rate = 0.5
checkpoint_every = 3
deterministic = true
[baseline]
textures = 4
[deployment]
spp = 1
"""
_XML = """\
<scene version="3.0.0">
    <integrator type="path"><integer name="max_depth" value="2"/></integrator>
    <shape type="rectangle">
        <transform name="to_world"><scale value="100"/></transform>
        <bsdf type="diffuse"/>
    </shape>
    <emitter type="constant"><rgb name="radiance" value="0.5"/></emitter>
</scene>
"""


def write_scenario(folder: Path, changes: dict[str, str] | None = None) -> Path:
    """Write the scenario with small fields and a policy; parts of its text changed."""
    files.make_folder(folder)
    save_field(folder / "scene.safetensors", _fog(9, 25.0, -3.0, 1.0, 1))
    save_field(folder / "object.safetensors", _fog(8, 1.0, 0.5, 0.2, 2))
    torch.manual_seed(0)
    net = PilotNet()
    with torch.no_grad():  # an untrained network hardly reacts; raise its gain
        for parameter in net.parameters():
            if parameter.ndim > 1:
                parameter.mul_(1.6)
    net.save(folder / "policy.safetensors")
    route = {"goal": 0, "lane_width_m": 3.5, "speed_ms": 5.0}
    route["points_m"] = [[-20.0, 0.0], [60.0, 0.0]]
    files.write_json(folder / "routes.json", {"line": route})
    files.write_text(folder / "deployment.xml", _XML)
    text = SCENARIO
    for old, new in (changes or {}).items():
        assert old in text
        text = text.replace(old, new)
    files.write_text(folder / "scenario.toml", text)
    return folder


def _fog(finest: int, half: float, density: float, step: float, seed: int) -> GridField:
    """Return a box of even density, its colours random."""
    layout = GridLayout(2, 6, finest)
    grid = GridField(layout, np.full(3, -half), np.full(3, half), step_m=step)
    colours = np.random.default_rng(seed).normal(0, 0.7, (grid.n_vertices, 3))
    filled(grid, density / layout.levels, colours)
    cells = np.ones((16, 16, 16), bool)
    cells[0, 0, 0] = False  # so the density has a slope at the faces of the box
    grid.occupy(Occupancy(cells))
    return grid
