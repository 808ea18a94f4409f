"""A finished run as a page shows it: figures, pictures, and what it was made with."""

from __future__ import annotations

import json
import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from mi_nerfattack.experiment.attribution import UNCHANGED
from mi_nerfattack.experiment.page.scrubbers import seen_scrubbers, turntables
from mi_nerfattack.experiment.run_folder import DRIVES, SCENARIO, read_finished
from mi_nerfattack.io import files
from mi_nerfattack.report.pages.parts import (
    ABOVE,
    COST,
    SEEN,
    TEXTURES,
    WHEN,
    RunPart,
)
from mi_nerfattack.report.pages.scrubber import Scrubber

#: Files of a run folder by their titles, by section of the page.
PICTURES: Mapping[str, Mapping[str, str]] = {
    ABOVE: {
        "Trajectories over the ground": "triptych.png",
        "Overhead view": "overhead.png",
        "Cross-track error": "errors.png",
    },
    COST: {"Convergence of the attack": "convergence.png"},
    SEEN: {"First-person frames": "strip.png"},
    WHEN: {
        "When the failure is made": "attribution.png",
        "Where the failure is made": "attribution_object.png",
    },
}


def read_run(folder: Path, label: str, repeat: str | None = None) -> RunPart:
    """Read a run folder, and render the objects as its attack left them.

    Args:
        folder: of a finished run.
        label: that tells it from others on the page.
        repeat: the command that makes it again; that of its scenario by default.

    Raises:
        InputError: it holds no finished run, or a file is damaged.
    """
    document = read_finished(folder)
    scenario = folder / SCENARIO
    pictures = _pictures(folder, document)
    scrubbers = {
        SEEN: seen_scrubbers(folder, document),
        TEXTURES: turntables(folder, document),
    }
    attack = f"mi-nerfattack attack {shlex.quote(str(scenario))} -o "
    return RunPart(
        label,
        document,
        files.read_text(scenario),
        *_provenance(folder),
        repeat or attack + "RUN",
        pictures,
        scrubbers,
        _missing(pictures, scrubbers, f"{attack}{shlex.quote(str(folder))}"),
    )


def _pictures(folder: Path, document: Mapping[str, Any]) -> dict[str, dict[str, Path]]:
    """Return the pictures that there are."""
    found = {
        section: {
            title: folder / name
            for title, name in names.items()
            if (folder / name).is_file()
        }
        for section, names in PICTURES.items()
    }
    if document["scenario"]["attack"]["parameters"] == "pose":
        found[WHEN] = {f"{k} ({UNCHANGED})": path for k, path in found[WHEN].items()}
    for name in document.get("replay") or {}:
        path = folder / f"controls_{name}.png"
        if path.is_file():
            found[SEEN][f"Change of control in the recording, {name}"] = path
    return found


def _missing(
    pictures: Mapping[str, Mapping[str, Path]],
    scrubbers: Mapping[str, Sequence[Scrubber]],
    resume: str,
) -> dict[str, str]:
    """Say why sections are empty, and what fills them."""
    drawn = any(pictures.values())
    found = {
        section: f"The run was made without pictures; this writes them: {resume}"
        for section, own in pictures.items()
        if not own
    }
    if drawn and WHEN in found:
        found[WHEN] = "The policy has no derivatives that would tell."
    if drawn and not scrubbers[SEEN]:
        found[SEEN] = f"There are no frames; this writes them: {resume} --frames all"
    if not scrubbers[TEXTURES]:
        found[TEXTURES] = "The folder has no objects; a new run writes them."
    return found


def _provenance(folder: Path) -> tuple[dict[str, str], dict[str, str]]:
    """Return versions, and checksums of files by key; nothing without drives."""
    for path in sorted((folder / DRIVES).glob("*.safetensors")):
        _, about = files.read_safetensors(path, ())
        made_with = {
            key: value
            for key, value in sorted(about.items())
            if not key.startswith(("scenario.", "kept.")) and key != "format"
        }
        named = {
            key: json.loads(value)
            for key, value in sorted(about.items())
            if key.startswith("scenario.") and '"sha256"' in value
        }
        digests = {
            f"{key.removeprefix('scenario.')}: {value['file']}": value["sha256"]
            for key, value in named.items()
        }
        return made_with, digests
    return {}, {}
