"""Field files: round trips, and what is said about damaged ones."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
from helpers import small_fields as small

from mi_nerfattack import InputError
from mi_nerfattack.fields import (
    GridField,
    GridLayout,
    NGPField,
    Occupancy,
    load_field,
    load_grid,
    save_field,
)
from mi_nerfattack.io import files

pytestmark = pytest.mark.usefixtures("variant")


def test_grid_file_keeps_all_within_half_precision(tmp_path, rng) -> None:
    field = small.blob(rng)
    cells = rng.random((3, 4, 5)) < 0.5
    field = GridField(
        field.layout,
        np.array([-1.0, -2, 0]),
        np.array([1.0, 2, 0.7]),
        density=field.parameters()["density"].numpy(),
        texture=field.texture.numpy(),
        occupancy=Occupancy(cells),
        density_scale=3.25,
        step_m=0.0123,
        info={"provenance": "test", "fit.psnr": "30.1"},
    )
    save_field(tmp_path / "a.safetensors", field)
    found = load_grid(tmp_path / "a.safetensors")
    held = field.held_vertices()
    half = np.where(held[:, None], field.texture.numpy(), 0).astype(np.float16)
    np.testing.assert_array_equal(found.texture, half)
    raw = np.where(held, field.parameters()["density"].numpy(), 0).astype(np.float16)
    np.testing.assert_array_equal(found.parameters()["density"].numpy(), raw)
    np.testing.assert_array_equal(found.occupancy.cells, cells)
    assert found.metadata() == field.metadata()
    assert (found.step_m, found.density_scale) == (0.0123, 3.25)
    np.testing.assert_array_equal(found.upper, field.upper)
    save_field(tmp_path / "b.safetensors", found)
    first, second = [(tmp_path / f"{x}.safetensors").read_bytes() for x in "ab"]
    assert first == second


def write_all_vertices(path: Path, field: GridField) -> None:
    """Write a file as earlier versions did."""
    header = {"format": "mi_nerfattack field 1", **field.metadata()}
    tensors = {
        "density": field.parameters()["density"].numpy().astype(np.float16),
        "texture": field.texture.numpy().astype(np.float16),
        **field.occupancy_tensors(),
    }
    files.write_safetensors(path, tensors, header)


def test_a_file_shows_what_one_of_all_vertices_does(tmp_path, rng) -> None:
    """To the bit, up to the faces of occupied cells."""
    field, cells = small.blob(rng), rng.random((3, 7, 5)) < 0.2
    field.occupy(Occupancy(cells))
    write_all_vertices(tmp_path / "all.safetensors", field)
    old = load_grid(tmp_path / "all.safetensors")
    half = field.texture.numpy().astype(np.float16)
    np.testing.assert_array_equal(old.texture, half)
    save_field(tmp_path / "held.safetensors", old)
    found = load_grid(tmp_path / "held.safetensors")
    assert (np.array(found.texture) != half).any()
    inside = np.argwhere(cells)[rng.integers(cells.sum(), size=2000)]
    at = rng.uniform(0, 1, (2000, 3))
    at = np.where(
        rng.random((2000, 3)) < 0.3, rng.choice([1e-7, 1 - 1e-7], at.shape), at
    )
    points = 2 * (inside + at) / cells.shape - 1
    expected = small.evaluate(old, points)
    assert expected[0].max() > 0.01
    for value, other in zip(small.evaluate(found, points), expected, strict=True):
        np.testing.assert_array_equal(value, other)


def test_held_are_the_vertices_that_a_cell_reads() -> None:
    """The middle one of three lies from 2.67 to 5.33 of 8."""
    field, cells = GridField(GridLayout(1, 9, 9), -small.ONES, small.ONES), (3, 3, 3)
    occupied = np.zeros(cells, bool)
    occupied[1, 1, 1] = True
    field.occupy(Occupancy(occupied))
    expected = np.zeros((9, 9, 9), bool)
    expected[2:7, 2:7, 2:7] = True
    np.testing.assert_array_equal(field.held_vertices()[:729], expected.ravel())


def test_ngp_file_evaluates_the_same(tmp_path: Path, rng: np.random.Generator) -> None:
    field = small.small_ngp(cone=1 / 64)
    table = field.parameters()["table"].numpy().astype(np.float16).astype(np.float32)
    field.set_parameter("table", mi.Float(table))
    save_field(tmp_path / "a.safetensors", field)
    found = load_field(tmp_path / "a.safetensors")
    assert isinstance(found, NGPField)
    assert found.metadata() == field.metadata() and found.cone == 1 / 64
    points = rng.uniform(-1, 1, (20, 3))
    for a, b in zip(
        small.evaluate(found, points), small.evaluate(field, points), strict=True
    ):
        np.testing.assert_array_equal(a, b)
    direction = mi.Vector3f(0.6, 0, 0.8)
    np.testing.assert_array_equal(
        found.background(direction).numpy(), field.background(direction).numpy()
    )
    save_field(tmp_path / "b.safetensors", found)
    first, second = [(tmp_path / f"{x}.safetensors").read_bytes() for x in "ab"]
    assert first == second


def test_octants_of_occupied_cells_are_kept(tmp_path, rng) -> None:
    field, path = small.small_ngp(), tmp_path / "a.safetensors"
    cells = rng.random((3, 4, 5)) < 0.5
    octants = rng.integers(0, 256, cells.shape, np.uint8)
    field.occupy(Occupancy(cells, octants))
    save_field(path, field)
    found = load_field(path).occupancy
    np.testing.assert_array_equal(found.octants, np.where(cells, octants, 0))
    tensors, header = files.read_safetensors(path)
    for bad in (tensors["octants"][1:], tensors["octants"].astype(np.float32)):
        files.write_safetensors(path, {**tensors, "octants": bad}, header)
        with pytest.raises(
            InputError, match=r"a\.safetensors: octants: .* a byte each"
        ):
            load_field(path)


def test_load_grid_refuses_an_ngp(tmp_path: Path) -> None:
    save_field(tmp_path / "n.safetensors", small.small_ngp())
    with pytest.raises(InputError, match=r"n\.safetensors: is a ngp_field"):
        load_grid(tmp_path / "n.safetensors")


@pytest.fixture
def stored(tmp_path: Path) -> tuple[Path, dict, dict]:
    """A good grid field file, with its tensors and its header to spoil."""
    path = tmp_path / "f.safetensors"
    save_field(path, GridField(GridLayout(1, 3, 3), -small.ONES, small.ONES))
    return path, *files.read_safetensors(path)


@pytest.mark.parametrize(
    ("entry", "value", "message"),
    [
        ("format", "other 1", "'format' is 'other 1'; expected"),
        ("kind", "mesh", "'kind' is 'mesh'; allowed: grid_field, ngp_field"),
        ("levels", "two", "'levels' holds 'two'; expected int"),
        ("levels", "0", "levels: 0; allowed"),
        ("levels", "2", "density: shape"),
        ("lower", "1 1", "bounding box"),
        ("upper", "1 1 x", "'upper' holds 'x'; expected float"),
        ("step_m", "0", "step_m: 0.0; must be positive"),
        ("step_m", "nan", "step_m: nan; must be positive"),
        ("density_scale", "-1", "density_scale: -1.0"),
        ("occupancy_shape", "9 9 9", "occupancy: 1 bytes for a grid of"),
        ("occupancy_shape", "-1 -1 1", "occupancy"),
        ("occupancy_shape", "1 1", "occupancy: 1 bytes for a grid of"),
    ],
)
def test_wrong_header_entries(stored, entry: str, value: str, message: str) -> None:
    path, tensors, header = stored
    files.write_safetensors(path, tensors, {**header, entry: value})
    with pytest.raises(InputError, match=message) as caught:
        load_field(path)
    assert str(caught.value).startswith(str(path))


@pytest.mark.parametrize(
    "entry",
    [
        *("levels", "upper", "step_m", "occupancy_shape"),
        *("density", "texture", "occupancy"),
    ],
)
def test_missing_entries(stored, entry: str) -> None:
    path, tensors, header = stored
    del (header if entry in header else tensors)[entry]
    files.write_safetensors(path, tensors, header)
    with pytest.raises(InputError, match=f"entry '{entry}' is missing") as caught:
        load_field(path)
    assert str(path) in str(caught.value)


@pytest.mark.parametrize(
    ("name", "change", "message"),
    [
        ("density", lambda raw: raw[1:], r"density: shape \(26,\); 27 .* of 28; "),
        ("density", lambda raw: raw[0], r"density: shape \(\); 27 vertices are held"),
        ("texture", lambda raw: raw[1:], r"texture: shape \(26, 3\); 27 vertices"),
        ("texture", lambda raw: raw[:, 1:], r"texture: shape \(27, 2\); 27 vertices"),
        ("occupancy", lambda bits: 0 * bits, r"density: shape \(27,\); 0 vertices"),
    ],
)
def test_damaged_vertices(stored, name: str, change, message: str) -> None:
    path, tensors, header = stored
    changed = np.array(change(tensors[name]))
    files.write_safetensors(path, {**tensors, name: changed}, header)
    with pytest.raises(InputError, match=f"{path}: {message}"):
        load_field(path)


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_texture_that_is_not_finite(stored, bad: float) -> None:
    path, tensors, header = stored
    texture = tensors["texture"].copy()
    texture[5, 1] = bad
    files.write_safetensors(path, {**tensors, "texture": texture}, header)
    with pytest.raises(InputError, match=r"f\.safetensors: tensor 'texture' holds NaN"):
        load_field(path)


@pytest.mark.parametrize("bad", [1e5, -1e5])
def test_fields_that_no_file_can_hold_are_not_written(tmp_path, bad: float) -> None:
    path = tmp_path / "f.safetensors"
    field = GridField(GridLayout(1, 3, 3), -small.ONES, small.ONES)
    texture = np.zeros((field.n_vertices, 3), np.float32)
    texture[5, 1] = bad
    field.set_parameter("texture", texture)
    with pytest.raises(InputError, match="tensor 'texture' holds NaN.*up to 65504"):
        save_field(path, field)
    assert not path.exists()


@pytest.mark.parametrize("name", ["density_net.1", "colour_net.0", "colour_net.2"])
def test_ngp_whose_sums_overflow(tmp_path: Path, name: str) -> None:
    """Infinity less infinity would be NaN in the picture."""
    path = tmp_path / "n.safetensors"
    save_field(path, small.small_ngp())
    tensors, header = files.read_safetensors(path)
    sign = np.where(np.arange(tensors[name].size) % 2, 1.0, -1.0)
    tensors[name] = (1e38 * sign).astype(np.float32).reshape(tensors[name].shape)
    files.write_safetensors(path, tensors, header)
    with pytest.raises(InputError, match=f"{path}: tensor '{name}': weights up to 1e"):
        load_field(path)


def test_ngp_matrix_of_another_shape(tmp_path: Path) -> None:
    path = tmp_path / "n.safetensors"
    save_field(path, small.small_ngp())
    tensors, header = files.read_safetensors(path)
    tensors["colour_net.1"] = np.zeros((3, 3), np.float32)
    files.write_safetensors(path, tensors, header)
    with pytest.raises(InputError, match=r"colour_net\.1: shape \(3, 3\); expected"):
        load_field(path)


def test_tensors_that_are_no_numbers_with_fractions(stored) -> None:
    path, tensors, header = stored
    tensors["density"] = np.zeros(tensors["density"].shape, np.int32)
    files.write_safetensors(path, tensors, header)
    with pytest.raises(InputError, match=f"{path}: density: type int32; expected"):
        load_field(path)


#: Loads files named on standard input; prints how far the peak of memory rose, bytes.
MEASURE = """
import sys
from mi_nerfattack import InputError, variant
from mi_nerfattack.fields import load_field

def peak():
    lines = open("/proc/self/status").read().splitlines()
    return next(int(x.split()[1]) for x in lines if x.startswith("VmHWM")) * 1024

variant.ensure()
good, *damaged = sys.stdin.read().split()
load_field(good)
for path in damaged:
    before = peak()
    try:
        load_field(path)
    except InputError as err:
        print(peak() - before, err)
"""

#: Changes of header entries and tensors: what is left of a file claims large arrays.
MANY = {"occupancy_shape": "192 192 192"}
BITS = {"occupancy": np.full(192**3 // 8, 255, np.uint8)}
DAMAGED = {
    "grid of two large levels": (
        small.homogeneous,
        {"levels": "2", "base_resolution": "230", "max_resolution": "240"},
        {},
        "density",
    ),
    "grid too large for kernels": (
        small.homogeneous,
        {"levels": "32", "base_resolution": "256", "max_resolution": "512"},
        {},
        "levels",
    ),
    "grid of many cells": (
        small.homogeneous,
        MANY,
        {**BITS, "density": np.zeros(3, np.float16)},
        "density",
    ),
    "ngp of a large table": (
        small.small_ngp,
        {"log2_table": "22", "max_resolution": "2048"},
        {},
        "table",
    ),
    "ngp of wide networks": (small.small_ngp, {"width": "256"}, {}, "density_net.0"),
    "ngp of many cells": (small.small_ngp, MANY | {"levels": "5"}, BITS, "table"),
    "bricks of many cells": (
        lambda: small.small_bricks(np.random.default_rng(0)),
        MANY,
        BITS,
        "subdivisions",
    ),
}


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="Linux tells peaks")
def test_damaged_files_are_refused_before_they_take_memory(tmp_path: Path) -> None:
    good = tmp_path / "good.safetensors"
    save_field(good, small.homogeneous())
    paths = [good]
    for make, entries, arrays, _ in DAMAGED.values():
        path = tmp_path / f"{len(paths)}.safetensors"
        save_field(path, make())
        tensors, header = files.read_safetensors(path)
        tensors.pop("octants", None)
        files.write_safetensors(path, tensors | arrays, header | entries)
        paths.append(path)
    names = "\n".join(map(str, paths))
    command = [sys.executable, "-c", MEASURE]
    result = subprocess.run(command, input=names, capture_output=True, text=True)
    assert result.returncode == 0, result.stderr
    lines = result.stdout.splitlines()
    for line, path, row in zip(lines, paths[1:], DAMAGED.values(), strict=True):
        grown, message = line.split(" ", 1)
        assert message.startswith(f"{path}: {row[-1]}: "), message
        assert int(grown) < 20e6, line
