"""What the commands of the suite read: a few pixels, a few hundred numbers."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
from support.files.runs import make_run
from support.worlds import attacks as attack_jobs
from support.worlds import films as film_scenes
from support.worlds.fields import small_ngp
from support.worlds.places import PaintedSite, make_place
from support.worlds.views import write_folder

from mi_nerfattack.commands.train import Train
from mi_nerfattack.experiment.job import Job
from mi_nerfattack.fields import Occupancy, save_field
from mi_nerfattack.io import files
from mi_nerfattack.scenario.scenario import load_scenario
from mi_nerfattack.scenes import bundled
from tests.experiment.conftest import write_found
from tests.fit.bake.test_bake import POINTS, SCENARIO

GRID = """\
scenario = "scenario.toml"
anyway = true
[[methods]]
name = "gradient"
set.attack.method.max_iterations = 2
set.baseline.textures = 1
"""
PILOTNET = {
    "horizon = 2": "horizon = 16",
    "max_iterations = 30": "max_iterations = 1",
    "textures = 4": "textures = 1",
    "runs = 2": "runs = 1",
    "[7.0, 4.2, 1.6]": "[-13.0, 3.4, 1.6]",
}
#: A training that changes the weights of a policy a little.
MODULE = """\
from mi_nerfattack.policy import PilotNet

def train(data, out, seed):
    network = PilotNet.load("policy.safetensors")
    for value in network.parameters():
        value.data += 1e-3 * (seed + 1)
    network.save(out)
"""


def scenario(folder: Path, patch: pytest.MonkeyPatch) -> None:
    path = write_found(folder)
    text = path.read_text()
    path.write_text(text.replace("checkpoint_every = 3", "checkpoint_every = 1"))


def grid(folder: Path, patch: pytest.MonkeyPatch) -> None:
    scenario(folder, patch)
    (folder / "grid.toml").write_text(GRID)


def painted(folder: Path, patch: pytest.MonkeyPatch) -> None:
    make_place(folder, patch)


def balls(folder: Path, patch: pytest.MonkeyPatch) -> None:
    film_scenes.write_balls(folder)
    film_scenes.write_path(folder, name="path.json")


def ground(folder: Path, patch: pytest.MonkeyPatch) -> None:
    (folder / "scene.xml").write_text(
        '<scene version="3.0.0"><integrator type="path"/><emitter type="constant"/>'
        '<shape type="rectangle"><transform name="to_world"><scale value="100"/>'
        "</transform></shape></scene>"
    )
    route = {"goal": 0, "lane_width_m": 3.5, "speed_ms": 5.0}
    route["points_m"] = [[0, 0], [10, 0], [20, 0]]
    files.write_json(folder / "routes.json", {"straight": route})


def sphere(folder: Path, patch: pytest.MonkeyPatch) -> None:
    write_folder(files.make_folder(folder / "views"), None)


def solid(folder: Path, patch: pytest.MonkeyPatch) -> None:
    field = small_ngp(cone=1 / 64)
    field.occupy(Occupancy(np.ones((6, 5, 4), bool)))
    save_field(folder / "field.safetensors", field)
    route = {"goal": 0, "lane_width_m": 7.0, "speed_ms": 5.0}
    route["points_m"] = POINTS.tolist()
    files.write_json(folder / "routes.json", {"line": route})
    (folder / "scenario.toml").write_text(SCENARIO)


def cube(folder: Path, patch: pytest.MonkeyPatch) -> None:
    shutil.copy(bundled("cube/field.safetensors"), folder / "cube.safetensors")


def made(folder: Path, patch: pytest.MonkeyPatch) -> None:
    make_run(folder / "run")


def site(folder: Path, patch: pytest.MonkeyPatch) -> None:
    patch.setattr(
        Train, "_sites", lambda *_: [PaintedSite("mitsuba", size_px=(200, 66))]
    )


def pilotnet(folder: Path, patch: pytest.MonkeyPatch | None = None) -> None:
    """Attack PilotNet, without pictures; `run` is the finished run."""
    attacked(folder, PILOTNET)


def attacked(folder: Path, changes: dict[str, str]) -> None:
    """Attack the policy of a scenario; `run` is the finished run."""
    attack_jobs.write_scenario(folder, changes)
    routes = files.read_json(folder / "routes.json")
    routes["line"]["points_m"] = [[-20.0, 0.0], [-8.0, 0.0]]
    files.write_json(folder / "routes.json", routes)
    loaded, text = load_scenario(folder / "scenario.toml")
    job = Job(loaded, text, loaded.build_policy(), folder / "run", frames=None)
    job.run(anyway=True)


def module(folder: Path, patch: pytest.MonkeyPatch) -> None:
    """Attack PilotNet, and write a training of it."""
    pilotnet(folder)
    (folder / "mine.py").write_text(MODULE)
