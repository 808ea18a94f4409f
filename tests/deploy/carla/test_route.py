"""Routes of the leaderboard: along lanes of the stand-in, and of the client's map."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from support.devices.carla import Map, Server
from support.faults.refusals import refusals

from mi_nerfattack.deploy.carla.route import read_leaderboard, town_routes

TOWN, API = Map("Carla/Maps/Town01"), Server().api()
#: Version 2, in CARLA's axes: straight on, and to the right; then one of version 1.
ROUTES = """<routes>
<route id="0" town="Town01"><weathers><weather/></weathers><waypoints>
<position x="0.0" y="-1.0" z="0.0"/><position x="80.0" y="0.5" z="0.0"/></waypoints>
<scenarios><scenario type="Accident"><trigger_point x="9" y="9" z="0"/></scenario>
</scenarios></route>
<route id="1" town="Town01"><waypoints><position x="10" y="0" z="0"/>
<position x="30" y="0" z="0"/><position x="60" y="30" z="0"/></waypoints></route>
<route id="2" town="Town02"><waypoint pitch="0" roll="0" x="1" y="2" yaw="90" z="3"/>
<waypoint pitch="0" roll="0" x="5" y="6" yaw="90" z="7"/></route></routes>"""


def written(folder: Path, text: str = ROUTES) -> Path:
    path = folder / "routes.xml"
    path.write_text(text)
    return path


def test_both_versions_are_read_in_our_axes(tmp_path):
    straight, right, old = read_leaderboard(written(tmp_path))
    assert straight.points.tolist() == [[0, 1, 0], [80, -0.5, 0]]
    assert (right.name, right.town, len(right.points)) == ("1", "Town01", 3)
    assert (old.town, old.points.tolist()) == ("Town02", [[1, -2, 3], [5, -6, 7]])


def test_routes_follow_the_lanes_of_their_town(tmp_path):
    straight, right = town_routes(written(tmp_path), TOWN, API, speed_ms=4.0)
    np.testing.assert_allclose(straight.points[[0, -1]], [[0, 0], [80, 0]], atol=1e-9)
    assert straight.lane_width_m == 3.5 and straight.speed_ms == 4.0
    # a turn to the right goes to our negative y
    np.testing.assert_allclose(right.points[-1], [60, -30], atol=0.75)
    assert right.length == pytest.approx(40 + 5 * math.pi + 20, abs=1.0)
    (only,) = town_routes(written(tmp_path), TOWN, API, ["1"])
    assert only.name == "1"


def way(town: str, *places: tuple[float, float]) -> str:
    text = "".join(f'<position x="{x}" y="{y}" z="0"/>' for x, y in places)
    head = f'<routes><route id="a" town="{town}"><waypoints>'
    return f"{head}{text}</waypoints></route></routes>"


@pytest.mark.parametrize("joint", [49.6, 49.9, 50.05, 50.9])
def test_positions_may_lie_anywhere_beside_the_joint_of_two_roads(tmp_path, joint):
    for first in (0.05, 0.85):
        text = way("Town01", (first, 0), (joint, 0), (80, 0))
        (route,) = town_routes(written(tmp_path, text), TOWN, API)
        assert route.length == pytest.approx(80 - first, abs=1.0)
        assert np.abs(np.diff(route.points[:, 1])).max() < 1e-9


def town(old="", new="", *names):
    text = ROUTES.replace(old, new) if old else ROUTES
    return lambda folder: town_routes(written(folder, text), TOWN, API, names)


test_routes_that_are_none = refusals(
    (town("<routes>", "<routes"), "routes.xml: not XML"),
    (town(ROUTES, "<routes/>"), "no <route>"),
    (town('id="1"', 'id="0"'), "route '0': .* id"),
    (town('id="1" town="Town01"', 'id="1"'), "route '1': .*a town"),
    (town('x="80.0"', 'x="far"'), "route '0': a position without x, y, z"),
    (town('x="80.0"', 'x="nan"'), "route '0': .*two finite positions"),
    (town("Town01", "Town05"), "'Town01'; .* Town02, T"),
    (town("", "", "2"), "no route '2' in 'Town01'; it has 0, 1"),
    (town('x="80.0" y="0.5"', 'x="80.0" y="-40"'), "position 1, .*40 m from"),
    (town('x="30"', 'x="4"'), "route '1': position 1, .*no lane"),
)


def test_a_route_along_an_opendrive_map_of_the_real_client(carla, tmp_path):
    """The lane's centre is 1.75 m right of the reference line."""
    town, text = carla.Map("bend", OPENDRIVE), way("bend", (1, 1), (61, -8))
    (route,) = town_routes(written(tmp_path, text), town, carla)
    # the arc turns left with radius 10 m about (50, 10), so the lane's has 11.75 m
    on_line = route.points[route.points[:, 0] < 50]
    np.testing.assert_allclose(on_line[:, 1], -1.75, atol=1e-3)
    in_bend = route.points[route.points[:, 0] > 50.01]
    radius = np.linalg.norm(in_bend - [50.0, 10.0], axis=1)
    np.testing.assert_allclose(radius, 11.75, atol=1e-2)
    assert in_bend[-1, 1] > 0  # to our left


@pytest.mark.parametrize("offset", [0.0, 0.25, 0.499999, 0.5, 0.500001, 0.75])
def test_a_way_is_found_from_any_place_of_a_lane(carla, offset, tmp_path):
    """Also from 10.5 m, where 11.5 and 12.5 are both rounded to 12."""
    town, x = carla.Map("bend", OPENDRIVE), 10.0 + offset
    text = way("bend", (x, 1), (x + 20, 1.75))
    (route,) = town_routes(written(tmp_path, text), town, carla)
    np.testing.assert_allclose(route.points[0], [x, -1.75], atol=1e-3)
    assert route.length == pytest.approx(20.0, abs=0.75)


def _road(number: int, line: str, length: float, link: str) -> str:
    """Write a road with one lane to the right of its line."""
    other, end, contact = link.split()
    return f"""<road name="r{number}" length="{length}" id="{number}" junction="-1">
<link><{end} elementType="road" elementId="{other}" contactPoint="{contact}"/></link>
<planView><geometry s="0" y="0" hdg="0" length="{length}" {line}</geometry></planView>
<elevationProfile/><lateralProfile/><lanes><laneSection s="0">
<center><lane id="0" type="none" level="false"/></center>
<right><lane id="-1" type="driving" level="false"><link><{end} id="-1"/></link>
<width sOffset="0" a="3.5" b="0" c="0" d="0"/></lane></right>
</laneSection></lanes></road>"""


OPENDRIVE = f"""<?xml version="1.0"?><OpenDRIVE>
<header revMajor="1" revMinor="4" name="bend" version="1" north="99" south="-99"
 east="99" west="-99"><geoReference><![CDATA[+proj=tmerc +lat_0=0 +lon_0=0]]>
</geoReference></header>
{_road(1, 'x="0"><line/>', 50.0, "2 successor start")}
{_road(2, 'x="50"><arc curvature="0.1"/>', 5 * math.pi, "1 predecessor end")}
</OpenDRIVE>"""
