"""Shards of frames as a PyTorch data set, for your own training code."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import fields
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch

from mi_nerfattack.errors import InputError
from mi_nerfattack.io import files
from mi_nerfattack.training.dataset import (
    FORMAT,
    FrameDataset,
    FrameStates,
    control_unit_of,
    find_shards,
)

_STATES = tuple(item.name for item in fields(FrameStates))


class Frame(NamedTuple):
    """Tensors of one frame; those of a batch have one more axis in front.

    Attributes:
        image: (3, height, width) float32, sRGB in [0, 1]; with a window
            (window, 3, height, width), the oldest first.
        goal: int64.
        control: float32 of the expert, rad/s or rad.
        waypoints: (k, 2) float32; this and all below as of `FrameStates`.
        pose: (3,) float64.
        speed, arc_length, cross_track: float32.
        drive: int64, number of the drive within the folder.
        step: int64.
        route: int64, index of the route in `Frames.routes`.
    """

    image: torch.Tensor
    goal: torch.Tensor
    control: torch.Tensor
    waypoints: torch.Tensor
    pose: torch.Tensor
    speed: torch.Tensor
    arc_length: torch.Tensor
    cross_track: torch.Tensor
    drive: torch.Tensor
    step: torch.Tensor
    route: torch.Tensor


class Frames(torch.utils.data.Dataset[Frame]):
    """Frames of shards as PyTorch takes them; images stay on the disk.

    All other columns are kept in memory, about 100 bytes per frame.

    Args:
        shards: files of `collect`; their order is that of the frames.
        window: number of frames of the same drive in each image, the frame itself and
            those before it. Before there are so many, the first one is repeated.

    Attributes:
        waypoints_s: k times ahead of the waypoints, seconds.
        control_unit: "rad/s" or "rad"; None where a site of yours does not say it.
        routes: names of the routes.

    Raises:
        InputError: no shard, a window below 1, or a shard that is damaged, of an
            earlier version, or of other times, another unit or another size than the
            first.
    """

    def __init__(self, shards: Sequence[Path], window: int = 1) -> None:
        if window < 1:
            raise InputError(f"window: {window}; at least 1 frame")
        columns: list[dict[str, np.ndarray]] = []
        kinds: dict[tuple[str, str | None], Path] = {}
        names: list[str] = []
        drives = 0
        for path in shards:
            states, metadata = _read_states(path)
            local = json.loads(metadata["route_names"])
            names += [name for name in local if name not in names]
            routes = np.array([names.index(name) for name in local])[states["routes"]]
            numbered = states["drives"] + drives
            columns.append(states | {"drives": numbered, "routes": routes})
            drives = int(numbered[-1]) + 1
            kind = metadata["settings.waypoints_s"], control_unit_of(path)
            kinds.setdefault(kind, path)
        if len(kinds) > 1:
            listing = "; ".join(
                f"{path}: waypoints after {times} s, controls in {unit}"
                for (times, unit), path in kinds.items()
            )
            raise InputError(f"{listing}: give a folder whose frames have the same")
        self._data = FrameDataset.from_shards(shards)
        self._columns = {
            name: np.concatenate([column[name] for column in columns])
            for name in _STATES
        }
        self._columns |= {"goals": self._data.goals, "controls": self._data.controls}
        self.window: int = window
        ((times, self.control_unit),) = kinds
        self.waypoints_s: tuple[float, ...] = tuple(json.loads(times))
        self.routes: tuple[str, ...] = tuple(names)

    def __len__(self) -> int:
        return len(self._data)

    def __getitem__(self, index: int) -> Frame:
        """Read one frame; raises `IndexError` beyond the last one."""
        row, columns = range(len(self))[index], self._columns
        first = np.searchsorted(columns["drives"], columns["drives"][row])
        rows = np.maximum(first, np.arange(row - self.window + 1, row + 1))
        image = torch.from_numpy(self._data.read_frames(rows))
        image = image.permute(0, 3, 1, 2).float() / 255

        def at(name: str) -> torch.Tensor:
            return torch.tensor(columns[name][row])

        return Frame(
            image=image if self.window > 1 else image[0],
            goal=at("goals"),
            control=at("controls"),
            waypoints=at("waypoints"),
            pose=at("poses"),
            speed=at("speeds"),
            arc_length=at("arc_lengths"),
            cross_track=at("cross_tracks"),
            drive=at("drives"),
            step=at("steps"),
            route=at("routes"),
        )


def frames(folder: str | Path, window: int = 1) -> Frames:
    """Open all frames below a folder for a PyTorch `DataLoader`.

    Args:
        folder: of `mi-nerfattack train --data`, or a part of it, such as ``round_0``.
        window: see `Frames`.

    Raises:
        InputError: the folder has no frames; or as of `Frames`.
    """
    return Frames(find_shards(folder), window)


def _read_states(path: Path) -> tuple[dict[str, np.ndarray], dict[str, str]]:
    """Read the columns of `FrameStates`, and the metadata, of a shard."""
    _, metadata = files.read_safetensors(path, ())
    if metadata.get("format") != FORMAT:
        raise InputError(
            f"{path}: format {metadata.get('format')!r}; poses and waypoints need "
            f"{FORMAT!r}: collect again, into another folder, or read the rest with "
            "training.FrameDataset"
        )
    return files.read_safetensors(path, _STATES)
