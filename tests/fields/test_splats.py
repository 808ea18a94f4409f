"""Files of splats: what is read, and what is refused by name."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
from helpers import splat_files as made

from mi_nerfattack.errors import InputError
from mi_nerfattack.fields.splats import Splats, read_splats


def same(a: Splats, b: Splats) -> None:
    """Check that splats agree but for rounding."""
    for name in ("centers", "scales", "quaternions", "opacities", "harmonics"):
        np.testing.assert_allclose(
            getattr(a, name), getattr(b, name), rtol=1e-5, atol=1e-7
        )


@pytest.fixture
def values(rng) -> dict[str, np.ndarray]:
    """Columns of seven splats of degree 2."""
    item = made.cloud(rng, 7)
    rest = rng.normal(0, 0.3, (7, 8, 3)).astype(np.float32)
    return made.columns(
        replace(item, harmonics=np.concatenate([item.harmonics, rest], 1))
    )


@pytest.mark.parametrize("text", [False, True])
@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_files_come_back(tmp_path: Path, rng, text: bool, degree: int) -> None:
    item = made.cloud(rng, 20)
    rest = rng.normal(0, 0.3, (20, (degree + 1) ** 2 - 1, 3)).astype(np.float32)
    item = replace(item, harmonics=np.concatenate([item.harmonics, rest], 1))
    path = made.write_ply(tmp_path / "s.ply", made.columns(item), text)
    loaded = read_splats(path)
    assert loaded.degree == degree and loaded.count == 20
    same(loaded, item)


@pytest.mark.usefixtures("variant")
def test_mitsuba_reads_the_same(tmp_path: Path, values) -> None:
    """The loader of `ellipsoids`, which knows this one layout."""
    path = made.write_ply(tmp_path / "s.ply", values)
    ours = read_splats(path)
    theirs = mi.traverse(mi.load_dict({"type": "ellipsoids", "filename": str(path)}))
    data = theirs["data"].numpy().reshape(7, 10)
    order = [3, 0, 1, 2]  # theirs are x, y, z, w
    pairs = [
        (data[:, :3], ours.centers),
        (data[:, 3:6], ours.scales),
        (data[:, 6:][:, order], ours.quaternions),
        (theirs["opacities"].numpy(), ours.opacities),
        (theirs["sh_coeffs"].numpy().reshape(7, 9, 3), ours.harmonics),
    ]
    for expected, found in pairs:
        np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-6)


def test_other_orders_types_and_properties_are_read(tmp_path: Path, values) -> None:
    plain = read_splats(made.write_ply(tmp_path / "a.ply", values))
    names = [n for n in reversed(values) if not n.startswith("n")] + ["label"]
    odd = {name: values.get(name, np.arange(7)) for name in names}
    types = {"x": "double", "label": "uchar"}
    same(read_splats(made.write_ply(tmp_path / "b.ply", odd, types=types)), plain)


def test_a_quaternion_of_any_length_is_a_rotation(tmp_path: Path, values) -> None:
    plain = read_splats(made.write_ply(tmp_path / "a.ply", values))
    for k in range(4):
        values[f"rot_{k}"] = 7.5 * values[f"rot_{k}"]
    same(read_splats(made.write_ply(tmp_path / "b.ply", values)), plain)


def _set(values, name, value):
    values[name] = values[name].copy()
    values[name][3] = value


BAD_VALUES = {
    "x of vertex 3 is nan": ("x", np.nan),
    "f_rest_5 of vertex 3 is inf": ("f_rest_5", np.inf),
    "opacity of vertex 3 is -inf": ("opacity", -np.inf),
    "scale_1 of vertex 3 is 40; allowed is -60 to 15": ("scale_1", 40.0),
    "scale_2 of vertex 3 is -90; allowed is -60 to 15": ("scale_2", -90.0),
}


@pytest.mark.parametrize("message", BAD_VALUES)
def test_bad_values_are_named(tmp_path: Path, values, message: str) -> None:
    _set(values, *BAD_VALUES[message])
    path = made.write_ply(tmp_path / "bad.ply", values)
    with pytest.raises(InputError, match=f"bad.ply: {message}"):
        read_splats(path)


def test_a_rotation_of_zeros_is_named(tmp_path: Path, values) -> None:
    for k in range(4):
        _set(values, f"rot_{k}", 0.0)
    path = made.write_ply(tmp_path / "bad.ply", values)
    with pytest.raises(InputError, match="rot_0, rot_1, rot_2, rot_3 of vertex 3"):
        read_splats(path)


@pytest.mark.parametrize(
    ("gone", "message"),
    [
        (["opacity"], "property opacity of 'vertex' is missing; 3D"),
        (["scale_2"], "property scale_2 of 'vertex' is missing; 3D"),
        (["rot_0", "rot_1"], "property rot_0 of 'vertex' is missing, and 1 more"),
        (["f_rest_3"], "23 properties f_rest_"),
    ],
)
def test_missing_properties_are_named(tmp_path, values, gone, message) -> None:
    for name in gone:
        del values[name]
    path = made.write_ply(tmp_path / "bad.ply", values)
    with pytest.raises(InputError, match=message):
        read_splats(path)


HEADS = {
    "no PLY header": b"PK\x03\x04 zipped",
    "format 'binary_big_endian 1.0'": (
        b"ply\nformat binary_big_endian 1.0\nend_header\n"
    ),
    "elements \\['chunk'\\]; the first must be 'vertex'": (
        b"ply\nformat ascii 1.0\nelement chunk 1\nend_header\n"
    ),
    "element vertex: 0": b"ply\nformat ascii 1.0\nelement vertex 0\nend_header\n",
    "element vertex: -4": b"ply\nformat ascii 1.0\nelement vertex -4\nend_header\n",
    "'property list uchar int x' of a vertex": (
        b"ply\nformat ascii 1.0\nelement vertex 1\n"
        b"property list uchar int x\nend_header\n"
    ),
    "property x is there twice": (
        b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\n"
        b"property float x\nend_header\n"
    ),
}


@pytest.mark.parametrize("message", HEADS)
def test_bad_headers_are_named(tmp_path: Path, message: str) -> None:
    path = tmp_path / "bad.ply"
    path.write_bytes(HEADS[message])
    with pytest.raises(InputError, match=f"bad.ply: {message}"):
        read_splats(path)


@pytest.mark.parametrize("text", [False, True])
def test_truncated_files_are_refused(tmp_path: Path, values, text: bool) -> None:
    path = made.write_ply(tmp_path / "bad.ply", values, text)
    path.write_bytes(path.read_bytes()[:-30])
    with pytest.raises(InputError, match="bad.ply: .* truncated"):
        read_splats(path)


def test_words_in_place_of_numbers_are_refused(tmp_path: Path, values) -> None:
    path = made.write_ply(tmp_path / "bad.ply", values, True)
    head, body = path.read_bytes().split(b"end_header\n")
    first, rest = body.split(b" ", 1)
    path.write_bytes(head + b"end_header\n" + b"word " + rest)
    with pytest.raises(InputError, match="bad.ply: .*word"):
        read_splats(path)


def test_missing_files_are_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="none.ply: does not exist"):
        read_splats(tmp_path / "none.ply")
