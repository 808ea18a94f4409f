"""How hard a policy steers back, by a policy and images of which that is known."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import mitsuba as mi
import numpy as np
import pytest

from bench.__main__ import main
from bench.table2 import steering
from bench.table2.steering import errors, lines, measure
from mi_nerfattack import cli
from mi_nerfattack.deploy.driving import policy_image
from mi_nerfattack.deploy.registry import kinematic_vehicle
from mi_nerfattack.deploy.surrogate.environment import SurrogateEnvironment
from mi_nerfattack.errors import InputError
from mi_nerfattack.experiment.sweep.reproduce import read_replay
from mi_nerfattack.experiment.sweep.table import RESULTS, read_table, write_table
from mi_nerfattack.scenario.world import build_world
from mi_nerfattack.vehicle.route.route import Route

pytestmark = pytest.mark.usefixtures("variant")
PER_RAD = 3.0
TABLE2 = Path(__file__).parents[2] / "docs" / "table2"


class Sensor:
    """Shows place and turn as colours of a pixel, and a texture in others.

    The road runs to the upper right, at 45 degrees.
    """

    def __init__(self, fields: list[Any]) -> None:
        self.fields = fields

    def observe(self, state: Any, step: int) -> Any:
        x, y, heading = np.array(state)[:, 0]
        image = np.zeros((1, 2, 2, 3), np.float32)
        aside, turned = (y - x) / np.sqrt(2), heading - np.pi / 4
        image[0, 0, 0] = 0.5 + aside, 0.5 + turned, 0.1 * step
        for field in self.fields:
            image[0, 1, : 1 + (step > 0)] = field.raw > 0
        return SimpleNamespace(image=mi.TensorXf(image))


class Policy:
    """Steers back by the colours, less and less hard: 0.5 - 0.1 step per metre."""

    def initial_memory(self, count: int) -> None:
        del count

    def step(self, image: Any, goal: int, memory: None) -> tuple[Any, None]:
        del goal
        aside, turned, blue = np.array(image)[0, 0, 0] - [0.5, 0.5, 0]
        return [-(0.5 - blue) * aside - PER_RAD * turned], memory


class Field:
    n_vertices, raw = 4, 0.0

    def set_parameter(self, name: str, value: Any) -> None:
        assert name == "texture"
        self.raw = float(value.mean())


def world(unit: str = "rad/s") -> Any:
    field = Field()
    car = SimpleNamespace(control_unit=unit)
    return SimpleNamespace(
        scenario=SimpleNamespace(name="slant", drive=SimpleNamespace(start_m=1.0)),
        route=Route("slant", 0, np.array([[0.0, 0], [20, 20]])),
        place=SimpleNamespace(car=car, period=0.1),
        surrogate=Sensor([field]),
        without_objects=lambda: Sensor([]),
        fields=[field],
        policy=Policy(),
        horizon=5,
    )


def test_gains_and_shares_are_those_of_the_policy_and_the_image():
    """Colours have eight bits, so that a gain is known to some hundredths."""
    first, second = measure(world())
    assert (first["along_m"], second["along_m"]) == (1.0, 3.0)
    assert (first["share"], second["share"]) == (0.25, 0.5)
    assert first["per_m"] == pytest.approx(0.5, abs=0.02)
    assert second["per_m"] == pytest.approx(0.1, abs=0.02)
    assert first["per_rad"] == pytest.approx(PER_RAD, rel=0.1)
    with pytest.raises(InputError, match="its control is in rad; give a sweep"):
        measure(world("rad"))


def test_a_line_has_means_the_most_and_the_least():
    case = {"environment": "surrogate", "cell": "a"}
    rows = [
        case | {"case": name, "cross_track_mean_m": error}
        for name, error in (
            ("no_object", 0.1),
            ("random", 0.1),
            ("random", 0.3),
            ("attack", 0.6),
            ("own", 9.0),
        )
    ]
    rows.append(rows[0] | {"environment": "deployment", "cross_track_mean_m": 9.0})
    own = errors(rows, "a")
    assert own == pytest.approx({"no_object": 0.1, "random": 0.2, "attack": 0.6})
    look = {"along_m": 4.0, "share": 0.02, "per_m": 0.5, "per_rad": 3.0}
    weak = {"along_m": 6.0, "share": 0.1, "per_m": -0.1, "per_rad": 5.0}
    place = {"route": "left", **own}
    [line] = lines([place | {"looks": [look, look]}, place | {"looks": [look, weak]}])
    assert line[:8] == ("left", "2", "4.0", "10.0", "0.35", "-0.10", "6", "3.50")
    assert line[8:] == ("0.100", "0.200", "0.600", "0.400")


def test_the_largest_change_counts_while_both_drives_see_alike(tmp_path):
    """The second step changes most; later the drives are apart."""
    steps = {
        "own": [(0.0, 0.0), (0.1, 0.0), (0.0, 0.0), (0.0, 0.0)],
        "attack": [(0.2, 0.1), (-0.5, 0.3), (1.5, 0.6), (1.0, 0.9)],
    }
    lines = ["environment,case,run,control,cross_track_m"]
    for case, rows in steps.items():
        lines += [f"surrogate,{case},0,{control},{aside}" for control, aside in rows]
        lines += [f"deployment,{case},0,{9 * (case == 'own')},0"]
    (tmp_path / "steps.csv").write_text("\n".join(lines))
    change = steering.largest_change(tmp_path / "steps.csv", 0.5)
    assert change == pytest.approx({"control": 0.6, "along_m": 0.5})
    places = [{"route": "left", "change": change}, {"route": "right"}]
    places.append({"route": "left", "change": {"control": 1.0, "along_m": 4.0}})
    [line] = steering.changed_lines(places)
    assert line == ("left", "2", "0.60 to 1.00", "0.5 to 4.0")


@pytest.fixture
def one_place(tmp_path):
    """Give the table of one place of Table 2."""
    pytest.importorskip("pyarrow")
    rows = read_table(TABLE2 / RESULTS)
    cell = next(row["cell"] for row in rows if row["route"] == "right")
    own = [row for row in rows if row["cell"] == cell]
    texts = read_table(TABLE2 / RESULTS, ["cell", "scenario"], [cell])
    pairs = zip(own, texts, strict=True)
    write_table(tmp_path / RESULTS, [row | text for row, text in pairs])
    return tmp_path


@pytest.mark.slow
def test_the_command_sees_what_an_environment_shows(one_place, monkeypatch, capsys):
    """Controls are those in frames of the surrogate as an environment, aside."""
    monkeypatch.setattr(steering, "EVERY", 40)
    assert main(["steering", str(one_place), "--json"]) == 0
    [place] = json.loads(capsys.readouterr().out)["places"]
    [cell] = read_replay(one_place, ["0"]).cells
    world = build_world(cell.scenario, cell.scenario.policy.build())
    vehicle = kinematic_vehicle(world.place)
    shown = SurrogateEnvironment(world.without_objects(), vehicle)
    look, route = place["looks"][0], world.route
    controls = []
    for aside in (steering.ASIDE_M, -steering.ASIDE_M):
        pose = route.pose_at(look["along_m"], aside)
        image = policy_image(shown.reset(route, pose, 0).image)
        memory = world.policy.initial_memory(1)
        control, _ = world.policy.step(image, route.goal, memory)
        controls.append(float(np.array(control)[0]))
    wanted = (controls[1] - controls[0]) / (2 * steering.ASIDE_M)
    assert look["per_m"] == pytest.approx(wanted, rel=1e-6) and wanted > 0
    assert len(place["looks"]) == 2 and 0 < look["share"] < 1


def test_a_sweep_with_several_methods_is_refused(one_place, capsys):
    rows = read_table(one_place / RESULTS)
    texts = read_table(one_place / RESULTS, ["cell", "scenario"])
    many = [row | text for row, text in zip(rows, texts, strict=True)]
    many.append(many[0] | {"method": "random"})
    write_table(one_place / RESULTS, many)
    assert main(["steering", str(one_place)]) == cli.EXIT_INPUT
    assert "the methods gradient, random; give" in capsys.readouterr().err
