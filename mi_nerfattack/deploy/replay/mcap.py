"""Recorded drives as MCAP logs of ROS 2 messages in CDR.

===========================================  ==========================================
message                                      what is read
===========================================  ==========================================
`sensor_msgs/msg/CompressedImage`            stamp, `data` (JPEG, PNG or WebP)
or `sensor_msgs/msg/Image`                   stamp, `data` in rgb8, bgr8 or mono8
`geometry_msgs/msg/PoseStamped`,             stamp, pose of the camera (OpenCV axes) or
`geometry_msgs/msg/PoseWithCovarianceStamped`  of the vehicle (x forward, y left, z up),
or `nav_msgs/msg/Odometry`                   to the world, metres
`sensor_msgs/msg/CameraInfo`                 width, height, k, d; may be missing
===========================================  ==========================================

The pose of a frame is interpolated in time. There is no depth. A log that is cut off,
as by a process that was killed, is read up to there; frames before the first pose and
after the last are left out.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from mi_nerfattack.capture.pose_files import pose_matrix
from mi_nerfattack.deploy.replay.folder import required_camera
from mi_nerfattack.deploy.replay.recording import (
    AbstractRecording,
    Track,
    check_times,
    checked_image,
    no_depth,
    poses_of_frames,
)
from mi_nerfattack.deploy.replay.ros2 import Topic, read_topics
from mi_nerfattack.errors import InputError
from mi_nerfattack.io import files
from mi_nerfattack.render.camera.intrinsics import Camera, CameraMount, camera_to_body
from mi_nerfattack.render.camera.pose import poses_at

_IMAGES = ("sensor_msgs/msg/CompressedImage", "sensor_msgs/msg/Image")
_POSES = (
    "geometry_msgs/msg/PoseStamped",
    "geometry_msgs/msg/PoseWithCovarianceStamped",
    "nav_msgs/msg/Odometry",
)
_INFOS = ("sensor_msgs/msg/CameraInfo",)
_CHANNELS = {"rgb8": 3, "bgr8": 3, "mono8": 1}


@dataclass(frozen=True)
class McapTopics:
    """Names of the topics of a log.

    Unnamed ones have the names in `_NAMES`, or are the only ones of their message.

    Args:
        image: of the frames.
        camera_pose: comes first where a log has both.
        vehicle_pose: combined with the camera's mount.
        calibration: of the camera.
    """

    image: str | None = None
    camera_pose: str | None = None
    vehicle_pose: str | None = None
    calibration: str | None = None

    @classmethod
    def parse(cls, texts: Sequence[str]) -> McapTopics:
        """Read "NAME=/topic" texts, where NAME is one of the arguments.

        Raises:
            InputError: another text, or one name twice.
        """
        pairs = [text.partition("=") for text in texts]
        known = [item.name for item in fields(cls)]
        names = [name for name, _, topic in pairs if name in known and topic]
        if len(names) < len(texts) or len(set(names)) < len(names):
            raise InputError(
                f"--topics: {' '.join(texts)}; NAME=/topic, NAME one of "
                f"{', '.join(known)}, each once"
            )
        return cls(**{name: topic for name, _, topic in pairs})


_NAMES = McapTopics(
    "/camera/image", "/camera/pose", "/vehicle/pose", calibration="/camera/camera_info"
)


class McapRecording(AbstractRecording):
    """An MCAP log; the images stay compressed until they are asked for.

    Args:
        path: of at most 4 GiB.
        camera: intrinsics, for logs without.
        mount: of the camera, for poses of the vehicle.
        topics: names.
    """

    def __init__(
        self,
        path: Path,
        camera: Camera | None,
        mount: CameraMount,
        topics: McapTopics | None = None,
    ) -> None:
        topics = topics or McapTopics()
        log_topics, self.remarks = read_topics(path)
        images = _choose(path, log_topics, topics, role="image", kinds=_IMAGES)
        if images is None:
            cut = "".join(f" ({remark})" for remark in self.remarks)
            raise InputError(
                f"{path}: no {' or '.join(_IMAGES)}, so no frame{cut}"
                f"{_others(log_topics)}"
            )
        self._path, self._images = path, images.decode()
        times = _stamps(images.where, self._images)
        where, pose_times, poses = _camera_poses(path, log_topics, topics, mount=mount)
        frames = _with_poses(times, pose_times, poses)
        if len(times[frames]) != len(times):
            self.remarks += (
                f"frames {frames.start} to {frames.stop - 1} of {len(times)} are read; "
                f"before and after them there are no poses on {where}",
            )
        times, self._images = times[frames], self._images[frames]
        frame_poses = poses_of_frames(
            str(path), where, times, pose_times=pose_times, matrices=poses
        )
        self.track = Track(str(path), times, frame_poses)
        own = _calibration(
            _choose(path, log_topics, topics, role="calibration", kinds=_INFOS)
        )
        self.camera = required_camera(path, own, camera)

    def image(self, index: int) -> np.ndarray:
        """Decode one image."""
        where = f"{self._path}: frame {index}"
        message = self._images[index]
        if hasattr(message, "format"):
            image = files.decode_image(where, bytes(message.data))
        else:
            image = _raw_image(where, message)
        return checked_image(where, image, self.camera)

    def depth(self, index: int) -> np.ndarray:
        """Return infinite depth: a log has none."""
        return no_depth(self.camera)


def read_vehicle_poses(
    path: Path, mount: CameraMount, topics: McapTopics | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Read all poses of a log's vehicle, those between frames too.

    Args:
        path: of at most 4 GiB.
        mount: of the camera, for logs of its poses.
        topics: names.

    Returns:
        times (n,), seconds, and body to world (n, 4, 4): x forward, y left, z up,
        metres.

    Raises:
        InputError: it cannot be read, or has no poses.
    """
    log_topics, _ = read_topics(path)
    _, times, poses = _camera_poses(
        path, log_topics, topics or McapTopics(), mount=mount
    )
    return times, poses @ np.linalg.inv(camera_to_body(mount))


def _choose(
    path: Path,
    log_topics: Mapping[str, Topic],
    topics: McapTopics,
    role: str,
    kinds: Sequence[str],
) -> Topic | None:
    """Return the topic of a role: as named, as we name it, or the only one."""
    named = getattr(topics, role)
    fitting = [topic for topic in log_topics.values() if topic.kind in kinds]
    if named is not None:
        (chosen,) = [topic for topic in fitting if topic.name == named] or [None]
        if chosen is None:
            raise InputError(
                f"{path}: no {' or '.join(kinds)} on {named}{_others(log_topics)}"
            )
        return chosen
    usual = getattr(_NAMES, role)
    if usual in log_topics and log_topics[usual] in fitting:
        return log_topics[usual]
    if len(fitting) > 1:
        names = ", ".join(topic.name for topic in fitting)
        raise InputError(
            f"{path}: {names} have such messages; name one: --topics {role}=TOPIC"
        )
    return fitting[0] if fitting else None


def _others(log_topics: Mapping[str, Topic]) -> str:
    listing = ", ".join(f"{topic.name} ({topic.kind})" for topic in log_topics.values())
    return f"; it has {listing}" if listing else ""


def _camera_poses(
    path: Path, log_topics: Mapping[str, Topic], topics: McapTopics, mount: CameraMount
) -> tuple[str, np.ndarray, np.ndarray]:
    """Return the topic, times (n,) and poses (n, 4, 4) of the camera, OpenCV axes."""
    of_camera, chosen = np.eye(4), None
    known = topics.vehicle_pose is None and _NAMES.camera_pose in log_topics
    if topics.camera_pose is not None or known:
        chosen = _choose(path, log_topics, topics, role="camera_pose", kinds=_POSES)
    if chosen is None:
        of_camera = camera_to_body(mount)
        chosen = _choose(path, log_topics, topics, role="vehicle_pose", kinds=_POSES)
    if chosen is None:
        raise InputError(
            f"{path}: no {', '.join(_POSES)}; record the poses, too"
            f"{_others(log_topics)}"
        )
    messages = chosen.decode()
    poses = np.stack([_pose(chosen.where, item) for item in messages]) @ of_camera
    return chosen.name, _stamps(chosen.where, messages), poses


def _with_poses(times: np.ndarray, pose_times: np.ndarray, poses: np.ndarray) -> slice:
    """Return the frames from the first that has a pose to the last."""
    known = np.flatnonzero(poses_at(pose_times, poses, times)[1])
    return slice(int(known[0]), int(known[-1]) + 1) if len(known) else slice(None)


def _stamps(where: str, messages: Sequence[Any]) -> np.ndarray:
    stamps = [message.header.stamp for message in messages]
    # seconds since 1970 leave 0.2 microseconds of a float64
    seconds = np.array([stamp.sec + 1e-9 * stamp.nanosec for stamp in stamps])
    check_times(where, seconds)
    return seconds


def _raw_image(where: str, message: Any) -> np.ndarray:
    """Return (height, width, 3) of a `sensor_msgs/msg/Image`."""
    channels = _CHANNELS.get(message.encoding)
    if channels is None:
        raise InputError(
            f"{where}: encoding {message.encoding!r}; only {', '.join(_CHANNELS)} "
            "are read"
        )
    height, width, step = message.height, message.width, message.step
    data = np.frombuffer(bytes(message.data), np.uint8)
    if step < channels * width or len(data) != height * step:
        raise InputError(
            f"{where}: {len(data)} bytes; {width} x {height} px in rows of {step}"
        )
    rows = data.reshape(height, step)[:, : channels * width]
    image = rows.reshape(height, width, channels)
    image = image[..., ::-1] if message.encoding == "bgr8" else image
    return np.repeat(image, 3 // channels, axis=2)


def _pose(where: str, message: Any) -> np.ndarray:
    pose = message.pose
    pose = getattr(pose, "pose", pose)  # with a covariance
    position = [getattr(pose.position, key) for key in "xyz"]
    turn = [getattr(pose.orientation, key) for key in "wxyz"]
    return pose_matrix(where, position, turn)


def _calibration(topic: Topic | None) -> Camera | None:
    """Return the camera of the last calibration; None if there is none."""
    if topic is None:
        return None
    message = replace(topic, raw=topic.raw[-1:]).decode()[0]
    k, d = np.reshape(message.k, (3, 3)), [*message.d, 0.0, 0.0, 0.0, 0.0]
    is_fisheye = message.distortion_model == "equidistant"
    known = is_fisheye or message.distortion_model in ("plumb_bob", "")
    if not known or any(d[4:]):
        raise InputError(
            f"{topic.where}: distortion_model {message.distortion_model!r}, d "
            f"{d[:-4]}; only plumb_bob with k1, k2, p1, p2 and equidistant are read"
        )
    try:
        names = ("k1", "k2", "k3", "k4") if is_fisheye else ("k1", "k2", "p1", "p2")
        return Camera(
            width=message.width,
            height=message.height,
            fx=float(k[0, 0]),
            fy=float(k[1, 1]),
            # counted from the centre of the first pixel there, from its corner here
            cx=float(k[0, 2] + 0.5),
            cy=float(k[1, 2] + 0.5),
            **dict(zip(names, d[:4], strict=True)),
            is_fisheye=is_fisheye,
        )
    except InputError as error:
        raise InputError(f"{topic.where}: {error}") from error
