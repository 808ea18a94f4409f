"""What a reader scrubs through: frames of a run's drives, and its objects turning."""

from __future__ import annotations

import csv
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from mi_nerfattack.experiment.run_folder import object_path
from mi_nerfattack.fields import load_grid
from mi_nerfattack.io import files
from mi_nerfattack.report.pages.parts import SHOWN_CASES
from mi_nerfattack.report.pages.scrubber import Pane, Scrubber, make_pane
from mi_nerfattack.report.plots.around import turntable
from mi_nerfattack.rollout.drive import ATTACK

MOST_FRAMES = 60
VIEWS = 12  # of a turntable
VIEW_PX = 256  # longer edge
TURN_S = 4.0  # once around
_FRAME = re.compile(r"([0-9]{4,})\.png")

#: Time and signed distance from the lane's centre after each control period of a drive.
Errors = Mapping[int, tuple[float, float]]


def seen_scrubbers(folder: Path, document: Mapping[str, Any]) -> list[Scrubber]:
    """Show drives without objects, past a random look and past the attack.

    Args:
        folder: of the run; what ``frames/`` holds is shown, `MOST_FRAMES` at most.
        document: its ``metrics.json``.

    Returns:
        one an environment of which there are frames.
    """
    names = [name for cases in document["routes"].values() for name in cases]
    names += document.get("replay") or {}
    errors = _read_errors(folder / "steps.csv")
    period = document["scenario"]["vehicle"]["dt_s"]
    found = [_seen(folder, name, errors, period) for name in names]
    return [scrubber for scrubber in found if scrubber is not None]


def turntables(folder: Path, document: Mapping[str, Any]) -> list[Scrubber]:
    """Show the attacked objects from all around; nothing if the run has none.

    Cost: about a second an object.

    Args:
        folder: of the run.
        document: its ``metrics.json``.
    """
    panes = []
    turns = [f"{360 * k / VIEWS:.0f}°" for k in range(VIEWS)]
    for item in document["scenario"]["objects"]:
        path = object_path(folder, item["id"])
        if path.is_file():
            alt = f"{item['id']} as the attack left it, turned about the vertical"
            views = turntable(load_grid(path), VIEWS, VIEW_PX)
            panes.append(make_pane(item["id"], alt, views, turns))
    title = "Objects as the attack left them"
    return [Scrubber(title, tuple(panes), 0, TURN_S / VIEWS)] if panes else []


def _seen(
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
        _pane(environment, case, own, steps, errors.get((environment, case), {}))
        for case, own in frames.items()
    ]
    attacked = errors.get((environment, ATTACK), {})
    far = [abs(attacked.get(step, (0.0, 0.0))[1]) for step in steps]
    last = (steps[-1] - steps[0]) / max(1, len(steps) - 1)
    title = f"First drives in {environment}"
    return Scrubber(
        title, tuple(panes), int(np.argmax(far)), max(last * period_s, 0.05)
    )


def _frames(folder: Path, environment: str, case: str) -> dict[int, Path]:
    """Return the frames of a drive by the control periods before them."""
    own = folder / "frames" / f"{environment}_{case}"
    found = {
        int(match[1]): path
        for path in (own.iterdir() if own.is_dir() else ())
        if (match := _FRAME.fullmatch(path.name))
    }
    return dict(sorted(found.items()))


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
    images = [files.read_image(frames[step]) for step in shown]
    labels = [_label(errors, step) for step in shown]
    word = case.replace("_", " ")
    alt = f"what the policy sees in {environment}, {word}, frame by frame"
    return make_pane(word, alt, images, labels)


def _label(errors: Errors, step: int) -> str:
    if step not in errors:
        return f"after {step} periods"
    time_s, error = errors[step]
    return f"{time_s:.1f} s, {error:+.2f} m"


def _read_errors(path: Path) -> dict[tuple[str, str], dict[int, tuple[float, float]]]:
    """Read where first drives were, by environment and case."""
    found: dict[tuple[str, str], dict[int, tuple[float, float]]] = {}
    for row in _rows(path):
        if row["run"] == "0":
            own = found.setdefault((row["environment"], row["case"]), {})
            own[int(row["step"])] = float(row["time_s"]), float(row["cross_track_m"])
    return found


def _rows(path: Path) -> Iterator[dict[str, str]]:
    if path.is_file():
        yield from csv.DictReader(files.read_text(path).splitlines())
