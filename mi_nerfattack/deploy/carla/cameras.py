"""A pair of CARLA's cameras, colour and depth, read frame by frame."""

from __future__ import annotations

import queue
import time
from collections.abc import Mapping
from typing import Any

import numpy as np

from mi_nerfattack.deploy.carla.conventions import (
    CarlaPose,
    along_rays,
    camera_from_carla,
    camera_to_carla,
    decode_colour,
    decode_depth,
    field_of_view_deg,
    read_bgra,
)
from mi_nerfattack.deploy.carla.session import CarlaSession
from mi_nerfattack.deploy.environment import CameraFrame
from mi_nerfattack.errors import InputError
from mi_nerfattack.render.camera.intrinsics import Camera

COLOUR, DEPTH = "sensor.camera.rgb", "sensor.camera.depth"
#: Attributes of the colour camera that differ from CARLA's own: nothing may depend on
#: how fast the vehicle was.
COLOUR_ATTRIBUTES = {"motion_blur_intensity": "0.0"}


class CarlaCameras:
    """A colour and a depth camera in one place on an actor.

    Args:
        session: of the world.
        camera: intrinsics, without distortion, centred, with square pixels.
        parent: actor that they are fixed to.
        body_to_camera: (4, 4), camera to the parent's body, OpenCV axes, metres.
        attributes: of the colour camera, such as its exposure.
    """

    def __init__(
        self,
        session: CarlaSession,
        camera: Camera,
        parent: Any,
        body_to_camera: np.ndarray,
        attributes: Mapping[str, str],
    ) -> None:
        self.camera, self._timeout_s = camera, session.server.timeout_s
        shape = {
            "image_size_x": str(camera.width),
            "image_size_y": str(camera.height),
            "fov": repr(field_of_view_deg(camera)),
            "sensor_tick": "0.0",
        }
        pose = camera_to_carla(body_to_camera)
        colour = {**shape, **COLOUR_ATTRIBUTES, **attributes}
        self._colour = _Inbox(session.spawn(COLOUR, pose, colour, parent=parent))
        self._depth = _Inbox(session.spawn(DEPTH, pose, shape, parent=parent))

    def read(self, frame: int) -> CameraFrame:
        """Wait for both images of a frame.

        Args:
            frame: number that the tick returned.

        Raises:
            InputError: an image does not come within the time limit, or has another
                size.
        """
        deadline = time.monotonic() + self._timeout_s
        colour = self._colour.take(frame, deadline, self._timeout_s)
        depth = self._depth.take(frame, deadline, self._timeout_s)
        width, height = self.camera.width, self.camera.height
        planar = decode_depth(read_bgra(depth.raw_data, width, height))
        return CameraFrame(
            decode_colour(read_bgra(colour.raw_data, width, height)),
            along_rays(planar, self.camera),
            camera_from_carla(read_pose(colour.transform)),
        )


class _Inbox:
    """Images of one sensor, which its thread delivers."""

    def __init__(self, sensor: Any) -> None:
        self._images: queue.SimpleQueue[Any] = queue.SimpleQueue()
        self._kind = sensor.type_id
        sensor.listen(self._images.put)

    def take(self, frame: int, deadline: float, timeout_s: float) -> Any:
        """Wait for the image of a frame and drop older ones."""
        while True:
            remaining_s = max(deadline - time.monotonic(), 0.0)
            try:
                image = self._images.get(timeout=remaining_s)
            except queue.Empty:
                raise InputError(
                    f"{self._kind}: no image of frame {frame} within {timeout_s:g} s; "
                    "see whether the server renders (not -nullrhi, and "
                    "no_rendering_mode off), or wait longer (timeout_s)"
                ) from None
            if image.frame == frame:
                return image
            if image.frame > frame:
                raise InputError(
                    f"{self._kind}: frame {frame} is missing, {image.frame} came; "
                    "another client ticks this server: let only one do so"
                )


def read_pose(transform: Any) -> CarlaPose:
    """Copy a `carla.Transform`."""
    at, turn = transform.location, transform.rotation
    return CarlaPose(at.x, at.y, at.z, pitch=turn.pitch, yaw=turn.yaw, roll=turn.roll)
