"""Field files are what `docs/fields.md` says: read by NumPy alone, they are equal."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest
from helpers.file_reader import FileReader
from helpers.small_fields import small_bricks

from mi_nerfattack.fields import GridField, load_field, save_field
from mi_nerfattack.scenes import bundled

pytestmark = pytest.mark.usefixtures("variant")


@pytest.mark.parametrize("name", ["hydrant", "intersection", "bricks"])
def test_a_reader_written_from_the_page_sees_the_same_field(name, rng, tmp_path):
    path = tmp_path / "bricks.safetensors"
    if name == "bricks":
        save_field(path, small_bricks(rng))
    else:
        path = bundled(f"{name}/field.safetensors")
    field, reader = load_field(path), FileReader(path)
    np.testing.assert_array_equal(reader.cells, field.occupancy.cells)
    anywhere = rng.uniform(0, 1, (300, 3))
    cells = np.argwhere(field.occupancy.cells)
    inside = cells[rng.integers(len(cells), size=300)] + rng.uniform(0, 1, (300, 3))
    unit = np.vstack([anywhere, inside / field.occupancy.shape]).astype(np.float32)
    # in single precision, as they reach the field
    points = (field.lower + unit * (field.upper - field.lower)).astype(np.float32)
    directions = rng.normal(0, 1, (600, 3)).astype(np.float32)
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)

    towards = mi.Vector3f(directions.T.copy())
    density, radiance = field.eval(mi.Point3f(points.T.copy()), towards, mi.Bool(True))
    there = reader.cells[tuple((unit * reader.cells.shape).astype(int).T)]
    expected = np.where(there, reader.density(points.astype(float)), 0)
    limit = 1e-6 * expected.max()  # where it is about to vanish
    rounding = 8 * np.spacing(np.abs(points)).astype(float)  # of places in the box
    near = points + rounding * np.vstack([np.eye(3), -np.eye(3)])[:, None]
    around = [np.where(there, reader.density(place), 0) for place in near]
    spread = np.abs(np.array(around) - expected).max(0)
    seen = expected > 100 * limit
    assert np.median(spread[seen] / expected[seen]) < 1e-3
    limit = limit + spread
    assert (np.abs(np.array(density) - expected) <= limit + 2e-3 * expected).all()
    expected = reader.radiance(points.astype(float), directions.astype(float))
    if name != "intersection":  # where nothing can be there is no colour
        radiance, expected = np.array(radiance)[:, there], expected[there]
    np.testing.assert_allclose(np.array(radiance).T, expected, atol=5e-4)
    assert expected.std() > 0.05
    if not isinstance(field, GridField):
        sky = np.array(field.background(towards)).T
        expected = reader.background(directions.astype(float))
        np.testing.assert_allclose(sky, expected, atol=1e-4)
