"""Point evaluation, parameters, occupancy and files of radiance fields."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from helpers import small_fields as small
from hypothesis import given, settings
from hypothesis import strategies as st

from mi_nerfattack.fields import GridField, GridLayout, NGPField, NGPLayout, Occupancy
from mi_nerfattack.fields.occupancy import MAX_DISTANCE

pytestmark = pytest.mark.usefixtures("variant")

quick = settings(max_examples=20)


# Grid


def test_grid_equals_float64_interpolation(rng: np.random.Generator) -> None:
    field = small.blob(rng)
    points = rng.uniform(-0.999, 0.999, (200, 3)).astype(np.float32)
    density, radiance = small.evaluate(field, points)
    expected_density, expected_radiance = small.eval_grid(field, points.astype(float))
    np.testing.assert_allclose(density, expected_density, rtol=2e-5)
    np.testing.assert_allclose(radiance, expected_radiance, atol=1e-5)


def test_grid_is_finite_on_the_corners_of_its_box(rng: np.random.Generator) -> None:
    field = small.blob(rng)
    corners = np.array([[(k >> a) & 1 for a in range(3)] for k in range(8)]) * 2.0 - 1
    density, radiance = small.evaluate(field, corners)
    expected_density, expected_radiance = small.eval_grid(field, corners)
    np.testing.assert_allclose(density, expected_density, rtol=1e-3)
    np.testing.assert_allclose(radiance, expected_radiance, atol=1e-4)


def test_raw_zero_is_the_density_scale_and_mid_grey() -> None:
    field = GridField(GridLayout(2, 4, 8), -small.ONES, small.ONES, density_scale=2.5)
    density, radiance = small.evaluate(field, np.zeros((1, 3)))
    assert density[0] == pytest.approx(2.5, rel=1e-6)
    # (0.5 + 0.055) / 1.055 to the power 2.4, IEC 61966-2-1
    np.testing.assert_allclose(radiance[0], 0.21404114, rtol=1e-5)


def test_masked_lanes_are_zero(rng: np.random.Generator) -> None:
    for field in (small.blob(rng), small.small_ngp()):
        density, radiance = field.eval(
            mi.Point3f(0.1), mi.Vector3f(0, 0, 1), mi.Bool(False, True)
        )
        assert density.numpy()[0] == 0 and density.numpy()[1] > 0
        assert (radiance.numpy()[:, 0] == 0).all()


@pytest.mark.parametrize("layout", [(3, 5, 12), (1, 7, 7), (4, 16, 33)])
def test_levels_have_the_cells_that_the_layout_asks_for(layout) -> None:
    field = GridField(GridLayout(*layout), -small.ONES, small.ONES)
    for k, level in enumerate(field.levels()):
        scale = layout[1] * field.layout.growth**k - 1
        # the encoding has ceil(scale) cells along an edge, up to rounding
        assert scale - 1e-4 <= level.resolution - 1 < scale + 1 + 1e-4
    assert field.levels()[0].resolution == layout[1]


def test_default_layout_has_the_size_of_the_appendix() -> None:
    field = GridField(GridLayout(), -small.ONES, small.ONES)
    assert 4 * field.n_vertices == pytest.approx(4.4e6, rel=0.02)
    assert field.step_m == pytest.approx(2 / 64)  # a voxel


@pytest.mark.parametrize("values", [(0, 16, 64), (33, 16, 64), (4, 1, 8), (4, 9, 8)])
def test_grid_layout_out_of_range(values: tuple[int, int, int]) -> None:
    with pytest.raises(ValueError, match="levels|resolutions"):
        GridLayout(*values)


@pytest.mark.parametrize(
    ("lower", "upper"),
    [((0, 0, 0), (1, 1, 0)), ((0, 0, np.nan), (1, 1, 1)), ((0, 0), (1, 1))],
)
def test_box_must_be_ordered_and_finite(lower, upper) -> None:
    with pytest.raises(ValueError, match="bounding box"):
        GridField(GridLayout(1, 2, 2), np.array(lower), np.array(upper))


@pytest.mark.parametrize("name", ["step_m", "density_scale"])
@pytest.mark.parametrize("value", [0.0, -1.0, np.nan, np.inf])
def test_grid_numbers_must_be_positive_and_finite(name: str, value: float) -> None:
    with pytest.raises(ValueError, match=f"{name}: .*positive"):
        GridField(GridLayout(1, 2, 2), -small.ONES, small.ONES, **{name: value})


@pytest.mark.parametrize("values", [{"step_m": 0.0}, {"cone": -0.1}, {"cone": np.nan}])
def test_ngp_steps_must_make_sense(values: dict[str, float]) -> None:
    layout = NGPLayout(1, 2, 8, 4, 4, 16)
    with pytest.raises(ValueError, match=next(iter(values))):
        NGPField(layout, -small.ONES, small.ONES, **values)


def test_density_bound_is_tight_where_density_is_constant() -> None:
    assert small.homogeneous(0.7).density_bound() == pytest.approx(0.7, rel=1e-5)


def test_density_bound_holds_everywhere(rng: np.random.Generator) -> None:
    field = GridField(small.SMALL, -small.ONES, small.ONES)
    raw = rng.normal(0, 1, field.n_vertices).astype(np.float32)
    field.set_parameter("density", raw)
    points = rng.uniform(-1, 1, (20000, 3))
    assert small.evaluate(field, points)[0].max() <= field.density_bound()


# Parameters of a grid


def test_packing_and_texture_gradient_are_inverse(rng: np.random.Generator) -> None:
    field = GridField(GridLayout(2, 3, 5), -small.ONES, small.ONES)
    n = field.n_vertices
    density = rng.normal(size=n).astype(np.float32)
    texture = rng.normal(size=(n, 3)).astype(np.float32)
    field.set_parameter("density", density)
    field.set_parameter("texture", texture)
    packed = field.packed.numpy().reshape(n, 4)
    np.testing.assert_array_equal(packed, np.c_[density, texture])
    np.testing.assert_array_equal(field.texture_gradient(field.packed), texture)


def test_texture_gradient_passes_through_set_parameter(rng) -> None:
    field = GridField(GridLayout(2, 3, 5), -small.ONES, small.ONES)
    cotangent = mi.Float(rng.normal(size=4 * field.n_vertices).astype(np.float32))
    texture = mi.TensorXf(field.texture)
    dr.enable_grad(texture)
    field.set_parameter("texture", texture)
    dr.backward(dr.sum(field.packed * cotangent))
    expected = cotangent.numpy().reshape(-1, 4)[:, 1:]
    np.testing.assert_array_equal(dr.grad(texture), expected)
    np.testing.assert_array_equal(field.texture_gradient(cotangent), expected)


def test_flat_and_shaped_textures_are_the_same(rng: np.random.Generator) -> None:
    field = GridField(GridLayout(1, 3, 3), -small.ONES, small.ONES)
    texture = rng.normal(size=(field.n_vertices, 3)).astype(np.float32)
    for value in (texture, texture.ravel(), mi.TensorXf(texture), texture[:, ::1]):
        field.set_parameter("texture", value)
        np.testing.assert_array_equal(field.texture, texture)


def test_grid_refuses_wrong_parameters() -> None:
    field = GridField(GridLayout(1, 3, 3), -small.ONES, small.ONES)
    with pytest.raises(ValueError, match=r"texture: shape \(5, 3\); expected"):
        field.set_parameter("texture", np.zeros((5, 3), np.float32))
    with pytest.raises(ValueError, match=r"colour: shape \(26, 3\); expected"):
        field.set_parameter("colour", dr.full(mi.TensorXf, 0.5, (26, 3)))
    with pytest.raises(KeyError, match="hue: a grid field has"):
        field.set_parameter("hue", np.zeros(1, np.float32))


# NGP


def test_ngp_equals_its_stored_matrices_in_float64(rng: np.random.Generator) -> None:
    field = small.small_ngp()
    points = rng.uniform(-1, 1, (50, 3)).astype(np.float32)
    heading = np.array([2.0, -1.0, 2.0]) / 3
    density, radiance = small.evaluate(field, points, heading)

    stored = field.tensors()
    unit = mi.Point3f(((points.T + 1) / 2).copy())
    h = np.array([x.numpy() for x in field.encoding(unit, mi.Bool(True))], float)
    for index in range(2):
        h = stored[f"density_net.{index}"] @ (np.maximum(h, 0) if index else h)
    harmonics = dr.sh_eval(mi.Vector3f(*map(float, heading)), 3)
    sphere = [float(mi.Float(x)[0]) for x in harmonics]
    c = np.concatenate([h, np.tile(np.array(sphere)[:, None], 50)])
    for index in range(3):
        c = stored[f"colour_net.{index}"] @ (np.maximum(c, 0) if index else c)
    np.testing.assert_allclose(density, np.exp(h[0]) / 2, rtol=1e-4)
    np.testing.assert_allclose(radiance, small.sigmoid_to_linear(c).T, atol=1e-5)
    alone = field.density(mi.Point3f(points.T.copy()), mi.Bool(True))
    np.testing.assert_allclose(alone.numpy(), density, rtol=1e-5)


def test_ngp_radiance_depends_on_direction_but_density_does_not() -> None:
    field, points = small.small_ngp(), np.full((1, 3), 0.3)
    there, back = (
        small.evaluate(field, points),
        small.evaluate(field, points, (0, 0, -1)),
    )
    assert there[0] == back[0]
    assert np.abs(there[1] - back[1]).max() > 1e-3


def sky_direction(row: float, column: float, height: int, width: int) -> mi.Vector3f:
    """Return the direction of a place in the sky's image, in texels."""
    phi, theta = 2 * np.pi * column / width, np.pi * (row + 0.5) / height
    sine = np.sin(theta)
    x, y, z = sine * np.cos(phi), sine * np.sin(phi), np.cos(theta)
    return mi.Vector3f(float(x), float(y), float(z))


def test_sky_is_exact_on_texels_and_linear_between() -> None:
    field = small.small_ngp()
    height, width = field.sky_shape
    raw = field.sky.numpy().reshape(height, width, 3).astype(float)
    for row, column in [(0, 0), (1, 3), (3, 7)]:
        seen = field.background(sky_direction(row, column, height, width))
        expected = small.sigmoid_to_linear(raw[row, column])
        np.testing.assert_allclose(seen.numpy()[:, 0], expected, atol=1e-4)
    seam = field.background(sky_direction(1, width - 0.5, height, width))
    expected = small.sigmoid_to_linear((raw[1, -1] + raw[1, 0]) / 2)
    np.testing.assert_allclose(seam.numpy()[:, 0], expected, atol=1e-4)


def test_grid_has_a_black_background(rng: np.random.Generator) -> None:
    assert (small.blob(rng).background(mi.Vector3f(0, 0, 1)).numpy() == 0).all()


def test_ngp_refuses_wrong_parameters() -> None:
    field = small.small_ngp()
    with pytest.raises(KeyError, match="texture: an NGP has table"):
        field.set_parameter("texture", mi.Float(0))
    with pytest.raises(ValueError, match="table: 1 values; expected"):
        field.set_parameter("table", mi.Float(0))
    with pytest.raises(ValueError, match="log2_table: 30; allowed are 8 to 24"):
        NGPLayout(log2_table=30)


# Occupancy


def brute_distance(cells: np.ndarray) -> np.ndarray:
    """Return the Chebyshev distance of every cell to the nearest occupied one."""
    places = np.argwhere(cells)
    index = np.stack(np.indices(cells.shape), -1)
    if len(places) == 0:
        return np.full(cells.shape, MAX_DISTANCE)
    gap = np.abs(index[..., None, :] - places).max(-1)
    return gap.min(-1)


@quick
@given(
    shape=st.tuples(*[st.integers(1, 5)] * 3),
    share=st.sampled_from([0.0, 0.05, 0.5, 1.0]),
    seed=st.integers(0, 99),
)
def test_occupancy_query_and_exit_against_brute_force(shape, share, seed) -> None:
    rng = np.random.default_rng(seed)
    cells = rng.random(shape) < share
    occupancy = Occupancy(cells)
    n = 32
    unit = rng.uniform(0, 1, (n, 3)).astype(np.float32)
    direction = rng.normal(size=(n, 3)).astype(np.float32)
    direction[0] = [0, 0, -2]
    place, heading = mi.Point3f(unit.T.copy()), mi.Vector3f(direction.T.copy())
    distance, cell = occupancy.query(place, mi.Bool(True))
    found = np.minimum((unit * shape).astype(int), np.array(shape) - 1)
    np.testing.assert_array_equal(cell.numpy().T, found)
    expected = brute_distance(cells)[tuple(found.T)]
    np.testing.assert_array_equal(distance.numpy(), expected)

    reach = occupancy.exit(place, heading, cell, distance).numpy()
    empty = np.flatnonzero(expected)
    for k in empty:
        # Every place before the exit lies in an empty cell or outside of the grid.
        t = np.linspace(0, min(reach[k], 1e3), 64)[:-1]
        walk = (unit[k] + t[:, None] * direction[k]) * shape
        walked = np.floor(walk + 1e-4 * np.sign(found[k] + 0.5 - walk)).astype(int)
        inside = ((walked >= 0) & (walked < shape)).all(1)
        assert not cells[tuple(walked[inside].T)].any()
        # The exit lies on the surface of the block of 2 n - 1 cells.
        end = (unit[k] + reach[k] * direction[k].astype(float)) * shape
        gap = np.abs(end - (found[k] + 0.5)).max()
        assert gap == pytest.approx(expected[k] - 0.5, rel=1e-3, abs=1e-3)


def test_empty_octants_of_occupied_cells(rng) -> None:
    cells = rng.random((3, 4, 5)) < 0.6
    octants = rng.integers(0, 4, cells.shape, np.uint8) * 51  # some cells have none
    fine = np.unpackbits(octants[..., None], axis=-1, bitorder="little")
    fine = fine.reshape(*cells.shape, 2, 2, 2).transpose(0, 3, 1, 4, 2, 5)
    fine = fine.reshape(6, 8, 10) & np.kron(cells, np.ones((2, 2, 2), np.uint8))
    occupancy = Occupancy(cells, octants)
    unit = rng.uniform(0, 1, (500, 3)).astype(np.float32)
    direction = rng.normal(size=(500, 3)).astype(np.float32)
    place, heading = mi.Point3f(unit.T.copy()), mi.Vector3f(direction.T.copy())
    distance, cell = occupancy.query(place, mi.Bool(True))
    found = distance.numpy()
    half = tuple((unit * fine.shape).astype(int).T)
    np.testing.assert_array_equal(found == 0, fine[half] > 0)
    whole = brute_distance(fine.reshape(3, 2, 4, 2, 5, 2).any((1, 3, 5)))
    cell = tuple(cell.numpy().astype(int))
    np.testing.assert_array_equal(found[found >= 1], whole[cell][found >= 1])
    assert set(found[whole[cell] == 0]) == {0, 0.5}
    # no way out of an octant leads past its faces
    reach = occupancy.exit(place, heading, mi.Point3f(*cell), distance).numpy()
    for k in np.flatnonzero(found == 0.5):
        end = (unit[k] + reach[k] * direction[k].astype(float)) * fine.shape
        assert np.abs(end - np.array(half)[:, k] - 0.5).max() <= 0.501


def test_occupancy_clamps_positions_outside() -> None:
    cells = np.zeros((2, 2, 2), bool)
    cells[1, 1, 1] = True
    outside = mi.Point3f([-3, 4], [-3, 4], [-3, 4])
    distance, cell = Occupancy(cells).query(outside, mi.Bool(True))
    np.testing.assert_array_equal(distance.numpy(), [1, 0])
    np.testing.assert_array_equal(cell.numpy(), [[0, 1]] * 3)


def test_occupancy_fraction_and_shape() -> None:
    cells = np.zeros((2, 3, 4), bool)
    cells[0] = True
    assert Occupancy(cells).fraction == 0.5
    assert Occupancy(cells).shape == (2, 3, 4)
    assert Occupancy.full(3).fraction == 1
    with pytest.raises(ValueError, match="occupancy: shape"):
        Occupancy(np.ones((2, 2), bool))
