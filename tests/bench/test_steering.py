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
from bench.table2.steering import errors, lines, measure

pytestmark = pytest.mark.usefixtures("variant")
PER_M, PER_RAD = 0.5, 3.0


class Sensor:
    """Shows where the vehicle is in two colours of a pixel, and a texture in one."""

    def __init__(self, fields: list[Any]) -> None:
        self.fields = fields

    def showing(self, objects: list[Any]) -> Sensor:
        return Sensor(objects)

    def observe(self, state: Any, step: int) -> Any:
        del step
        _, aside, turned = np.array(state)[:, 0]
        image = np.zeros((1, 2, 2, 3), np.float32)
        image[0, 0, 0] = 0.5 + aside, 0.5 + turned, 0
        for field in self.fields:
            image[0, 1, 1] = field.raw > 0
        return SimpleNamespace(image=mi.TensorXf(image))


class Policy:
    """Steers back to the axis, by the colours."""

    def initial_memory(self, count: int) -> None:
        del count

    def step(self, image: Any, goal: int, memory: None) -> tuple[Any, None]:
        del goal
        aside, turned = np.array(image)[0, 0, 0, :2] - 0.5
        return [-PER_M * aside - PER_RAD * turned], memory


class Field:
    n_vertices, raw = 4, 0.0

    def set_parameter(self, name: str, value: Any) -> None:
        assert name == "texture"
        self.raw = float(value.mean())


def world() -> Any:
    field = Field()
    scenario = SimpleNamespace(
        drive=SimpleNamespace(start_m=1.0), vehicle=SimpleNamespace(dt_s=0.1)
    )
    route = SimpleNamespace(speed_ms=5.0, goal=0, pose_at=lambda along: [along, 0, 0])
    return SimpleNamespace(
        scenario=scenario,
        route=route,
        surrogate=Sensor([field]),
        fields=[field],
        policy=Policy(),
        horizon=9,
    )


def test_gains_and_shares_are_those_of_the_policy_and_the_image():
    """Colours have eight bits, so that a metre is known to a hundredth."""
    found = measure(world())
    assert found["share"] == found["share_most"] == 0.25
    assert found["per_m"] == pytest.approx(PER_M, rel=0.03)
    assert found["per_m_least"] == pytest.approx(PER_M, rel=0.03)
    assert found["per_rad"] == pytest.approx(PER_RAD, rel=0.1)


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
    place = {"route": "left", "seed": 1, **own, "share": 0.02, "share_most": 0.1}
    place |= {"per_m": 0.5, "per_m_least": 0.3, "per_rad": 3.0}
    other = place | {"share": 0.04, "share_most": 0.05, "per_m_least": -0.1}
    [line] = lines([place, other])
    assert line[:7] == ("left", "2", "3.0", "10.0", "0.50", "-0.10", "3.00")
    assert line[7:] == ("0.100", "0.200", "0.600", "0.400")


@pytest.mark.slow
def test_the_command_looks_at_the_places_of_a_table(tmp_path, capsys):
    """One place of Table 2, whose errors are the table's."""
    pytest.importorskip("pyarrow")
    from mi_nerfattack.experiment.sweep.table import RESULTS, read_table, write_table

    path = Path(__file__).parents[2] / "docs" / "table2" / RESULTS
    rows = read_table(path)
    cell = next(row["cell"] for row in rows if row["route"] == "right")
    own = [row for row in rows if row["cell"] == cell]
    texts = read_table(path, ["cell", "scenario"], [cell])
    pairs = zip(own, texts, strict=True)
    write_table(tmp_path / RESULTS, [row | text for row, text in pairs])
    assert main(["steering", str(tmp_path), "--json"]) == 0
    [place] = json.loads(capsys.readouterr().out)["places"]
    assert place["attack"] > 2 * place["random"] > 0.05
    assert 0.5 < place["per_m"] < 0.8 and 0.01 < place["share"] < 0.1
