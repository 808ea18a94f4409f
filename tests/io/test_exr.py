"""EXR files: round trips, what other programs see, and files that must be refused."""

from __future__ import annotations

import re
import struct

import numpy as np
import OpenEXR
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mi_nerfattack.errors import InputError
from mi_nerfattack.io import exr


def frame_layers(rng, height=9, width=7):
    depth = rng.uniform(1, 90, (height, width)).astype(np.float32)
    depth[:3] = np.inf
    colour = {
        name: rng.uniform(0, 4, (height, width, 4)).astype(np.float16)
        for name in ("", "scene", "object")
    }
    return colour | {"Z": depth, "scene.Z": depth * 2, "object.Z": depth + 1}


@pytest.mark.parametrize("half", [True, False])
def test_exr_round_trip(tmp_path, half):
    layers = frame_layers(np.random.default_rng(0))
    path = tmp_path / "frame.exr"
    exr.write_layers(path, layers, {"step": "12", "case": "attack"}, half)
    read, metadata = exr.read_layers(path)
    assert set(read) == set(layers)
    for name, array in layers.items():
        assert read[name].dtype == np.float32
        np.testing.assert_array_equal(read[name], array)
    assert np.isinf(read["Z"][:3]).all()
    assert metadata["step"] == "12"
    assert metadata["colorSpace"] == "linear Rec.709"


def test_exr_channels_as_other_programs_see_them(tmp_path):
    path = tmp_path / "frame.exr"
    layers = frame_layers(np.random.default_rng(1))
    exr.write_layers(path, layers)
    with OpenEXR.File(str(path), separate_channels=True) as file:
        header = dict(file.header())
        pixels = {name: channel.pixels for name, channel in file.channels().items()}
    names = {f"{p}{c}" for p in ("", "scene.", "object.") for c in "RGBAZ"}
    assert set(pixels) == names
    for name, values in pixels.items():
        assert values.dtype == (np.float32 if name.endswith("Z") else np.float16)
    np.testing.assert_array_equal(pixels["scene.G"], layers["scene"][..., 1])
    assert header["compression"] == OpenEXR.ZIP_COMPRESSION
    assert header["chromaticities"] == pytest.approx(exr.REC709_CHROMATICITIES)


def test_only_colour_and_opacity_are_shortened(tmp_path):
    names = ["R", "A", "normal.X", "normal.Y", "normal.Z", "shape.I", "dd.T", "Z"]
    layers = {name: np.full((2, 2), 4097.0) for name in names}
    exr.write_layers(tmp_path / "a.exr", layers, {"step": "1"})
    with OpenEXR.File(str(tmp_path / "a.exr"), separate_channels=True) as file:
        stored = {name: channel.pixels for name, channel in file.channels().items()}
    for name in names:
        is_short = name in ("R", "A")
        assert stored[name].dtype == (np.float16 if is_short else np.float32), name
        assert stored[name][0, 0] == (4096 if is_short else 4097), name
    assert exr.read_metadata(tmp_path / "a.exr")["step"] == "1"


def test_z_of_a_normal_is_no_depth(tmp_path):
    far = {"normal.X": np.zeros((2, 2)), "normal.Z": np.full((2, 2), np.inf)}
    with pytest.raises(InputError, match=r"'normal.Z' is infinite"):
        exr.write_layers(tmp_path / "a.exr", far)


@given(
    st.floats(0, 60000, width=32),
    st.integers(1, 5),
    st.integers(1, 5),
)
def test_half_rounds_to_eleven_bits(tmp_path_factory, value, height, width):
    path = tmp_path_factory.mktemp("exr") / "a.exr"
    exr.write_layers(path, {"scene": np.full((height, width, 3), value)})
    read, _ = exr.read_layers(path)
    assert read["scene"].shape == (height, width, 3)
    # Half an ulp: 2^-11 of the value, or 2^-25 among the subnormal numbers.
    assert abs(read["scene"][0, 0, 0] - value) <= max(value * 2**-11, 2**-25)


@pytest.mark.parametrize(
    ("layers", "message"),
    [
        ({"scene": np.full((2, 2, 3), np.nan)}, "NaN"),
        ({"scene": np.full((2, 2, 3), np.inf)}, "only Z may be"),
        ({"Z": np.full((2, 2), -np.inf)}, "NaN or -inf"),
        ({"scene": np.full((2, 2, 3), 7e4)}, "half=False"),
        ({"scene": np.zeros((2, 2, 2))}, "shape"),
        ({"": np.zeros((2, 2))}, "channel's name"),
        ({"Z": np.zeros((2, 2)), "A": np.zeros((2, 3))}, "one"),
        ({"Z": np.zeros((0, 2))}, "one"),
        ({}, "one"),
        ({"": np.zeros((2, 2, 3)), "R": np.zeros((2, 2))}, "'R' twice"),
        ({"Z": np.full((2, 2), "far")}, "give numbers"),
    ],
)
def test_exr_refuses_bad_layers(tmp_path, layers, message):
    with pytest.raises(InputError, match=message):
        exr.write_layers(tmp_path / "a.exr", layers)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("metadata", [{"channels": "x"}, {"": "x"}, {"step": 1}])
def test_exr_refuses_bad_metadata(tmp_path, metadata):
    with pytest.raises(InputError, match="metadata"):
        exr.write_layers(tmp_path / "a.exr", {"Z": np.zeros((2, 2))}, metadata)


def test_exr_leaves_the_callers_layers_alone(tmp_path):
    layers = {"Z": np.ones((2, 2)), "scene": np.ones((2, 2, 3), np.float16)}
    exr.write_layers(tmp_path / "a.exr", layers)
    assert type(layers["Z"]) is np.ndarray
    assert type(layers["scene"]) is np.ndarray


@pytest.mark.parametrize("part", [0.0, 0.05, 0.3, 0.6, 0.999])
def test_truncated_exr(tmp_path, part):
    path = tmp_path / "a.exr"
    exr.write_layers(path, frame_layers(np.random.default_rng(2), 64, 40))
    raw = path.read_bytes()
    path.write_bytes(raw[: int(part * len(raw))])
    with pytest.raises(InputError, match=r"a\.exr"):
        exr.read_layers(path)


def test_foreign_missing_and_huge_exr(tmp_path):
    for path in (tmp_path, tmp_path / "none.exr"):
        with pytest.raises(InputError, match=re.escape(str(path))):
            exr.read_layers(path)
    path = tmp_path / "a.exr"
    path.write_text("not an image" * 50)
    with pytest.raises(InputError, match="not an EXR file"):
        exr.read_layers(path)
    exr.write_layers(path, {"Z": np.zeros((2, 2))})
    window = struct.pack("<4i", 0, 0, 1, 1)
    large = struct.pack("<4i", 0, 0, 99999, 99999)
    path.write_bytes(path.read_bytes().replace(window, large))
    with pytest.raises(InputError, match=r"a\.exr"):
        exr.read_layers(path)


def test_multi_part_exr_is_refused(tmp_path):
    parts = [OpenEXR.Part({}, {"Z": np.ones((4, 4), np.float32)}, n) for n in "ab"]
    path = tmp_path / "a.exr"
    OpenEXR.File(parts).write(str(path))
    with pytest.raises(InputError, match="2 parts"):
        exr.read_layers(path)
