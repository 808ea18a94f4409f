"""Recorded drives as videos with a pose file."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from mi_nerfattack.capture.pose_files import SUFFIXES, PoseTable, read_poses
from mi_nerfattack.deploy.replay.folder import required_camera
from mi_nerfattack.deploy.replay.recording import (
    AbstractRecording,
    Track,
    check_times,
    checked_image,
    no_depth,
    poses_of_frames,
)
from mi_nerfattack.errors import InputError
from mi_nerfattack.io import files
from mi_nerfattack.io.video import (
    MAX_VIDEO_BYTES,
    damaged_video,
    decode_video,
    ffmpeg_error,
    open_video,
    rgb_of,
    video_stream,
)
from mi_nerfattack.render.camera.intrinsics import Camera, CameraMount


class VideoRecording(AbstractRecording):
    """A video and its pose file of the same name (`drive.mp4` and `drive.csv`).

    Both files are in one folder. A file of poses without times has one pose for each
    frame, in the order of the frames. Poses with times are interpolated, and every
    frame needs a pose within 0.1 s. Frames are decoded when the caller asks for them;
    an earlier frame than the last is decoded from the start of the video.

    Args:
        path: any container and codec that PyAV decodes.
        camera: intrinsics, for pose files without.
        mount: of the camera, for poses of the vehicle.
    """

    def __init__(self, path: Path, camera: Camera | None, mount: CameraMount) -> None:
        self._path = path
        self._raw = files.read_bytes(path, MAX_VIDEO_BYTES)
        source = _pose_file(path)
        width, height, times = self._scan()
        table = read_poses(source, mount, (height, width, 3))
        self.camera = required_camera(source, table.camera, camera)
        if (width, height) != (self.camera.width, self.camera.height):
            raise InputError(
                f"{path}: {width} x {height} px; the camera has {self.camera.width} x "
                f"{self.camera.height} px"
            )
        self.track = Track(str(path), times, _assign(path, table, times))
        self._frames: Iterator[Any] = iter(())
        self._at = len(times)  # the frame shown: beyond the end, so that it starts anew
        self._shown = np.zeros((0, 0, 3), np.uint8)

    def image(self, index: int) -> np.ndarray:
        """Decode up to one frame."""
        if index < self._at:
            self._frames, self._at = decode_video(self._path, self._raw), -1
        while self._at < index:
            frame, _ = next(self._frames, (None, 0))
            if frame is None:
                raise InputError(
                    f"{self._path}: ends at frame {self._at + 1} of "
                    f"{len(self.track.times)}; truncated: copy it again"
                )
            self._at += 1
            if self._at == index:
                self._shown = rgb_of(self._path, frame)
        where = f"{self._path}: frame {index}"
        return checked_image(where, self._shown, self.camera)

    def depth(self, index: int) -> np.ndarray:
        """Return infinite depth: a video has none."""
        return no_depth(self.camera)

    def close(self) -> None:
        """Stop decoding."""
        self._frames, self._at = iter(()), len(self.track.times)

    def _scan(self) -> tuple[int, int, np.ndarray]:
        """Return width and height in pixels, and the times of all frames, seconds."""
        FFmpegError = ffmpeg_error()
        try:
            with open_video(self._raw) as container:
                stream = video_stream(self._path, container)
                width, height = stream.codec_context.width, stream.codec_context.height
                # what a cut keeps before its first frame is decoded, but not shown
                packets = [(p.pts, p.is_discard) for p in container.demux(stream)]
                announced, base = stream.frames, stream.time_base
        except FFmpegError as error:
            raise damaged_video(self._path, error) from error
        stamped = [(stamp, hidden) for stamp, hidden in packets if stamp is not None]
        stamps = [stamp for stamp, hidden in stamped if not hidden]
        if not stamps or base is None or announced > len(stamped):
            raise InputError(
                f"{self._path}: {len(stamped)} of {announced} frames are there; "
                "truncated: copy it again"
            )
        times = np.sort(np.array([float(stamp * base) for stamp in stamps]))
        check_times(str(self._path), times)
        return width, height, times


def _pose_file(path: Path) -> Path:
    candidates = [path.with_suffix(suffix) for suffix in SUFFIXES]
    with files.reported(path):
        paths = [item for item in candidates if item.is_file()]
    if not paths:
        names = ", ".join(item.name for item in candidates)
        raise InputError(f"{path}: no pose file beside it; add one of {names}")
    return paths[0]


def _assign(path: Path, table: PoseTable, times: np.ndarray) -> np.ndarray:
    """Return the pose (n, 4, 4) of each frame."""
    poses = table.camera_to_world
    if table.times is None:
        if len(poses) != len(times):
            raise InputError(
                f"{table.where}: {len(poses)} poses, but {path} has {len(times)} "
                "frames; give one for each, or times"
            )
        return poses
    return poses_of_frames(
        str(path), str(table.where), times, pose_times=table.times, matrices=poses
    )
