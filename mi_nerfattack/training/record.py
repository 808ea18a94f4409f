"""What a training writes down about itself, beside the policy."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from mi_nerfattack.deploy.sites import AbstractSite
from mi_nerfattack.io import files
from mi_nerfattack.policy.exported.program import SUFFIX, export_program
from mi_nerfattack.training.dataset import FramesFile
from mi_nerfattack.training.imitate import Imitated
from mi_nerfattack.training.settings import ImitationSettings


def training_record(
    settings: ImitationSettings,
    sites: Sequence[AbstractSite],
    data: Path,
    shards: Sequence[Path],
    command: str,
) -> dict[str, Any]:
    """Describe a training: what its page shows.

    Args:
        settings: of the training.
        sites: where its frames come from.
        data: folder of the frames.
        shards: that were trained and validated on.
        command: that was given.

    Returns:
        `command`, `seed`, `settings`, `augmentation`, `data` (frames by collection),
        `sites` and `checksums` (SHA-256 of the sites' files), as JSON.
    """
    described = [site.describe() for site in sites]
    record = {
        "command": command,
        "seed": settings.seed,
        "settings": _settings(settings),
        "augmentation": asdict(settings.training.augmentation),
        "data": count_frames(data, shards),
        "sites": {
            site.name: {key: value for key, value in about.items() if key != "files"}
            for site, about in zip(sites, described, strict=True)
        },
        "checksums": {
            name: digest
            for about in described
            for name, digest in about.get("files", {}).items()
        },
    }
    return json.loads(json.dumps(record, default=str))


def write_trained(path: Path, result: Imitated, record: Mapping[str, Any]) -> None:
    """Write a policy, and beside it its program and its record.

    Args:
        path: of the weights (.safetensors).
        result: of the training.
        record: see `training_record`.
    """
    result.module.save(path)
    export_program(result.module, path.with_suffix(SUFFIX))
    document = {
        "schema": 2,
        "environments": result.card,
        "training": result.history,
        "best_round": result.best_round,
        **record,
    }
    files.write_json(path.with_suffix(".json"), document)


def read_record(path: Path) -> dict[str, Any] | None:
    """Read what training writes beside a policy; None for JSON of something else.

    Raises:
        InputError: unreadable, or no JSON.
    """
    found = files.read_json(path)
    ours = (
        isinstance(found, dict)
        and type(found.get("schema")) is int
        and isinstance(found.get("training"), list)
        and all(_is_history(rows) for rows in found["training"])
    )
    return found if ours else None


def _is_history(rows: Any) -> bool:
    return isinstance(rows, list) and all(isinstance(row, dict) for row in rows)


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
        place = shard.parent.relative_to(data).as_posix() if own else ""
        counts[place or f"earlier/{shard.parent.name}"] += len(FramesFile(shard))
    return dict(counts)
