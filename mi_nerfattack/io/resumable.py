"""Work that is done, kept in files that an interrupted job goes on from.

A unit of work is one safetensors file, written whole or not at all and never changed
in part. Its metadata hold the *identity* of the unit, a record that decides nothing,
and a checksum of the tensors. The identity is the format, the versions and all values
that decide the unit's result, each under a separate key.
"""

from __future__ import annotations

import hashlib
import json
import zlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic, TypeVar

import numpy as np
import pydantic

from mi_nerfattack.errors import InputError, is_interrupt
from mi_nerfattack.io import files


def array_digest(arrays: Iterable[np.ndarray]) -> str:
    """Return the SHA-256 of types, shapes and values of arrays, in their order."""
    digest = hashlib.sha256()
    for values in arrays:
        digest.update(f"{values.dtype} {values.shape}".encode())
        digest.update(np.ascontiguousarray(values).reshape(-1).data)
    return digest.hexdigest()


def json_digest(value: Any) -> str:
    """Return the SHA-256 of a value as JSON; the order of keys does not count."""
    return hashlib.sha256(json.dumps(value, sort_keys=True).encode()).hexdigest()


_RECORD = "kept.record"
_CHECKSUM = "kept.crc32"
_NONE = "(none)"


class Record(pydantic.BaseModel):
    """Values that a file keeps in addition to tensors; written and read as JSON."""

    model_config = pydantic.ConfigDict(
        extra="forbid", frozen=True, strict=True, ser_json_inf_nan="constants"
    )


R = TypeVar("R", bound=Record)


@dataclass(frozen=True, eq=False)
class UnitContent(Generic[R]):
    """The content of a unit's file.

    Attributes:
        tensors: tensors of the unit, by name.
        record: record of the unit.
        ignored: differences that were ignored, one line each.
    """

    tensors: dict[str, np.ndarray]
    record: R
    ignored: list[str]


@dataclass(frozen=True, eq=False)
class Unit(Generic[R]):
    """One unit of work and its file.

    Args:
        path: the file; there when the unit is done.
        identity: values that decide the result; ``format`` among them.
        model: of the record.
        remedy: what to do where the file belongs to something else.
    """

    path: Path
    identity: Mapping[str, str]
    model: type[R]
    remedy: str

    def write(self, tensors: Mapping[str, np.ndarray], record: R) -> None:
        """Replace the file atomically.

        Raises:
            InputError: it cannot be written; the file that was there is intact.
        """
        header = {_RECORD: record.model_dump_json(), _CHECKSUM: _checksum(tensors)}
        files.write_safetensors(self.path, tensors, {**self.identity, **header})

    def read(self, force: bool = False) -> UnitContent[R] | None:
        """Read the file; None where the unit is not done.

        Args:
            force: ignore differences but that of the format.

        Raises:
            InputError: the file cannot be read, is damaged, of another format, or
                belongs to something else; the message then lists the differences.
        """
        if not self.path.exists():
            return None
        tensors, metadata = files.read_safetensors(self.path)
        self._check_format(metadata)
        if metadata.get(_CHECKSUM) != _checksum(tensors):
            raise InputError(
                f"{self.path}: damaged, its checksum is wrong; copy it again, or start "
                "again without the file"
            )
        record, ignored = self._judge(metadata, force)
        return UnitContent(tensors, record, ignored)

    def read_record(self) -> R | None:
        """Read the record alone; None where the unit is not done.

        Costs nothing but the header, and does not notice damaged tensors.

        Raises:
            InputError: as of :meth:`read`.
        """
        if not self.path.exists():
            return None
        _, metadata = files.read_safetensors(self.path, ())
        self._check_format(metadata)
        return self._judge(metadata, False)[0]

    def _check_format(self, metadata: Mapping[str, str]) -> None:
        expected = self.identity["format"]
        if metadata.get("format") != expected or _RECORD not in metadata:
            raise InputError(
                f"{self.path}: format {metadata.get('format')!r}, this program reads "
                f"{expected!r}; start again without the file"
            )

    def _judge(self, metadata: dict[str, str], force: bool) -> tuple[R, list[str]]:
        identity = {
            key: value
            for key, value in metadata.items()
            if key not in (_RECORD, _CHECKSUM)
        }
        changes = differences(identity, self.identity)
        if not force:
            refuse(self.path, changes, self.remedy)
        try:
            return self.model.model_validate_json(metadata[_RECORD]), changes
        except pydantic.ValidationError as err:
            raise InputError(
                f"{self.path}: its record is damaged ({err.errors()[0]['msg']}); start "
                "again without the file"
            ) from err


def check_entries(
    path: Path, tensors: Mapping[str, np.ndarray], needed: Mapping[str, np.ndarray]
) -> None:
    """Raise InputError unless tensors have the types and shapes that are needed.

    Args:
        path: their file.
        tensors: tensors of the file, by name; those that are not needed are ignored.
        needed: examples of the needed tensors, by name; where an example is empty, the
            first axis may have any length.
    """
    for name, like in needed.items():
        value, free = tensors.get(name), 0 if like.size else 1
        kind = None if value is None else (value.dtype, value.shape[free:], value.ndim)
        if kind != (like.dtype, like.shape[free:], like.ndim):
            there = "missing" if value is None else f"{value.dtype} {value.shape}"
            raise InputError(
                f"{path}: {name}: {there}, this run needs {like.dtype} {like.shape}; "
                "start again without the file"
            )


@contextmanager
def misfits_reported(path: Path) -> Iterator[None]:
    """Tell of entries whose values do not go together, whatever stumbles over them."""
    try:
        yield
    except (LookupError, TypeError, ValueError, OverflowError, RuntimeError) as err:
        if is_interrupt(err):
            raise
        raise InputError(
            f"{path}: its entries do not go together ({err}); start again without the "
            "file"
        ) from err


def refuse(path: str | Path, changes: Sequence[str], remedy: str) -> None:
    """Raise InputError if a file differs from what is wanted.

    Args:
        path: the file.
        changes: of :func:`differences`.
        remedy: what to do.
    """
    if changes:
        lines = "\n".join(f"  {line}" for line in changes)
        raise InputError(
            f"{path}: belongs to something else (value there -> value here)\n"
            f"{lines}\n{remedy}"
        )


def flatten(name: str, value: Any) -> dict[str, str]:
    """Name each value of a JSON document for an identity.

    Returns:
        ``{"name.key": "1", ...}``; what is no object is one value.
    """
    if isinstance(value, dict) and value:
        branches = [flatten(f"{name}.{key}", item) for key, item in value.items()]
        return {key: text for branch in branches for key, text in branch.items()}
    return {name: json.dumps(value, sort_keys=True)}


def differences(stored: Mapping[str, str], present: Mapping[str, str]) -> list[str]:
    """Compare two identities.

    A value that is JSON with the keys ``file`` and ``sha256`` describes a file: only
    the file's content counts.

    Returns:
        a line for each key whose values differ: ``key: stored -> present``.
    """
    keys = [*present, *(key for key in stored if key not in present)]
    return [
        line for key in keys if (line := _difference(key, stored.get(key), present))
    ]


def _difference(key: str, stored: str | None, present: Mapping[str, str]) -> str:
    now = present.get(key)
    if stored == now:
        return ""
    old, new = _as_file(stored), _as_file(now)
    if old is None or new is None:
        return f"{key}: {_shown(stored, old)} -> {_shown(now, new)}"
    if old["sha256"] == new["sha256"]:
        return ""
    if old["file"] == new["file"]:
        return f"{key}: the content of {old['file']} has changed"
    return f"{key}: {old['file']} -> {new['file']}, of other content"


def content_of(value: str) -> str:
    """Return the SHA-256 in a value that describes a file; any other value itself."""
    entry = _as_file(value)
    return value if entry is None else entry["sha256"]


def _as_file(value: str | None) -> dict[str, Any] | None:
    try:
        entry = json.loads(value or "")
    except (ValueError, RecursionError):
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
