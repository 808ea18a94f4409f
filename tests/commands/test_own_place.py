"""Where `evaluate` drives the policy of a scenario."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import tomlkit

from mi_nerfattack.commands.evaluate import Evaluate
from mi_nerfattack.commands.shared.evaluate_options import (
    PlaceOptions,
    PolicyOptions,
)
from mi_nerfattack.commands.shared.policy_file import PolicyFile
from mi_nerfattack.deploy.place import bundled_place
from mi_nerfattack.errors import InputError
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


@pytest.mark.usefixtures("variant")
def test_a_place_that_is_named_counts_though_it_is_the_usual_one(tmp_path):
    room = Evaluate(str(bundled("room.toml")), drives=tmp_path)
    assert room._work().place.scene == bundled("room/scene.xml")
    # of that place, which the policy of the room cannot drive
    with pytest.raises(InputError, match=r"goal: \[1\]; at least 0"):
        replace(room, where=PlaceOptions(place="intersection"))._work()


def test_a_scale_that_is_named_counts_though_it_is_the_usual_one():
    with pytest.raises(InputError, match="leave out .*--control-scale"):
        PolicyOptions(control_scale=1.0).section(str(bundled("room.toml")))
