"""Levels of grids against Dr.Jit's encoding, and the largest sum of them."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest
from helpers import small_fields as small

from mi_nerfattack.errors import InputError
from mi_nerfattack.fields import (
    GridField,
    GridLayout,
    NGPField,
    NGPLayout,
    Occupancy,
    load_grid,
)
from mi_nerfattack.fields.levels import count_read
from mi_nerfattack.scenes import bundled

pytestmark = pytest.mark.usefixtures("variant")

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


@pytest.mark.parametrize(
    ("layout", "name"),
    [
        (lambda: GridLayout(32, 256, 512), "levels: 32, from 256 to 512"),
        (lambda: NGPLayout(32, 8, 24, 1024, 65536), "log2_table: 24"),
    ],
)
def test_layouts_that_no_kernel_can_index(layout, name: str) -> None:
    with pytest.raises(InputError, match=name):
        layout()


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
    found = []
    for cell in np.argwhere(field.window.cells):
        edges = np.array([cell, cell + 1]) / field.window.cells.shape
        places = [
            [x for x in np.unique(np.concatenate([*planes, edge])) if a <= x <= b]
            for edge, a, b in zip(edges.T, *edges, strict=True)
        ]
        found.append(np.stack(np.meshgrid(*places), -1).reshape(-1, 3))
    return np.concatenate(found)


def densities(field: GridField, rng: np.random.Generator, count: int) -> np.ndarray:
    """Evaluate at random points of occupied cells, half of them near faces."""
    cells = np.argwhere(field.window.cells)
    inside = rng.random((count, 3))
    inside[::2] = np.round(inside[::2] * 64) / 64
    unit = (
        cells[rng.integers(len(cells), size=count)] + inside
    ) / field.window.cells.shape
    points = field.lower + unit * (field.upper - field.lower)
    return field.density(
        mi.Point3f(points.T.astype(np.float32).copy()), mi.Bool(True)
    ).numpy()


@pytest.mark.parametrize("name", ["hydrant", "car"])
def test_the_bound_of_a_bundled_field_is_tight(name: str, rng) -> None:
    field = load_grid(bundled(f"{name}/field.safetensors"))
    largest = densities(field, rng, 1_000_000).max()
    assert largest <= field.density_bound() * (1 + 1e-5)
    assert field.density_bound() <= 2 * largest


@pytest.mark.parametrize("shape", [(1, 1, 1), (2, 3, 5), (40, 3, 2)])
def test_the_bound_is_the_largest_density_of_a_random_field(shape, rng) -> None:
    field = GridField(
        GridLayout(4, 3, 9), np.array([-1.0, -2, 0]), small.ONES, density_scale=0.3
    )
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


def test_the_bound_of_one_level_is_its_largest_vertex(rng) -> None:
    field = GridField(GridLayout(1, 6, 6), -small.ONES, small.ONES)
    raw = rng.normal(0, 2, field.n_vertices).astype(np.float32)
    field.set_parameter("density", raw)
    expected = np.exp(raw[: 6**3].max())
    assert field.density_bound() == pytest.approx(expected, rel=1e-5)


def test_an_empty_field_has_the_bound_0() -> None:
    field = GridField(GridLayout(2, 3, 4), -small.ONES, small.ONES)
    field.occupy(Occupancy(np.zeros((2, 2, 2), bool)))
    assert field.density_bound() == 0
