"""When and where a failure is made: shares by hand, heat of known gradients."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from support.pages.read import drawn
from support.worlds import loops as toy
from support.worlds.fields import blob, vertices

from mi_nerfattack.attack.gradient import GradientAttack
from mi_nerfattack.attack.objectives import AbsoluteDeviation
from mi_nerfattack.errors import InputError
from mi_nerfattack.experiment.attribution import (
    FailureAttribution,
    attribute,
    write_attribution,
)
from mi_nerfattack.io import files
from mi_nerfattack.report.plots import heat
from mi_nerfattack.report.plots.curves import TimeAttribution
from mi_nerfattack.report.plots.heat import (
    SIDES,
    side_views,
    surface_heat,
)
from mi_nerfattack.rollout.function import Rollout
from mi_nerfattack.rollout.objective import StageSum

pytestmark = pytest.mark.usefixtures("variant")


def test_shares_are_parts_of_the_gradient():
    along, costates = np.array([[1.0, 2.0], [-1.0, 6.0]]), np.zeros((2, 1, 3))
    data = TimeAttribution(np.arange(2), costates, along, along, 0.85, ["a", "b"])
    np.testing.assert_allclose(data.shares, [[0.125, 0.25], [-0.125, 0.75]])
    assert not dataclasses.replace(data, along=0 * along).shares.any()


def shown(grid):
    """Return the mask of the vertices of the level that is shown, and its voxel."""
    level, resolution = heat._shown_level(grid)
    start = grid.encoding.level_offset(level)
    mask = np.zeros(grid.n_vertices, bool)
    mask[start : start + resolution**3] = True
    return mask, np.prod((grid.upper - grid.lower) / (resolution - 1))


def test_constant_gradient_gives_constant_heat(rng):
    """Interpolation keeps a constant: its norm 5, over the volume of a voxel."""
    grid = blob(rng, peak=4.0)
    gradient = np.tile([3.0, 0.0, -4.0], (grid.n_vertices, 1))
    mask, voxel = shown(grid)
    values = surface_heat(grid, gradient)
    np.testing.assert_allclose(values[mask], 5 / voxel)
    assert not values[~mask].any()
    views = side_views(grid, gradient, 40)
    assert [view.name for view in views] == list(heat.SIDES)
    for view in views:
        assert view.colour.shape == (*view.heat.shape, 3)
        assert max(view.heat.shape) == 40
        known = view.heat[np.isfinite(view.heat)]
        assert 50 < known.size < view.heat.size
        np.testing.assert_allclose(known, 5 / voxel, rtol=1e-3)
        assert np.all(view.colour[~np.isfinite(view.heat)] > 0.8)


def test_heat_lies_where_the_gradient_is(rng):
    """A gradient on the half of +x is seen from +x and not from -x."""
    grid = blob(rng, peak=6.0)
    gradient = np.where(vertices(grid)[:, :1] > 0.3, [[0.0, 2.0, 0.0]], 0.0)
    views = {view.name: view.heat for view in side_views(grid, gradient, 40)}
    middle = tuple(size // 2 for size in views["from +x"].shape)
    assert views["from +x"][middle] > 20 * views["from -x"][middle]
    # seen from +y, the hot side is on the left: x points to the left there
    width = views["from +y"].shape[1]
    left = np.nansum(views["from +y"][:, : width // 2])
    right = np.nansum(views["from +y"][:, width // 2 :])
    assert left > 20 * right
    assert np.nansum(views["from -y"][:, : width // 2]) < 0.05 * left


def test_a_failure_is_taken_apart(tmp_path, monkeypatch):
    """Shares add up to 1; the last costate is minus the derivative of the last cost."""
    loop, grid = toy.make_loop()
    objective = StageSum(AbsoluteDeviation(toy.ROUTE))
    initial = loop.initial(np.array([[0.0, 0.1, 0.0], [0.0, -0.2, 0.05]]))
    attack = GradientAttack(Rollout(loop, objective, 3), toy.ROUTE, initial)
    attack.measure()
    steps = []
    attribution = attribute(attack, ["ball"], 0.85, steps.append)
    assert len(steps) == 9
    times = attribution.times
    assert times.costates.shape == (3, 2, 3) and times.shares.shape == (3, 1)
    assert times.shares.sum() == pytest.approx(1, rel=1e-6)
    square = (attribution.textures[0].astype(float) ** 2).sum()
    assert times.along.sum() == pytest.approx(square, rel=1e-4)
    # the last image steers the last period, whose heading no state follows
    assert attribution.norms[-1, 0] == pytest.approx(0, abs=1e-12)
    np.testing.assert_allclose(times.time_s, toy.DT * np.array([1, 2, 3]))
    side = np.sign(times.cross_track_m[-1])
    np.testing.assert_allclose(
        times.costates[-1], [[0, side[0] / 2, 0], [0, side[1] / 2, 0]], atol=1e-12
    )
    figures = drawn(monkeypatch)
    write_attribution(tmp_path, attribution, [grid])
    data = files.read_json(tmp_path / "attribution.json")
    assert data["gradient_share"]["ball"] == times.shares[:, 0].tolist()
    costates, shares, errors = figures[0].axes
    turn = np.abs(times.costates[:, :, 2]).mean(1)
    np.testing.assert_allclose(costates.lines[-1].get_ydata(), turn)
    heights = [bar.get_height() for bar in shares.containers[0]]
    np.testing.assert_allclose(heights, 100 * times.shares[:, 0])
    distance = np.abs(times.cross_track_m).mean(1)
    np.testing.assert_allclose(errors.lines[2].get_ydata(), distance)
    assert len(figures[1].axes) == 2 * len(SIDES) + 1  # textures, heat, colour bar


def test_a_drive_that_no_texture_changes_is_drawn(tmp_path):
    grid, zero = toy.make_loop()[1], np.zeros((1, 1))
    costates, names = np.zeros((1, 1, 3)), ["still"]
    times = TimeAttribution(zero[0] + 0.1, costates, zero, zero, 0.85, names)
    textures = [np.zeros((grid.n_vertices, 3))]
    write_attribution(tmp_path, FailureAttribution(times, zero, textures), [grid])
    with pytest.raises(InputError, match="along: not finite"):
        dataclasses.replace(times, along=zero + np.nan)
