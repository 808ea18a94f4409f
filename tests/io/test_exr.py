"""EXR files: round trips, what other programs see, and files that must be refused."""

from __future__ import annotations

import struct

import numpy as np
import OpenEXR
import pytest

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
    path, passed = tmp_path / "frame.exr", dict(layers)
    exr.write_layers(path, passed, {"step": "12", "case": "attack"}, half)
    read, metadata = exr.read_layers(path)
    assert set(read) == set(layers)
    for name, array in layers.items():
        assert passed[name] is array and type(array) is np.ndarray
        np.testing.assert_array_equal(read[name], np.float32(array), strict=True)
    assert metadata["step"] == exr.read_metadata(path)["step"] == "12"
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
    exr.write_layers(tmp_path / "a.exr", layers)
    with OpenEXR.File(str(tmp_path / "a.exr"), separate_channels=True) as file:
        stored = {name: channel.pixels for name, channel in file.channels().items()}
    for name in names:
        number, value = (np.float16, 4096) if name in "RA" else (np.float32, 4097)
        assert stored[name].dtype == number and stored[name][0, 0] == value, name


Z = {"Z": np.zeros((2, 2))}
RGB = np.zeros((2, 2, 3))


@pytest.mark.parametrize(
    ("layers", "metadata", "message"),
    [
        ({"a": RGB + np.nan}, {}, "channel 'a.R' holds NaN"),
        ({"a": RGB + np.inf}, {}, "channel 'a.R' is infinite; only Z"),
        ({"n.X": Z["Z"], "n.Z": Z["Z"] + np.inf}, {}, "channel 'n.Z' is infinite"),
        ({"Z": Z["Z"] - np.inf}, {}, "channel 'Z' holds NaN or -inf"),
        ({"a": RGB + 7e4}, {}, "channel 'a.R' .*half=False"),
        ({"a": RGB[..., :2]}, {}, "layer 'a' of shape"),
        ({"": RGB[..., 0]}, {}, "layer '' of shape"),
        ({**Z, "A": np.zeros((2, 3))}, {}, "layers of shapes"),
        ({"Z": np.zeros((0, 2))}, {}, "layers of shapes"),
        ({}, {}, "layers of shapes"),
        ({"": RGB, "R": Z["Z"]}, {}, "channel 'R' twice"),
        ({"Z": np.full((2, 2), "far")}, {}, "channel 'Z' is .*; give numbers"),
        (Z, {"channels": "x"}, "metadata 'channels'"),
        (Z, {"": "x"}, "metadata ''"),
        (Z, {"step": 1}, "metadata 'step': 1"),
    ],
)
def test_what_is_not_written(tmp_path, layers, metadata, message):
    path = tmp_path / "a.exr"
    with pytest.raises(InputError, match=f"{path}: {message}"):
        exr.write_layers(path, layers, metadata)
    assert not path.exists()


def two_parts(path):
    exr_parts = [OpenEXR.Part({}, {"Z": np.ones((4, 4), np.float32)}, n) for n in "ab"]
    OpenEXR.File(exr_parts).write(str(path))


def huge(path):
    exr.write_layers(path, Z)
    small, large = (struct.pack("<4i", 0, 0, n, n) for n in (1, 99999))
    path.write_bytes(path.read_bytes().replace(small, large))


def truncated(path):
    exr.write_layers(path, frame_layers(np.random.default_rng(2), 64, 40))
    path.write_bytes(path.read_bytes()[:-9])


@pytest.mark.parametrize(
    ("write", "message"),
    [
        (lambda path: None, "does not exist"),
        (lambda path: path.mkdir(), "is a folder"),
        (lambda path: path.write_text("not an image" * 50), "not an EXR file"),
        (two_parts, "2 parts"),
        (huge, "10000000000 values"),
        (truncated, "truncated"),
    ],
)
def test_what_is_not_read(tmp_path, write, message):
    path = tmp_path / "a.exr"
    write(path)
    with pytest.raises(InputError, match=f"{path}: {message}"):
        exr.read_layers(path)
