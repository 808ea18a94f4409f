"""A camera that Linux shows as /dev/videoN, read by PyAV.

PyAV is here already, gives the kernel's times of the frames, and ends with an error
where the device goes away; OpenCV's VideoCapture gives neither times nor reasons.
"""

from __future__ import annotations

import errno
import threading
import time
from typing import Any

from mi_nerfattack.car.camera.preparation import AbstractPreparation, check_size
from mi_nerfattack.car.devices import AbstractCamera, Clock, DeviceLostError, Frame
from mi_nerfattack.errors import InputError
from mi_nerfattack.extras import load_extra
from mi_nerfattack.io.video import ffmpeg_error

DRIVER = "v4l2"
_FIRST_S, _SILENT_S = 5.0, 1.0  # longest waits for the first frame, and for another
_KERNEL_S = 60.0  # oldest age of the first frame's time that is taken for this clock's
_REMEDIES = {
    errno.ENOENT: "plug it in; ls /dev/video*",
    errno.EACCES: "add this user to the group video, and log in again",
    errno.EBUSY: "another program uses it",
    errno.EINVAL: "it has no such mode: v4l2-ctl --list-formats-ext -d DEVICE",
}


class V4lCamera(AbstractCamera):
    """A camera, read by a thread that keeps the newest frame alone.

    A frame's time is the kernel's where that is by this computer's monotonic clock, as
    of UVC cameras, else when it came; the first frame decides, until one comes from the
    future. Frames are prepared when they are asked for, so that the thread keeps up
    with the device.

    Args:
        device: such as /dev/video0.
        prepare: what makes the camera's frames of the device's.
        fps: frames per second to ask for.
        clock: of the frames' times.
        driver: FFmpeg's input device.

    Raises:
        InputError: it cannot be opened, or gives frames of another size than
            `prepare.source_px`, which it was asked for.
    """

    def __init__(
        self,
        device: str,
        prepare: AbstractPreparation,
        fps: int = 30,
        clock: Clock = time.monotonic,
        driver: str = DRIVER,
    ) -> None:
        self.camera = prepare.camera
        self._device, self._prepare, self._clock = device, prepare, clock
        self._frame: Frame | None = None
        self._lock = threading.Lock()
        self._unprepared: tuple[Any, float, int] | None = None
        self._error, self._is_closed = "", threading.Event()
        self._container = _opened(device, prepare, fps, driver=driver)
        self._heard_s, self._longest_s = time.monotonic(), _FIRST_S
        self._thread = threading.Thread(target=self._read, name="camera", daemon=True)
        self._thread.start()

    def newest(self) -> Frame | None:
        """Return the newest frame."""
        silent_s = time.monotonic() - self._heard_s
        if not self._error and silent_s > self._longest_s:
            raise DeviceLostError(
                f"{self._device}: no image for {silent_s:.1f} s; is it plugged in?"
            )
        if self._error:
            raise DeviceLostError(f"{self._device}: {self._error}")
        with self._lock:
            if self._unprepared is not None:
                frame, time_s, index = self._unprepared
                self._unprepared = None
                image = self._prepare.apply(frame.to_ndarray(format="rgb24"))
                self._frame = Frame(image, time_s, index)
            return self._frame

    def close(self) -> None:
        """Stop reading; a thread that the device holds ends with the process."""
        self._error = self._error or "it is closed"
        self._is_closed.set()
        self._thread.join(_SILENT_S)

    def _read(self) -> None:
        FFmpegError = ffmpeg_error()
        try:
            is_kernels = None
            for index, frame in enumerate(self._decoded()):
                if self._is_closed.is_set():
                    break
                now, came_s = time.monotonic(), self._clock()
                age_s = now - frame.time if frame.time is not None else -1.0
                if is_kernels is None:
                    is_kernels = age_s < _KERNEL_S
                is_kernels = is_kernels and age_s >= 0
                age_s = age_s if is_kernels else 0.0
                check_size(
                    self._device, frame.width, frame.height, prepare=self._prepare
                )
                with self._lock:
                    self._unprepared = frame, came_s - age_s, index
                self._heard_s, self._longest_s = now, _SILENT_S
            self._error = self._error or "it gives no more images"
        except (FFmpegError, InputError) as error:
            self._error = self._error or f"reading failed ({error}); is it plugged in?"
        finally:
            self._error = self._error or "reading failed"
            with self._lock:  # it may lie in the device's memory
                self._unprepared = None
            self._container.close()

    def _decoded(self) -> Any:
        """Yield the device's frames but for those that came damaged."""
        InvalidDataError = load_extra("av.error", "a camera").InvalidDataError
        for packet in self._container.demux(video=0):
            try:
                yield from packet.decode()
            except InvalidDataError:  # one of compressed ones, as over a bad cable
                continue


def _opened(device: str, prepare: AbstractPreparation, fps: int, driver: str) -> Any:
    av = load_extra("av", "a camera")
    FFmpegError = ffmpeg_error()
    width, height = prepare.source_px
    asked = {"video_size": f"{width}x{height}", "framerate": str(fps)}
    options = asked if driver == DRIVER else {}
    try:
        container = av.open(device, format=driver, options=options)
    except FFmpegError as error:
        remedy = _REMEDIES.get(
            error.errno or 0, "v4l2-ctl --list-devices shows cameras"
        )
        raise InputError(
            f"{device}: cannot be opened at {width} x {height} px, {fps} frames a "
            f"second ({error.strerror}); {remedy}"
        ) from error
    except ValueError as error:
        raise InputError(
            f"{device}: PyAV has no driver {driver!r} here ({error}); it takes Linux"
        ) from error
    try:
        stream = container.streams.video[0]
        check_size(device, stream.width, stream.height, prepare=prepare)
    except (InputError, IndexError) as error:
        container.close()
        if isinstance(error, IndexError):
            raise InputError(f"{device}: gives no pictures; is it a camera?") from error
        raise
    return container
