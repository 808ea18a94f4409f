"""A place whose environments are painted, and the command that evaluates there."""

from __future__ import annotations

from pathlib import Path

import pytest
from helpers.roadside import Grey, PaintedEnvironment

from mi_nerfattack.evaluation import work as evaluate_work
from mi_nerfattack.io import files

ROUTES = {
    "straight": {
        "goal": 0,
        "points_m": [[0, 0], [20, 0], [40, 0]],
        "lane_width_m": 3.5,
        "speed_ms": 5.0,
    }
}
SCENE = """<scene version="3.0.0">
<integrator type="direct"/>
<shape type="rectangle"><transform name="to_world">
<scale x="90" y="90"/></transform></shape>
<emitter type="constant"/>
</scene>"""
CALLABLE = ("--kind", "callable", "--trust-code")
STILL = "def drive(image, goal, step):\n    return [0.0] * len(image)\n"


def make_place(folder: Path, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Files of a place and a policy, and the painted environment under every name."""
    (folder / "scene.xml").write_text(SCENE)
    (folder / "still.py").write_text(STILL)
    files.write_json(folder / "routes.json", ROUTES)
    made: list[PaintedEnvironment] = []

    def make(name, where, conditions=None):
        made.append(PaintedEnvironment(where.camera, Grey()))
        made[-1].name = name
        return made[-1]

    monkeypatch.setattr(evaluate_work, "make_environment", make)
    monkeypatch.chdir(folder)
    options = ["--scene", "scene.xml", "--routes-file", "routes.json"]
    options += ["--workers", "1", *CALLABLE, "--runs", "2"]
    return ["evaluate", "still.py:drive", "--environments", "mitsuba", *options]


def with_policy(name: str, place: list[str]) -> list[str]:
    """Name a policy that needs no word about how it is called."""
    return ["evaluate", name, *(word for word in place[2:] if word not in CALLABLE)]
