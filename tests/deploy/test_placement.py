"""Where vehicles and roadside objects are put."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.roadside import KERB_M, bent, flat_ground, kerb_scene, small_grid, straight

from mi_nerfattack.deploy.placement import Roadside, Scatter, scene_ground
from mi_nerfattack.errors import InputError
from mi_nerfattack.fields.grid import GridField


@pytest.fixture
def grid(variant) -> GridField:
    return small_grid()


def test_scatter_has_its_deviations_and_cuts(rng):
    scatter = Scatter(close_share=0.0)
    states = scatter.states(straight(), np.full(4000, 7.0), rng)
    assert np.abs(states[:, 1]).max() <= 1.5
    assert np.abs(states[:, 2]).max() <= 0.4
    # of a normal cut at three standard deviations: 0.9867 of the deviation
    assert states[:, 1].std() == pytest.approx(0.4933, rel=0.04)
    np.testing.assert_allclose(states[:, 0], 7.0)


def test_close_states_deviate_a_fifth(rng):
    states = Scatter(close_share=1.0).states(straight(), np.full(500, 7.0), rng)
    assert np.abs(states[:, 1]).max() <= 0.3
    assert np.abs(states[:, 2]).max() <= 0.08


def test_a_scatter_of_nothing_is_the_lane_centre(rng):
    """As for drives that start on it exactly."""
    states = Scatter(0.0, 0.0, 0.0, 0.0).states(straight(), np.full(3, 7.0), rng)
    np.testing.assert_array_equal(states, [[7.0, 0.0, 0.0]] * 3)


@pytest.mark.parametrize(
    "change",
    [{"lateral_sd_m": -0.1}, {"heading_max": float("nan")}, {"close_share": 2.0}],
)
def test_a_scatter_out_of_range_is_refused(change):
    with pytest.raises(InputError, match=f"Scatter.{next(iter(change))}: "):
        Scatter(**change)


@pytest.mark.parametrize("route", [straight(), bent()], ids=lambda r: r.name)
def test_objects_keep_clear_of_the_lane(grid, rng, route):
    sides = []
    for _ in range(50):
        pose = Roadside().draw(grid, route, (2.0, 20.0), flat_ground, rng)
        state = np.array([*pose.translation[:2], 0.0])
        (error,) = route.cross_track_numpy(state)
        radius = pose.scale * np.hypot(0.2, 0.2)
        assert abs(error) >= max(2.0, 0.9 + radius)
        assert abs(error) <= 5.01
        assert 1.0 <= pose.scale * 0.8 <= 2.5
        assert pose.translation[2] == 0
        sides.append(error > 0)
    assert 5 < sum(sides) < 45


def test_blocked_roadside_is_an_error(grid, rng):
    def nowhere(points):
        return np.full(len(points), np.nan)

    with pytest.raises(InputError, match="'straight'.*no free ground"):
        Roadside().draw(grid, straight(), (2.0, 20.0), nowhere, rng)


def test_ground_is_the_highest_low_surface(variant):
    points = np.array([[0.0, 0.0], [0.0, 10.0], [20.0, 0.0], [200.0, 0.0]])
    height = scene_ground(kerb_scene())(points)
    np.testing.assert_allclose(height, [0, KERB_M, np.nan, np.nan], atol=1e-5)
