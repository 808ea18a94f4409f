"""The record of a training, which is written next to the policy."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, Literal

from pydantic import Field, ValidationError

from mi_nerfattack.deploy.sites import AbstractSite
from mi_nerfattack.io import files
from mi_nerfattack.io.resumable import Record
from mi_nerfattack.policy.exported import SUFFIX, export_program
from mi_nerfattack.policy.pilotnet import PilotNet
from mi_nerfattack.system.machine import machine
from mi_nerfattack.training.dataset import FramesFile
from mi_nerfattack.training.imitate import Imitated
from mi_nerfattack.training.settings import ImitationSettings
from mi_nerfattack.training.validation import Epoch


class TrainingRecord(Record):
    """How a policy was trained, and how it drove: the JSON file next to the policy.

    Attributes:
        environments: of the last validation, {ENVIRONMENT: {ROUTE: {CASE: figures}}}.
        training: epochs of the first training and of each round's.
        best_round: whose weights the policy has.
        command: that was given.
        seed: of the training.
        settings: `ImitationSettings`, without settings that others override.
        augmentation: of the images.
        data: frames by collection.
        sites: where the frames come from.
        checksums: SHA-256 of the sites' files.
        machine: that it was trained on; None where it was not written down.
    """

    schema_version: Literal[2] = Field(default=2, alias="schema")
    environments: dict[str, Any]
    training: list[list[Epoch]]
    best_round: int
    command: str
    seed: int
    settings: dict[str, Any]
    augmentation: dict[str, float]
    data: dict[str, int]
    sites: dict[str, Any]
    checksums: dict[str, str]
    machine: str | None = None


def training_record(
    settings: ImitationSettings,
    sites: Sequence[AbstractSite],
    data: Path,
    result: Imitated,
    command: str,
) -> TrainingRecord:
    """Describe a training.

    Args:
        settings: of the training.
        sites: where its frames come from.
        data: folder of the frames.
        result: of the training.
        command: that was given.
    """
    described = {site.name: site.describe() for site in sites}
    sums = [description.pop("files", {}) for description in described.values()]
    return TrainingRecord(
        environments=result.card,
        training=result.history,
        best_round=result.best_round,
        command=command,
        seed=settings.seed,
        settings=_settings(settings),
        augmentation=asdict(settings.training.augmentation),
        data=count_frames(data, result.shards),
        sites=described,
        checksums={name: digest for each in sums for name, digest in each.items()},
        machine=machine(),
    )


def write_trained(
    path: Path, module: PilotNet, record: TrainingRecord
) -> dict[str, Any]:
    """Write a policy and, next to it, its program and its record; return the record.

    Args:
        path: of the weights (.safetensors).
        module: the policy.
        record: of its training.
    """
    module.save(path)
    export_program(module, path.with_suffix(SUFFIX))
    document = record.model_dump(mode="json", by_alias=True)
    files.write_json(path.with_suffix(".json"), document)
    return document


def read_record(path: Path) -> TrainingRecord | None:
    """Read the record next to a policy; None for JSON of something else.

    Raises:
        InputError: unreadable, or no JSON.
    """
    document = files.read_json(path)
    try:
        return TrainingRecord.model_validate(document)
    except ValidationError:
        return None


def _settings(settings: ImitationSettings) -> dict[str, Any]:
    """Return the settings without those that others override."""
    values = asdict(settings)
    values["cloning"] = settings.cloning.describe()
    for part, name in (
        ("collecting", "frames"),
        ("collecting", "seed"),
        ("training", "seed"),
    ):
        del values[part][name]
    return values


def count_frames(data: Path, shards: Sequence[Path]) -> dict[str, int]:
    """Count the frames of shards: by folder below `data`, earlier ones by name.

    Args:
        data: folder of the frames of this training.
        shards: each counts as often as it is there.
    """
    counts: Counter[str] = Counter()
    for shard in sorted(shards):
        own = shard.is_relative_to(data)
        name = shard.parent.relative_to(data).as_posix() if own else ""
        counts[name or f"earlier/{shard.parent.name}"] += len(FramesFile(shard))
    return dict(counts)
