"""3D Gaussian splats from files of any kind: PLY, and the compact SPZ and SPLAT.

SPZ (Niantic, versions 2 and 3) is a compressed stream of quantised numbers in a frame
whose y points up and z back. It is turned into that of the trainer's PLY file, y down
and z ahead, as by the format's own tools. SPLAT, of web viewers, has 32 bytes a splat
and one colour from all sides.

Source: github.com/nianticlabs/spz, "File Format"; github.com/antimatter15/splat.
"""

from __future__ import annotations

import struct
import zlib
from pathlib import Path

import numpy as np

from mi_nerfattack.errors import InputError
from mi_nerfattack.fields.splats import MAX_BYTES, Splats, make_splats, read_splats
from mi_nerfattack.io import files

_C0 = 0.5 / np.sqrt(np.pi)  # the harmonic of degree 0
_MAGIC = b"NGSP"
_EXTENDED = 2  # flag: extensions follow, which may change what numbers mean
_TURN = np.array([1.0, -1, -1])  # half a turn about x
#: The same of harmonics of degree 1 to 3.
_TURNED = np.array([-1.0, -1, 1, -1, 1, 1, -1, 1, -1, 1, -1, -1, 1, -1, 1])
_SPLAT = np.dtype(
    [("at", "<f4", 3), ("scale", "<f4", 3), ("rgba", "u1", 4), ("turn", "u1", 4)]
)


def load_splats(path: str | Path) -> Splats:
    """Read splats, in the form that the suffix of a file says.

    Args:
        path: ``.ply``, ``.spz`` or ``.splat``; at most 2 GiB.

    Raises:
        InputError: as `fields.splats.read_splats`.
    """
    suffix = Path(path).suffix.lower()
    if suffix == ".spz":
        return _read_spz(path)
    return _read_splat(path) if suffix == ".splat" else read_splats(path)


def _read_splat(path: str | Path) -> Splats:
    raw = files.read_bytes(path, MAX_BYTES)
    if not raw or len(raw) % _SPLAT.itemsize:
        raise InputError(
            f"{path}: {len(raw)} bytes; a .splat has {_SPLAT.itemsize} for each splat, "
            "and at least one: truncated, or no .splat; copy or export it again"
        )
    rows = np.frombuffer(raw, _SPLAT)
    with np.errstate(invalid="ignore"):  # of signalling NaN, refused below
        centers, scales = (rows[k].astype(np.float64) for k in ("at", "scale"))
    if not (scales > 0).all():
        raise InputError(f"{path}: a scale is not positive; damaged: export it again")
    colours = (rows["rgba"][:, None, :3] / 255 - 0.5) / _C0
    return make_splats(
        path,
        centers,
        logarithms=np.log(scales),
        quaternions=(rows["turn"] - 128.0) / 128,
        opacities=rows["rgba"][:, 3] / 255,
        harmonics=colours,
    )


def _read_spz(path: str | Path) -> Splats:
    raw = _decompress(path, files.read_bytes(path, MAX_BYTES))
    if len(raw) < 16 or raw[:4] != _MAGIC:
        raise InputError(f"{path}: does not begin as an .spz; export it again")
    version, count, degree, bits, flags = struct.unpack_from("<IIBBB", raw, 4)
    if version not in (2, 3) or flags & _EXTENDED:
        what = "extensions" if version in (2, 3) else f"version {version}"
        raise InputError(
            f"{path}: an .spz with {what}; versions 2 and 3 without extensions are "
            "read: export it so, or as .ply"
        )
    if degree > 3 or bits > 23:
        raise InputError(
            f"{path}: harmonics of degree {degree} and {bits} bits of a fraction; at "
            "most 3 and 23 are read: export it as .ply of degree 3"
        )
    terms = (degree + 1) ** 2 - 1
    sizes = [9, 1, 3, 3, 3 if version == 2 else 4, 3 * terms]
    if len(raw) != 16 + count * sum(sizes) or not count:
        raise InputError(
            f"{path}: {len(raw)} bytes for {count} splats, which need "
            f"{16 + count * sum(sizes)}, and at least one: damaged; export it again"
        )
    ends = 16 + count * np.cumsum([0, *sizes])
    data = np.frombuffer(raw, np.uint8)
    at, alphas, colours, scales, turns, term_bytes = (
        data[begin:end].reshape(count, size)
        for begin, end, size in zip(ends[:-1], ends[1:], sizes, strict=True)
    )
    harmonics = np.empty((count, 1 + terms, 3))
    harmonics[:, 0] = (colours / 255 - 0.5) / 0.15
    coefficients = (term_bytes.reshape(count, terms, 3) - 128.0) / 128
    harmonics[:, 1:] = coefficients * _TURNED[:terms, None]
    quaternions = _first_three(turns) if version == 2 else _smallest_three(turns)
    quaternions[:, 1:] *= _TURN
    return make_splats(
        path,
        _fixed(at.reshape(count, 3, 3)) / 2.0**bits * _TURN,
        logarithms=scales / 16 - 10.0,
        quaternions=quaternions,
        opacities=alphas[:, 0] / 255,
        harmonics=harmonics,
    )


def _decompress(path: str | Path, raw: bytes) -> bytes:
    stream = zlib.decompressobj(16 + zlib.MAX_WBITS)  # of gzip
    try:
        contents = stream.decompress(raw, MAX_BYTES)
    except zlib.error as err:
        raise InputError(f"{path}: {err}; damaged: copy or export it again") from err
    if not stream.eof:
        raise InputError(
            f"{path}: ends early, or holds more than {MAX_BYTES >> 30} GiB; copy or "
            "export it again"
        )
    return contents


def _fixed(octets: np.ndarray) -> np.ndarray:
    """Return signed numbers of 24 bits, the lowest byte first, (n, 3)."""
    low, middle, high = (octets[..., k].astype(np.int32) for k in range(3))
    return low | middle << 8 | high.astype(np.int8).astype(np.int32) << 16


def _first_three(octets: np.ndarray) -> np.ndarray:
    """Return quaternions w, x, y, z, of whose x, y, z each has a byte."""
    vector = octets / 127.5 - 1
    real = np.sqrt(np.maximum(1 - (vector**2).sum(1, keepdims=True), 0))
    return np.concatenate([real, vector], 1)


def _smallest_three(octets: np.ndarray) -> np.ndarray:
    """Return quaternions w, x, y, z, of which all but the largest have 10 bits."""
    word = np.ascontiguousarray(octets).view("<u4")[:, 0]
    largest = word >> 30
    result = np.zeros((len(word), 4))  # x, y, z, w
    for index in (3, 2, 1, 0):
        stored = largest != index
        value = (word & 511) / 511 * np.sqrt(0.5) * np.where(word & 512, -1, 1)
        result[stored, index] = value[stored]
        word = np.where(stored, word >> 10, word)
    magnitude = np.sqrt(np.maximum(1 - (result**2).sum(1), 0))
    result[np.arange(len(word)), largest] = magnitude
    return result[:, [3, 0, 1, 2]]
