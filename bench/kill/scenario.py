"""The tiny scenario that :mod:`kill` attacks, and the job of one of its processes."""

from __future__ import annotations

import json
import os
from pathlib import Path

import numpy as np
import torch

from mi_nerfattack import variant
from mi_nerfattack.io import files

# The parts below define types of the variant.
variant.ensure()

import mi_nerfattack.experiment.results  # noqa: E402, F401  slow, so before the fork
from mi_nerfattack.backend.determinism import one_thread  # noqa: E402  see above
from mi_nerfattack.experiment.job import Job  # noqa: E402  see above
from mi_nerfattack.fields import GridField, GridLayout, Occupancy, save_field  # noqa: E402  see above
from mi_nerfattack.policy.pilotnet import PilotNet  # noqa: E402  see above
from mi_nerfattack.policy.torch_policy import TorchPolicy  # noqa: E402  see above
from mi_nerfattack.scenario.scenario import load_scenario  # noqa: E402  see above

HORIZON, RUNS = 2, 2
EVERY = 3
WRITING = "writing a file"

SCENARIO = f"""\
name = "kill"
seed = 1
[scene]
field = "scene.safetensors"
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
horizon = {HORIZON}
runs = {RUNS}
[attack]
max_iterations = 30
learning_rate = 0.5
checkpoint_every = {EVERY}
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


def make_scenario(folder: Path) -> None:
    """Write a scenario with fields of some hundred vertices and a policy."""
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
    route = {
        "goal": 0,
        "lane_width_m": 3.5,
        "speed_ms": 5.0,
        "points_m": [[-20.0, 0.0], [60.0, 0.0]],
    }
    files.write_json(folder / "routes.json", {"line": route})
    files.write_text(folder / "deployment.xml", _XML)
    files.write_text(folder / "scenario.toml", SCENARIO)


def _fog(finest: int, half: float, density: float, step: float, seed: int) -> GridField:
    """Return a box of even density, its colours random."""
    layout = GridLayout(2, 6, finest)
    grid = GridField(layout, np.full(3, -half), np.full(3, half), step_m=step)
    count = grid.n_vertices
    value = np.full(count, density / layout.levels, np.float32)
    grid.set_parameter("density", value)
    colours = np.random.default_rng(seed).normal(0, 0.7, (count, 3))
    grid.set_parameter("texture", colours.astype(np.float32))
    cells = np.ones((16, 16, 16), bool)
    cells[0, 0, 0] = False  # so the density has a slope at the faces of the box
    grid.occupy(Occupancy(cells))
    return grid


def run_job(folder: Path, output: Path, writer: int) -> None:
    """Do the job, or what is left of it, and tell of every step.

    Args:
        folder: from :func:`make_scenario`.
        output: the run folder.
        writer: descriptor; lines ``stage, steps done, remark`` parted by tabs.
    """

    def tell(stage: str, done: int, total: int, remark: str) -> None:
        del total
        os.write(writer, f"{stage}\t{done}\t{remark}\n".encode())

    def fsync(descriptor: int) -> None:
        tell(WRITING, 0, 0, "")
        flush(descriptor)

    flush, os.fsync = os.fsync, fsync  # in this process, which ends with the job
    scenario, text = load_scenario(folder / "scenario.toml")
    policy = TorchPolicy(PilotNet.load(folder / "policy.safetensors"))
    with one_thread():
        Job(scenario, text, policy, output, tell).run()
    json.loads(files.read_text(output / "metrics.json"))
