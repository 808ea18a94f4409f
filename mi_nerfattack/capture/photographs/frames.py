"""Frames of a video to reconstruct from: sharp ones, between which the camera moved."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy import fft, ndimage

from mi_nerfattack.capture.colmap.follow import StageCallback
from mi_nerfattack.capture.colmap.process import LEAST_IMAGES
from mi_nerfattack.errors import InputError
from mi_nerfattack.io import files
from mi_nerfattack.io.video import MAX_VIDEO_BYTES, decode_video, rgb_of
from mi_nerfattack.ranges import Count, Positive, checked

_SMALL_PX = 256  # longer edge at which sharpness and motion are measured
_TILES = 4  # each way
_SLACK = 0.4  # a frame may lie that much before or after its place, in baselines
_RENEWED = 0.02  # shift to the reference frame from which on another is taken
_RATIO = 1.15  # by which a baseline grows or shrinks until the frames are few or many
_FEW, _FINEST = 20, 0.2  # frames below which it shrinks, and to which share of it
_WINDOW = 32  # frames that are first looked at for the next one
_MOVING = 75.0  # percentile of tiles: around a thing, the picture's middle stands still


@dataclass(frozen=True)
@checked()
class FrameOptions:
    """Which frames of a video are taken.

    Attributes:
        frames: largest number of frames.
        baseline: how far the picture moves between two frames, as a share of its
            longer edge; a quarter of the picture moves at least so far. The program
            takes a larger baseline if there would be too many frames. It takes a
            smaller one, down to a fifth, if there would be fewer than 20.
    """

    frames: Count = 150
    baseline: Positive = 0.05


@dataclass(frozen=True, eq=False)
class Motion:
    """What a video's frames are chosen by.

    Attributes:
        sharpness: (n,), of each frame; see `measure_sharpness`.
        place: (n, tiles, 2), how far the tiles have moved since the first frame, in
            shares of the longer edge.
    """

    sharpness: np.ndarray
    place: np.ndarray


def measure_sharpness(grey: np.ndarray) -> float:
    """Return the variance of the Laplacian of a grey image (h, w), 0 to 255."""
    return float(ndimage.laplace(np.asarray(grey, np.float32)).var())


def choose_frames(motion: Motion, options: FrameOptions) -> list[int]:
    """Choose frames of a video: a standing camera gives few, a fast one many.

    From one to the next the picture has moved by about the baseline; of the frames
    near that place, the sharpest is taken. Steps back and forth, as of a hand that
    shakes, cancel.

    Returns:
        indices, increasing.
    """
    baseline = options.baseline
    indices = _spaced(motion, baseline)
    while len(indices) > options.frames:
        baseline *= _RATIO
        indices = _spaced(motion, baseline)
    few, finest = min(_FEW, options.frames), _FINEST * options.baseline
    while len(indices) < few and baseline > finest:
        baseline /= _RATIO
        finer = _spaced(motion, baseline)
        if len(finer) > options.frames:
            break
        indices = finer
    return indices


def _spaced(motion: Motion, baseline: float) -> list[int]:
    indices: list[int] = []
    start = 0
    while True:  # each of them is later, as its place is not the last one's
        near = 1 - _SLACK if indices else 0.0
        moved = _moved_from(motion, start, baseline, limit=near + 2 * _SLACK)
        is_beyond = moved[-1] > near + 2 * _SLACK
        if indices and not is_beyond:
            return indices
        first = int(np.flatnonzero(moved >= near)[0])
        end = len(moved) - 1 if is_beyond else len(moved)
        window = np.arange(first, max(end, first + 1))
        start += int(window[motion.sharpness[start + window].argmax()])
        indices.append(start)


def _moved_from(
    motion: Motion, start: int, baseline: float, limit: float
) -> np.ndarray:
    """Return how many baselines the frames from one on are away from it.

    Up to the first beyond a limit, or to the film's end; looked for in windows that
    grow, so that short baselines in a long film do not each cost the whole of it.
    """
    distances, at, length = [], start, _WINDOW
    while at < len(motion.place):
        away = np.linalg.norm(
            motion.place[at : at + length] - motion.place[start], axis=2
        )
        moved = np.percentile(away, _MOVING, axis=1) / baseline
        beyond = np.flatnonzero(moved > limit)
        if len(beyond):
            distances.append(moved[: beyond[0] + 1])
            break
        distances.append(moved)
        at, length = at + length, 2 * length
    return np.concatenate(distances)


def measure_motion(
    video: Path, raw: bytes, progress: StageCallback = lambda stage, done, total: None
) -> Motion:
    """Measure sharpness and motion of all frames of a video, reduced to 256 px.

    Raises:
        InputError: it cannot be read, or has fewer than 3 frames.
    """
    sharpness: list[float] = []
    places: list[np.ndarray] = []
    reference, at = np.zeros(0), np.zeros((_TILES**2, 2))
    for frame, announced in decode_video(video, raw):
        scale = min(1.0, _SMALL_PX / max(frame.width, frame.height))
        size = (max(1, round(scale * v)) for v in (frame.width, frame.height))
        width, height = size
        grey = frame.reformat(width, height, "gray").to_ndarray().astype(np.float32)
        sharpness.append(measure_sharpness(grey))
        spectra = _spectra(grey)
        if not places:
            reference = spectra
        # not to the frame before: slow motion is less than a pixel between two
        shift = _moved(reference, spectra) / max(width, height)
        places.append(at + shift)
        if np.median(np.linalg.norm(shift, axis=1)) > _RENEWED:
            reference, at = spectra, places[-1]
        total = max(announced, len(sharpness) + 1)
        progress("motion", len(sharpness), total)
    if len(sharpness) < LEAST_IMAGES:
        raise InputError(
            f"{video}: {len(sharpness)} frames; at least {LEAST_IMAGES} are needed: "
            "film for 10 seconds or more while walking around the place"
        )
    progress("motion", len(sharpness), len(sharpness))
    return Motion(np.array(sharpness), np.stack(places))


def _spectra(grey: np.ndarray) -> np.ndarray:
    """Return the spectra (tiles, h, w) of an image's tiles under a window."""
    h, w = (length // _TILES for length in grey.shape)
    tiles = grey[: h * _TILES, : w * _TILES].reshape(_TILES, h, _TILES, w)
    tiles = tiles.swapaxes(1, 2).reshape(-1, h, w)
    tiles = tiles - tiles.mean((1, 2), keepdims=True)
    return np.asarray(fft.fft2(tiles * np.outer(np.hanning(h), np.hanning(w))))


def _moved(before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """Return the shifts (tiles, 2) in pixels, rows first, by phase correlation."""
    product = after * before.conj()
    length = np.abs(product)
    # weak frequencies hold noise alone
    product /= length + 1e-3 * length.max((1, 2), keepdims=True) + 1e-9
    peak = np.real(np.asarray(fft.ifft2(product))).reshape(len(before), -1).argmax(1)
    shape = before.shape[1:]
    at = np.stack(np.unravel_index(peak, shape), axis=1)
    half = np.array(shape) / 2
    return np.where(at > half, at - np.array(shape), at).astype(float)


def extract_frames(
    video: str | Path,
    folder: Path,
    options: FrameOptions | None = None,
    progress: StageCallback = lambda stage, done, total: None,
) -> dict[str, float]:
    """Write chosen frames of a video as JPEG images, upright.

    Args:
        video: any container and codec that PyAV decodes.
        folder: that exists.
        options: None for the defaults.
        progress: called with stage, done and total.

    Returns:
        times of the frames, seconds from the video's start, by the names of the files,
        in the order of the video; NaN where the video has none.

    Raises:
        InputError: the video cannot be read, is too short, or its camera stands still.
    """
    path = Path(video)
    raw = files.read_bytes(path, MAX_VIDEO_BYTES)
    motion = measure_motion(path, raw, progress)
    chosen = choose_frames(motion, options or FrameOptions())
    if len(chosen) < LEAST_IMAGES:
        raise InputError(
            f"{path}: {len(motion.sharpness)} frames, but the camera moves so little "
            f"that {len(chosen)} differ by the baseline; walk around the place while "
            "filming, or choose a smaller one (--baseline)"
        )
    times: dict[str, float] = {}
    for frame in _pick(path, raw, chosen):
        name = f"frame_{chosen[len(times)]:06d}.jpg"
        times[name] = float("nan") if frame.time is None else frame.time
        files.write_image(folder / name, _upright(path, frame))
        progress("frames", len(times), len(chosen))
    return times


def _pick(path: Path, raw: bytes, chosen: Sequence[int]) -> Iterator[Any]:
    indices = set(chosen)
    for index, (frame, _) in enumerate(decode_video(path, raw)):
        if index in indices:
            yield frame
        if index >= chosen[-1]:
            return


def _upright(video: Path, frame: Any) -> np.ndarray:
    """Return the picture as it is shown: phones store it turned, and say so."""
    return np.rot90(rgb_of(video, frame), round(frame.rotation / 90) % 4)
