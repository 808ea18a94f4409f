"""Parameters of fields: whose memory they have, and which values are refused."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from helpers import small_fields as small

from mi_nerfattack.errors import InputError
from mi_nerfattack.fields import BrickField, GridField, GridLayout, NGPField, Occupancy
from mi_nerfattack.fields.bricks import Codes
from mi_nerfattack.fields.sky import sky_colour

pytestmark = pytest.mark.usefixtures("variant")


@pytest.fixture
def grid() -> GridField:
    return GridField(GridLayout(2, 3, 5), -small.ONES, small.ONES)


@pytest.mark.parametrize("name", ["density", "texture"])
@pytest.mark.parametrize("makes", [True, False], ids=["constructor", "set_parameter"])
def test_a_grid_does_not_share_the_memory_of_the_caller(grid, name, makes, rng) -> None:
    array = np.zeros(grid.parameters()[name].shape, np.float32)
    if makes:
        grid = GridField(grid.layout, grid.lower, grid.upper, **{name: array})
    else:
        grid.set_parameter(name, array)
    array[:] = 5
    assert (grid.parameters()[name].numpy() == 0).all()
    other = "density" if name == "texture" else "texture"
    grid.set_parameter(other, grid.parameters()[other])  # packs both again
    assert (grid.packed.numpy() == 0).all()


def test_other_fields_do_not_share_the_memory_of_the_caller(rng) -> None:
    direction, at = mi.Vector3f(0.6, 0, 0.8), mi.Point3f(0.1, 0.2, 0.3)
    tensors = small.small_ngp().tensors()
    given = {name: value.copy() for name, value in tensors.items()}
    ngp = NGPField(small.small_ngp().layout, -small.ONES, small.ONES, given)
    octants = np.full((1, 1, 1), 255, np.uint8)
    words, sky = np.full(8, 99, np.uint32), np.ones((2, 3, 3), np.float32)
    one = np.ones(1, np.uint8)
    parts = Occupancy(octants > 0, octants), one, words, Codes(-1.0, 1.0), sky
    bricks = BrickField(-small.ONES, small.ONES, *parts, step_m=0.1, cone=0.0)
    fields = [ngp, bricks]

    def values() -> list[np.ndarray]:
        seen = [x for f in fields for x in f.eval(at, direction, mi.Bool(True))]
        seen += [field.background(direction) for field in fields]
        seen += [bricks.occupancy.query(at, mi.Bool(True))[0]]
        return [x.numpy() for x in seen]

    before = values()
    for array in (*given.values(), octants, words, sky, one):
        array[...] = 3
    for old, new in zip(before, values(), strict=True):
        np.testing.assert_array_equal(old, new)
    assert (bricks.tensors()["subdivisions"] == 1).all()


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize(
    "form", [np.asarray, lambda x: mi.TensorXf(x), lambda x: mi.Float(x.ravel())]
)
@pytest.mark.parametrize(
    ("name", "index", "message"),
    [
        ("texture", (7, 1), "texture: 1 of {} values .* first at vertex 7; lower the"),
        ("density", (7,), "density: 1 of {} values .* first at vertex 7; lower the"),
    ],
)
def test_values_that_are_not_finite(grid, name, index, message, form, bad) -> None:
    before = grid.parameters()[name].numpy().copy()
    array = before.copy()
    array[index] = bad
    with pytest.raises(InputError, match=message.format(array.size)):
        grid.set_parameter(name, form(array))
    np.testing.assert_array_equal(grid.parameters()[name].numpy(), before)


@pytest.mark.parametrize("name", ["table", "density_weights", "colour_weights", "sky"])
def test_values_of_an_ngp_that_are_not_finite(name: str) -> None:
    field = small.small_ngp()
    old = field.parameters()[name]
    array = old.numpy().copy()
    array[[3, 5]] = np.nan
    with pytest.raises(InputError, match=f"{name}: 2 of {array.size} .* at value 3; "):
        field.set_parameter(name, type(old)(array))


def test_attached_values_stay_attached(grid) -> None:
    texture = dr.zeros(mi.TensorXf, grid.texture.shape)
    dr.enable_grad(texture)
    grid.set_parameter("texture", texture)
    dr.backward(dr.sum(grid.packed))
    np.testing.assert_array_equal(dr.grad(texture).numpy(), 1)


def test_a_second_call_compiles_nothing(grid) -> None:
    values = [dr.full(mi.TensorXf, k, grid.texture.shape) for k in (0.1, 0.2, 0.3)]
    dr.make_opaque(values)
    grid.set_parameter("texture", values[0])
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        for value in values[1:]:
            grid.set_parameter("texture", value)
        kernels = dr.kernel_history([dr.KernelType.JIT])
    assert len(kernels) == 4  # finite and packed, twice
    assert all(kernel["cache_hit"] for kernel in kernels)


def test_a_frozen_function_may_set_a_texture(grid) -> None:
    @dr.freeze(state_fn=lambda texture: grid.parameters()["density"])
    def packed(texture: mi.TensorXf) -> mi.Float:
        grid.set_parameter("texture", texture)
        return mi.Float(grid.packed)

    for k in (1.0, 2.0):
        texture = dr.full(mi.TensorXf, k, grid.texture.shape)
        dr.make_opaque(texture)
        colours = packed(texture).numpy().reshape(-1, 4)[:, 1:]
        np.testing.assert_array_equal(colours, k)


@pytest.mark.parametrize("towards", [(np.inf, -np.inf, 0), (0, 0.6, np.nan)])
def test_a_direction_that_is_no_number_reads_inside_of_the_sky(
    towards, monkeypatch
) -> None:
    direction = mi.Vector3f(*[mi.Float([v, 0.6]) for v in towards])
    indices, gather = [], dr.gather

    def record(kind, source, index, *more):
        indices.append(index.numpy().copy())
        return gather(kind, source, dr.minimum(index, 5), *more)

    monkeypatch.setattr(dr, "gather", record)
    colour = sky_colour(dr.ones(mi.Float, 2 * 3 * 3), (2, 3), direction)
    assert len(indices) == 4
    assert max(index.max() for index in indices) < 2 * 3
    np.testing.assert_array_equal(np.isfinite(colour.numpy()), [[False, True]] * 3)
