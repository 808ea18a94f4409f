"""Files that an interrupted job goes on from: what they belong to is checked.

Such a file is a safetensors file whose metadata hold the *identity* of the job (its
format, versions and all values that decide its result, each under a key of its own),
remarks that decide nothing, and a checksum of the tensors.
"""

from __future__ import annotations

import json
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mi_nerfattack.errors import InputError
from mi_nerfattack.io import files

_ABOUT = "about."  # prefix of the remarks' keys
_CHECKSUM = "about.crc32"
_NONE = "(none)"


@dataclass(frozen=True, eq=False)
class Kept:
    """What a file held.

    Attributes:
        tensors: by name.
        about: the remarks.
        ignored: differences that were ignored, one line each.
    """

    tensors: dict[str, np.ndarray]
    about: dict[str, str]
    ignored: list[str]


def write_kept(
    path: str | Path,
    tensors: Mapping[str, np.ndarray],
    identity: Mapping[str, str],
    about: Mapping[str, str],
) -> None:
    """Replace a file atomically.

    Args:
        path: the file.
        tensors: by name.
        identity: values that decide the result; ``format`` among them.
        about: remarks.

    Raises:
        InputError: it cannot be written; the file that was there is intact.
    """
    remarks = {_ABOUT + key: value for key, value in about.items()}
    checksum = {_CHECKSUM: _checksum(tensors)}
    files.write_safetensors(path, tensors, {**identity, **remarks, **checksum})


def read_kept(
    path: str | Path, identity: Mapping[str, str], remedy: str, force: bool = False
) -> Kept:
    """Read a file that belongs to a job.

    Args:
        path: the file.
        identity: of the job that reads, as for :func:`write_kept`.
        remedy: what to do where the file belongs to another job.
        force: ignore differences but that of the format.

    Raises:
        InputError: the file cannot be read, is damaged, of another format, or belongs
            to another job; the message then lists the differences.
    """
    tensors, metadata = files.read_safetensors(path)
    if metadata.get("format") != identity["format"]:
        raise InputError(
            f"{path}: format {metadata.get('format')!r}, this program reads "
            f"{identity['format']!r}; start again without the file"
        )
    if metadata.pop(_CHECKSUM, "") != _checksum(tensors):
        raise InputError(
            f"{path}: damaged, its checksum is wrong; copy it again, or start again "
            "without the file"
        )
    size = len(_ABOUT)
    about = {k[size:]: v for k, v in metadata.items() if k.startswith(_ABOUT)}
    kept = {k: v for k, v in metadata.items() if not k.startswith(_ABOUT)}
    found = differences(kept, identity)
    if found and not force:
        lines = "\n".join(f"  {line}" for line in found)
        raise InputError(
            f"{path}: belongs to something else (value there -> value here)\n"
            f"{lines}\n{remedy}"
        )
    return Kept(tensors, about, found)


def differences(kept: Mapping[str, str], present: Mapping[str, str]) -> list[str]:
    """Compare two identities.

    A value that is JSON with a key ``sha256`` stands for a file: only its content
    counts.

    Returns:
        a line for each key whose values differ: ``key: kept -> present``.
    """
    keys = [*present, *(key for key in kept if key not in present)]
    return [line for key in keys if (line := _difference(key, kept.get(key), present))]


def _difference(key: str, kept: str | None, present: Mapping[str, str]) -> str:
    now = present.get(key)
    if kept == now:
        return ""
    old, new = _as_file(kept), _as_file(now)
    if old is None or new is None:
        return f"{key}: {_shown(kept, old)} -> {_shown(now, new)}"
    if old["sha256"] == new["sha256"]:
        return ""
    if old["file"] == new["file"]:
        return f"{key}: the content of {old['file']} has changed"
    return f"{key}: {old['file']} -> {new['file']}, of other content"


def _as_file(value: str | None) -> dict[str, Any] | None:
    try:
        entry = json.loads(value or "")
    except ValueError:
        return None
    is_file = isinstance(entry, dict) and {"file", "sha256"} <= set(entry)
    return entry if is_file else None


def _shown(value: str | None, entry: dict[str, Any] | None) -> str:
    if entry is not None:
        return entry["file"]
    return _NONE if value is None else value


def _checksum(tensors: Mapping[str, np.ndarray]) -> str:
    total = 0
    for name in sorted(tensors):
        value = np.ascontiguousarray(tensors[name])
        total = zlib.crc32(f"{name} {value.dtype.str} {value.shape}".encode(), total)
        total = zlib.crc32(value.reshape(-1).view(np.uint8).data, total)
    return f"{total:08x}"
