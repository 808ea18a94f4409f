"""What colours an attack may find."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest

from mi_nerfattack.attack.texture.constraints import Constraints
from mi_nerfattack.errors import InputError
from mi_nerfattack.fields import GridField, GridLayout
from mi_nerfattack.fields.occupancy import Occupancy

pytestmark = pytest.mark.usefixtures("variant")


@pytest.fixture
def field(rng):
    cells = np.zeros((4, 4, 4), bool)
    cells[1:3] = True  # the middle half along x
    layout = GridLayout(2, 4, 9)
    occupancy = Occupancy(cells)
    result = GridField(layout, -np.ones(3), np.ones(3), occupancy=occupancy)
    texture = rng.normal(0, 1, (result.n_vertices, 3)).astype(np.float32)
    result.set_parameter("texture", texture)
    return result


def colours(field, **constraints):
    from mi_nerfattack.attack.texture.colours import Colours

    return Colours(field, smoothing=0, constraints=Constraints(**constraints))


def far_off(mine, rng):
    return mine.start + rng.normal(0, 1, mine.start.shape).astype(np.float32)


def test_boxes_bound_every_value(field, rng):
    mine = colours(field, linf=0.1, lowest=0.2, highest=0.7)
    found = mine.project(far_off(mine, rng))
    assert np.abs(found - mine.start).max() <= 0.1 + 1e-6
    assert found.min() >= 0.2 - 1e-6
    assert found.max() <= 0.7 + 1e-6
    # the original is drawn into the range, and the picture shows it
    field.set_parameter("texture", mine.texture(mine.start))
    assert colours(field).start.min() >= 0.2 - 1e-4


def test_ball_bounds_the_mean_square_over_occupied_cells(field, rng):
    mine = colours(field, l2=0.05)
    found = mine.project(far_off(mine, rng))
    n = mine.level.resolution
    change = (found - mine.start).reshape(n, n, n, 3)[:, :, 2:7]  # z, y, x
    assert np.sqrt((change.astype(float) ** 2).mean()) == pytest.approx(0.05, rel=1e-4)
    near = mine.start + np.float32(0.001) * (mine.start < 0.5)
    np.testing.assert_array_equal(mine.project(near), near)


def test_fixed_regions_stay(field, rng):
    mine = colours(field, fixed=(((-1, -1, -1), (1, 1, 0.1)),))
    found = mine.project(far_off(mine, rng)).clip(0.01, 0.99)
    n = mine.level.resolution
    changed = (found != mine.start).reshape(n, n, n, 3).any(axis=(1, 2, 3))
    assert changed.tolist() == [False] * 6 + [True] * 3  # by z
    points = mi.Point3f(rng.uniform(-1, 0.1, (3, 200)).tolist())
    seen = []
    for value in (mine.start, found):
        field.set_parameter("texture", mine.texture(value))
        looked = field.eval_everywhere(points, mi.Vector3f(0, 0, 1), mi.Bool(True))
        seen.append(np.array(looked[1]))
    np.testing.assert_array_equal(*seen)
    with pytest.raises(InputError, match=r"fixed: \(3, 3, 3\) to .*the object lies in"):
        colours(field, fixed=(((3, 3, 3), (4, 4, 4)),))


def test_penalty_is_the_variation_and_its_gradient_that_of_it(field, rng):
    mine = colours(field, total_variation=3.0)
    value = rng.uniform(0.2, 0.8, mine.start.shape)
    n = mine.level.resolution
    cube = value.reshape(n, n, n, 3)[:, :, 2:7]
    pairs = [np.abs(np.diff(cube, axis=axis)).ravel() for axis in range(3)]
    assert mine.penalty(value) == pytest.approx(3 * np.concatenate(pairs).mean(), 0.01)
    change = 1e-4 * rng.normal(size=value.shape)
    wanted = (mine.penalty(value + change) - mine.penalty(value - change)) / 2
    nothing = np.zeros((field.n_vertices, 3))
    found = (mine.gradient(value, nothing) * change).sum()
    assert found == pytest.approx(wanted, rel=1e-3)


def test_what_allows_nothing_is_refused():
    with pytest.raises(InputError, match="lowest: 0.6, highest: 0.5"):
        Constraints(lowest=0.6, highest=0.5)
    for bounds in ({"lowest": 0.995}, {"highest": 0.005}):
        with pytest.raises(InputError, match=r"0\.01 from 0 and 1"):
            Constraints(**bounds)
    with pytest.raises(InputError, match="fixed: "):
        Constraints(fixed=(((0, 0, 0), (1, 0, 1)),))
    with pytest.raises(InputError, match=r"constraints\.linf: -0\.1; must be"):
        Constraints(linf=-0.1)
