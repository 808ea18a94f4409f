"""Bricks against interpolation in NumPy, their files, and their derivatives."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from scipy.interpolate import RegularGridInterpolator

from mi_nerfattack.errors import InputError
from mi_nerfattack.fields import BrickField, Occupancy, load_field, save_field
from mi_nerfattack.fields.bricks import Codes, vertex_count
from mi_nerfattack.io import files

pytestmark = pytest.mark.usefixtures("variant")

LOWER, UPPER = np.array([-1.0, 0.0, 2.0]), np.array([2.0, 2.0, 3.0])
CODES = Codes(-3.0, 2.0)


@pytest.fixture
def bricks(rng) -> BrickField:
    cells = rng.random((3, 2, 4)) < 0.6
    cells[0, 0, 0], cells[0, 0, 1] = True, False
    divided = rng.choice(np.array([1, 2, 4, 8], np.uint8), cells.sum())
    words = rng.integers(0, 1 << 32, vertex_count(divided), np.uint32)
    parts = Occupancy(cells), divided, words, CODES, rng.normal(size=(3, 5, 3))
    return BrickField(LOWER, UPPER, *parts, step_m=0.05, cone=0.01, info={"fit.a": "b"})


def test_it_interpolates_the_bytes_of_vertices(bricks, rng):
    cells = np.argwhere(bricks.occupancy.cells)
    ends = np.cumsum((bricks.subdivisions.astype(int) + 1) ** 3)
    words = bricks.vertices.numpy()
    for k, (cell, n) in enumerate(
        zip(cells, bricks.subdivisions.tolist(), strict=True)
    ):
        mine = words[ends[k] - (n + 1) ** 3 : ends[k]].view(np.uint8)
        values = mine.reshape(n + 1, n + 1, n + 1, 4).astype(float)
        inside = rng.uniform(0, 1, (20, 3))
        expected = RegularGridInterpolator([np.linspace(0, 1, n + 1)] * 3, values)(
            inside
        )
        unit = (cell + inside) / bricks.occupancy.shape
        points = LOWER + unit * (UPPER - LOWER)
        found = bricks.eval_everywhere(
            mi.Point3f(points.T.copy()), mi.Vector3f(0, 0, 1), mi.Bool(True)
        )
        density = np.exp(-3 + expected[:, 0] / 255 * 5)
        np.testing.assert_allclose(found[0].numpy(), density, rtol=2e-4)
        colour = expected[:, 1:] / 255
        linear = np.where(
            colour <= 0.04045, colour / 12.92, ((colour + 0.055) / 1.055) ** 2.4
        )
        np.testing.assert_allclose(found[1].numpy().T, linear, atol=2e-4)


def test_its_derivative_by_the_position(bricks):
    # in the first brick, away from the faces of its parts
    at = LOWER + (UPPER - LOWER) / bricks.occupancy.shape * [0.29, 0.41, 0.66]
    point, step = mi.Point3f(*at.tolist()), 1e-3

    def density(place):
        return bricks.eval_everywhere(place, mi.Vector3f(0, 0, 1), mi.Bool(True))[0]

    dr.enable_grad(point)
    dr.backward(density(point))
    for axis in range(3):
        offset = [step * (k == axis) for k in range(3)]
        ends = [density(dr.detach(point) + mi.Point3f(offset) * s) for s in (1, -1)]
        expected = float((ends[0] - ends[1])[0]) / (2 * step)
        assert expected != 0
        assert float(dr.grad(point)[axis][0]) == pytest.approx(expected, rel=2e-2)


def test_files_keep_everything(bricks, tmp_path, rng):
    save_field(tmp_path / "a.safetensors", bricks)
    found = load_field(tmp_path / "a.safetensors")
    assert isinstance(found, BrickField)
    assert found.metadata() == bricks.metadata() and found.codes == CODES
    points = mi.Point3f(rng.uniform(LOWER, UPPER, (50, 3)).T.copy())
    values = []
    for field in (bricks, found):
        density, colour = field.eval(points, mi.Vector3f(0, 0, 1), mi.Bool(True))
        sky = field.background(mi.Vector3f(0.6, 0, 0.8))
        values.append([x.numpy() for x in (density, colour, sky)])
    first, second = values
    for a, b in zip(first, second, strict=True):
        np.testing.assert_array_equal(a, b)
    assert (first[0] == 0).any() and (first[0] > 0).any()
    save_field(tmp_path / "b.safetensors", found)
    assert (tmp_path / "a.safetensors").read_bytes() == (
        tmp_path / "b.safetensors"
    ).read_bytes()


@pytest.mark.parametrize("name", ["subdivisions", "vertices", "sky", "log_density"])
def test_damaged_files(bricks, tmp_path, name):
    path = tmp_path / "f.safetensors"
    save_field(path, bricks)
    tensors, header = files.read_safetensors(path)
    if name in header:
        header[name] = "low high"
    else:
        tensors[name] = tensors[name][:-1].copy() if name != "sky" else np.zeros(4)
    files.write_safetensors(path, tensors, header)
    with pytest.raises(InputError, match=rf"f\.safetensors: .*{name}"):
        load_field(path)


def test_subdivisions_are_powers_of_two(bricks):
    divided = bricks.subdivisions.copy()
    divided[0] = 3
    with pytest.raises(InputError, match="of 1, 2, 4 and 8"):
        BrickField(
            LOWER,
            UPPER,
            bricks.occupancy,
            divided,
            np.zeros(vertex_count(divided), np.uint32),
            CODES,
            np.zeros((2, 2, 3)),
            0.1,
            0.0,
        )
