"""Files of splats: what is read, and what is refused by name."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
from support.files import objects as made

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
    bands = rng.normal(0, 0.3, (7, 8, 3)).astype(np.float32)
    return made.columns(
        replace(item, harmonics=np.concatenate([item.harmonics, bands], 1))
    )


@pytest.mark.parametrize(("degree", "text"), [(0, True), (1, False), (3, False)])
def test_files_come_back(tmp_path: Path, rng, text: bool, degree: int) -> None:
    item = made.cloud(rng, 20)
    bands = rng.normal(0, 0.3, (20, (degree + 1) ** 2 - 1, 3)).astype(np.float32)
    item = replace(item, harmonics=np.concatenate([item.harmonics, bands], 1))
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
    for expected, actual in [
        (data[:, :3], ours.centers),
        (data[:, 3:6], ours.scales),
        (data[:, [9, 6, 7, 8]], ours.quaternions),  # theirs are x, y, z, w
        (theirs["opacities"].numpy(), ours.opacities),
        (theirs["sh_coeffs"].numpy().reshape(7, 9, 3), ours.harmonics),
    ]:
        np.testing.assert_allclose(actual, expected, rtol=1e-5, atol=1e-6)


def test_other_orders_types_properties_and_lengths_are_read(tmp_path, values) -> None:
    plain = read_splats(made.write_ply(tmp_path / "a.ply", values))
    names = [n for n in reversed(values) if not n.startswith("n")] + ["label"]
    odd = {name: values.get(name, np.arange(7)) for name in names}
    odd |= {f"rot_{k}": 7.5 * values[f"rot_{k}"] for k in range(4)}
    types = {"x": "double", "label": "uchar"}
    same(read_splats(made.write_ply(tmp_path / "b.ply", odd, types=types)), plain)


def test_the_3d_filter_of_mip_splatting_is_applied(tmp_path: Path, values, rng) -> None:
    plain = read_splats(made.write_ply(tmp_path / "a.ply", values))
    width = rng.uniform(0.01, 0.5, 7)
    path = made.write_ply(tmp_path / "b.ply", {**values, "filter_3D": width})
    variance = plain.scales.astype(float) ** 2
    wide = variance + width[:, None] ** 2
    ratio = np.sqrt(np.prod(variance, axis=1) / np.prod(wide, axis=1))
    filtered = replace(plain, scales=wide**0.5, opacities=plain.opacities * ratio)
    same(read_splats(path), filtered)


COLUMNS = [  # of vertex 3, or nothing where the whole property is missing
    ({"x": np.nan}, "x of vertex 3 is nan"),
    ({"f_rest_5": np.inf}, "f_rest_5 of vertex 3 is inf"),
    ({"scale_1": 40.0}, "scale_1 of vertex 3 is 40; allowed is -60 to 15"),
    ({"scale_2": -90.0}, "scale_2 of vertex 3 is -90; allowed is -60 to 15"),
    ({f"rot_{k}": 0.0 for k in range(4)}, "rot_0, rot_1, rot_2, rot_3 of vertex 3"),
    ({"opacity": None}, "property opacity of 'vertex' is missing; 3D"),
    ({"rot_0": None, "rot_1": None}, "property rot_0 of .* and 1 more"),
    ({"f_rest_3": None}, "23 properties f_rest_"),
    ({"opacity_activation": 0.0}, "property opacity_activation of .* not known"),
]


@pytest.mark.parametrize(("changes", "message"), COLUMNS)
def test_bad_columns_are_named(tmp_path: Path, values, changes, message) -> None:
    for name, value in changes.items():
        column = values.pop(name, np.zeros(7)).copy()
        column[3] = value
        if value is not None:
            values[name] = column
    path = made.write_ply(tmp_path / "bad.ply", values)
    with pytest.raises(InputError, match=f"{path}: {message}"):
        read_splats(path)


FILES = [
    (False, b"ply\n", b"PK\x03\x04", "no PLY header"),
    (False, b"binary_little", b"binary_big", "format 'binary_big_endian 1.0'"),
    (False, b"element vertex", b"element chunk", r"elements \['chunk'\]"),
    (False, b"vertex 7", b"vertex 0", "element vertex: 0"),
    (False, b"vertex 7", b"vertex -4", "element vertex: -4"),
    (False, b"float x", b"list uchar int x", "'property list uchar int x'"),
    (False, b"float y", b"float x", "property x is there twice"),
    (False, b"vertex 7", b"vertex 8", ".*truncated"),
    (True, b"vertex 7", b"vertex 8", ".*truncated"),
    (True, b"end_header\n", b"end_header\nword", ".*word"),
]


@pytest.mark.parametrize(("text", "old", "new", "message"), FILES)
def test_bad_files_are_named(tmp_path: Path, values, text, old, new, message) -> None:
    path = made.write_ply(tmp_path / "bad.ply", values, text)
    path.write_bytes(path.read_bytes().replace(old, new, 1))
    with pytest.raises(InputError, match=f"{path}: {message}"):
        read_splats(path)
