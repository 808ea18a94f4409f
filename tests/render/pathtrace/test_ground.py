"""The ground under routes and walls across them, by hand."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest
from support.worlds.cameras import block

from mi_nerfattack.render.pathtrace.ground import (
    arc_lengths,
    ground_findings,
    vertical_reach,
    wall_findings,
)
from mi_nerfattack.vehicle.route.route import Route

pytestmark = pytest.mark.usefixtures("variant")

ROUTE = Route("line", 0, np.array([[0.0, 0.0], [10.0, 0.0]]))


def street(wall_at: float, gap: tuple[float, float] = (4.0, 4.0)) -> mi.Scene:
    """Load ground from x = -10 to 20, but for a gap, a wall, and a roof of x < -1."""
    low, high = (-10 + gap[0]) / 2, (gap[1] + 20) / 2
    blocks = {
        "before": block([low, 0, -1], [gap[0] - low, 5, 1]),
        "after": block([high, 0, -1], [20 - high, 5, 1]),
        "roof": block([-6, 0, 4], [5, 5, 1]),
        "wall": block([wall_at + 1, 0, 0], [1, 5, 3]),
    }
    return mi.load_dict({"type": "scene", **blocks})


def test_reach_is_a_distance_up_or_down() -> None:
    points, scene = np.array([[-5.0, 0.0], [50.0, 0.0]]), street(15)
    assert vertical_reach(scene, points, 1.0).tolist() == [1, np.inf]
    assert vertical_reach(scene, points, 1.0, up=True).tolist() == [2, np.inf]


def test_the_ground_is_looked_for_every_half_metre() -> None:
    np.testing.assert_allclose(arc_lengths(3, 5), [3, 3.5, 4, 4.5, 5])
    assert arc_lengths(3, 3.1).tolist() == [3, 3.1]


@pytest.mark.parametrize(
    ("gap", "count"), [((3.8, 4.2), 0), ((3.8, 4.7), 1)], ids=["seam", "hole"]
)
def test_two_places_in_a_row_without_ground_are_a_hole(gap, count: int) -> None:
    issues = list(ground_findings(ROUTE, arc_lengths(0, 10), street(15, gap), "s.xml"))
    assert len(issues) == count
    assert all("from 4.0 to 4.5 m along it (10 %" in line for line in issues)


@pytest.mark.parametrize(("wall_at", "count"), [(9.8, 1), (10.2, 0)])
def test_a_wall_behind_the_end_is_not_met(wall_at: float, count: int) -> None:
    issues = list(wall_findings(ROUTE, arc_lengths(0, 10), street(wall_at), "s.xml"))
    assert len(issues) == count
    assert all("after 9.5 m along it, at (9.5, 0) m" in line for line in issues)
