"""The command that evaluates policies in a town of CARLA; no server runs."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest
from support.devices.carla import Server
from support.worlds.places import straight, write_place

from mi_nerfattack import cli
from mi_nerfattack.deploy.carla import environment as carla_environment
from mi_nerfattack.deploy.carla import session
from mi_nerfattack.deploy.place import Conditions
from mi_nerfattack.drives.store import Store
from mi_nerfattack.evaluation.evaluate import EvaluateSettings
from mi_nerfattack.evaluation.identity import EnvironmentUnder
from mi_nerfattack.evaluation.work import EvaluateDrives, load_objects
from mi_nerfattack.io import files
from mi_nerfattack.scenario.policy.kinds import HttpSection

pytestmark = pytest.mark.usefixtures("variant")

ROUTE = {"goal": 0, "points_m": [[2, 0], [40, 0]], "lane_width_m": 3.5, "speed_ms": 5}
TOWN = ["--server", "127.0.0.1:2000/Town01", "--routes-file", "routes.json"]


@pytest.fixture
def server(tmp_path, monkeypatch) -> Server:
    """A stand-in that the command finds, and files of a policy and its routes."""
    stand_in = Server()
    monkeypatch.setattr(carla_environment, "load_client", stand_in.api)
    monkeypatch.chdir(tmp_path)
    files.write_json("routes.json", {"straight": ROUTE})
    Path("still.py").write_text("def drive(image, goal, step):\n    return [0.0]\n")
    return stand_in


def evaluate(*arguments: str) -> int:
    start = ["evaluate", "still.py:drive", "--runs", "1"]
    start += ["--set", "policy.kind=callable", "--set", "policy.trust_code=true"]
    return cli.main([*start, "--horizon", "3", "--environments", *arguments])


def test_a_town_is_driven_in_this_process_and_given_back(server, capsys):
    assert evaluate("carla", *TOWN, "--json", "--page", "out") == 0
    read = capsys.readouterr()
    figures = json.loads(read.out)["carla"]["straight"]
    assert list(figures) == ["no_object"] and figures["no_object"]["n"] == 1
    assert figures["no_object"]["expert"]["n"] == 1
    assert "no drives past objects: a town its --scene" in read.err
    text = Path("out/still-drive.md").read_text()
    assert "CARLA's Town01" in text and "scene.xml" not in text
    assert server.is_as_before


def test_routes_of_the_leaderboard_are_driven(server, capsys, monkeypatch):
    monkeypatch.setattr(session, "load_client", server.api)
    xml = """<routes><route id="7" town="Town01"><waypoints>
    <position x="2" y="0" z="0"/><position x="40" y="0" z="0"/></waypoints></route>
    </routes>"""
    Path("routes.xml").write_text(xml)
    assert evaluate("carla", *TOWN[:3], "routes.xml", "--json") == 0
    assert list(json.loads(capsys.readouterr().out)["carla"]) == ["7"]
    assert server.is_as_before
    assert evaluate("mitsuba", "--routes-file", "routes.xml") == 2  # without a town


def test_objects_stand_beside_routes_of_the_leaderboard(tmp_path):
    """Objects keep off the lanes that were followed in the town: the XML has none."""
    place = replace(write_place(tmp_path), routes=tmp_path / "routes.xml")
    place.routes.write_text("<routes/>")
    work = EvaluateDrives(
        store=Store(tmp_path),
        policy=HttpSection(kind="http", url="http://a:1"),
        place=place,
        environments=(EnvironmentUnder("carla", Conditions()),),
        routes=(straight(),),
        settings=EvaluateSettings(),
    )
    objects, surroundings = load_objects(work)
    assert len(objects) == 1 and surroundings is not None
    assert surroundings.routes == work.routes


def test_ctrl_c_gives_the_town_back(server):
    server.interrupted = server.frame + 17  # within the first drive
    assert evaluate("carla", *TOWN) == 130
    assert server.is_as_before


@pytest.mark.parametrize(
    ("options", "where"),
    [
        (["carla", *TOWN[:2]], "--environments"),
        (["carla", *TOWN[2:]], "--environments"),
        (["carla", "--server", "127.0.0.1:2000", *TOWN[2:]], "--environments"),
        (["carla", "--server", "nowhere", *TOWN[2:]], "server"),
        (["carla", *TOWN, "--workers", "2"], "workers"),
        (["carla", *TOWN, "--object", "box.safetensors"], "--environments"),
        (["mitsuba", *TOWN], "--server"),
    ],
)
def test_what_a_town_needs_is_said_first(server, capsys, options, where):
    assert evaluate(*options) == 2
    assert f"error: {where}: " in capsys.readouterr().err
    assert server.frame == 100 and not Path("runs").exists()
