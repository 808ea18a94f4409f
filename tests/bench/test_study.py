"""Studies: tables that go on where they stopped, and places drawn by a rule."""

from __future__ import annotations

import json

import numpy as np
import pytest

from bench.study import distribution, robust, rows, seeds, steps, textures
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


def test_places_are_those_that_the_protocols_were_committed_with():
    """The first place of each route, as the rule drew it before any result."""
    limits = distribution.LATERAL_M, distribution.ARC_M
    found = [Place(route, *limits, 0).pose(NATURAL_M) for route in ROUTES]
    expected = [
        [-16.92941042, -5.89178344, 0.11999512],
        [0.10573977, -5.57416764, 0.0],
        [-3.59223909, -4.75881706, 0.0],
    ]
    np.testing.assert_allclose([p.translation for p in found], expected, atol=1e-6)


def test_every_row_of_every_study_is_a_scenario(tmp_path):
    for study in (steps, robust, textures, seeds, distribution):
        keys = [json.dumps(key) for key in study.keys()]
        assert len(set(keys)) == len(keys)
    assert len(steps.keys()) == 72
    assert len(distribution.keys()) == 48
    place = Place(ROUTES[0], steps.LATERAL_M["near"], steps.ARC_M, 0)
    for row in robust.ROWS:
        path = place.write(1.5, robust.scenario_keys(row), tmp_path)
        scenario, _ = load_scenario(path)
        frames = scenario.attack.poses * scenario.attack.method.max_iterations
        assert frames == robust.DRIVES
    for row in textures.ROWS:
        load_scenario(place.write(1.5, textures.scenario_keys(row), tmp_path))
    assert load_scenario(seeds.write(tmp_path, 2))[0].seed == 2
    load_scenario(place.write(1.5, distribution.KEYS, tmp_path))


def cells(table):
    """Return the rows of a table, texts by column."""
    names = [str(column.header) for column in table.columns]
    lines = zip(*(column.cells for column in table.columns), strict=True)
    return [dict(zip(names, line, strict=True)) for line in lines]


def made_row(attack, random, **more):
    case = {"wheel_out_s": 0.5, "drives_departed": 1, "n": 4}
    cases = {
        "attack": {"cross_track_mean_m": attack, **case},
        **{name: {"cross_track_mean_m": random} for name in ("own", "random")},
        "best_random": {"cross_track_mean_m": 2 * random},
    }
    names = ("surrogate", "deployment", *robust.DEPLOYMENTS)
    figures = {"flags": [], "saturated_share": 0.5, "total_variation": 0.1}
    figures["textures"] = {"hydrant": {"spectrum": [0.75, 0.25]}}
    return {**more, **figures, "environments": dict.fromkeys(names, cases)}


def test_steps_are_compared_at_equal_frames():
    found = [
        {
            **key,
            "best_mean_m": 0.2 if key["variant"] == "raw" else 0.6,
            "mean_m": [0.1, 0.2, 0.3],
            "texture": {"saturated_share": 0.5, "total_variation": 0.1},
        }
        for key in steps.keys()
    ]
    lines = {
        (line["variant"], line["rate"]): line for line in cells(steps.table(found))
    }
    assert len(lines) == 12
    other = lines["smoothed", "0.1"]
    assert (other["geometric mean"], other["to raw 0.3"]) == ("0.600", "3.000")
    assert other["iterations to raw 0.3"] == "1"
    cut = cells(steps.table(found[:-1]))
    assert len(cut) == 11  # no mean of five places beside means of six
    begun = {line["to raw 0.3"] for line in cells(steps.table(found[:25]))}
    assert begun == {""}


def test_errors_and_transfer_are_averaged_as_ratios(tmp_path):
    same = made_row(0.1, 0.05, kind="level 16")
    same["textures"] = {"hydrant": {"spectrum": []}}
    [line] = cells(textures.table([same]))
    assert line["spectrum: 1, 2, 4, ... voxels"] == ""
    both = [made_row(0.1, 0.05, kind="default"), made_row(0.4, 0.1, kind="default")]
    [line] = cells(textures.table(both))
    assert (line["surrogate, m"], line["transfer"]) == ("0.200", "1.000")
    assert line["spectrum: 1, 2, 4, ... voxels"] == "0.75, 0.25"
    [line] = cells(robust.table([{**row, "parts": "all"} for row in both]))
    assert (line["attacks"], line["noisy, m (transfer)"]) == ("2", "0.200 (1.00)")
    [line] = cells(seeds.table([{**both[0], "seed": 1}]))
    assert (line["to random"], line["to best random"]) == ("2.000", "1.000")
    places = [{**row, **key} for row in both for key in distribution.keys()[:24]]
    table = distribution.table(places)
    assert "1.50 m, deployment: 0 of 24" in table.caption
    listed = cells(table)
    assert len(listed) == 48
    assert {line["to random"] for line in listed} == {"2.000", "4.000"}
    distribution.draw(tmp_path / "places.png", places)
    assert (tmp_path / "places.png").stat().st_size > 10000
