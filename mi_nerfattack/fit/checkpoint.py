"""Checkpoints of a fit: one safetensors file, replaced atomically."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from mi_nerfattack.backend.versions import versions
from mi_nerfattack.fit.options import FitOptions, FitProgress
from mi_nerfattack.fit.training import Training
from mi_nerfattack.io import files
from mi_nerfattack.io.resumable import (
    Record,
    Unit,
    array_digest,
    check_entries,
    json_digest,
    misfits_reported,
)

FORMAT = "mi_nerfattack fit checkpoint 4"
_REMEDY = (
    "go on with the same images, depth, options and versions, or start again, which "
    "replaces the file (--force)"
)
_EVERY_S = 30.0
_MAX_SHARE = 0.02  # of the time that may go into writing


class FitRecord(Record):
    """Values that a checkpoint keeps with the state: wall time, and reports so far."""

    elapsed_s: float
    history: list[FitProgress]


class FitCheckpoint:
    """Keeps the state of a fit on disk.

    Args:
        path: file, replaced atomically; if the file exists, the fit goes on from it.
        training: the fit.
        anew: start the fit from its beginning even if the file exists.

    Attributes:
        elapsed_s: wall time of the fit before it was interrupted.
        history: reports before it was interrupted.

    Raises:
        InputError: the file cannot be read, or belongs to other images, depth, options
            or versions.
    """

    def __init__(self, path: Path, training: Training, anew: bool = False) -> None:
        self.training = training
        self.elapsed_s = 0.0
        self.history: list[FitProgress] = []
        identity = {"format": FORMAT, **versions(), "fit": _digest(training)}
        self._unit = Unit(path, identity, FitRecord, remedy=_REMEDY)
        content = None if anew else self._unit.read()
        if content is not None:
            check_entries(path, content.tensors, training.tensors())
            with misfits_reported(path):
                training.load_tensors(content.tensors)
            self.elapsed_s, self.history = (
                content.record.elapsed_s,
                content.record.history,
            )
        files.check_writable(path)
        self._written = time.perf_counter()
        self._cost_s = 0.0

    def save_if_due(self, elapsed_s: float, history: Sequence[FitProgress]) -> None:
        """Save if the last time is long enough ago, for what saving costs."""
        waited = time.perf_counter() - self._written
        if waited >= max(_EVERY_S, self._cost_s / _MAX_SHARE):
            self.save(elapsed_s, history)

    def save(self, elapsed_s: float, history: Sequence[FitProgress]) -> None:
        """Write the complete state."""
        start = time.perf_counter()
        record = FitRecord(elapsed_s=elapsed_s, history=list(history))
        self._unit.write(self.training.tensors(), record)
        self._written = time.perf_counter()
        self._cost_s = self._written - start


def _digest(training: Training) -> str:
    """Hash what decides a fit: images, masks, poses, depth, options, field, box.

    How long it lasts is left out: a longer fit goes on from a shorter one.
    """
    usual = FitOptions()
    options = replace(
        training.options,
        steps=usual.steps,
        epochs=usual.epochs,
        budget_minutes=usual.budget_minutes,
        patience=usual.patience,
    )
    images = training.images
    arrays = [*images.images, *(images.masks if images.masks is not None else ())]
    arrays += [images.camera_to_world]
    arrays += [] if training.depth is None else list(training.depth)
    metadata = training.field.metadata()
    info = {key: metadata[key] for key in metadata if key not in training.field.info}
    settings = images.camera, images.cameras, options, info, training.pixels
    return json_digest([array_digest(arrays), repr(settings)])[:16]
