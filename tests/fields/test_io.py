"""Field files: round trips, and what is said about damaged ones."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
from support.reference.fields import FileReader
from support.worlds import fields as small
from support.worlds.fields import small_bricks

from mi_nerfattack import InputError
from mi_nerfattack.fields import (
    GridField,
    GridLayout,
    Occupancy,
    load_field,
    load_grid,
    save_field,
)
from mi_nerfattack.fields.io import AnyField
from mi_nerfattack.io import files
from mi_nerfattack.scenes import bundled

pytestmark = pytest.mark.usefixtures("variant")


def check_rewritten(folder: Path, field: AnyField) -> AnyField:
    """Check that a field from a file is written to the same bytes, and return it."""
    first, second = folder / "a.safetensors", folder / "b.safetensors"
    save_field(first, field)
    loaded = load_field(first)
    assert type(loaded) is type(field) and loaded.metadata() == field.metadata()
    save_field(second, loaded)
    assert first.read_bytes() == second.read_bytes()
    return loaded


def appearance(field: AnyField, points: np.ndarray) -> list[np.ndarray]:
    """Return density, radiance and background, at and behind points."""
    sky = field.background(mi.Vector3f(0.6, 0, 0.8)).numpy()
    return [*small.evaluate(field, points), sky]


def test_grid_file_keeps_all_within_half_precision(tmp_path, rng) -> None:
    field = small.blob(rng)
    cells = rng.random((3, 4, 5)) < 0.5
    density, texture = field.parameters()["density"].numpy(), field.texture.numpy()
    field = GridField(
        field.layout,
        np.array([-1.0, -2, 0]),
        np.array([1.0, 2, 0.7]),
        density=density,
        texture=texture,
        occupancy=Occupancy(cells),
        density_scale=3.25,
        step_m=0.0123,
        info={"provenance": "test", "fit.psnr": "30.1"},
    )
    loaded = check_rewritten(tmp_path, field)
    held = field.held_vertices()
    half = np.where(held[:, None], texture, 0).astype(np.float16)
    np.testing.assert_array_equal(loaded.texture, half)
    raw = np.where(held, density, 0).astype(np.float16)
    np.testing.assert_array_equal(loaded.parameters()["density"].numpy(), raw)
    np.testing.assert_array_equal(loaded.occupancy.cells, cells)
    assert (loaded.step_m, loaded.density_scale) == (0.0123, 3.25)
    np.testing.assert_array_equal(loaded.upper, field.upper)


def write_all_vertices(path: Path, field: GridField) -> None:
    """Write a file as earlier versions did."""
    header = {"format": "mi_nerfattack field 1", **field.metadata()}
    values = {"density": field.parameters()["density"], "texture": field.texture}
    tensors = {n: np.array(v).astype(np.float16) for n, v in values.items()}
    files.write_safetensors(path, tensors | field.occupancy_tensors(), header)


def test_a_file_shows_what_one_of_all_vertices_does(tmp_path, rng) -> None:
    """To the bit, up to the faces of occupied cells."""
    field, cells = small.blob(rng), rng.random((3, 7, 5)) < 0.2
    field.occupy(Occupancy(cells))
    path = tmp_path / "a.safetensors"
    write_all_vertices(path, field)
    old = load_grid(path)
    half = field.texture.numpy().astype(np.float16)
    np.testing.assert_array_equal(old.texture, half)
    save_field(path, old)
    rewritten = load_grid(path)
    assert (np.array(rewritten.texture) != half).any()
    at, faces = rng.uniform(0, 1, (2000, 3)), rng.choice([1e-7, 1 - 1e-7], (2000, 3))
    at = np.where(rng.random((2000, 3)) < 0.3, faces, at)
    points = np.argwhere(cells)[rng.integers(cells.sum(), size=2000)] + at
    points = 2 * points / cells.shape - 1
    expected = small.evaluate(old, points)
    assert expected[0].max() > 0.01
    for value, other in zip(small.evaluate(rewritten, points), expected, strict=True):
        np.testing.assert_array_equal(value, other)


@pytest.mark.parametrize("kind", ["ngp", "bricks"])
def test_a_file_evaluates_the_same(tmp_path: Path, rng, kind: str) -> None:
    field = bricks()
    if kind == "ngp":
        field = small.small_ngp(cone=1 / 64)
        half = field.parameters()["table"].numpy().astype(np.float16)
        field.set_parameter("table", mi.Float(half.astype(np.float32)))
    loaded = check_rewritten(tmp_path, field)
    assert loaded.cone == 1 / 64
    points = rng.uniform(-1, 1, (50, 3))
    expected = appearance(field, points)
    assert (expected[0] > 0).any()
    for value, other in zip(appearance(loaded, points), expected, strict=True):
        np.testing.assert_array_equal(value, other)


def grid() -> GridField:
    return GridField(GridLayout(1, 3, 3), -small.ONES, small.ONES)


def bricks() -> AnyField:
    return small.small_bricks(np.random.default_rng(0))


def with_nan(values: np.ndarray) -> np.ndarray:
    values = values.copy()
    values[5] = np.nan
    return values


def huge(values: np.ndarray) -> np.ndarray:
    """Weights of both signs: infinity less infinity would be NaN in the picture."""
    sign = np.where(np.arange(values.size) % 2, 1.0, -1.0)
    return (1e38 * sign).astype(np.float32).reshape(values.shape)


NGP = small.small_ngp
REFUSED = [  # entries of headers and tensors, and what they become; nothing if missing
    (grid, "format", "other 1", "header entry 'format' is 'other 1'"),
    (grid, "kind", "mesh", "header entry 'kind' is 'mesh'; .*grid_field, ngp_field"),
    (grid, "levels", "two", "header entry 'levels' holds 'two'; expected int"),
    (grid, "levels", "0", "levels: 0; allowed"),
    (grid, "levels", "2", "density: shape"),
    (grid, "lower", "1 1", ".*bounding box"),
    (grid, "upper", "1 1 x", "header entry 'upper' holds 'x'; expected float"),
    (grid, "step_m", "nan", "step_m: nan; must be positive"),
    (grid, "density_scale", "-1", "density_scale: -1.0"),
    (grid, "occupancy_shape", "9 9 9", "occupancy: 1 bytes"),
    (grid, "occupancy_shape", "-1 -1 1", "occupancy"),
    (grid, "occupancy_shape", "1 1", "occupancy: 1 bytes"),
    *(
        (grid, name, None, f"entry '{name}' is missing")
        for name in ("levels", "upper", "step_m", "occupancy_shape", "texture")
    ),
    (grid, "density", lambda raw: raw[1:], r"density: shape \(26,\); 27 .* of 28; "),
    (grid, "density", lambda raw: raw[0], r"density: shape \(\); 27"),
    (grid, "density", lambda raw: raw.astype(np.int32), "density: type int32"),
    (grid, "texture", lambda raw: raw[1:], r"texture: shape \(26, 3\); 27"),
    (grid, "texture", lambda raw: raw[:, 1:], r"texture: shape \(27, 2\); 27"),
    (grid, "texture", with_nan, "tensor 'texture'"),
    (grid, "occupancy", lambda bits: 0 * bits, r"density: shape \(27,\); 0"),
    (NGP, "density_net.1", huge, "tensor 'density_net.1': .* 1e"),
    (NGP, "colour_net.2", huge, "tensor 'colour_net.2': .* 1e"),
    (NGP, "colour_net.1", lambda raw: raw[:3, :3], r"colour_net\.1: shape \(3, 3\)"),
    (bricks, "octants", lambda raw: raw[1:], "octants: "),
    (bricks, "octants", lambda raw: raw.astype(np.float32), "octants: float32"),
    (bricks, "subdivisions", lambda raw: raw[:-1], "subdivisions"),
    (bricks, "subdivisions", lambda raw: 0 * raw + 3, ".*1, 2, 4 and 8"),
    (bricks, "vertices", lambda raw: raw[:-1], "vertices"),
    (bricks, "sky", lambda raw: raw[0, 0], "sky"),
    (bricks, "log_density", "low high", "header entry 'log_density' .*low"),
]


@pytest.mark.parametrize(("make", "entry", "change", "message"), REFUSED)
def test_refused(tmp_path: Path, make, entry, change, message: str) -> None:
    path = tmp_path / "f.safetensors"
    save_field(path, make())
    tensors, header = files.read_safetensors(path)
    if change is None:
        del (header if entry in header else tensors)[entry]
    elif isinstance(change, str):
        header[entry] = change
    else:
        tensors[entry] = np.array(change(tensors[entry]))
    files.write_safetensors(path, tensors, header)
    with pytest.raises(InputError, match=f"{path}: {message}"):
        load_field(path)


def test_load_grid_refuses_an_ngp(tmp_path: Path) -> None:
    save_field(tmp_path / "n.safetensors", small.small_ngp())
    with pytest.raises(InputError, match=r"n\.safetensors: is a ngp_field"):
        load_grid(tmp_path / "n.safetensors")


def test_fields_that_no_file_can_hold_are_not_written(tmp_path) -> None:
    path, field = tmp_path / "f.safetensors", grid()
    texture = np.zeros((field.n_vertices, 3), np.float32)
    texture[5, 1] = -1e5
    field.set_parameter("texture", texture)
    with pytest.raises(InputError, match=f"{path}: tensor 'texture' .*up to 65504"):
        save_field(path, field)
    assert not path.exists()


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


def levels(*numbers: int) -> dict[str, str]:
    names = ("levels", "base_resolution", "max_resolution")
    return dict(zip(names, map(str, numbers), strict=True))


DAMAGED = [  # a good field, entries of its header, its tensors, and what is named
    (small.homogeneous, levels(2, 230, 240), {}, "density"),
    (small.homogeneous, levels(32, 256, 512), {}, "levels"),  # more than kernels take
    (small.homogeneous, MANY, BITS | {"density": np.zeros(3, np.float16)}, "density"),
    (NGP, {"log2_table": "22", "max_resolution": "2048"}, {}, "table"),
    (NGP, {"width": "256"}, {}, "density_net.0"),
    (NGP, MANY | {"levels": "5"}, BITS, "table"),
    (bricks, MANY, BITS, "subdivisions"),
]


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="Linux tells peaks")
def test_damaged_files_are_refused_before_they_take_memory(tmp_path: Path) -> None:
    paths = [tmp_path / "good.safetensors"]
    save_field(paths[0], small.homogeneous())
    for make, entries, arrays, _ in DAMAGED:
        path = tmp_path / f"{len(paths)}.safetensors"
        save_field(path, make())
        tensors, header = files.read_safetensors(path)
        tensors.pop("octants", None)
        files.write_safetensors(path, tensors | arrays, header | entries)
        paths.append(path)
    command = [sys.executable, "-c", MEASURE]
    names = "\n".join(map(str, paths))
    result = subprocess.run(command, input=names, capture_output=True, text=True)
    assert result.returncode == 0, result.stderr
    lines = result.stdout.splitlines()
    for line, path, row in zip(lines, paths[1:], DAMAGED, strict=True):
        grown, message = line.split(" ", 1)
        assert message.startswith(f"{path}: {row[-1]}: "), message
        assert int(grown) < 20e6, line


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
    dense = expected > 100 * limit
    assert np.median(spread[dense] / expected[dense]) < 1e-3
    limit = limit + spread
    assert (np.abs(np.array(density) - expected) <= limit + 2e-3 * expected).all()
    expected = reader.radiance(points.astype(float), directions.astype(float))
    if name != "intersection":  # where nothing can be there is no colour
        radiance, expected = np.array(radiance)[:, there], expected[there]
    np.testing.assert_allclose(np.array(radiance).T, expected, atol=5e-4)
    assert expected.std() > 0.05
    if not isinstance(field, GridField):
        expected = reader.background(directions.astype(float)).T
        np.testing.assert_allclose(field.background(towards), expected, atol=1e-4)
