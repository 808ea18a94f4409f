"""CARLA (a stand-in) and recordings by name and as Gymnasium environments."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from helpers.carla_stand_in import Server
from helpers.recorded_drives import CAMERA, MOUNT, log_messages, write_folder, write_log

from mi_nerfattack.deploy.gym import DrivingEnv
from mi_nerfattack.deploy.place import Conditions, Place
from mi_nerfattack.deploy.registry import make_environment
from mi_nerfattack.errors import InputError
from mi_nerfattack.vehicle.route.route import Route

NONE = Path("none")
PLACE = Place(NONE, None, NONE, (), CAMERA, MOUNT)
ROUTE = Route("straight", 0, np.array([[0.0, 0.0], [90.0, 0.0]]))

pytestmark = [
    pytest.mark.usefixtures("variant"),
    # Gymnasium's advice to make the environment by its own registry, and on spaces
    pytest.mark.filterwarnings("ignore:.*WARN.*:UserWarning"),
]


@pytest.fixture
def server(monkeypatch) -> Server:
    """A stand-in server, whose client is what `import carla` finds."""
    found = Server()
    monkeypatch.setitem(sys.modules, "carla", found.api())
    return found


def test_carla_by_name(server):
    conditions = Conditions(sky="overcast", exposure_ev=0.5)
    environment = make_environment("carla", PLACE, conditions)
    environment.reset(ROUTE)
    assert server.weather.cloudiness == 60.0
    colour = next(a for a in server.actors.values() if a.type_id.endswith("rgb"))
    assert colour.attributes["exposure_compensation"] == "0.5"
    environment.close()
    assert server.is_as_before


def test_carla_by_name_without_a_server(server):
    server.answers = False
    with pytest.raises(InputError, match="CARLA at 127.0.0.1:2001: no answer within"):
        make_environment("carla", replace(PLACE, server="127.0.0.1:2001"))


def test_carla_equals_its_copy_for_100_steps(server):
    controls = np.random.default_rng(0).normal(0, 0.3, 100)
    runs = []
    for _ in range(2):
        environment = make_environment("carla", PLACE)
        frames = [environment.reset(ROUTE, seed=5)]
        frames += [environment.step(control) for control in controls]
        runs.append((frames, environment.state))
        environment.close()
    np.testing.assert_array_equal(runs[0][1], runs[1][1])
    for one, two in zip(runs[0][0], runs[1][0], strict=True):
        np.testing.assert_array_equal(one.image, two.image)
        np.testing.assert_array_equal(one.depth, two.depth)
        np.testing.assert_array_equal(one.camera_to_world, two.camera_to_world)


def test_gymnasium_accepts_carla(server):
    env = DrivingEnv(make_environment("carla", PLACE), [ROUTE])
    check_env(env, skip_render_check=True)
    env.close()
    assert server.is_as_before


def test_an_episode_in_a_recording_is_truncated_at_its_end(tmp_path):
    place = replace(PLACE, recording=write_folder(tmp_path / "frames"))
    env = DrivingEnv(make_environment("replay", place), [ROUTE])
    env.reset(seed=0)
    ends = [env.step(np.zeros(1, np.float32))[3] for _ in range(5)]
    assert ends == [False, False, False, False, True]
    env.close()


DOCS = Path(__file__).parents[2] / "docs" / "environments.md"


def documented(heading: str) -> str:
    """The first Python block under a heading of the documentation."""
    section = DOCS.read_text("utf-8").split(f"\n## {heading}\n")[1]
    return section.split("```python\n")[1].split("```")[0]


def test_the_documented_drive_in_carla(server):
    names: dict = {}
    exec(documented("CARLA"), names)
    assert names["frame"].image.shape == (66, 200, 3)
    assert server.town == "Town03" and server.is_as_before


def test_the_documented_replay(tmp_path, monkeypatch):
    topics = log_messages(tmp_path)
    del topics["/camera/calibration"]
    write_log(tmp_path / "drive.mcap", topics)
    monkeypatch.chdir(tmp_path)
    code = documented("Replay").replace("366, 188, 75.0", "16, 8, 90.0")
    names: dict = {}
    exec(code, names)
    assert names["environment"].reset(ROUTE).image.shape == (8, 16, 3)
