"""Steps in colour, their schedule, and what they made of a texture."""

from __future__ import annotations

from dataclasses import astuple

import mitsuba as mi
import numpy as np
import pytest
from support.worlds import loops as toy

from mi_nerfattack.attack.plan import Schedule, has_settled
from mi_nerfattack.attack.texture import statistics
from mi_nerfattack.attack.texture.colours import Colours, vertex_colours
from mi_nerfattack.attack.texture.constraints import MARGIN
from mi_nerfattack.attack.texture.statistics import seen_weights, texture_statistics
from mi_nerfattack.errors import InputError
from mi_nerfattack.fields import GridField, GridLayout

pytestmark = pytest.mark.usefixtures("variant")


def field_of(levels: int, rng: np.random.Generator) -> GridField:
    field = GridField(GridLayout(levels, 4, 12), -np.ones(3), np.ones(3))
    texture = rng.normal(0, 0.5 / levels, (field.n_vertices, 3)).astype(np.float32)
    field.set_parameter("texture", texture)
    return field


@pytest.mark.parametrize("levels", [1, 3, 9])
def test_a_step_changes_colours_by_its_length_on_any_number_of_levels(levels, rng):
    field = field_of(levels, rng)
    colours = Colours(field)
    original = field.texture.numpy()
    np.testing.assert_array_equal(colours.texture(colours.start), original)
    field.set_parameter("texture", colours.texture(colours.start + 0.01))
    changed = vertex_colours(field, field.levels()[-1])
    np.testing.assert_allclose(changed - colours.start, 0.01, atol=1e-5)


def test_projection_allows_colours_and_what_was_there(rng):
    field = field_of(1, rng)
    texture = field.texture.numpy().copy()
    texture[0] = 9.0  # nearly white
    field.set_parameter("texture", texture)
    colours = Colours(field)
    np.testing.assert_array_equal(colours.project(colours.start), colours.start)
    assert (colours.project(colours.start - 2) == np.float32(MARGIN)).all()
    highest = colours.project(colours.start + 2)
    np.testing.assert_allclose(highest[0], colours.start[0])
    assert (highest[1:] == np.float32(1 - MARGIN)).all()


def test_gradient_is_that_of_the_texture(rng):
    field = field_of(3, rng)
    colours = Colours(field)
    by_texture = rng.normal(size=(field.n_vertices, 3))
    value = rng.uniform(0.2, 0.8, colours.start.shape)
    change = 1e-4 * rng.normal(size=value.shape)
    up, down = (colours.texture(value + s * change) for s in (1, -1))
    expected = ((up.astype(np.float64) - down) * by_texture).sum() / 2
    derivative = (colours.gradient(value, by_texture) * change).sum()
    assert derivative == pytest.approx(expected, rel=1e-3)
    level = Colours(field, resolution=8).level
    assert level.resolution == 7
    with pytest.raises(InputError, match="resolution: 3; .* 4"):
        Colours(field, resolution=3)


def test_rates_fall_when_nothing_more_is_gained_or_time_is_short():
    falling = list(np.linspace(1, 0, 20))
    short, long = Schedule(20, 0.01), Schedule(100, 0.01)
    assert [short.rate(falling[:k]) for k in range(15)] == [1.0] * 15
    rates = [short.rate(falling[:k]) for k in range(15, 20)]
    np.testing.assert_allclose(rates, 0.01 ** (np.arange(1, 6) / 5))
    assert short.is_over(falling)
    assert not short.is_over(falling[:19])
    assert not short.has_converged(falling)
    settled = [*np.linspace(1, 0.2, 8), 0.199, 0.3]
    assert long.rate(settled) == pytest.approx(0.01 ** (1 / 3))  # from 10 on
    assert long.has_converged(settled)
    ending = [long.is_over([*settled, *[0.0] * count]) for count in range(4)]
    assert ending == [False, False, False, True]
    assert long.rate([0.5] * 70) == 1.0  # stuck from the first is not converged


def test_a_search_settles_at_its_first_fifth_without_gain(rng):
    for share in (0.3, 0.6, 0.9):
        moves = np.where(rng.random(120) < share, 0, rng.random(120) - 0.7)
        objectives = np.cumsum(moves).tolist()

        def is_settled(done: int, values=objectives) -> bool:
            least = [min(values[: k + 1]) for k in range(done)]
            gain = least[0] - least[-1]
            return gain > 0 and least[-1 - done // 5] - least[-1] < 0.02 * gain

        first = next((k for k in range(10, 121) if is_settled(k)), 750)
        schedule = Schedule(1000, 0.01)
        rates = [schedule.rate(objectives[:k]) for k in range(121)]
        assert rates[:first] == [1.0] * min(first, 121)
        assert all(rate < 1 for rate in rates[first:])
        assert has_settled(objectives) == is_settled(120)


def test_statistics_of_a_texture_that_is_known():
    loop, grid = toy.make_loop()
    original = toy.texture_of(grid)
    states = [loop.initial(np.zeros((1, 3)))]
    [weights] = seen_weights(loop.sensor, [grid], states)
    assert (weights > 0).sum() > 50
    np.testing.assert_array_equal(toy.texture_of(grid), original)
    same = texture_statistics(grid, original, weights)
    assert (same.l2, same.linf, same.saturated_share) == (0, 0, 0)
    assert same.total_variation > 0.01
    grey = np.zeros_like(original)
    white = grey + 9.0  # the sum of three levels: 27
    grid.set_parameter("texture", mi.TensorXf(white))
    painted = texture_statistics(grid, grey, weights)
    assert painted.l2 == pytest.approx(0.5, abs=1e-5)
    assert painted.linf == pytest.approx(0.5, abs=1e-5)
    assert painted.saturated_share == pytest.approx(1)
    assert painted.total_variation == pytest.approx(0, abs=1e-6)
    assert same.spectrum == []
    assert painted.spectrum[-1] == pytest.approx(1)  # all of it is the mean
    unseen = texture_statistics(grid, grey, np.zeros_like(weights))
    assert astuple(unseen) == (0, 0, 0, 0, [])


def test_measuring_that_fails_leaves_the_texture(monkeypatch):
    loop, grid = toy.make_loop()
    original = toy.texture_of(grid)

    def fail(*_):
        assert not np.array_equal(toy.texture_of(grid), original)
        raise MemoryError

    monkeypatch.setattr(type(loop.sensor), "observe", fail)
    with pytest.raises(MemoryError):
        statistics.seen_weights(loop.sensor, [grid], [loop.initial(np.zeros((1, 3)))])
    np.testing.assert_array_equal(toy.texture_of(grid), original)
    colours = iter([lambda *_: 0.0, fail])
    monkeypatch.setattr(statistics, "vertex_colours", lambda *a: next(colours)(*a))
    edge = grid.levels()[-1].resolution
    with pytest.raises(MemoryError):
        statistics.texture_statistics(grid, original + 1, np.ones((edge,) * 3))
    np.testing.assert_array_equal(toy.texture_of(grid), original)


def test_spectrum_tells_fine_structure_from_coarse():
    grid = GridField(GridLayout(1, 8, 8), -np.ones(3), np.ones(3))
    original = grid.texture.numpy().copy()
    index = np.indices((8, 8, 8)).reshape(3, -1)
    everywhere = np.ones((8, 8, 8))
    for period, expected in ((1, [1, 0, 0, 0]), (2, [0, 1, 0, 0]), (8, [0, 0, 0, 1])):
        board = 1 - 2 * (index // period % 2).max(axis=0)
        raw = original + board[:, None].astype(np.float32)
        if expected[-1] == 0:
            raw -= raw.reshape(-1, 3).mean(axis=0)
        grid.set_parameter("texture", raw)
        spectrum = texture_statistics(grid, original, everywhere).spectrum
        assert sum(spectrum) == pytest.approx(1)
        assert spectrum == pytest.approx(expected, abs=0.06)
