"""Driving frames with goals and expert controls, memory-mapped from shards.

A shard is a folder of three NumPy files: `frames.npy`, uint8 (n, height, width, 3),
sRGB; `goals.npy`, int64 (n,); `controls.npy`, float32 (n,), rad/s. Frames stay on
the disk and are read row by row.
"""

from __future__ import annotations

import hashlib
import io
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from mi_nerfattack.errors import InputError
from mi_nerfattack.io import files

COLUMNS = {"frames": np.uint8, "goals": np.int64, "controls": np.float32}


class FramesFile:
    """Frames of one shard on the disk, read row by row.

    No file stays open or mapped: either holds a descriptor, of which a process may have
    1,024 on many systems, and large collections have more shards.

    Args:
        path: `frames.npy`.
    """

    def __init__(self, path: Path) -> None:
        column = _map_column(path, np.uint8)
        self.path, self._start = path, column.offset
        self.shape, self.dtype = column.shape, column.dtype

    def __len__(self) -> int:
        """Count the rows."""
        return self.shape[0]

    def __getitem__(self, rows: np.ndarray) -> np.ndarray:
        """Read rows (k,): (k, height, width, 3), as an array in memory gives them."""
        result = np.empty((len(rows), *self.shape[1:]), np.uint8)
        files.read_rows(self.path, self._start, rows, result)
        return result


@dataclass(frozen=True, eq=False)
class FrameDataset:
    """Rows of several shards under one index.

    Args:
        frames: (n_k, height, width, 3) uint8 sRGB for each shard, in memory or on the
            disk.
        goals: (sum n_k,) int64.
        controls: (sum n_k,) float32, rad/s.
    """

    frames: tuple[np.ndarray | FramesFile, ...]
    goals: np.ndarray
    controls: np.ndarray

    def __post_init__(self) -> None:
        shapes = {array.shape[1:] for array in self.frames}
        count = sum(len(array) for array in self.frames)
        if len(shapes) != 1 or any(array.dtype != np.uint8 for array in self.frames):
            raise InputError(f"frames: uint8 of one shape are needed, not {shapes}")
        if count == 0 or {self.goals.shape, self.controls.shape} != {(count,)}:
            raise InputError(
                f"dataset: {count} frames, goals {self.goals.shape}, controls "
                f"{self.controls.shape}; at least one row, and as many of each"
            )
        if not np.isfinite(self.controls).all():
            row = int(np.argmin(np.isfinite(self.controls)))
            raise InputError(
                f"controls: row {row} is {self.controls[row]}; finite only"
            )

    @classmethod
    def from_folders(cls, folders: Sequence[str | Path]) -> FrameDataset:
        """Map shards written by `write_shard`, in the order given.

        Raises:
            InputError: no folder; a missing or damaged file; lengths that differ.
        """
        if not folders:
            raise InputError("dataset: no folders; give at least one shard")
        shards = [
            (
                FramesFile(Path(folder) / "frames.npy"),
                _read_column(Path(folder), "goals"),
                _read_column(Path(folder), "controls"),
            )
            for folder in folders
        ]
        for folder, shard in zip(folders, shards, strict=True):
            if len({len(column) for column in shard}) != 1:
                raise InputError(
                    f"{folder}: {[len(column) for column in shard]} rows of "
                    f"{list(COLUMNS)}; remove the folder, and the command that "
                    "collected it renders it again"
                )
        frames, goals, controls = zip(*shards, strict=True)
        return cls(tuple(frames), np.concatenate(goals), np.concatenate(controls))

    def __len__(self) -> int:
        """Count the rows."""
        return len(self.goals)

    @cached_property
    def digest(self) -> str:
        """Return the SHA-256 of frames, goals and controls; all of them are read."""
        total = hashlib.sha256()
        for array in (*self.frames, self.goals, self.controls):
            total.update(str((array.shape, array.dtype)).encode())
            total.update(array[np.arange(len(array))].reshape(-1).data)
        return total.hexdigest()

    def read_frames(self, rows: np.ndarray) -> np.ndarray:
        """Copy frames (k, height, width, 3) uint8 of the given row numbers (k,)."""
        starts = np.cumsum([0, *(len(array) for array in self.frames)])
        result = np.empty((len(rows), *self.frames[0].shape[1:]), np.uint8)
        shard = np.searchsorted(starts, rows, side="right") - 1
        for number in np.unique(shard):
            chosen = shard == number
            result[chosen] = self.frames[number][rows[chosen] - starts[number]]
        return result

    def split(
        self, fraction: float, seed: int, block: int = 64
    ) -> tuple[np.ndarray, np.ndarray]:
        """Divide the rows into training and held-out rows by whole blocks.

        Neighbouring frames of one drive look alike; whole blocks of consecutive rows
        keep them on the same side.

        Args:
            fraction: held out, in (0, 1).
            seed: of the choice of blocks.
            block: consecutive rows that stay together.

        Returns:
            Training and held-out row numbers, ascending; neither is empty.
        """
        if not 0 < fraction < 1:
            raise InputError(f"held_out: {fraction!r}; between 0 and 1")
        block = max(1, min(block, len(self) // 4))
        number = np.arange(len(self)) // block
        count = int(number[-1]) + 1
        if count < 2:
            raise InputError(f"dataset: {len(self)} rows cannot be split; at least 2")
        held = min(max(1, round(fraction * count)), count - 1)
        chosen = np.random.default_rng(seed).permutation(count)[:held]
        mask = np.isin(number, chosen)
        return np.flatnonzero(~mask), np.flatnonzero(mask)


def write_shard(
    folder: str | Path, frames: np.ndarray, goals: np.ndarray, controls: np.ndarray
) -> None:
    """Write one shard; each of its files appears whole or not at all.

    Args:
        folder: made if missing.
        frames: (n, height, width, 3) uint8, sRGB.
        goals: (n,) integers.
        controls: (n,) rad/s.
    """
    goals = np.asarray(goals, np.int64)
    controls = np.asarray(controls, np.float32)
    FrameDataset((np.asarray(frames),), goals, controls)  # checks all three
    folder = files.make_folder(folder)
    for name, array in zip(COLUMNS, (frames, goals, controls), strict=True):
        buffer = io.BytesIO()
        np.save(buffer, np.ascontiguousarray(array), allow_pickle=False)
        files.write_bytes(folder / f"{name}.npy", buffer.getvalue())


def divide_shards(
    shards: Sequence[Path], fraction: float, least: int = 0
) -> tuple[list[Path], list[Path]]:
    """Divide shards into those to train on and those to hold out.

    A shard's own controls decide about it, whatever the others are: it keeps its role
    when more shards come. Shards share neither drives nor textures.

    Args:
        shards: folders written by `write_shard`.
        fraction: held out, of many; in [0, 1).
        least: held out at least, where one is left to train on; those nearest to being
            held out anyway.

    Returns:
        Shards to train on and held-out ones, in their order; with `least` the first
        are not empty.
    """
    drawn = np.array([_draw_of(shard) for shard in shards])
    count = int((drawn < fraction).sum())
    if least:
        count = min(max(count, least), len(shards) - 1)
    held = set(np.argsort(drawn, kind="stable")[:count].tolist())
    parts: tuple[list[Path], list[Path]] = [], []
    for index, shard in enumerate(shards):
        parts[index in held].append(shard)
    return parts


def _draw_of(shard: Path) -> float:
    """Return a number in [0, 1) that looks random and is the shard's own."""
    return zlib.crc32(_read_column(shard, "controls").tobytes()) / 2**32


def _read_column(shard: Path, name: str) -> np.ndarray:
    """Copy one of the small .npy files of a shard into memory, checked."""
    return np.array(_map_column(shard / f"{name}.npy", COLUMNS[name]))


def _map_column(path: Path, dtype: type) -> np.memmap:
    """Memory-map one .npy file and check its type and shape."""
    try:
        array = np.load(path, mmap_mode="r", allow_pickle=False)
    except (OSError, ValueError, EOFError) as error:
        raise InputError(
            f"{path}: cannot be read ({error}); remove its folder, and the command "
            "that collected it renders it again"
        ) from error
    image = len(array.shape) == 4 and array.shape[3] == 3
    fits = array.dtype == dtype and array.flags.c_contiguous
    if not fits or not (image if dtype is np.uint8 else array.ndim == 1):
        raise InputError(
            f"{path}: {array.dtype} {array.shape}; {np.dtype(dtype)} of shape "
            f"{'(n, height, width, 3)' if dtype is np.uint8 else '(n,)'}, in C order, "
            "is needed"
        )
    return array
