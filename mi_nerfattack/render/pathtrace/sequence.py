"""Frames along a camera path: a folder of EXR files that can be continued, a video."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from mi_nerfattack.io import exr, files, locks
from mi_nerfattack.io.resumable import differences, refuse
from mi_nerfattack.io.video import check_fps, write_video
from mi_nerfattack.render.pathtrace.frames import (
    Frame,
    FrameRenderer,
    Precision,
    to_srgb,
    write_frame,
)

# What must agree for a frame to be kept.
_COMPARED = (
    "digests",
    "scene_parameters",
    "sensor",
    "camera",
    "spp",
    "seed",
    "variant",
    "versions",
    "precision",
)


@dataclass(frozen=True, eq=False)
class Shot:
    """What to render along a path, and how.

    Args:
        renderer: the scene and its sensor.
        camera_to_world: (n, 4, 4), OpenCV axes.
        seed: of the first pose; frame i has `seed + i`, modulo 2^32.
        precision: of colour and opacity in the files.
        anew: render frames that are there again; by default they are kept, and must
            have been rendered from the same files, pose, camera, samples and seed, by
            the same programs, with the same precision.
    """

    renderer: FrameRenderer
    camera_to_world: np.ndarray
    seed: int = 0
    precision: Precision = "half"
    anew: bool = False


def frame_path(folder: str | Path, index: int) -> Path:
    """Return the file of the frame at a pose, counted from 0."""
    return Path(folder) / f"frame_{index:04d}.exr"


def render_folder(
    shot: Shot,
    folder: str | Path,
    progress: Callable[[int, int, bool], None] = lambda done, total, skipped: None,
) -> list[Path]:
    """Render a path to `frame_0000.exr`, ... in a folder.

    An interruption leaves whole frames only.

    Args:
        shot: what to render.
        folder: made if needed; frames that are there are kept, see `Shot.anew`.
        progress: called with (frames done, all frames, whether the last one was kept).

    Returns:
        The files, in order.

    Raises:
        InputError: a frame that cannot be written, or one that is there and shows
            something else, or another process works in the folder.
    """
    with locks.exclusive(files.make_folder(folder)):
        return _render(shot, Path(folder), progress, select=lambda frame: frame)


def render_video(
    shot: Shot,
    path: str | Path,
    fps: float,
    progress: Callable[[int, int, bool], None] = lambda done, total, skipped: None,
) -> tuple[int, int]:
    """Render a path to an MP4 file; see `write_video`.

    The colour of each frame is kept as EXR in `working_folder(path)` until the video
    is written, so that an interrupted one can be continued.

    Args:
        shot: what to render.
        path: the file.
        fps: frames per second.
        progress: as for `render_folder`.

    Returns:
        Width and height of the video, pixels.
    """
    check_fps(fps)
    files.check_writable(path)
    folder = working_folder(path)
    # 8 bits clip what is too bright for 16-bit floats
    exact = replace(shot, precision="float")
    with locks.exclusive(files.make_folder(folder)):
        paths = _render(exact, folder, progress, select=Frame.colour_only)
        size = write_video(path, _read_srgb(paths), fps)
        for frame in paths:
            frame.unlink()
        if not any(folder.iterdir()):
            folder.rmdir()
    return size


def working_folder(path: str | Path) -> Path:
    """Return the folder that holds the frames of an unfinished video."""
    return Path(path).with_suffix(".frames")


def _render(
    shot: Shot,
    folder: Path,
    progress: Callable[[int, int, bool], None],
    select: Callable[[Frame], Frame],
) -> list[Path]:
    for left in filter(locks.is_partial, folder.glob(".frame_*.tmp")):
        left.unlink(missing_ok=True)  # of a process that was killed
    total = len(shot.camera_to_world)
    paths = [frame_path(folder, i) for i in range(total)]
    files.check_writable(paths[0])
    for i, (path, pose) in enumerate(zip(paths, shot.camera_to_world, strict=True)):
        seed = (shot.seed + i) % 2**32
        skipped = path.is_file() and not shot.anew
        precision = {"precision": shot.precision}
        if skipped:
            check_same(path, shot.renderer.metadata(pose, seed) | precision)
        else:
            frame = select(shot.renderer.render(pose, seed))
            labelled = replace(frame, metadata={**frame.metadata, **precision})
            write_frame(path, labelled, shot.precision)
        progress(i + 1, total, skipped)
    return paths


def check_same(path: str | Path, expected: dict[str, str]) -> None:
    """Raise InputError if an EXR file was not rendered from what `expected` says."""
    present = exr.read_metadata(path)
    compared = {key: present[key] for key in _COMPARED if key in present}
    issues = differences(compared, {key: expected[key] for key in _COMPARED})
    refuse(path, issues, "render all anew (--force), or to another folder")


def _read_srgb(paths: list[Path]) -> Iterator[np.ndarray]:
    for path in paths:
        layers, metadata = exr.read_layers(path)
        channels = (
            dict(zip("RGB", np.moveaxis(layers[""], 2, 0), strict=True))
            if "" in layers
            else layers
        )
        yield to_srgb(path, Frame(channels, metadata))
