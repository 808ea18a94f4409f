"""Where vehicles are put."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.roadside import straight

from mi_nerfattack.deploy.scatter import Scatter
from mi_nerfattack.errors import InputError


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
