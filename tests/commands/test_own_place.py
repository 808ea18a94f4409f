"""Where `evaluate` drives the policy of a scenario."""

from __future__ import annotations

import numpy as np
import pytest
import tomlkit

from mi_nerfattack.commands.shared.policy_file import PolicyFile
from mi_nerfattack.deploy.place import bundled_place
from mi_nerfattack.scenes import bundled
from mi_nerfattack.training.presets import EVALUATIONS, evaluation_for

TURNED = [[0.0, -2.0, 0.0, 3.0], [2.0, 0.0, 0.0, -1.0], [0, 0, 2.0, 0], [0, 0, 0, 1]]


@pytest.mark.parametrize("to_world", [None, TURNED])
def test_the_field_stands_where_the_scenario_puts_it(tmp_path, to_world):
    table = tomlkit.parse(bundled("room.toml").read_text(encoding="utf-8")).unwrap()
    if to_world is not None:
        table["scene"]["to_world"] = to_world
    path = tmp_path / "scenario.toml"
    path.write_text(tomlkit.dumps(table), encoding="utf-8")
    place = PolicyFile.read(str(path)).place(bundled_place("intersection"), False)
    assert place.field == bundled("room/field.safetensors")
    if to_world is None:
        assert place.field_pose is None
    else:
        assert place.field_pose is not None
        moved = place.field_pose.apply(np.array([[1.0, 0, 0]]))
        assert moved[0].tolist() == pytest.approx([3, 1, 0])


@pytest.mark.parametrize(("width_m", "name"), [(0.296, "room"), (1.9, "intersection")])
def test_starts_and_objects_are_those_for_a_car_of_its_size(width_m, name):
    assert evaluation_for(width_m) is EVALUATIONS[name]
