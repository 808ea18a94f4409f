"""CARLA (a stand-in) and recordings by name, and as the documentation has them."""

from __future__ import annotations

import sys
import textwrap
from pathlib import Path

import numpy as np
import pytest
from support.devices.carla import Server
from support.files.recordings import CAMERA, MOUNT, log_messages, write_log

from mi_nerfattack.deploy.place import Conditions, Place
from mi_nerfattack.deploy.registry import make_environment
from mi_nerfattack.vehicle.route.route import Route

NONE = Path("none")
PLACE = Place(NONE, None, NONE, (), CAMERA, MOUNT)
ROUTE = Route("straight", 0, np.array([[0.0, 0.0], [90.0, 0.0]]))

pytestmark = pytest.mark.usefixtures("variant")


@pytest.fixture
def server(monkeypatch) -> Server:
    """A stand-in server, whose client is what `import carla` finds."""
    stand_in = Server()
    monkeypatch.setitem(sys.modules, "carla", stand_in.api())
    return stand_in


def test_carla_by_name(server):
    conditions = Conditions(sky="overcast", exposure_ev=0.5)
    environment = make_environment("carla", PLACE, conditions)
    environment.reset(ROUTE)
    assert server.weather.cloudiness == 60.0
    colour = next(a for a in server.actors.values() if a.type_id.endswith("rgb"))
    assert colour.attributes["exposure_compensation"] == "0.5"
    environment.close()
    assert server.is_as_before


DOCS = Path(__file__).parents[2] / "docs/howto"


def documented(page: str) -> str:
    """The first Python block of a page of the documentation."""
    block = (DOCS / page).read_text("utf-8").split("```python\n")[1].split("```")[0]
    return textwrap.dedent(block)


def test_the_documented_drive_in_carla(server):
    names: dict = {}
    exec(documented("carla.md"), names)
    assert names["frame"].image.shape == (66, 200, 3)
    assert server.town == "Town03" and server.is_as_before


def test_the_documented_replay(tmp_path, monkeypatch):
    topics = log_messages(tmp_path)
    del topics["/camera/camera_info"]
    write_log(tmp_path / "drive.mcap", topics)
    monkeypatch.chdir(tmp_path)
    code = documented("replay.md").replace("366, 188, 75.0", "16, 8, 90.0")
    names: dict = {}
    exec(code, names)
    assert names["environment"].reset(ROUTE).image.shape == (8, 16, 3)
