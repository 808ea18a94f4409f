"""The command that evaluates policies in a town of CARLA; no server runs."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from helpers.carla_stand_in import Server

from mi_nerfattack import cli
from mi_nerfattack.deploy.carla import environment as carla_environment
from mi_nerfattack.io import files

pytestmark = pytest.mark.usefixtures("variant")

ROUTES = {
    "straight": {
        "goal": 0,
        "points_m": [[2, 0], [40, 0]],
        "lane_width_m": 3.5,
        "speed_ms": 5.0,
    }
}
TOWN = ["--server", "127.0.0.1:2000/Town01", "--routes-file", "routes.json"]


@pytest.fixture
def server(tmp_path, monkeypatch) -> Server:
    """A stand-in that the command finds, and files of a policy and its routes."""
    found = Server()
    monkeypatch.setattr(carla_environment, "load_client", found.api)
    monkeypatch.chdir(tmp_path)
    files.write_json("routes.json", ROUTES)
    Path("still.py").write_text("def drive(image, goal, step):\n    return [0.0]\n")
    return found


def evaluate(*more: str) -> int:
    start = ["evaluate", "still.py:drive", "--kind", "callable", "--runs", "1"]
    start += ["--trust-code"]
    return cli.main([*start, "--horizon", "3", "--environments", *more])


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


def test_ctrl_c_gives_the_town_back(server, capsys):
    server.interrupted = server.frame + 17  # within the first drive
    assert evaluate("carla", *TOWN) == 130
    assert server.is_as_before
    capsys.readouterr()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["carla"], "give --server HOST:PORT/TOWN and --routes-file"),
        (["carla", *TOWN[:2]], "give --server HOST:PORT/TOWN and --routes-file"),
        (["carla", *TOWN[2:]], "give --server HOST:PORT/TOWN and --routes-file"),
        (
            ["carla", "--server", "127.0.0.1:2000", *TOWN[2:]],
            "give --server HOST:PORT/TOWN and --routes-file",
        ),
        (["carla", "--server", "nowhere", *TOWN[2:]], "server: 'nowhere'; HOST:PORT"),
        (["carla", *TOWN, "--workers", "2"], "workers: several processes for"),
        (["carla", "mitsuba", *TOWN], "needs the town's --scene"),
        (["carla", *TOWN, "--object", "box.safetensors"], "needs the town's --scene"),
        (["mitsuba", *TOWN], "--server: '127.0.0.1:2000/Town01'; only the environment"),
    ],
)
def test_what_a_town_needs_is_said_first(server, capsys, options, message):
    assert evaluate(*options) == 2
    errors = capsys.readouterr().err
    assert message in errors and "Traceback" not in errors
    assert server.frame == 100 and not Path("runs").exists()
