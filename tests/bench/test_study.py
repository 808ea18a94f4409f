"""Studies: tables that go on where they stopped, and places drawn by a rule."""

from __future__ import annotations

import json

import numpy as np
import pytest

from bench.study import distribution, robust, rows, steps, textures
from bench.study.places import NATURAL_M, ROUTES, Place
from mi_nerfattack.errors import InputError
from mi_nerfattack.scenario.scenario import load_scenario

pytestmark = pytest.mark.usefixtures("variant")


def test_a_table_goes_on_where_it_was_stopped(tmp_path):
    path, keys, made = tmp_path / "table.jsonl", [{"a": 1}, {"a": 2}, {"a": 3}], []

    def work(key):
        if len(made) == 2:
            raise KeyboardInterrupt
        made.append(key["a"])
        return {"square": key["a"] ** 2}

    def quiet(done, count, key):
        del done, count, key

    with pytest.raises(KeyboardInterrupt):
        rows.fill(path, keys, work, quiet)
    made[:] = [0]
    found = rows.fill(path, reversed(keys), work, quiet)
    assert made == [0, 3]
    assert [row["square"] for row in found] == [9, 4, 1]
    assert len(path.read_text().splitlines()) == 3
    path.write_text('{"a": 1}\n{"a":')
    with pytest.raises(InputError, match=r"table\.jsonl:2: .*delete the line"):
        rows.read(path)


def test_places_are_drawn_once_and_for_all_sizes(tmp_path):
    near, far = (
        Place(ROUTES[1], steps.LATERAL_M[name], steps.ARC_M, 0)
        for name in ("near", "far")
    )
    scenario, _ = load_scenario(near.write(NATURAL_M, steps.KEYS, tmp_path, seed=5))
    again, _ = load_scenario(near.write(2 * NATURAL_M, steps.KEYS, tmp_path))
    assert (scenario.seed, again.seed) == (5, 0)
    [first], [second] = scenario.objects, again.objects
    assert second.scale == pytest.approx(2 * first.scale, rel=1e-5)
    assert second.yaw_deg == pytest.approx(first.yaw_deg)
    shift = np.subtract(first.position_m, second.position_m)
    assert np.abs(shift).max() < 1.5  # a larger one keeps farther from the lane
    [other] = load_scenario(far.write(NATURAL_M, steps.KEYS, tmp_path))[0].objects
    assert other.position_m != first.position_m


def test_every_row_of_every_study_is_a_scenario(tmp_path):
    for study in (steps, robust, textures, distribution):
        keys = [json.dumps(key) for key in study.keys()]
        assert len(set(keys)) == len(keys)
    assert len(steps.keys()) == 72
    assert len(distribution.keys()) == 48
    place = Place(ROUTES[0], steps.LATERAL_M["near"], steps.ARC_M, 0)
    for row in robust.ROWS:
        path = place.write(1.5, robust.scenario_keys(row), tmp_path)
        scenario, _ = load_scenario(path)
        frames = scenario.attack.poses * scenario.attack.max_iterations
        assert frames == robust.DRIVES
    for row in textures.ROWS:
        load_scenario(place.write(1.5, textures.scenario_keys(row), tmp_path))
    load_scenario(place.write(1.5, distribution.KEYS, tmp_path))
