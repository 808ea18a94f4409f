"""A recorded video as a car's camera."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from mi_nerfattack.car.camera.preparation import AbstractPreparation, check_size
from mi_nerfattack.car.devices import AbstractCamera, Clock, DeviceLostError, Frame
from mi_nerfattack.errors import InputError
from mi_nerfattack.io import files
from mi_nerfattack.io.video import MAX_VIDEO_BYTES, decode_video, rgb_of


class VideoCamera(AbstractCamera):
    """A video that plays from the moment it is made, at its own times.

    Frames are decoded up to the newest when it is asked for; the others are counted.

    Args:
        path: any container and codec that PyAV decodes.
        prepare: what makes the camera's frames of the video's.
        clock: of the frames' times.
        is_looped: whether it starts again after its end.

    Raises:
        InputError: it cannot be read, or has frames of another size.
    """

    def __init__(
        self,
        path: Path,
        prepare: AbstractPreparation,
        clock: Clock = time.monotonic,
        is_looped: bool = False,
    ) -> None:
        self.camera = prepare.camera
        self._path, self._prepare, self._clock = path, prepare, clock
        self._raw, self._is_looped = files.read_bytes(path, MAX_VIDEO_BYTES), is_looped
        self._frame: Frame | None = None
        self._step_s, self._is_closed = 0.0, False
        self._frames = self._play()
        self._due = next(self._frames, None)
        if self._due is None:
            raise InputError(f"{path}: no frames; truncated: copy it again")
        check_size(str(path), self._due[1].width, self._due[1].height, prepare=prepare)
        self._start_s = clock()

    def newest(self) -> Frame | None:
        """Return the newest frame.

        Raises:
            DeviceLostError: the video is over.
            InputError: it is damaged, or its size changes.
        """
        if self._is_closed:
            raise DeviceLostError(f"{self._path}: it is closed")
        now, shown = self._clock() - self._start_s, None
        index = -1 if self._frame is None else self._frame.index
        while self._due is not None and self._due[0] <= now:
            shown, index = self._due, index + 1
            self._due = next(self._frames, None)
        if shown is not None:
            time_s, frame = shown
            check_size(
                str(self._path), frame.width, frame.height, prepare=self._prepare
            )
            image = self._prepare.apply(rgb_of(self._path, frame))
            self._frame = Frame(image, self._start_s + time_s, index)
        elif self._due is None and self._frame is not None:
            if self._clock() >= self._frame.time_s + self._step_s:
                raise DeviceLostError(f"{self._path}: the video is over")
        return self._frame

    def close(self) -> None:
        """Stop decoding."""
        self._is_closed = True
        self._frames, self._due = iter(()), None

    def _play(self) -> Iterator[tuple[float, Any]]:
        """Yield when frames are due, seconds from the first one, and PyAV's frames."""
        start = 0.0
        while True:
            first, due = None, start
            for frame, _ in decode_video(self._path, self._raw):
                if frame.time is None:
                    raise InputError(f"{self._path}: its frames have no times")
                first = frame.time if first is None else first
                before, due = due, start + frame.time - first
                self._step_s = due - before or self._step_s
                yield due, frame
            if first is None or not self._is_looped:
                return
            start = due + self._step_s
