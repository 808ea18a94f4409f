"""Cameras by the words of a command line."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path

from mi_nerfattack.car.camera.preparation import AbstractPreparation, AsTheyCome
from mi_nerfattack.car.camera.v4l import V4lCamera
from mi_nerfattack.car.camera.video import VideoCamera
from mi_nerfattack.car.camera.zed import LeftEye, read_left_eye
from mi_nerfattack.car.devices import AbstractCamera, Clock
from mi_nerfattack.errors import InputError
from mi_nerfattack.render.camera.intrinsics import Camera

FORMS = "zed:/dev/videoN, v4l:/dev/videoN, video:FILE"
SETTINGS = Path("/usr/local/zed/settings")


@dataclass(frozen=True)
class ZedOptions:
    """How a ZED is used.

    Args:
        calibration: `SN<serial>.conf`; None for the only one in `SETTINGS`.
        mode: of `zed.MODES`.
        size_px: width and height of frames, where no camera is asked for; None for half
            of the mode's.
        is_undistorted: whether lens distortion is taken out, where no camera is asked
            for.
    """

    calibration: Path | None = None
    mode: str = "VGA"
    size_px: tuple[int, int] | None = None
    is_undistorted: bool = True

    def build(self, camera: Camera | None = None) -> LeftEye:
        """Read the calibration.

        Args:
            camera: whose frames are made; None for one of the eye's own.

        Raises:
            InputError: it cannot be found or used.
        """
        eye = read_left_eye(self.calibration or _only_calibration(), self.mode)
        own = (
            eye.camera(self.size_px, self.is_undistorted) if camera is None else camera
        )
        return LeftEye(eye, own)


def open_camera(
    text: str,
    camera: Camera | None = None,
    zed: ZedOptions | None = None,
    fps: int = 30,
    is_looped: bool = False,
    clock: Clock = time.monotonic,
) -> AbstractCamera:
    """Open the camera that a word names.

    Args:
        text: one of `FORMS`.
        camera: intrinsics of `v4l` and `video`, whose frames must have its size; a
            ZED's are made into those of it, if it is given.
        zed: for `zed`, and for a `video` of both its eyes.
        fps: frames per second to ask a device for.
        is_looped: whether a video starts again after its end.
        clock: of the frames' times.

    Raises:
        InputError: it names none, or one that cannot be opened.
        SetupError: a package is not installed.
    """
    kind, _, source = text.partition(":")
    if kind not in ("zed", "v4l", "video") or not source:
        raise InputError(f"camera {text!r}: must be {FORMS}")
    prepare: AbstractPreparation
    if kind == "zed" or (kind == "video" and zed is not None):
        prepare = (zed or ZedOptions()).build(camera)
    elif camera is not None:
        prepare = AsTheyCome(camera)
    else:
        raise InputError(f"camera {text!r}: no intrinsics; give those of its frames")
    if kind == "video":
        return VideoCamera(Path(source), prepare, clock, is_looped=is_looped)
    return V4lCamera(source, prepare, fps, clock=clock)


def _only_calibration() -> Path:
    paths = sorted(SETTINGS.glob("SN*.conf"))
    if len(paths) != 1:
        names = ", ".join(path.name for path in paths) or "none"
        raise InputError(
            f"ZED: no calibration named; {SETTINGS} has {names}: name the file of the "
            "serial number, from http://calib.stereolabs.com/?SN=SERIAL"
        )
    return paths[0]
