"""EXR frames with named layers, linear Rec.709 colour and metric depth."""

from __future__ import annotations

import io
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR

from mi_nerfattack.errors import InputError
from mi_nerfattack.io import files

MAX_FILE_BYTES = 1 << 28
MAX_VALUES = 1 << 28
COLOUR_SPACE = "linear Rec.709"
REC709_CHROMATICITIES = (0.64, 0.33, 0.30, 0.60, 0.15, 0.06, 0.3127, 0.3290)

_OWN_ATTRIBUTES = {
    "colorSpace": COLOUR_SPACE,
    "colorInteropID": "lin_rec709_scene",
    "chromaticities": REC709_CHROMATICITIES,
}
_HALF_MAX = float(np.finfo(np.float16).max)


def write_layers(
    path: str | Path,
    layers: Mapping[str, np.ndarray],
    metadata: Mapping[str, str] | None = None,
    half: bool = True,
) -> None:
    """Write one ZIP-compressed scanline EXR file atomically.

    An array of three or four channels under a layer's name becomes `<layer>.R`, `.G`,
    `.B` and `.A`; the empty name is the beauty, plain `R`, `G`, `B`, `A`. An array
    (H, W) is one channel and its name the channel's: `Z`, `scene.Z`, `object.A`.

    Args:
        path: the file.
        layers: (H, W), (H, W, 3) or (H, W, 4), all of one height and width. Colour is
            linear Rec.709, `A` opacity, `Z` expected depth in metres, infinite where
            there is nothing.
        metadata: string attributes, e.g. {"step": "12"}.
        half: store colour and opacity as 16-bit floats; depth and whatever else
            there is (positions, normals, indices) is 32-bit always.

    Raises:
        InputError: for a wrong name or shape, NaN, infinity outside `Z`, or a value
            beyond the half range.
    """
    channels: dict[str, np.ndarray] = {}
    for name, array in layers.items():
        for channel, values in _split(path, name, np.asarray(array)).items():
            if channel in channels:
                raise InputError(f"{path}: channel {channel!r} twice; rename a layer")
            channels[channel] = values
    for channel, values in channels.items():
        channels[channel] = _encode(path, channel, values, half=half, names=channels)
    shapes = sorted({values.shape for values in channels.values()})
    if len(shapes) != 1 or 0 in shapes[0]:
        raise InputError(f"{path}: layers of shapes {shapes}; all need one (H, W)")
    header: dict[str, Any] = {
        "compression": OpenEXR.ZIP_COMPRESSION,
        "type": OpenEXR.scanlineimage,
        **_checked_metadata(path, metadata or {}),
        **_OWN_ATTRIBUTES,
    }
    stream = io.BytesIO()
    try:
        OpenEXR.File(header, channels).write(stream)
    except (RuntimeError, TypeError, ValueError) as err:
        raise InputError(f"{path}: {err}; check layer and metadata names") from err
    files.write_bytes(path, stream.getvalue())


def read_layers(path: str | Path) -> tuple[dict[str, np.ndarray], dict[str, str]]:
    """Read what `write_layers` wrote, or any single-part flat EXR file.

    Returns:
        The layers as float32, named and shaped as for `write_layers`, and the file's
        string attributes. A layer's R, G, B and, where present, A together are (H, W,
        3 or 4); any other channel alone is (H, W).

    Raises:
        InputError: for a missing, foreign, truncated, deep, multi-part or subsampled
            file, or one of more than 2^28 values.
    """
    raw, header = _read_header(path)
    part = _open(path, raw, header_only=False)
    try:
        channels = {name: c.pixels for name, c in part.channels().items()}
    except (RuntimeError, ValueError) as err:
        raise InputError(f"{path}: truncated or damaged; copy it again") from err
    single = {n: p.astype(np.float32) for n, p in sorted(channels.items())}
    return _join(single), _strings(header)


def read_metadata(path: str | Path) -> dict[str, str]:
    """Read the string attributes of an EXR file; see `read_layers`."""
    return _strings(_read_header(path)[1])


def _read_header(path: str | Path) -> tuple[bytes, dict[str, Any]]:
    raw = files.read_bytes(path, MAX_FILE_BYTES)
    headers = _open(path, raw, header_only=True)
    if len(headers.parts) != 1:
        raise InputError(f"{path}: {len(headers.parts)} parts; single-part files only")
    header = headers.header()
    _check_header(path, header)
    return raw, header


def _strings(header: Mapping[str, Any]) -> dict[str, str]:
    return {n: v for n, v in header.items() if isinstance(v, str) and n != "name"}


def _split(path: str | Path, name: str, array: np.ndarray) -> dict[str, np.ndarray]:
    if array.ndim == 2 and name and not name.startswith(".") and name[-1] != ".":
        return {name: array}
    if array.ndim == 3 and array.shape[2] in (3, 4) and not name.endswith("."):
        prefix = f"{name}." if name else ""
        return {prefix + "RGBA"[i]: array[..., i] for i in range(array.shape[2])}
    raise InputError(
        f"{path}: layer {name!r} of shape {array.shape}; give (H, W) with a channel's "
        "name, or (H, W, 3) or (H, W, 4) with a layer's"
    )


def _encode(
    path: str | Path,
    name: str,
    values: np.ndarray,
    half: bool,
    names: Collection[str],
) -> np.ndarray:
    if values.dtype.kind not in "fiu":
        raise InputError(f"{path}: channel {name!r} is {values.dtype}; give numbers")
    if np.any(np.isnan(values)) or np.any(np.isneginf(values)):
        raise InputError(f"{path}: channel {name!r} holds NaN or -inf; fix its source")
    if not _is_depth(name, names) and np.any(np.isinf(values)):
        raise InputError(f"{path}: channel {name!r} is infinite; only Z may be")
    if half and name.rpartition(".")[2] in ("R", "G", "B", "A"):
        largest = float(np.max(np.abs(values), initial=0))
        if largest > _HALF_MAX:
            raise InputError(
                f"{path}: channel {name!r} reaches {largest:g}, beyond 16-bit floats; "
                "write 32-bit floats (half=False, --precision float)"
            )
        return np.ascontiguousarray(values, dtype=np.float16)
    return np.ascontiguousarray(values, dtype=np.float32)


def _is_depth(name: str, names: Collection[str]) -> bool:
    """Tell a depth from the third component of a normal or a position."""
    return name.rpartition(".")[2] == "Z" and name[:-1] + "X" not in names


def _checked_metadata(path: str | Path, metadata: Mapping[str, str]) -> dict[str, str]:
    reserved = {"channels", "compression", "dataWindow", "displayWindow", "lineOrder"}
    reserved |= {"pixelAspectRatio", "screenWindowCenter", "screenWindowWidth"}
    reserved |= {"name", "type", "version", "chunkCount", "tiles", *_OWN_ATTRIBUTES}
    for name, value in metadata.items():
        if not name or name in reserved or not isinstance(value, str):
            raise InputError(
                f"{path}: metadata {name!r}: {value!r}; give text under a name that "
                "the format does not reserve"
            )
    return dict(metadata)


def _open(path: str | Path, raw: bytes, header_only: bool) -> Any:
    try:
        return OpenEXR.File(
            io.BytesIO(raw), separate_channels=True, header_only=header_only
        )
    except (RuntimeError, ValueError) as err:
        raise InputError(f"{path}: not an EXR file, or damaged; copy it again") from err


def _check_header(path: str | Path, header: Mapping[str, Any]) -> None:
    low, high = header["dataWindow"]
    width, height = (int(high[i]) - int(low[i]) + 1 for i in range(2))
    values = width * height * len(header["channels"])
    if values > MAX_VALUES:
        raise InputError(f"{path}: {values} values; at most {MAX_VALUES} are read")
    if header.get("type") not in (None, OpenEXR.scanlineimage, OpenEXR.tiledimage):
        raise InputError(f"{path}: deep pixels; flatten the file first")
    for channel in header["channels"]:
        if (channel.xSampling, channel.ySampling) != (1, 1):
            raise InputError(f"{path}: channel {channel.name!r} is subsampled")


def _join(channels: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    layers: dict[str, np.ndarray] = {}
    for name, pixels in channels.items():
        layer, _, last = name.rpartition(".")
        prefix = f"{layer}." if layer else ""
        colour = [prefix + letter for letter in "RGB"]
        if last not in "RGBA" or not all(c in channels for c in colour):
            layers[name] = pixels
        elif last == "R":
            alpha = [prefix + "A"] if prefix + "A" in channels else []
            layers[layer] = np.stack([channels[c] for c in colour + alpha], axis=-1)
    return layers
