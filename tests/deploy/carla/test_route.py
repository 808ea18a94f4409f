"""Routes along the lanes of a town: of the stand-in, and of the client's own map."""

from __future__ import annotations

import math

import numpy as np
import pytest
from helpers.carla_stand_in import Map, Server

from mi_nerfattack.deploy.carla.route import route_from_town
from mi_nerfattack.errors import InputError

TOWN, API = Map("Town01"), Server().api()


def test_a_route_straight_on():
    route = route_from_town(TOWN, API, (0.0, 1.0), distance_m=80.0, speed_ms=4.0)
    np.testing.assert_allclose(route.points[0], [0, 0], atol=1e-9)
    np.testing.assert_allclose(route.points[-1], [80, 0], atol=1e-9)
    assert route.lane_width_m == 3.5 and route.speed_ms == 4.0


def test_a_route_to_the_right_goes_to_our_negative_y():
    route = route_from_town(TOWN, API, (0, 0), distance_m=90.0, turns=["right"])
    assert route.points[-1, 0] == pytest.approx(60.0)
    assert route.points[-1, 1] == pytest.approx(-(10 + 40 - 5 * math.pi))


def test_a_route_to_an_end():
    route = route_from_town(TOWN, API, (10, 0), end=(60.0, -30.0))
    np.testing.assert_allclose(route.points[-1], [60, -30], atol=0.75)
    assert route.length == pytest.approx(40 + 5 * math.pi + 20, abs=1.0)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({}, "give either end or distance_m"),
        ({"end": (9, 0), "distance_m": 3.0}, "give either end or distance_m"),
        ({"distance_m": 300.0}, "the lane ends after 90 of 300 m"),
        ({"distance_m": 0.0}, "distance_m 0.0; more than 0"),
        ({"distance_m": 9.0, "turns": ["up"]}, "turn: 'up'; one of straight"),
        ({"distance_m": 9.0, "turns": ["left"]}, "turns: left; .* no fork for it with"),
        ({"end": (60.0, -30.0), "turns": ["left"]}, "turns: left; those of a route by"),
        ({"end": (1.0, 0.0)}, r"no way from \[10.0, 0.0\] to \[1.0, 0.0\]"),
        ({"end": (math.nan, 0.0)}, "finite numbers"),
        ({"distance_m": 9.0, "spacing_m": 0.0}, "spacing_m 0.0; 0.1 to 10 m"),
    ],
)
def test_routes_that_are_none(arguments, message):
    with pytest.raises(InputError, match=message):
        route_from_town(TOWN, API, (10.0, 0.0), **arguments)


def test_a_route_along_an_opendrive_map_of_the_real_client(carla):
    town = carla.Map("bend", OPENDRIVE)
    # the lane's centre is 1.75 m right of the reference line; the arc turns left
    # with radius 10 m about (50, 10), so the lane's has 11.75 m
    route = route_from_town(town, carla, (1.0, -1.0), distance_m=60.0)
    on_line = route.points[route.points[:, 0] < 50]
    np.testing.assert_allclose(on_line[:, 1], -1.75, atol=1e-3)
    in_bend = route.points[route.points[:, 0] > 50.01]
    radius = np.linalg.norm(in_bend - [50.0, 10.0], axis=1)
    np.testing.assert_allclose(radius, 11.75, atol=1e-2)
    assert in_bend[-1, 1] > 0  # to our left
    there = route_from_town(town, carla, (1.0, -1.0), end=in_bend[-1])
    np.testing.assert_allclose(there.points[-1], in_bend[-1], atol=0.8)


@pytest.mark.parametrize("offset", [0.0, 0.25, 0.499999, 0.5, 0.500001, 0.75])
@pytest.mark.parametrize("spacing", [0.3, 1.0, 2.0])
def test_a_way_is_found_from_any_place_of_a_lane(carla, offset, spacing):
    """Also from 10.5 m, where 11.5 and 12.5 are both rounded to 12."""
    town, x = carla.Map("bend", OPENDRIVE), 10.0 + offset
    end, choice = (30.0 + offset, -1.75), {"spacing_m": spacing}
    route = route_from_town(town, carla, (x, -1.0), end=end, **choice)
    np.testing.assert_allclose(route.points[0], [x, -1.75], atol=1e-3)
    np.testing.assert_allclose(route.points[-1], end, atol=0.75 * spacing + 1e-3)
    assert route.length == pytest.approx(20.0, abs=0.75 * spacing + 1e-3)


def _road(number: int, geometry: str, length: float, link: str, lane_link: str) -> str:
    return f"""<road name="r{number}" length="{length}" id="{number}" junction="-1">
<link>{link}</link><planView>{geometry}</planView><elevationProfile/>
<lateralProfile/><lanes><laneSection s="0">
<center><lane id="0" type="none" level="false"/></center>
<right><lane id="-1" type="driving" level="false"><link>{lane_link}</link>
<width sOffset="0" a="3.5" b="0" c="0" d="0"/></lane></right>
</laneSection></lanes></road>"""


_ARC = 5 * math.pi


OPENDRIVE = f"""<?xml version="1.0"?><OpenDRIVE>
<header revMajor="1" revMinor="4" name="bend" version="1" north="99" south="-99"
 east="99" west="-99"><geoReference><![CDATA[+proj=tmerc +lat_0=0 +lon_0=0]]>
</geoReference></header>
{
    _road(
        1,
        '<geometry s="0" x="0" y="0" hdg="0" length="50"><line/></geometry>',
        50.0,
        '<successor elementType="road" elementId="2" contactPoint="start"/>',
        '<successor id="-1"/>',
    )
}{
    _road(
        2,
        f'<geometry s="0" x="50" y="0" hdg="0" length="{_ARC}">'
        '<arc curvature="0.1"/></geometry>',
        _ARC,
        '<predecessor elementType="road" elementId="1" contactPoint="end"/>',
        '<predecessor id="-1"/>',
    )
}</OpenDRIVE>"""
