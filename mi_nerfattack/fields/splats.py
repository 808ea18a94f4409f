"""3D Gaussian splats as data, and a checked reader of their PLY files.

The file is the one that Kerbl et al. 2023 write, and most trainers after them: an
element ``vertex`` with ``x y z``, ``f_dc_0..2``, ``f_rest_*``, ``opacity``,
``scale_0..2`` and ``rot_0..3``. The 3D filter of Mip-Splatting, ``filter_3D``, is
applied. Normals, points' colours and labels are skipped. Other properties are refused:
there, trainers with other shapes or activations write what decides the picture.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mi_nerfattack.errors import InputError
from mi_nerfattack.io import files
from mi_nerfattack.io.strict import require_near

MAX_BYTES = 1 << 31
MAX_HEADER_BYTES = 1 << 16
MAX_LOG_SCALE = 15.0  # a standard deviation of 3,000 km
MIN_LOG_SCALE = -60.0  # below, its inverse overflows single precision
REST_OF_DEGREE = {0: 0, 9: 1, 24: 2, 45: 3}  # numbers of f_rest_*

_TYPES = {
    "char": "i1",
    "int8": "i1",
    "uchar": "u1",
    "uint8": "u1",
    "short": "i2",
    "int16": "i2",
    "ushort": "u2",
    "uint16": "u2",
    "int": "i4",
    "int32": "i4",
    "uint": "u4",
    "uint32": "u4",
    "float": "f4",
    "float32": "f4",
    "double": "f8",
    "float64": "f8",
}
_CENTERS = ("x", "y", "z")
_COLOURS = ("f_dc_0", "f_dc_1", "f_dc_2")
_SCALES = ("scale_0", "scale_1", "scale_2")
_ROTATIONS = ("rot_0", "rot_1", "rot_2", "rot_3")
_FILTER = "filter_3D"
_SKIPPED = "nx ny nz red green blue alpha label id object_id segment confidence".split()
_NEEDED = (*_CENTERS, *_COLOURS, "opacity", *_SCALES, *_ROTATIONS)


@dataclass(frozen=True, eq=False)
class Splats:
    """n Gaussians in the frame and unit of their file.

    Attributes:
        source: where they come from, for messages.
        centers: (n, 3), metres once posed.
        scales: (n, 3) standard deviations along the axes, metres once posed.
        quaternions: (n, 4) unit quaternions w, x, y, z; axes to the file's frame.
        opacities: (n,) in [0, 1], at the centre.
        harmonics: (n, k, 3) coefficients of real spherical harmonics of a direction
            of view in the file's frame, k = 1, 4, 9 or 16; their sum plus 0.5 is a
            colour in sRGB.
    """

    source: str
    centers: np.ndarray
    scales: np.ndarray
    quaternions: np.ndarray
    opacities: np.ndarray
    harmonics: np.ndarray

    @property
    def count(self) -> int:
        """Number of Gaussians."""
        return len(self.centers)

    @property
    def degree(self) -> int:
        """Degree of the spherical harmonics, 0 to 3."""
        return round(self.harmonics.shape[1] ** 0.5) - 1


def read_splats(path: str | Path) -> Splats:
    """Read a PLY file of 3D Gaussian splats, ASCII or binary little endian.

    Args:
        path: at most 2 GiB.

    Raises:
        InputError: the file is missing, truncated or no such PLY; a property is
            missing, not finite or out of range; the message names file and property.
    """
    return _decode(path, _rows(path, _check_present))


def read_points(path: str | Path) -> np.ndarray:
    """Read the positions (n, 3) of a PLY file's vertices, float64, finite.

    Raises:
        InputError: as `read_splats`; of properties, ``x y z`` alone are needed.
    """

    def check(path: str | Path, present: list[str]) -> None:
        if not {*_CENTERS} <= {*present}:
            raise InputError(f"{path}: its vertices need x, y and z, not {present}")

    return _columns(path, _rows(path, check), _CENTERS)


def _rows(path: str | Path, check: Callable[[str | Path, list[str]], None]) -> Any:
    """Return the vertices of a PLY file, whose property names `check` takes first."""
    raw = files.read_bytes(path, MAX_BYTES)
    encoding, count, dtype, start = _header(path, raw)
    check(path, list(dtype.names or ()))
    if encoding == "ascii":
        return _ascii_rows(path, raw[start:], count, dtype=dtype)
    return _binary_rows(path, raw, count, dtype=dtype, start=start)


def _header(path: str | Path, raw: bytes) -> tuple[str, int, np.dtype, int]:
    """Return encoding, number of vertices, type of one, and where they start."""
    head = raw[:MAX_HEADER_BYTES]
    end = head.find(b"end_header")
    newline = head.find(b"\n", end)
    if not head.startswith(b"ply") or end < 0 or newline < 0:
        raise InputError(
            f"{path}: no PLY header; give a .ply of points or of 3D Gaussian splats "
            "(.ksplat and other formats must be exported as .ply)"
        )
    text = head[:end].decode("latin-1")
    lines = [words for line in text.splitlines()[1:] if (words := line.split())]
    encoding = next((" ".join(w[1:]) for w in lines if w[0] == "format"), "missing")
    if encoding not in ("ascii 1.0", "binary_little_endian 1.0"):
        raise InputError(
            f"{path}: format {encoding!r}; allowed: ascii 1.0, binary_little_endian 1.0"
        )
    count, dtype = _vertex(path, lines)
    return encoding.split()[0], count, dtype, newline + 1


def _vertex(path: str | Path, lines: list[list[str]]) -> tuple[int, np.dtype]:
    """Return number and type of the vertices, which must be the first element."""
    elements = [i for i, words in enumerate(lines) if words[0] == "element"]
    names = [" ".join(lines[i][1:2]) for i in elements]
    if not names or names[0] != "vertex":
        raise InputError(
            f"{path}: elements {names}; the first must be 'vertex', as in the .ply of "
            "3D Gaussian splatting (export it uncompressed)"
        )
    first, last = elements[0], (elements[1:] or [len(lines)])[0]
    number = (lines[first][2:3] or ["missing"])[0]
    if not (number.isdecimal() and len(number) <= 10):
        raise InputError(f"{path}: element vertex: {number}; needs their number")
    fields: list[tuple[str, str]] = []
    for words in lines[first + 1 : last]:
        if words[0] != "property":
            continue
        if len(words) != 3 or words[1] not in _TYPES:
            raise InputError(
                f"{path}: {' '.join(words)!r} of a vertex; splats have numbers alone"
            )
        fields.append((words[2], "<" + _TYPES[words[1]]))
    present = [name for name, _ in fields]
    if len(set(present)) < len(present):
        twice = next(name for name in present if present.count(name) > 1)
        raise InputError(f"{path}: property {twice} is there twice")
    return int(number), np.dtype(fields)


def _check_present(path: str | Path, present: list[str]) -> None:
    missing = [name for name in _NEEDED if name not in present]
    if missing:
        raise InputError(
            f"{path}: property {missing[0]} of 'vertex' is missing"
            + (f", and {len(missing) - 1} more" if len(missing) > 1 else "")
            + f"; 3D Gaussian splats need {', '.join(_NEEDED)}"
        )
    harmonics = [name for name in present if name.startswith("f_rest_")]
    known = {*_NEEDED, *_SKIPPED, *harmonics, _FILTER}
    if unknown := [name for name in present if name not in known]:
        raise InputError(
            f"{path}: property {', '.join(unknown[:9])} of 'vertex' is not known and "
            "may change the picture; export plain 3D Gaussian splats, or remove it if "
            "it does not"
        )
    expected = [f"f_rest_{i}" for i in range(len(harmonics))]
    if len(harmonics) not in REST_OF_DEGREE or set(harmonics) != set(expected):
        raise InputError(
            f"{path}: {len(harmonics)} properties f_rest_*; spherical harmonics of "
            "degree 0 to 3 have f_rest_0 up to none, 8, 23 or 44"
        )


def _binary_rows(
    path: str | Path, raw: bytes, count: int, dtype: np.dtype, start: int
) -> np.ndarray:
    needed = count * dtype.itemsize
    if len(raw) - start < needed:
        raise InputError(
            f"{path}: {len(raw) - start} bytes of data, {needed} for {count} vertices "
            "are needed: truncated; copy or export it again"
        )
    return np.frombuffer(raw, dtype, count, start) if count else np.empty(0, dtype)


def _ascii_rows(
    path: str | Path, body: bytes, count: int, dtype: np.dtype
) -> np.ndarray:
    names = dtype.names or ()
    lines = body.split(b"\n", count)[:count]
    words = b" ".join(lines).split()
    if len(words) != count * len(names):
        raise InputError(
            f"{path}: {len(words)} numbers in {count} lines; {len(names)} a vertex are "
            "needed: truncated or damaged; export it again"
        )
    try:
        table = np.array(words).astype(np.float64).reshape(count, len(names))
    except ValueError as err:
        raise InputError(f"{path}: {err}; vertices are lines of numbers") from err
    rows = np.empty(count, np.dtype([(name, "<f8") for name in names]))
    for k, name in enumerate(names):
        rows[name] = table[:, k]
    return rows


def _decode(path: str | Path, rows: np.ndarray) -> Splats:
    """Turn the trained parameters into what they stand for."""
    if not len(rows):
        raise InputError(f"{path}: element vertex: 0; at least 1 is needed")
    n_coefficients = sum(name.startswith("f_rest_") for name in rows.dtype.names or ())
    per_channel = n_coefficients // 3
    harmonics = np.empty((len(rows), 1 + per_channel, 3), np.float32)
    harmonics[:, 0] = _columns(path, rows, _COLOURS)
    for channel in range(3):  # the file holds channel after channel
        first = channel * per_channel
        names = tuple(f"f_rest_{first + j}" for j in range(per_channel))
        if names:
            harmonics[:, 1:, channel] = _columns(path, rows, names)
    scales = _columns(path, rows, _SCALES)
    opacities = 0.5 + 0.5 * np.tanh(0.5 * _columns(path, rows, ("opacity",))[:, 0])
    if _FILTER in (rows.dtype.names or ()):
        # Yu et al. 2024, "Mip-Splatting", equation 9
        _check_scales(path, scales)
        sizes = np.exp(scales)
        wide = np.hypot(sizes, _columns(path, rows, (_FILTER,)))
        opacities, scales = opacities * np.prod(sizes / wide, axis=1), np.log(wide)
    centers = _columns(path, rows, _CENTERS)
    quaternions = _columns(path, rows, _ROTATIONS)
    return make_splats(
        path,
        centers,
        logarithms=scales,
        quaternions=quaternions,
        opacities=opacities,
        harmonics=harmonics,
    )


def make_splats(
    path: str | Path,
    centers: np.ndarray,
    logarithms: np.ndarray,
    quaternions: np.ndarray,
    opacities: np.ndarray,
    harmonics: np.ndarray,
) -> Splats:
    """Check what a file says of n splats.

    Args:
        path: for messages.
        centers: (n, 3).
        logarithms: (n, 3), natural, of the standard deviations.
        quaternions: (n, 4), w, x, y, z, of any length.
        opacities: (n,), within 0 and 1.
        harmonics: (n, k, 3).

    Raises:
        InputError: a number is out of range; the message names splat and property.
    """
    _check_scales(path, logarithms)
    lengths = np.linalg.norm(quaternions, axis=1, keepdims=True)
    if not lengths.all():
        where = int(np.flatnonzero(lengths[:, 0] == 0)[0])
        raise InputError(
            f"{path}: rot_0, rot_1, rot_2, rot_3 of vertex {where} are all 0; a "
            "rotation is a quaternion w, x, y, z"
        )
    if not np.isfinite(centers).all():
        raise InputError(f"{path}: a position is not finite; export it again")
    require_near(path, centers)
    return Splats(
        source=str(path),
        centers=centers.astype(np.float32),
        scales=np.exp(logarithms).astype(np.float32),
        quaternions=(quaternions / lengths).astype(np.float32),
        opacities=opacities.astype(np.float32),
        harmonics=harmonics.astype(np.float32),
    )


def _columns(path: str | Path, rows: np.ndarray, names: tuple[str, ...]) -> np.ndarray:
    """Return properties as (n, len(names)), float64, finite also in float32."""
    with np.errstate(invalid="ignore"):  # of signalling NaN, refused below
        columns = np.stack([rows[name].astype(np.float64) for name in names], 1)
    bad = ~(np.abs(columns) < np.finfo(np.float32).max)  # also where it is NaN
    if bad.any():
        vertex, column = np.argwhere(bad)[0]
        raise InputError(
            f"{path}: {names[column]} of vertex {vertex} is {columns[vertex, column]}; "
            "all must be finite; remove such splats and export again"
        )
    return columns


def _check_scales(path: str | Path, logarithms: np.ndarray) -> None:
    bad = (logarithms < MIN_LOG_SCALE) | (logarithms > MAX_LOG_SCALE)
    if bad.any():
        vertex, axis = np.argwhere(bad)[0]
        value = logarithms[vertex, axis]
        raise InputError(
            f"{path}: scale_{axis} of vertex {vertex} is {value:g}; allowed is "
            f"{MIN_LOG_SCALE:g} to {MAX_LOG_SCALE:g}: scales are stored as natural "
            "logarithms of the standard deviations"
        )
