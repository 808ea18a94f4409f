"""Shards of frames, written without a collection."""

from __future__ import annotations

from pathlib import Path

from mi_nerfattack.io import files
from mi_nerfattack.training.dataset import shard_columns


def write_shard(path: Path, frames, goals, controls) -> Path:
    """Write `PATH.safetensors` and return it."""
    path = path.with_suffix(".safetensors")
    files.write_safetensors(path, shard_columns(frames, goals, controls))
    return path
