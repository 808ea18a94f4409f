"""Checked readers and atomic writers: the only place that opens user files.

Readers check kind and size before they allocate. Writers fill a temporary file in
the target's folder, flush it to the disk, rename it over the target and flush the
folder, so that an interruption leaves the old file or the new one. Every function
raises InputError with the path in its message.
"""

from __future__ import annotations

import errno
import hashlib
import io
import json
import os
import re
import secrets
import stat
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, ImageOps

from mi_nerfattack.errors import InputError
from mi_nerfattack.extras import load_extra
from mi_nerfattack.io.strict import parse_json, parse_toml

MAX_TEXT_BYTES = 1 << 28
MAX_TOML_BYTES = 1 << 21
MAX_IMAGE_BYTES = 1 << 28
MAX_IMAGE_PIXELS = 1 << 27
MAX_TENSOR_BYTES = 1 << 33

HEIC_SUFFIXES = (".heic", ".heif")
IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".webp", *HEIC_SUFFIXES)  # that are read
_HEIC_BRANDS = (b"heic", b"heix", b"hevc", b"heim", b"heis", b"mif1", b"msf1")
_IMAGE_FORMATS = {".png": "PNG", ".jpg": "JPEG", ".jpeg": "JPEG"}
TEMPORARY = re.compile(r"\..+\.[0-9a-f]{12}\.tmp")  # what a killed writer leaves
_TENSOR_REMEDY = "only .safetensors files are read"

_REASONS = {
    errno.ENOENT: "does not exist; check the path",
    errno.ENOTDIR: "a part of the path is not a folder; check the path",
    errno.EISDIR: "is a folder; give a file",
    errno.EACCES: "permission denied; check the owner and mode of file and folder",
    errno.EPERM: "operation not permitted; check the owner and mode",
    errno.EROFS: "the file system is read-only; choose another folder",
    errno.ENOSPC: "no space left on the disk; free some or choose another folder",
    errno.EDQUOT: "disk quota exceeded; free some space or choose another folder",
    errno.ENAMETOOLONG: "the name is too long; check the path",
    errno.ELOOP: "too many symbolic links; check the path",
    errno.EEXIST: "exists and is not a folder; choose another name",
}


def read_bytes(path: str | Path, limit: int) -> bytes:
    """Read a regular file of at most `limit` bytes."""
    piece = max(_check_file(path, limit), 1 << 16)  # files of the system tell 0 bytes
    chunks, size = [], 0
    with reported(path), open(path, "rb") as file:
        while size <= limit and (chunk := file.read(piece)):
            chunks.append(chunk)
            size += len(chunk)
    if size > limit:
        raise InputError(f"{path}: more than {limit} bytes; it grows while it is read")
    return b"".join(chunks)


def sha256(path: str | Path) -> str:
    """Return the SHA-256 of a file's content as hexadecimal digits."""
    digest = hashlib.sha256()
    _check_file(path, MAX_TENSOR_BYTES)
    with reported(path), open(path, "rb") as file:
        while piece := file.read(1 << 20):
            digest.update(piece)
    return digest.hexdigest()


def read_text(path: str | Path, limit: int = MAX_TEXT_BYTES) -> str:
    """Read a UTF-8 text file of at most `limit` bytes, without a byte order mark."""
    raw = read_bytes(path, limit)
    try:
        return raw.decode("utf-8-sig")
    except UnicodeDecodeError as err:
        raise InputError(
            f"{path}: byte {err.start} is not UTF-8; save the file as UTF-8 text"
        ) from err


def read_json(path: str | Path) -> Any:
    """Read strict JSON: no NaN or infinity, no key twice in one object."""
    return parse_json(path, read_text(path))


def read_toml(path: str | Path) -> dict[str, Any]:
    """Read a TOML file of at most 2 MiB; see `parse_toml`."""
    return parse_toml(path, read_text(path, MAX_TOML_BYTES))


def read_image(path: str | Path, as_shown: bool = False) -> np.ndarray:
    """Read a PNG, JPEG, WebP or HEIC image; see `decode_image`."""
    return decode_image(path, read_bytes(path, MAX_IMAGE_BYTES), as_shown)


def decode_image(path: str | Path, raw: bytes, as_shown: bool = False) -> np.ndarray:
    """Decode the content of a PNG, JPEG, WebP or HEIC file; `path` is for messages.

    The pixels come as they are stored, since calibrated poses refer to the stored grid;
    `as_shown` turns them as their EXIF orientation says and as viewers do. HEIC turns
    them by itself. Grey and palette images become RGB.

    Returns:
        sRGB values, uint8, (height, width, 3), or (height, width, 4) with alpha.

    Raises:
        InputError: it is damaged, or HEIC and pillow-heif is not installed.
    """
    with _decoding(path, raw, image_formats(path, raw)) as image:
        if image.mode not in ("1", "L", "P", "RGB", "LA", "PA", "RGBA"):
            raise InputError(
                f"{path}: pixel type {image.mode}; use 8 bits a channel, grey or RGB"
            )
        mode = "RGBA" if image.has_transparency_data else "RGB"
        shown = ImageOps.exif_transpose(image) if as_shown else image
        return np.array(shown.convert(mode), dtype=np.uint8)


def image_formats(path: str | Path, raw: bytes) -> tuple[str, ...]:
    """Return the formats of Pillow for `decode_image`; it then knows HEIC, too."""
    if raw[4:8] != b"ftyp" or raw[8:12] not in _HEIC_BRANDS:
        return "PNG", "JPEG", "WEBP"
    what = f"{path}: a HEIC photograph"
    load_extra("pillow_heif", what, "convert it to JPEG").register_heif_opener()
    return ("HEIF",)


def read_image16(path: str | Path) -> np.ndarray:
    """Read a grey PNG of 16 bits, as depth cameras write them.

    Returns:
        values as they are stored, uint16, (height, width).
    """
    with _decoding(path, read_bytes(path, MAX_IMAGE_BYTES), ("PNG",)) as image:
        if image.mode not in ("I;16", "I;16B", "I"):
            raise InputError(f"{path}: pixel type {image.mode}; must be grey, 16 bits")
        return np.array(image).astype(np.uint16)


def read_safetensors(
    path: str | Path, names: Sequence[str] | None = None
) -> tuple[dict[str, np.ndarray], dict[str, str]]:
    """Read tensors of a safetensors file: those of some names, or all.

    The format's checks (header length, offsets, shapes, types, file size) pass
    before a tensor is allocated. Values are not checked: NaN is the caller's matter.

    Returns:
        The tensors by name, and the file's metadata.
    """
    with open_safetensors(path) as file:
        keys = file.keys() if names is None else names
        tensors = {name: file.get_tensor(name) for name in keys}
        return tensors, dict(file.metadata() or {})


@contextmanager
def open_safetensors(path: str | Path) -> Iterator[Any]:
    """Open a safetensors file, to read tensors whole or in part, as `safe_open` does.

    The file is checked as by `read_safetensors`, and mapped as long as it is open.
    """
    import safetensors

    size = _check_file(path, MAX_TENSOR_BYTES)
    with reported(path), open(path, "rb") as file:
        start = file.read(9)
    _check_tensor_header(path, start, size)
    try:
        with safetensors.safe_open(str(path), framework="numpy") as file:
            yield file
    except safetensors.SafetensorError as err:
        raise InputError(
            f"{path}: damaged or truncated ({err}); write or copy it again"
        ) from err
    except (TypeError, AttributeError, OSError, ValueError) as err:
        raise InputError(f"{path}: {err}; use types and sizes NumPy has") from err


def write_text(path: str | Path, text: str) -> None:
    """Write UTF-8 text atomically."""
    write_bytes(path, text.encode("utf-8"))


def write_json(path: str | Path, value: Any) -> None:
    """Write strict, indented JSON atomically; NaN and infinity raise InputError."""
    try:
        text = json.dumps(value, indent=2, ensure_ascii=False, allow_nan=False)
    except ValueError as err:
        raise InputError(
            f"{path}: {err}; JSON holds finite numbers, write null instead"
        ) from err
    write_text(path, text + "\n")


def write_image(path: str | Path, image: np.ndarray) -> None:
    """Write an image atomically as PNG or, by suffix, as JPEG of quality 95.

    Args:
        path: ends in .png, .jpg or .jpeg.
        image: sRGB values, uint8, (height, width), (height, width, 3) or, for PNG
            alone, (height, width, 4).
    """
    name = _IMAGE_FORMATS.get(Path(path).suffix.lower())
    if name is None:
        raise InputError(f"{path}: unknown image suffix; use .png, .jpg or .jpeg")
    channels = (3,) if name == "JPEG" else (3, 4)
    shaped = image.ndim == 2 or (image.ndim == 3 and image.shape[2] in channels)
    if image.dtype != np.uint8 or not shaped or image.size == 0:
        raise InputError(
            f"{path}: array {image.dtype} {image.shape}; {name} takes uint8 "
            f"(height, width) or (height, width, {' or '.join(map(str, channels))})"
        )
    buffer, options = io.BytesIO(), {"quality": 95} if name == "JPEG" else {}
    Image.fromarray(np.ascontiguousarray(image)).save(buffer, name, **options)
    write_bytes(path, buffer.getvalue())


def write_safetensors(
    path: str | Path,
    tensors: Mapping[str, np.ndarray],
    metadata: Mapping[str, str] | None = None,
) -> None:
    """Write tensors atomically; equal input gives equal bytes."""
    import safetensors.numpy

    arrays = {name: np.asarray(value, order="C") for name, value in tensors.items()}
    raw = safetensors.numpy.save(arrays)
    length = int.from_bytes(raw[:8], "little")
    header = json.loads(raw[8 : 8 + length])
    if metadata:
        header = {"__metadata__": dict(sorted(metadata.items())), **header}
    encoded = json.dumps(header, separators=(",", ":")).encode("utf-8")
    encoded += b" " * (-len(encoded) % 8)
    start = len(encoded).to_bytes(8, "little") + encoded
    _write(path, [start, memoryview(raw)[8 + length :]])


def write_bytes(path: str | Path, data: bytes) -> None:
    """Write bytes atomically: temporary file, fsync, rename, fsync of the folder."""
    _write(path, [data])


def _write(path: str | Path, chunks: Sequence[bytes | memoryview]) -> None:
    with reported(path):
        target = Path(os.path.realpath(path))
        if target.is_dir():
            raise IsADirectoryError(errno.EISDIR, "is a folder")
        if target.exists() and not target.is_file():
            raise InputError(f"{path}: is not a regular file; choose another name")
        partial = _temporary(target)
        try:
            _write_new(partial, chunks)
            os.replace(partial, target)
        finally:
            partial.unlink(missing_ok=True)
        _sync_folder(target.parent)


def make_folder(path: str | Path) -> Path:
    """Create a folder and its parents where they are missing."""
    with reported(path):
        Path(path).mkdir(parents=True, exist_ok=True)
    return Path(path)


def check_writable(path: str | Path) -> None:
    """Raise InputError if a file could not be written to a path.

    Call it before long work; it makes a file in the target's folder and removes it.
    """
    with reported(path):
        target = Path(os.path.realpath(path))
        if target.is_dir():
            raise IsADirectoryError(errno.EISDIR, "is a folder")
        probe = _temporary(target)
        try:
            _write_new(probe, [])
        finally:
            probe.unlink(missing_ok=True)


def check_folder(path: str | Path) -> None:
    """Raise InputError if a folder could not be made or written to; none is made."""
    parents = (Path(path).absolute() / ".probe").parents
    check_writable(next(p for p in parents if os.path.exists(p)) / ".probe")


@contextmanager
def reported(path: str | Path) -> Iterator[None]:
    """Turn errors of the system into InputError with the path."""
    try:
        yield
    except OSError as err:
        reason = _REASONS.get(err.errno or 0, f"{err.strerror}; check path and disk")
        if err.errno == errno.ENOENT and not (folder := Path(path).parent).exists():
            reason += f", there is no folder {folder}"
        raise InputError(f"{path}: {reason}") from err
    except ValueError as err:
        if isinstance(err, InputError):
            raise
        raise InputError(f"{str(path)!r}: {err}; check the path") from err


@contextmanager
def _decoding(
    path: str | Path, raw: bytes, formats: tuple[str, ...]
) -> Iterator[Image.Image]:
    """Decode an image of at most `MAX_IMAGE_PIXELS` pixels, and tell of its damage."""
    names = " or ".join(formats)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)
            image = Image.open(io.BytesIO(raw), formats=formats)
        if image.width * image.height > MAX_IMAGE_PIXELS:
            raise InputError(
                f"{path}: {image.width} x {image.height} pixels; "
                f"at most {MAX_IMAGE_PIXELS} pixels are read"
            )
        image.load()
        yield image
    except Image.UnidentifiedImageError as err:
        raise InputError(f"{path}: not an image that can be read; use {names}") from err
    # a damaged file makes Pillow raise whatever its parser stumbles over
    except Exception as err:
        if isinstance(err, InputError | MemoryError):
            raise
        raise InputError(
            f"{path}: damaged image ({err}); write or copy it again"
        ) from err


def _check_file(path: str | Path, limit: int) -> int:
    with reported(path):
        status = os.stat(path)
    if stat.S_ISDIR(status.st_mode):
        raise InputError(f"{path}: {_REASONS[errno.EISDIR]}")
    if not stat.S_ISREG(status.st_mode):
        raise InputError(f"{path}: is not a regular file; copy it to one first")
    if status.st_size > limit:
        raise InputError(f"{path}: {status.st_size} bytes; at most {limit} are read")
    return status.st_size


def _check_tensor_header(path: str | Path, start: bytes, size: int) -> None:
    """Check the first nine bytes: the header's length and its opening brace."""
    length = int.from_bytes(start[:8], "little")
    if start[8:] != b"{":
        if start.startswith(b"PK"):
            raise InputError(f"{path}: is a zip archive (a pickle?); {_TENSOR_REMEDY}")
        if start[:1] == b"\x80" and start[1:2] in (b"\2", b"\3", b"\4", b"\5"):
            raise InputError(f"{path}: is a pickle; {_TENSOR_REMEDY}")
        raise InputError(
            f"{path}: {size} bytes without a safetensors header, truncated or of "
            f"another format; {_TENSOR_REMEDY}"
        )
    if length > size - 8:
        raise InputError(
            f"{path}: header of {length} bytes in a file of {size} bytes, truncated "
            "or damaged; write or copy it again"
        )


def _temporary(target: Path) -> Path:
    return target.with_name(f".{target.name[:80]}.{secrets.token_hex(6)}.tmp")


def _write_new(path: Path, chunks: Sequence[bytes | memoryview]) -> None:
    descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o666)
    try:
        for view in map(memoryview, chunks):
            while view:
                view = view[os.write(descriptor, view) :]
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _sync_folder(folder: Path) -> None:
    if os.name == "nt":  # folders cannot be opened there
        return
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
