"""Driving frames with goals, expert controls and states, read row by row from shards.

A shard is one safetensors file: `frames`, uint8 (n, height, width, 3), sRGB; `goals`,
int64 (n,); `controls`, float32 (n,), rad/s or rad; and the columns of `FrameStates`.
Frames stay on the disk.
"""

from __future__ import annotations

import json
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from mi_nerfattack.errors import InputError
from mi_nerfattack.io import files
from mi_nerfattack.io.resumable import array_digest

#: Format of a shard in its metadata.
FORMAT = "mi_nerfattack frames 2"
#: Names of the files of shards.
SHARDS = "shard_*.safetensors"


@dataclass(frozen=True, eq=False)
class FrameStates:
    """Where the n frames of a shard were taken, and where the expert goes from there.

    Args:
        poses: (n, 3) float64 of the vehicle, x and y in metres, heading in radians.
        speeds: (n,) float32, metres per second, over the control period that ends with
            the frame; the route's speed at the first frame of a drive.
        arc_lengths: (n,) float32, of the nearest point of the route, metres.
        cross_tracks: (n,) float32, signed cross-track error, metres, positive on the
            left.
        waypoints: (n, k, 2) float32, the expert's positions at k times ahead, metres
            forward and to the left, see `vehicle.expert.future_positions`.
        drives: (n,) int64, number of the drive within the shard.
        steps: (n,) int64, control periods since the drive began.
        routes: (n,) int64, index of the route in the shard's `route_names`.
    """

    poses: np.ndarray
    speeds: np.ndarray
    arc_lengths: np.ndarray
    cross_tracks: np.ndarray
    waypoints: np.ndarray
    drives: np.ndarray
    steps: np.ndarray
    routes: np.ndarray


class FramesFile:
    """Frames of one shard on the disk, read row by row.

    No file stays open or mapped: either holds a descriptor, of which a process may have
    1,024 on many systems, and large collections have more shards.

    Args:
        path: the shard.
    """

    dtype = np.dtype(np.uint8)

    def __init__(self, path: Path) -> None:
        self.path = path
        with files.open_safetensors(path) as file:
            frames = file.get_slice("frames")
            dtype, self.shape = frames.get_dtype(), tuple(frames.get_shape())
        if dtype != "U8" or len(self.shape) != 4 or self.shape[3] != 3:
            raise InputError(
                f"{path}: frames {dtype} {self.shape}; U8 of shape "
                "(n, height, width, 3) is needed"
            )

    def __len__(self) -> int:
        return self.shape[0]

    def __getitem__(self, rows: np.ndarray) -> np.ndarray:
        """Read rows (k,): (k, height, width, 3), as an array in memory gives them."""
        result = np.empty((len(rows), *self.shape[1:]), np.uint8)
        with files.open_safetensors(self.path) as file:
            frames = file.get_slice("frames")
            for i, row in enumerate(rows.tolist()):
                result[i] = frames[row]
        return result


@dataclass(frozen=True, eq=False)
class FrameDataset:
    """Rows of several shards under one index.

    Args:
        frames: (n_k, height, width, 3) uint8 sRGB for each shard, in memory or on the
            disk.
        goals: (sum n_k,) int64.
        controls: (sum n_k,) float32, rad/s or rad; (sum n_k, j) of j > 1 controls.
    """

    frames: tuple[np.ndarray | FramesFile, ...]
    goals: np.ndarray
    controls: np.ndarray

    def __post_init__(self) -> None:
        shapes = {array.shape[1:] for array in self.frames}
        count = sum(len(array) for array in self.frames)
        if len(shapes) != 1 or any(array.dtype != np.uint8 for array in self.frames):
            raise InputError(f"frames: uint8 of one shape are needed, not {shapes}")
        shapes = {self.goals.shape, self.controls.shape[:1]}
        if count == 0 or shapes != {(count,)} or self.controls.ndim > 2:
            raise InputError(
                f"dataset: {count} frames, goals {self.goals.shape}, controls "
                f"{self.controls.shape}; at least one row, and as many of each"
            )
        if not np.isfinite(self.controls).all():
            row = int(np.argwhere(~np.isfinite(self.controls))[0, 0])
            raise InputError(
                f"controls: row {row} is {self.controls[row]}; finite only"
            )

    @classmethod
    def from_shards(cls, paths: Sequence[str | Path]) -> FrameDataset:
        """Open shards, in the order given; their frames are read when they are needed.

        Raises:
            InputError: no file; one that is missing or damaged, or whose columns are no
                frames or differ in length.
        """
        if not paths:
            raise InputError("dataset: no shards; give at least one")
        frames, goals, controls = [], [], []
        for path in map(Path, paths):
            images, columns = FramesFile(path), _read_columns(path)
            if {len(column) for column in columns} != {len(images)}:
                raise InputError(
                    f"{path}: {len(images)} frames, but {len(columns[0])} goals and "
                    f"{len(columns[1])} controls; remove it, and the command that "
                    "collected it renders it again"
                )
            frames.append(images)
            goals.append(columns[0])
            controls.append(columns[1])
        return cls(tuple(frames), np.concatenate(goals), np.concatenate(controls))

    def __len__(self) -> int:
        return len(self.goals)

    @cached_property
    def digest(self) -> str:
        """Return the SHA-256 of frames, goals and controls; all of them are read."""
        columns = (*self.frames, self.goals, self.controls)
        return array_digest(column[np.arange(len(column))] for column in columns)

    @cached_property
    def _starts(self) -> np.ndarray:
        """Row numbers at which shards begin, and their end."""
        return np.cumsum([0, *(len(array) for array in self.frames)])

    def read_frames(self, rows: np.ndarray) -> np.ndarray:
        """Copy frames (k, height, width, 3) uint8 of the given row numbers (k,)."""
        starts = self._starts
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


def shard_columns(
    frames: np.ndarray,
    goals: np.ndarray,
    controls: np.ndarray,
    states: FrameStates | None = None,
) -> dict[str, np.ndarray]:
    """Check and name what a shard holds.

    Args:
        frames: (n, height, width, 3) uint8, sRGB.
        goals: (n,) integers.
        controls: (n,) rad/s or rad; (n, j) of j > 1 controls.
        states: of the vehicle; None where nothing but controls is imitated.

    Raises:
        InputError: shapes or types that do not fit, controls that are not finite.
    """
    data = FrameDataset(
        (np.asarray(frames),),
        np.asarray(goals, np.int64),
        np.asarray(controls, np.float32),
    )
    columns = {"frames": frames, "goals": data.goals, "controls": data.controls}
    return columns if states is None else columns | vars(states)


def find_shards(*folders: str | Path) -> list[Path]:
    """Return the shards anywhere below each folder, in order of their names.

    Raises:
        InputError: a folder has none.
    """
    shards: list[Path] = []
    for folder in folders:
        shards += (own := sorted(Path(folder).rglob(SHARDS)))
        if not own:
            raise InputError(
                f"{folder}: no frames in it; give a folder of 'mi-nerfattack train'"
            )
    return shards


def control_unit_of(shard: Path) -> str | None:
    """Return the unit of a shard's controls; None where its site does not say it."""
    _, metadata = files.read_safetensors(shard, ())
    return json.loads(metadata.get("site.car.control_unit", "null"))


def divide_shards(
    shards: Sequence[Path], fraction: float, least: int = 0
) -> tuple[list[Path], list[Path]]:
    """Divide shards into those to train on and those to hold out.

    A shard's own controls decide about it, whatever the others are: it keeps its role
    when more shards come. Shards share neither drives nor textures.

    Args:
        shards: files of `collect`.
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
    groups: tuple[list[Path], list[Path]] = [], []
    for index, shard in enumerate(shards):
        groups[index in held].append(shard)
    return groups


def _draw_of(shard: Path) -> float:
    """Return a number in [0, 1) that looks random and is the shard's own."""
    return zlib.crc32(_read_columns(shard)[1].tobytes()) / 2**32


def _read_columns(shard: Path) -> tuple[np.ndarray, np.ndarray]:
    columns, _ = files.read_safetensors(shard, ("goals", "controls"))
    goals, controls = columns["goals"], columns["controls"]
    if goals.dtype != np.int64 or controls.dtype != np.float32:
        raise InputError(
            f"{shard}: goals {goals.dtype}, controls {controls.dtype}; int64 and "
            "float32 are needed"
        )
    return goals, controls
