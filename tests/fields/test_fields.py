"""Point evaluation, parameters, occupancy and files of radiance fields."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.faults.refusals import refusals
from support.worlds import fields as small

from mi_nerfattack.fields import GridField, GridLayout, NGPField, NGPLayout, Occupancy
from mi_nerfattack.fields.levels import count_read
from mi_nerfattack.fields.occupancy import MAX_DISTANCE

pytestmark = pytest.mark.usefixtures("variant")

quick = settings(max_examples=20)


def test_grid_equals_float64_interpolation(rng: np.random.Generator) -> None:
    field = small.blob(rng)
    inside = rng.uniform(-0.999, 0.999, (200, 3)).astype(np.float32)
    corners = 2.0 * np.array(list(np.ndindex(2, 2, 2))) - 1
    for points, rtol, atol in ((inside, 2e-5, 1e-5), (corners, 1e-3, 1e-4)):
        density, radiance = small.evaluate(field, points)
        expected = small.eval_grid(field, points.astype(float))
        np.testing.assert_allclose(density, expected[0], rtol=rtol)
        np.testing.assert_allclose(radiance, expected[1], atol=atol)


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


def test_default_layout_has_the_size_of_the_appendix() -> None:
    field = GridField(GridLayout(), -small.ONES, small.ONES)
    assert 4 * field.n_vertices == pytest.approx(4.4e6, rel=0.02)
    assert field.step_m == pytest.approx(2 / 64)  # a voxel


def grid(lower=-small.ONES, upper=small.ONES, **numbers: float) -> GridField:
    return GridField(GridLayout(1, 3, 3), np.array(lower), np.array(upper), **numbers)


def ngp(**numbers: float) -> NGPField:
    layout = NGPLayout(1, 2, 8, 4, 4, 16)
    return NGPField(layout, -small.ONES, small.ONES, **numbers)


test_refused = refusals(
    (lambda: GridLayout(0, 16, 64), "levels: 0"),
    (lambda: GridLayout(33, 16, 64), "levels: 33"),
    (lambda: GridLayout(4, 1, 8), "resolutions: 1"),
    (lambda: GridLayout(4, 9, 8), "resolutions: 9"),
    (lambda: GridLayout(32, 256, 512), "levels: 32, from 256 to 512"),
    (lambda: NGPLayout(32, 8, 24, 1024, 65536), "log2_table: 24"),
    (lambda: NGPLayout(log2_table=30), "log2_table: 30; allowed are 8 to 24"),
    (lambda: grid((0, 0, 0), (1, 1, 0)), "bounding box"),
    (lambda: grid((0, 0, np.nan), (1, 1, 1)), "bounding box"),
    (lambda: grid((0, 0), (1, 1)), "bounding box"),
    (lambda: grid(step_m=0.0), "step_m: 0.0"),
    (lambda: grid(step_m=np.nan), "step_m: nan"),
    (lambda: grid(density_scale=-1.0), "density_scale: -1.0"),
    (lambda: grid(density_scale=np.inf), "density_scale: inf"),
    (lambda: ngp(step_m=0.0), "step_m: 0.0"),
    (lambda: ngp(cone=-0.1), "cone: -0.1"),
    (lambda: ngp(cone=np.nan), "cone: nan"),
    (lambda: grid().set_parameter("texture", np.zeros((5, 3))), r"texture: .*\(5, 3\)"),
    (lambda: grid().set_parameter("colour", np.zeros((9, 3))), r"colour: .*\(9, 3\)"),
    (lambda: ngp().set_parameter("table", mi.Float(0)), "table: 1 values"),
)


def test_parameters_that_a_field_does_not_have() -> None:
    for make, name, others in ((grid, "hue", "density"), (ngp, "texture", "table")):
        with pytest.raises(KeyError, match=f"{name}: .*{others}"):
            make().set_parameter(name, mi.Float(0))


def test_packing_and_texture_gradient_are_inverse(rng: np.random.Generator) -> None:
    field = GridField(GridLayout(2, 3, 5), -small.ONES, small.ONES)
    n = field.n_vertices
    density = rng.normal(size=n).astype(np.float32)
    texture = rng.normal(size=(n, 3)).astype(np.float32)
    field.set_parameter("density", density)
    for value in (texture, texture.ravel(), mi.TensorXf(texture)):
        field.set_parameter("texture", value)
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


def test_the_derivative_of_bricks_by_the_position() -> None:
    bricks = small.small_bricks(np.random.default_rng(0))
    # in the first brick, away from the faces of its parts
    cell = np.argwhere(bricks.occupancy.cells)[0]
    at = -1 + 2 * (cell + [0.29, 0.41, 0.66]) / bricks.occupancy.shape
    point, step = mi.Point3f(*at.tolist()), 1e-3

    def density(place):
        return bricks.eval_everywhere(place, mi.Vector3f(0, 0, 1), mi.Bool(True))[0]

    dr.enable_grad(point)
    dr.backward(density(point))
    for axis in range(3):
        offset = mi.Point3f([step * (k == axis) for k in range(3)])
        ends = [density(dr.detach(point) + s * offset) for s in (1, -1)]
        expected = float((ends[0] - ends[1])[0]) / (2 * step)
        assert expected != 0
        assert float(dr.grad(point)[axis][0]) == pytest.approx(expected, rel=2e-2)


def test_ngp_radiance_depends_on_direction_but_density_does_not() -> None:
    field, points = small.small_ngp(), np.full((1, 3), 0.3)
    there, back = (small.evaluate(field, points, (0, 0, z)) for z in (1, -1))
    assert there[0] == back[0]
    assert np.abs(there[1] - back[1]).max() > 1e-3


def test_grid_has_a_black_background(rng: np.random.Generator) -> None:
    assert (small.blob(rng).background(mi.Vector3f(0, 0, 1)).numpy() == 0).all()


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
    indices = np.minimum((unit * shape).astype(int), np.array(shape) - 1)
    np.testing.assert_array_equal(cell.numpy().T, indices)
    expected = brute_distance(cells)[tuple(indices.T)]
    np.testing.assert_array_equal(distance.numpy(), expected)

    reach = occupancy.exit(place, heading, cell, distance).numpy()
    empty = np.flatnonzero(expected)
    for k in empty:
        # Every place before the exit lies in an empty cell or outside of the grid.
        t = np.linspace(0, min(reach[k], 1e3), 64)[:-1]
        walk = (unit[k] + t[:, None] * direction[k]) * shape
        walked = np.floor(walk + 1e-4 * np.sign(indices[k] + 0.5 - walk)).astype(int)
        inside = ((walked >= 0) & (walked < shape)).all(1)
        assert not cells[tuple(walked[inside].T)].any()
        # The exit lies on the surface of the block of 2 n - 1 cells.
        end = (unit[k] + reach[k] * direction[k].astype(float)) * shape
        gap = np.abs(end - (indices[k] + 0.5)).max()
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
    distances = distance.numpy()
    half = tuple((unit * fine.shape).astype(int).T)
    np.testing.assert_array_equal(distances == 0, fine[half] > 0)
    cell_distances = brute_distance(fine.reshape(3, 2, 4, 2, 5, 2).any((1, 3, 5)))
    cell = tuple(cell.numpy().astype(int))
    np.testing.assert_array_equal(
        distances[distances >= 1], cell_distances[cell][distances >= 1]
    )
    assert set(distances[cell_distances[cell] == 0]) == {0, 0.5}
    # no way out of an octant leads past its faces
    reach = occupancy.exit(place, heading, mi.Point3f(*cell), distance).numpy()
    for k in np.flatnonzero(distances == 0.5):
        end = (unit[k] + reach[k] * direction[k].astype(float)) * fine.shape
        assert np.abs(end - np.array(half)[:, k] - 0.5).max() <= 0.501


def test_occupancy_clamps_positions_outside() -> None:
    cells = np.arange(8).reshape(2, 2, 2) == 7
    outside = mi.Point3f([-3, 4], [-3, 4], [-3, 4])
    distance, cell = Occupancy(cells).query(outside, mi.Bool(True))
    np.testing.assert_array_equal(distance.numpy(), [1, 0])
    np.testing.assert_array_equal(cell.numpy(), [[0, 1]] * 3)


def test_occupancy_fraction_and_shape() -> None:
    half = Occupancy(np.repeat([True, False], 12).reshape(2, 3, 4))
    assert (half.fraction, half.shape) == (0.5, (2, 3, 4))
    assert Occupancy.full(3).fraction == 1
    with pytest.raises(ValueError, match=r"occupancy: shape \(2, 2\)"):
        Occupancy(np.ones((2, 2), bool))


LAYOUTS = [(1, 2, 2), (1, 3, 3), (2, 3, 4), (3, 4, 12), (5, 6, 6), (16, 16, 64)]


@pytest.mark.parametrize("numbers", LAYOUTS)
def test_levels_are_those_of_the_encoding(numbers: tuple[int, int, int]) -> None:
    field = GridField(GridLayout(*numbers), -small.ONES, small.ONES)
    assert 4 * field.n_vertices == field.encoding.n_params
    for index, level in enumerate(field.levels()):
        start, resolution, scale = small.level_vertices(field, index)
        assert (level.scale, level.resolution) == (scale, resolution)
        assert level.vertices == slice(start, start + resolution**3)


@pytest.mark.parametrize("features", [2, 4, 8])
def test_size_of_a_hashed_table(features: int) -> None:
    layout = NGPLayout(6, features, 10, 4, 33, 16)
    field = NGPField(layout, -small.ONES, small.ONES)
    assert layout.n_params == field.encoding.n_params


@pytest.mark.parametrize("shape", [(1, 1, 1), (3, 2, 4), (20, 1, 7)])
def test_read_vertices_are_the_corners_of_cells_with_points(shape, rng) -> None:
    field = GridField(GridLayout(3, 4, 11), -small.ONES, small.ONES)
    cells = rng.random(shape) < 0.4
    cells[0, 0, 0] = True
    field.occupy(Occupancy(cells))
    held, expected = field.held_vertices(), np.zeros(field.n_vertices, bool)
    places = np.argwhere(cells)[rng.integers(cells.sum(), size=20000)]
    unit = (places + rng.random((20000, 3))) / shape
    for level in field.levels():
        low = np.floor(unit * level.scale).astype(int)
        for corner in np.ndindex(2, 2, 2):
            x, y, z = np.minimum(low + corner, level.resolution - 1).T
            n = level.resolution
            expected[level.vertices.start + x + n * (y + n * z)] = True
    assert not (expected & ~held).any()
    assert held.sum() == count_read(field.levels(), cells)
    assert held.sum() <= 1.3 * expected.sum() + 9  # and few others, at faces


def crossings(field: GridField) -> np.ndarray:
    """Return where planes of vertices meet in occupied cells, (n, 3) of the box."""
    planes = [np.arange(x.resolution) / x.scale for x in field.levels()]
    points = []
    for cell in np.argwhere(field.window.cells):
        edges = np.array([cell, cell + 1]) / field.window.cells.shape
        places = [
            [x for x in np.unique(np.concatenate([*planes, edge])) if a <= x <= b]
            for edge, a, b in zip(edges.T, *edges, strict=True)
        ]
        points.append(np.stack(np.meshgrid(*places), -1).reshape(-1, 3))
    return np.concatenate(points)


@pytest.mark.parametrize("layout", [GridLayout(4, 3, 9), GridLayout(1, 6, 6)])
@pytest.mark.parametrize("shape", [(1, 1, 1), (2, 3, 5), (40, 3, 2)])
def test_the_bound_is_the_largest_density_of_a_random_field(layout, shape, rng) -> None:
    field = GridField(layout, np.array([-1.0, -2, 0]), small.ONES, density_scale=0.3)
    cells = rng.random(shape) < 0.5
    cells[0, 0, 0] = True
    field.occupy(Occupancy(cells))
    for _ in range(2):  # a changed density has another bound
        raw = rng.normal(0, 1, field.n_vertices).astype(np.float32)
        field.set_parameter("density", raw)
        points = field.lower + crossings(field) * (field.upper - field.lower)
        expected = small.eval_grid(field, points)[0].max()
        assert field.density_bound() == pytest.approx(expected, rel=1e-5)
    before = field.density_bound()
    field.occupy(Occupancy(np.arange(cells.size).reshape(shape) == 0))
    assert field.density_bound() <= before
    field.occupy(Occupancy(np.zeros(shape, bool)))
    assert field.density_bound() == 0
