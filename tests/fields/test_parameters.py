"""Parameters of fields: whose memory they have, and which values are refused."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from support.faults.refusals import refusals
from support.worlds import fields as small
from support.worlds.places import small_grid

from mi_nerfattack.backend.colour import linear_to_srgb_numpy
from mi_nerfattack.errors import InputError
from mi_nerfattack.fields import BrickField, GridField, GridLayout, NGPField, Occupancy
from mi_nerfattack.fields.base import sky_colour
from mi_nerfattack.fields.bricks import Codes
from mi_nerfattack.fields.cpu.grid import LongWords, ShortWords, pack_words
from mi_nerfattack.fields.random_textures import KINDS, random_texture

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


def test_other_fields_do_not_share_the_memory_of_the_caller() -> None:
    direction, at = mi.Vector3f(0.6, 0, 0.8), mi.Point3f(0.1, 0.2, 0.3)
    made = small.small_ngp()
    tensors = {name: value.copy() for name, value in made.tensors().items()}
    ngp = NGPField(made.layout, made.lower, made.upper, tensors)
    octants, one = np.full((1, 1, 1), 255, np.uint8), np.ones(1, np.uint8)
    words, sky = np.full(8, 99, np.uint32), np.ones((2, 3, 3), np.float32)
    contents = Occupancy(octants > 0, octants), one, words, Codes(-1.0, 1.0), sky
    bricks = BrickField(-small.ONES, small.ONES, *contents, step_m=0.1, cone=0.0)

    def values() -> list[np.ndarray]:
        outputs = [bricks.occupancy.query(at, mi.Bool(True))[0]]
        for field in (ngp, bricks):
            outputs += [*field.eval(at, direction, mi.Bool(True))]
            outputs.append(field.background(direction))
        return [x.numpy() for x in outputs]

    before = values()
    for array in (*tensors.values(), octants, words, sky, one):
        array[...] = 3
    for old, new in zip(before, values(), strict=True):
        np.testing.assert_array_equal(old, new)
    assert (bricks.tensors()["subdivisions"] == 1).all()


@pytest.mark.parametrize("bad", [np.nan, -np.inf])
@pytest.mark.parametrize(
    "form", [np.asarray, lambda x: mi.TensorXf(x), lambda x: mi.Float(x.ravel())]
)
@pytest.mark.parametrize(("name", "index"), [("texture", (7, 1)), ("density", (7,))])
def test_values_that_are_not_finite(grid, name, index, form, bad) -> None:
    before = grid.parameters()[name].numpy().copy()
    array = before.copy()
    array[index] = bad
    with pytest.raises(InputError, match=f"{name}: 1 of {array.size} .* vertex 7"):
        grid.set_parameter(name, form(array))
    np.testing.assert_array_equal(grid.parameters()[name].numpy(), before)


@pytest.mark.parametrize("name", ["table", "density_weights", "colour_weights", "sky"])
def test_values_of_an_ngp_that_are_not_finite(name: str) -> None:
    field = small.small_ngp()
    old = field.parameters()[name]
    array = old.numpy().copy()
    array[[3, 5]] = np.nan
    with pytest.raises(InputError, match=f"{name}: 2 of {array.size} .* at value 3"):
        field.set_parameter(name, type(old)(array))


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
def test_a_direction_that_is_no_number_reads_inside_of_the_sky(towards, monkeypatch):
    direction = mi.Vector3f(*[mi.Float([v, 0.6]) for v in towards])
    indices, gather = [], dr.gather

    def record(kind, source, index, *arguments):
        indices.append(index.numpy().copy())
        return gather(kind, source, dr.minimum(index, 5), *arguments)

    monkeypatch.setattr(dr, "gather", record)
    colour = sky_colour(dr.ones(mi.Float, 2 * 3 * 3), (2, 3), direction)
    assert len(indices) == 4 and np.max(indices) < 2 * 3
    np.testing.assert_array_equal(np.isfinite(colour.numpy()), [[False, True]] * 3)


def read(values: np.ndarray) -> np.ndarray:
    """Pack, gather everything and undo the scale."""
    words = pack_words(values)
    index = dr.arange(mi.UInt32, len(values) // 2)
    pair = words.gather(index, mi.Bool(True))
    dr.eval(pair)
    return np.stack([x.numpy() * np.float32(words.scale) for x in pair], 1).ravel()


def every_half() -> np.ndarray:
    """Return all finite numbers of half precision."""
    values = np.arange(1 << 16, dtype=np.uint16).view(np.float16)
    return values[np.isfinite(values)].astype(np.float32)


def test_short_words_hold_every_half_below_128():
    values = every_half()
    values = values[np.abs(values) < 128]
    assert isinstance(pack_words(values), ShortWords)
    np.testing.assert_array_equal(read(values), values)


@pytest.mark.parametrize("odd", [128.0, -128.0, 0.1, 2.0**-25, 1e-42, 3e38])
def test_one_other_number_takes_long_words(odd):
    values = np.array([0.5, 0.25, -1.5, odd], np.float32)
    assert isinstance(pack_words(values), LongWords)
    np.testing.assert_array_equal(read(values), values)


def test_masked_pairs_are_zero():
    for odd in (0.5, 0.1):
        words = pack_words(np.array([odd, 2, 3, 4], np.float32))
        pair = words.gather(mi.UInt32([0, 1]), mi.Bool([False, True]))
        values = np.array(pair) * words.scale
        np.testing.assert_array_equal(values, [[0, 3], [0, 4]])


def test_memory_that_drjit_knows_is_copied():
    values = dr.linspace(mi.Float, 0.1, 0.9, 64)
    dr.eval(values)
    dr.sync_thread()
    np.testing.assert_array_equal(read(values.numpy()), values.numpy())


@pytest.fixture
def small_one() -> GridField:
    return small_grid()


def colours(field: GridField, kind: str, seed: int, shift: float = 0.0) -> np.ndarray:
    """Return sRGB colours (3, n) of a random texture, at the same random points."""
    field.set_parameter("texture", random_texture(field, kind, seed))
    unit = np.random.default_rng(0).uniform(0, 0.98, (3, 4000)) + shift
    point = field.lower[:, None] + unit * (field.upper - field.lower)[:, None]
    up = mi.Vector3f(0, 0, 1)
    _, radiance = field.eval(mi.Point3f(point.astype(np.float32)), up, mi.Bool(True))
    return linear_to_srgb_numpy(radiance.numpy())


@pytest.mark.parametrize("kind", KINDS)
def test_textures_cover_the_range_of_colours(small_one, kind):
    all_colours = np.stack([colours(small_one, kind, seed) for seed in range(40)])
    low, high = np.percentile(all_colours, [5, 95])
    assert low < 0.2 and high > 0.8
    assert abs(all_colours.mean() - 0.5) < 0.06
    assert np.isfinite(all_colours).all()
    if kind == "flat":
        assert np.ptp(all_colours, axis=2).max() < 4e-6


def test_blobs_are_smoother_than_noise(small_one):
    def roughness(kind: str) -> float:
        """Mean square change over 0.02 of the box, by the variance."""
        ratio = []
        for seed in range(10):
            unshifted, shifted = (
                colours(small_one, kind, seed, shift) for shift in (0, 0.02)
            )
            ratio.append(np.mean((shifted - unshifted) ** 2) / unshifted.var(1).mean())
        return float(np.mean(ratio))

    assert roughness("blobs") < 0.5 * roughness("noise")


test_refused = refusals(
    (lambda: random_texture(small_grid(), "stripes", 0), "'stripes'.*flat"),
    (lambda: random_texture(small_grid(), "flat", -1), "-1"),
)


def test_textures_depend_on_the_seed_alone(small_one):
    first = random_texture(small_one, "mixed", 3)
    np.testing.assert_array_equal(first, random_texture(small_one, "mixed", 3))
    assert first.shape == (small_one.n_vertices, 3)
    assert first.dtype == np.float32
    different = {
        random_texture(small_one, "mixed", seed).tobytes() for seed in range(12)
    }
    assert len(different) == 12
