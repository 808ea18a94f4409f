"""A complete scenario of tiny fields, and the command line in a process."""

from __future__ import annotations

import json
import subprocess
import sys

import pytest
import torch

SCENARIO = """\
name = "toy"
seed = 1
[scene]
field = "scene.safetensors"
deployment = "deployment.xml"
routes = "routes.json"
route = "line"
[[objects]]
id = "ball"
field = "object.safetensors"
position_m = [7.0, 2.4, 1.0]
scale = 1.5
[policy]
file = "policy.safetensors"
[drive]
horizon = 4
runs = 2
[attack]
iterations = 3
learning_rate = 0.5
checkpoint_every = 1
[deployment]
spp = 1
"""

XML = """\
<scene version="3.0.0">
    <integrator type="path"><integer name="max_depth" value="2"/></integrator>
    <shape type="rectangle">
        <transform name="to_world"><scale value="100"/></transform>
        <bsdf type="diffuse"/>
    </shape>
    <emitter type="constant"><rgb name="radiance" value="0.5"/></emitter>
</scene>
"""


@pytest.fixture(scope="module")
def scenario_folder(tmp_path_factory):
    """A complete scenario with tiny fields and an untrained policy."""
    import mitsuba as mi

    mi.set_variant("llvm_ad_rgb")
    from helpers import toy_loop as toy

    from mi_nerfattack.fields import GridLayout, save_field
    from mi_nerfattack.policy.pilotnet import PilotNet

    path = tmp_path_factory.mktemp("scenario")
    scene = toy.blob(GridLayout(2, 6, 9), 25.0, -2.0, 1.0, 1)
    save_field(path / "scene.safetensors", scene)
    item = toy.blob(GridLayout(2, 6, 8), 1.0, 3.0, 0.2, 2)
    save_field(path / "object.safetensors", item)
    torch.manual_seed(0)
    net = PilotNet()
    with torch.no_grad():  # an untrained network hardly reacts; raise its gain
        for parameter in net.parameters():
            if parameter.ndim > 1:
                parameter.mul_(1.6)
    net.save(path / "policy.safetensors")
    points = [[-20.0, 0.0], [60.0, 0.0]]
    route = {"goal": 0, "lane_width_m": 3.5, "speed_ms": 5.0, "points_m": points}
    (path / "routes.json").write_text(json.dumps({"line": route}))
    (path / "deployment.xml").write_text(XML)
    (path / "scenario.toml").write_text(SCENARIO)
    return path


def run(*arguments, cwd, check=None, **options):
    result = subprocess.run(
        [sys.executable, "-m", "mi_nerfattack.cli", *map(str, arguments)],
        cwd=cwd,
        capture_output=True,
        text=True,
        timeout=900,
        **options,
    )
    if check is not None:
        assert result.returncode == check, result.stderr
        assert "Traceback" not in result.stderr
    return result
