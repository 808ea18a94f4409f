"""Random textures of grid fields."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest
from helpers.roadside import small_grid

from mi_nerfattack.backend.colour import linear_to_srgb_numpy
from mi_nerfattack.errors import InputError
from mi_nerfattack.fields.grid import GridField
from mi_nerfattack.fields.random_textures import KINDS, random_texture


@pytest.fixture
def grid(variant) -> GridField:
    return small_grid()


def colours(field: GridField, texture: np.ndarray) -> np.ndarray:
    """sRGB colours (3, n) at random points of the field."""
    field.set_parameter("texture", texture)
    unit = np.random.default_rng(0).uniform(0, 1, (3, 4000))
    point = field.lower[:, None] + unit * (field.upper - field.lower)[:, None]
    up = mi.Vector3f(0, 0, 1)
    _, radiance = field.eval(mi.Point3f(point.astype(np.float32)), up, mi.Bool(True))
    return linear_to_srgb_numpy(radiance.numpy())


@pytest.mark.parametrize("kind", KINDS)
def test_textures_cover_the_range_of_colours(grid, kind):
    all_colours = np.stack(
        [colours(grid, random_texture(grid, kind, seed)) for seed in range(40)]
    )
    low, high = np.percentile(all_colours, [5, 95])
    assert low < 0.2
    assert high > 0.8
    assert abs(all_colours.mean() - 0.5) < 0.06
    assert np.isfinite(all_colours).all()


def test_flat_texture_has_one_colour(grid):
    for seed in range(3):
        found = colours(grid, random_texture(grid, "flat", seed))
        np.testing.assert_allclose(found, found[:, :1].repeat(4000, 1), atol=2e-6)


def test_blobs_are_smoother_than_noise(grid):
    def roughness(kind: str) -> float:
        """Mean square change over 0.02 of the box, by the variance."""
        ratio = []
        for seed in range(10):
            grid.set_parameter("texture", random_texture(grid, kind, seed))
            unit = np.random.default_rng(1).uniform(0, 0.98, (3, 3000))
            values = []
            for shift in (0.0, 0.02):
                point = grid.lower[:, None] + (unit + shift) * np.array(
                    [[0.4], [0.4], [0.8]]
                )
                at = mi.Point3f(point.astype(np.float32))
                seen = grid.eval(at, mi.Vector3f(0, 0, 1), mi.Bool(True))[1]
                values.append(linear_to_srgb_numpy(seen.numpy()))
            ratio.append(
                np.mean((values[1] - values[0]) ** 2) / values[0].var(1).mean()
            )
        return float(np.mean(ratio))

    assert roughness("blobs") < 0.5 * roughness("noise")


def test_textures_depend_on_the_seed_alone(grid):
    first = random_texture(grid, "mixed", 3)
    np.testing.assert_array_equal(first, random_texture(grid, "mixed", 3))
    assert first.shape == (grid.n_vertices, 3)
    assert first.dtype == np.float32
    different = {random_texture(grid, "mixed", seed).tobytes() for seed in range(12)}
    assert len(different) == 12


def test_unknown_kind_and_negative_seed_are_refused(grid):
    with pytest.raises(InputError, match="'stripes'.*flat"):
        random_texture(grid, "stripes", 0)
    with pytest.raises(InputError, match="-1"):
        random_texture(grid, "flat", -1)
