"""Boxes with a colour a face, without an attack, and run folders of tiny attacks."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from helpers import attack_jobs
from helpers.small_fields import empty_border, vertices

from mi_nerfattack.fields import GridField, GridLayout, save_field
from mi_nerfattack.render.camera.pose import Pose
from mi_nerfattack.robot.attacked import AttackedBox

_POLICY = """\
file = "smooth.py:SmoothPolicy"
trust_code = true
goal = "integer"
goals = 3
"""
COLOURS = {
    "front": (200, 30, 30),
    "right": (30, 200, 30),
    "back": (30, 30, 200),
    "left": (200, 200, 30),
    "top": (200, 30, 200),
    "bottom": (30, 200, 200),
}


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
    raw = np.clip(400 * inside(at), -20, 6).astype(np.float32)
    field.set_parameter("density", raw)
    colour = np.clip(0.5 + 0.4 * at, 0.1, 0.9)
    field.set_parameter("texture", np.log(colour / (1 - colour)).astype(np.float32))
    return field


def cube_field(half: float = 0.5) -> GridField:
    """Return a cube in a field a tenth larger, as `asset` writes it."""
    field = solid(
        lambda at: (half - np.abs(at)).min(1), [-1.1 * half] * 3, [1.1 * half] * 3
    )
    corners = {"lower": -half, "upper": half}
    for name, value in corners.items():
        field.info[f"provenance.object_{name}"] = f"{value} {value} {value}"
    return field


def attacked_run(folder: Path, field: GridField) -> Path:
    """Attack an object once, of scale 1.5 at (7, 4.2, 1.6), and return the folder."""
    from mi_nerfattack.experiment.job import Job
    from mi_nerfattack.scenario.scenario import load_scenario

    attack_jobs.write_scenario(
        folder,
        {
            "max_iterations = 30": "max_iterations = 1",
            "textures = 4": "textures = 1",
            'file = "policy.safetensors"\n': _POLICY,
            "runs = 2": "runs = 1",
            "[drive]": "[camera]\nwidth = 24\nheight = 10\n[drive]",
            "[attack]\n": '[attack]\nparameters = "both"\npose_limit_m = 0.2\n',
        },
    )
    empty_border(field)
    save_field(folder / "object.safetensors", field)
    (folder / "smooth.py").write_text("from helpers.toy_loop import SmoothPolicy\n")
    scenario, text = load_scenario(folder / "scenario.toml")
    run = folder / "run"
    Job(scenario, text, scenario.build_policy(), run, frames=None).run(anyway=True)
    return run
