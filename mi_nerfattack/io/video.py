"""Videos: written as every player shows them, H.264 in MP4, and decoded."""

from __future__ import annotations

import io
from collections.abc import Iterable, Iterator
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np

from mi_nerfattack.errors import InputError, SetupError
from mi_nerfattack.extras import load_extra
from mi_nerfattack.io import files

CODEC = "libx264"
VIDEO_SUFFIXES = (".mp4", ".mkv", ".mov", ".avi", ".webm")
MAX_VIDEO_BYTES = 1 << 32
_OPTIONS = {"crf": "17", "preset": "medium"}
_PURPOSE = "a video"  # for messages
_BT709 = 1  # primaries and matrix of ITU-T H.273, equal to those of sRGB
_SRGB_CURVE = 13


def _av() -> Any:
    return load_extra("av", _PURPOSE)


def ffmpeg_error() -> Any:
    """Return PyAV's exception for whatever FFmpeg cannot do."""
    return load_extra("av.error", _PURPOSE).FFmpegError


def even_size(width: int, height: int) -> tuple[int, int]:
    """Return the next size that 4:2:0 subsampling can hold: both even."""
    return width + width % 2, height + height % 2


def write_video(
    path: str | Path, frames: Iterable[np.ndarray], fps: float
) -> tuple[int, int]:
    """Write an MP4 file atomically: H.264, yuv420p, BT.709, constant quality.

    Nothing is scaled. 4:2:0 subsampling needs even sizes: the last column or row of an
    odd size is repeated once.

    Args:
        path: the file; it appears when all frames are encoded.
        frames: (height, width, 3), uint8, sRGB, all of one size; at least one.
        fps: frames per second.

    Returns:
        Width and height of the video, pixels.

    Raises:
        InputError: no frames, frames of several sizes, or a file that cannot be
            written.
        SetupError: PyAV is not installed, or was built without H.264.
    """
    av = _av()
    if CODEC not in av.codecs_available:
        raise SetupError(f"PyAV {av.__version__} has no {CODEC}; install it from PyPI")
    buffer = io.BytesIO()
    shape: tuple[int, ...] | None = None
    container = av.open(buffer, "w", format="mp4")
    with container:
        stream: Any = None
        for frame in frames:
            if shape is None:
                shape = frame.shape
                stream = _add_stream(container, shape, fps)
            if frame.shape != shape:
                raise InputError(
                    f"{path}: frames of {frame.shape} and {shape}; all need one size"
                )
            container.mux(stream.encode(_to_yuv(frame)))
        if stream is None:
            raise InputError(f"{path}: no frames; give at least one")
        container.mux(stream.encode())
        size = stream.width, stream.height
    files.write_bytes(path, buffer.getvalue())
    return size


def _add_stream(container: Any, shape: tuple[int, ...], fps: float) -> Any:
    rate = Fraction(fps).limit_denominator(1001)
    stream = container.add_stream(CODEC, rate=rate, options=_OPTIONS)
    stream.width, stream.height = even_size(shape[1], shape[0])
    stream.pix_fmt = "yuv420p"
    context = stream.codec_context
    context.color_primaries = context.colorspace = _BT709
    context.color_trc = _SRGB_CURVE
    context.color_range = 1  # 16 to 235, as players expect
    return stream


def _to_yuv(image: np.ndarray) -> Any:
    VideoFrame = load_extra("av.video.frame", _PURPOSE).VideoFrame
    kinds = load_extra("av.video.reformatter", _PURPOSE)
    height, width = image.shape[:2]
    even = even_size(width, height)
    padding = ((0, even[1] - height), (0, even[0] - width), (0, 0))
    frame = VideoFrame.from_ndarray(np.pad(image, padding, "edge"), format="rgb24")
    return frame.reformat(
        format="yuv420p",
        dst_colorspace=kinds.Colorspace.ITU709,
        dst_color_range=kinds.ColorRange.MPEG,
    )


def check_fps(fps: float) -> None:
    """Raise InputError unless frames per second are in [0.1, 1000]."""
    if not 0.1 <= fps <= 1000:
        raise InputError(f"fps: {fps}; frames per second, from 0.1 to 1000")


def open_video(raw: bytes) -> Any:
    """Open the bytes of a video as PyAV's container."""
    return _av().open(io.BytesIO(raw), metadata_errors="replace")


def video_stream(path: Path, container: Any) -> Any:
    """Return a container's first stream of pictures.

    Raises:
        InputError: it has none, one of an unknown codec, or too large ones.
    """
    if not container.streams.video:
        raise InputError(f"{path}: has no pictures; truncated, or only sound")
    stream = container.streams.video[0]
    if stream.codec_context is None:
        raise InputError(f"{path}: a codec that PyAV does not know; use H.264")
    width, height = stream.codec_context.width, stream.codec_context.height
    if not 0 < width * height <= files.MAX_IMAGE_PIXELS:
        raise InputError(
            f"{path}: {width} x {height} px; at most {files.MAX_IMAGE_PIXELS} pixels "
            "are read"
        )
    return stream


def decode_video(path: Path, raw: bytes) -> Iterator[tuple[Any, int]]:
    """Yield the frames of a video.

    Args:
        path: of the video, for messages.
        raw: its bytes.

    Returns:
        PyAV's frames, each with the number of frames that the video announces; 0 where
        it does not tell.

    Raises:
        InputError: it is no video, or damaged.
    """
    FFmpegError = ffmpeg_error()
    try:
        with open_video(raw) as container:
            stream = video_stream(path, container)
            stream.codec_context.options = {"max_pixels": str(files.MAX_IMAGE_PIXELS)}
            for frame in container.decode(stream):
                yield frame, stream.frames
    except FFmpegError as error:
        raise damaged_video(path, error) from error


def rgb_of(path: Path, frame: Any) -> np.ndarray:
    """Return the picture (h, w, 3) uint8 of one of PyAV's frames.

    Raises:
        InputError: its pixels are of a kind that FFmpeg does not convert.
    """
    FFmpegError = ffmpeg_error()
    try:
        return frame.to_ndarray(format="rgb24")
    except FFmpegError as error:
        raise damaged_video(path, error) from error


def damaged_video(path: Path, error: Exception) -> InputError:
    """Return what is raised for a video that FFmpeg cannot read."""
    return InputError(f"{path}: damaged or truncated video ({error}); copy it again")
