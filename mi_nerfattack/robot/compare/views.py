"""What real cameras and the run's saw at equal places of the route."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import closing
from pathlib import Path

import numpy as np
from PIL import Image

from mi_nerfattack.deploy.replay.environment import open_recording
from mi_nerfattack.deploy.replay.recording import AbstractRecording
from mi_nerfattack.report.plots.strip import first_person_strip
from mi_nerfattack.robot.compare.aligned import Aligned
from mi_nerfattack.robot.compare.course import Course
from mi_nerfattack.rollout.drive import Drive

_PLACES = 6


def draw_views(
    path: Path,
    aligned: Sequence[Aligned],
    run: Sequence[Drive],
    frames: Path,
    course: Course,
) -> None:
    """Write frames of the last real drive of each case below those of the run.

    Of cases of which the run kept every frame; nothing where there are none.

    Args:
        path: PNG file.
        aligned: real drives; the places are those of the last one.
        run: drives of the run; of each case the first has frames.
        frames: folder with those of the run, a recording for each environment and case.
        course: of all drives.

    Source: appendix, figure C.4.
    """
    last = {item.recorded.drive.case: item for item in aligned}
    firsts = {drive.case: drive for drive in reversed(run)}
    places = aligned[-1].places
    # not to the very end, which not all reach
    places = np.linspace(places[0], places[-3], _PLACES)
    rows: dict[str, Sequence[np.ndarray]] = {}
    for case, item in last.items():
        drive, recorded = firsts[case], item.recorded
        folder = frames / f"{drive.environment}_{case}"
        if not folder.is_dir():
            continue
        recording = open_recording(folder, course.camera, course.mount, course.period)
        with closing(recording):
            if len(recording.track.times) < len(drive.controls):
                continue
            seen = _frames(recording, course.arcs(drive.states[:-1]), places)
        if not seen:
            continue
        size = seen[0].shape[1], seen[0].shape[0]
        rows[f"{drive.environment}\n{case}"] = seen
        recording = open_recording(
            recorded.path, course.camera, course.mount, course.period
        )
        with closing(recording):
            arcs = course.arcs(recorded.drive.states)
            real = _frames(recording, arcs, places, recorded.first)
        if real:
            rows[f"real\n{case}"] = [_shrunk(image, size) for image in real]
    if rows:
        first_person_strip(path, rows, [f"{place:.1f} m" for place in places])


def _frames(
    recording: AbstractRecording, arcs: np.ndarray, places: np.ndarray, first: int = 0
) -> list[np.ndarray]:
    """Return the frames at which places are first reached, of those that are."""
    furthest = np.maximum.accumulate(arcs)
    reached = np.searchsorted(furthest, places - 1e-9)
    return [recording.image(first + int(k)) for k in reached if k < len(arcs)]


def _shrunk(image: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Make an image no larger than a size, width and height, pixels."""
    small = Image.fromarray(image)
    small.thumbnail(size)
    return np.asarray(small)
