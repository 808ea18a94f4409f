"""All cases of an environment side by side, as a video."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import groupby
from pathlib import Path

import numpy as np

from mi_nerfattack.experiment.finished import Finished
from mi_nerfattack.experiment.pictures.frames import frame_folder, nominal_drives
from mi_nerfattack.experiment.stages import OnProgress
from mi_nerfattack.io import files
from mi_nerfattack.io.video import write_video
from mi_nerfattack.report.plots.strip import tiles
from mi_nerfattack.rollout.drive import Drive


def write_videos(output: Path, done: Finished, on_progress: OnProgress) -> None:
    """Write ``videos/ENV.mp4`` from the frames of all control periods, in real time.

    Args:
        output: the run folder, with all frames.
        done: what the run came to.
        on_progress: told about every frame.
    """
    files.make_folder(output / "videos")
    nominal = nominal_drives(done.drives, done.looks)
    groups = groupby(nominal, lambda drive: drive.environment)
    for label, group in groups:
        drives = list(group)
        pictures = _pictures(output, drives, f"{label}: video", on_progress)
        path = output / "videos" / f"{label}.mp4"
        write_video(path, pictures, 1 / float(drives[0].time_s[0]))


def _pictures(
    output: Path, drives: list[Drive], stage: str, on_progress: OnProgress
) -> Iterator[np.ndarray]:
    """Lay the frames of all drives side by side; a drive that is over stands still."""
    count = 1 + max(len(drive.controls) for drive in drives)
    for step in range(count):
        images = {}
        for drive in drives:
            own = min(step, len(drive.controls))
            time_s, error = 0.0, ""
            if own:
                time_s = drive.time_s[own - 1]
                error = f"{drive.cross_track_m[own - 1]:+.2f} m"
            title = f"{drive.case.replace('_', ' ')}  {time_s:.1f} s  {error}"
            path = frame_folder(output, drive) / f"{own:04d}.png"
            images[title] = files.read_image(path)
        yield tiles(images)
        on_progress(stage, step + 1, count, "")
