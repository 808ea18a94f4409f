"""Checkpoints of an attack: one safetensors file, replaced atomically."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from mi_nerfattack import files
from mi_nerfattack.attack.gradient import GradientAttack
from mi_nerfattack.errors import InputError
from mi_nerfattack.versions import versions

FORMAT = "mi_nerfattack attack checkpoint 1"


def save_checkpoint(path: str | Path, attack: GradientAttack, digest: str) -> None:
    """Write the complete state of an attack.

    Args:
        path: file, replaced atomically.
        attack: the attack.
        digest: hash of the scenario.
    """
    metadata = {"format": FORMAT, "scenario": digest, **versions()}
    files.write_safetensors(path, attack.tensors(), metadata)


def load_checkpoint(path: str | Path, attack: GradientAttack, digest: str) -> None:
    """Continue an attack from a file.

    Raises:
        InputError: the file is no checkpoint, belongs to another scenario or was
            written by other versions.
    """
    try:
        attack.load_tensors(check_checkpoint(path, digest))
    except KeyError as err:
        raise InputError(
            f"{path}: entry {err} is missing; the file is damaged"
        ) from err


def check_checkpoint(path: str | Path, digest: str) -> dict[str, np.ndarray]:
    """Read the tensors of a checkpoint that belongs to a scenario.

    Raises:
        InputError: as :func:`load_checkpoint`.
    """
    tensors, metadata = files.read_safetensors(path)
    expected = {"format": FORMAT, "scenario": digest, **versions()}
    for key, value in expected.items():
        if metadata.get(key) != value:
            raise InputError(
                f"{path}: {key} is {metadata.get(key)!r}, this run has {value!r}; "
                "resume with the same scenario and versions, or start a new run folder"
            )
    return tensors
