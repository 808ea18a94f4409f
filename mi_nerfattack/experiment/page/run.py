"""A finished run as a page shows it: figures, pictures, and what it was made with."""

from __future__ import annotations

import json
import re
import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from mi_nerfattack.drives.store import read_drives
from mi_nerfattack.drives.table import FURTHER, STEPS, read_csv, records
from mi_nerfattack.errors import InputError
from mi_nerfattack.experiment.attribution import ATTRIBUTION, UNCHANGED
from mi_nerfattack.experiment.run_folder import (
    DRIVES,
    EFFORT,
    SCENARIO,
    object_path,
    read_finished,
)
from mi_nerfattack.fields import load_grid
from mi_nerfattack.io import files
from mi_nerfattack.render.posed import PosedField, object_footprints
from mi_nerfattack.report.pages.elements import (
    ABOVE,
    COST,
    FRAMES,
    SHOWN_CASES,
    TEXTURES,
    WHEN,
    Pane,
    RunPart,
    Scrubber,
    make_pane,
)
from mi_nerfattack.report.plots.map import overhead
from mi_nerfattack.report.plots.strip import turntable
from mi_nerfattack.rollout.drive import ATTACK, NO_OBJECT, RANDOM, Drive, Lane
from mi_nerfattack.scenario.scenario import load_scenario
from mi_nerfattack.scenario.world import driven_route

#: Files of a run folder by their titles, by section of the page.
PICTURES: Mapping[str, Mapping[str, str]] = {
    ABOVE: {
        "Trajectories over the ground": "triptych.png",
        "Overhead view": "overhead.png",
        "Cross-track error": "errors.png",
    },
    COST: {"Convergence of the attack": "convergence.png"},
    FRAMES: {"First-person frames": "strip.png"},
    WHEN: {
        "When the failure is made": "attribution.png",
        "Where the failure is made": "attribution_object.png",
    },
}


def read_run(folder: Path, label: str, repeat: str | None = None) -> RunPart:
    """Read a run folder, and render the objects as its attack left them.

    Args:
        folder: of a finished run.
        label: name of the run on the page, different from other names.
        repeat: the command that makes the run again; by default ``attack`` with its
            scenario.

    Raises:
        InputError: it holds no finished run, or a file is damaged.
    """
    document = read_finished(folder)
    scenario = folder / SCENARIO
    pictures = _pictures(folder, document)
    scrubbers = {
        FRAMES: _drive_scrubbers(folder, document),
        TEXTURES: _turntables(folder, document),
    }
    attack = f"mi-nerfattack attack {shlex.quote(str(scenario))} -o "
    text = files.read_text(scenario)
    made_with, digests = _provenance(folder)
    return RunPart(
        label,
        document,
        text,
        made_with=made_with,
        digests=digests,
        repeat=repeat or attack + "RUN",
        pictures=pictures,
        scrubbers=scrubbers,
        missing=_missing(pictures, scrubbers, f"{attack}{shlex.quote(str(folder))}"),
    )


def _pictures(folder: Path, document: Mapping[str, Any]) -> dict[str, dict[str, Path]]:
    pictures = {
        section: {
            title: folder / name
            for title, name in names.items()
            if (folder / name).is_file()
        }
        for section, names in PICTURES.items()
    }
    if document["scenario"]["attack"]["freedom"]["kind"] == "pose":
        pictures[WHEN] = {
            f"{k} ({UNCHANGED})": path for k, path in pictures[WHEN].items()
        }
    for name in document.get("replay") or {}:
        path = folder / f"controls_{name}.png"
        if path.is_file():
            pictures[FRAMES][f"Change of control in the recording, {name}"] = path
    return pictures


def _missing(
    pictures: Mapping[str, Mapping[str, Path]],
    scrubbers: Mapping[str, Sequence[Scrubber]],
    resume: str,
) -> dict[str, str]:
    """Say why sections are empty, and what fills them."""
    drawn = any(pictures.values())
    reasons = {
        section: f"The run was made without pictures; this writes them: {resume}"
        for section, own in pictures.items()
        if not own
    }
    if drawn and WHEN in reasons:
        reasons[WHEN] = "The policy has no derivatives that would tell."
    if drawn and not scrubbers[FRAMES]:
        reasons[FRAMES] = (
            f"There are no frames; this writes them: {resume} --pictures all"
        )
    if not scrubbers[TEXTURES]:
        reasons[TEXTURES] = "The folder has no objects; a new run writes them."
    return reasons


def _provenance(folder: Path) -> tuple[dict[str, str], dict[str, str]]:
    """Return versions, and checksums of files by key; nothing without them."""
    path = folder / EFFORT
    if not path.is_file():
        return {}, {}
    _, metadata = files.read_safetensors(path, ())
    made_with = {
        key: value
        for key, value in sorted(metadata.items())
        if not key.startswith(("scenario.", "kept.")) and key != "format"
    }
    named = {
        key: json.loads(value)
        for key, value in sorted(metadata.items())
        if key.startswith("scenario.") and '"sha256"' in value
    }
    digests = {
        f"{key.removeprefix('scenario.')}: {value['file']}": value["sha256"]
        for key, value in named.items()
    }
    for key, value in sorted(metadata.items()):  # of other packages
        if key.startswith("scenario.") and key.endswith(".package"):
            made_with[key.removeprefix("scenario.")] = json.loads(value)
    for key, value in named.items():
        if "packages" in value:
            made_with[key.removeprefix("scenario.")] = value["packages"]
    return made_with, digests


MOST_FRAMES = 60
VIEWS = 12  # of a turntable
VIEW_PX = 256  # longer edge
TURN_S = 4.0  # once around
_FRAME = re.compile(r"([0-9]{4,})\.png")

#: Time and signed distance from the lane's centre after each control period of a drive.
Errors = Mapping[int, tuple[float, float]]


def _drive_scrubbers(folder: Path, document: Mapping[str, Any]) -> list[Scrubber]:
    """Show drives without objects, past random textures and past the attack.

    There is one scrubber for each environment with frames.
    """
    names = [name for cases in document["routes"].values() for name in cases]
    names += document.get("replay") or {}
    errors = _read_errors(folder / "steps.csv")
    period = document["scenario"]["vehicle"]["dt_s"]
    scrubbers = [
        _drive_scrubber(folder, name, errors, period_s=period) for name in names
    ]
    return [scrubber for scrubber in scrubbers if scrubber is not None]


def _turntables(folder: Path, document: Mapping[str, Any]) -> list[Scrubber]:
    """Show the attacked objects from all around, if any; a second for each."""
    panes = []
    turns = [f"{360 * k / VIEWS:.0f}°" for k in range(VIEWS)]
    for item in document["scenario"]["objects"]:
        path = object_path(folder, item["id"])
        if path.is_file():
            alt = f"{item['id']} as the attack left it, turned about the vertical"
            views = turntable(load_grid(path), VIEWS, VIEW_PX)
            panes.append(make_pane(item["id"], alt, views, labels=turns))
    title = "Objects as the attack left them"
    if not panes:
        return []
    return [Scrubber(title, tuple(panes), start=0, period_s=TURN_S / VIEWS)]


def _drive_scrubber(
    folder: Path,
    environment: str,
    errors: Mapping[tuple[str, str], Errors],
    period_s: float,
) -> Scrubber | None:
    """Show the drives of an environment; None where there are no frames."""
    frames = {case: _frames(folder, environment, case) for case in SHOWN_CASES}
    frames = {case: own for case, own in frames.items() if own}
    if not frames:
        return None
    steps = sorted({step for own in frames.values() for step in own})
    if len(steps) > MOST_FRAMES:
        chosen = np.linspace(0, len(steps) - 1, MOST_FRAMES).round().astype(int)
        steps = [steps[index] for index in chosen]
    panes = [
        _pane(
            environment,
            case,
            own,
            steps=steps,
            errors=errors.get((environment, case), {}),
        )
        for case, own in frames.items()
    ]
    last = (steps[-1] - steps[0]) / max(1, len(steps) - 1)
    title, start = f"First drives in {environment}", _acting(folder, frames, steps)
    return Scrubber(title, tuple(panes), start, period_s=max(last * period_s, 0.05))


def _acting(
    folder: Path, frames: Mapping[str, Mapping[int, Path]], steps: Sequence[int]
) -> int:
    """Find where the attack acts: the index of one of the control periods.

    It has the largest share of the attack's gradient. Without an attribution, it is
    where the attacked frame differs most from a frame of another case.
    """
    path = folder / ATTRIBUTION
    if path.is_file():
        by_object = files.read_json(path)["gradient_share"].values()
        shares = np.sum(list(by_object), axis=0)
        return int(np.argmax([shares[step : step + 1].sum() for step in steps]))
    attacked = frames.get(ATTACK, {})
    other = frames.get(RANDOM) or frames.get(NO_OBJECT, {})
    return int(np.argmax([_difference(attacked.get(k), other.get(k)) for k in steps]))


def _difference(one: Path | None, other: Path | None) -> float:
    """Return the mean difference of two frames, 0 where one is missing."""
    if one is None or other is None:
        return 0.0
    images = [files.read_image(path).astype(float) for path in (one, other)]
    return float(np.abs(images[0] - images[1]).mean())


def _frames(folder: Path, environment: str, case: str) -> dict[int, Path]:
    """Return the frames of a drive by the control periods before them."""
    own = folder / "frames" / f"{environment}_{case}"
    frames = {
        int(match[1]): path
        for path in (own.iterdir() if own.is_dir() else ())
        if (match := _FRAME.fullmatch(path.name))
    }
    return dict(sorted(frames.items()))


def _pane(
    environment: str,
    case: str,
    frames: Mapping[int, Path],
    steps: list[int],
    errors: Errors,
) -> Pane:
    """Show, at each step, the frame that is nearest."""
    known = np.array(list(frames))
    shown = [int(known[np.abs(known - step).argmin()]) for step in steps]
    word = case.replace("_", " ")
    return make_pane(
        word,
        f"what the policy sees in {environment}, {word}, frame by frame",
        [files.read_image(frames[step]) for step in shown],
        labels=[
            "{:.1f} s, {:+.2f} m".format(*errors[step])
            if step in errors
            else f"after {step} periods"
            for step in shown
        ],
    )


def _read_errors(path: Path) -> dict[tuple[str, str], dict[int, tuple[float, float]]]:
    """Read where first drives were, by environment and case; nothing without a file."""
    errors: dict[tuple[str, str], dict[int, tuple[float, float]]] = {}
    table = read_csv(path, STEPS, FURTHER) if path.is_file() else pd.DataFrame()
    for row in records(table):
        if row["run"] == 0:
            own = errors.setdefault((row["environment"], row["case"]), {})
            own[row["step"]] = row["time_s"], row["cross_track_m"]
    return errors


def draw_above(path: Path, folders: Sequence[Path]) -> None:
    """Plot the first drives of runs on one route, with the objects of all of them.

    Args:
        path: PNG file.
        folders: of finished runs; at least one.

    Raises:
        InputError: a drive is missing or damaged, or a file that a scenario names.
    """
    drives: list[Drive] = []
    footprints, grids = [], {}
    scenario, _ = load_scenario(folders[0] / SCENARIO)
    route = driven_route(scenario, scenario.vehicle.motion())
    for folder in folders:
        own, _ = load_scenario(folder / SCENARIO)
        for item in own.objects:
            if item.position_m is None:  # it is in a scene in XML
                continue
            if item not in grids:
                grids[item] = item.load()
            footprints += object_footprints([PosedField(grids[item], item.pose)])
        routes = read_finished(folder)["routes"].values()
        closed = {environment for cases in routes for environment in cases}
        drives += [
            drive
            for drive in read_drives(folder / DRIVES)
            if drive.run == 0
            and drive.case in SHOWN_CASES
            and drive.environment in closed
        ]
    if not drives:
        raise InputError(f"{folders[0] / DRIVES}: no drives; they were removed")
    limit = Lane.of(route, scenario.vehicle.width_m).wheel_m
    overhead(path, drives, route, object_footprints=footprints, limit=limit)
