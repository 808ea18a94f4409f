"""Recorded poses by a clock, and words that name trackers."""

from __future__ import annotations

import numpy as np
import pytest
from support.files.recordings import (
    MOUNT,
    STATES,
    log_messages,
    pose_message,
    write_log,
)

from mi_nerfattack.car.devices import DeviceLostError
from mi_nerfattack.car.tracker.open import open_tracker
from mi_nerfattack.car.tracker.vicon import ViconTracker
from mi_nerfattack.errors import InputError
from mi_nerfattack.render.camera.intrinsics import mount_matrix


def test_recorded_poses_come_at_their_times(tmp_path):
    path, now = tmp_path / "drive.csv", [20.0]
    rows = [f"{1000 + 0.02 * k},{0.1 * k},-1,0.5" for k in range(5)]
    path.write_text("\n".join(["time_s,x_m,y_m,heading_rad", *rows]))
    tracker = open_tracker(f"replay:{path}", MOUNT, clock=lambda: now[0])
    for after_s, index in ((0.0, 0), (0.019, 0), (0.021, 1), (0.079, 3), (0.099, 4)):
        now[0] = 20.0 + after_s
        pose = tracker.newest("any")
        assert pose is not None and pose.index == index
        assert pose.time_s == pytest.approx(20 + 0.02 * index)
        expected = body(0.1 * index, -1, 0.5)
        assert pose.body_to_world == pytest.approx(expected, abs=1e-12)
    now[0] = 20.11
    with pytest.raises(DeviceLostError, match="drive.csv: the recording is over"):
        tracker.newest("any")
    now[0] = 20.0
    tracker.close()
    with pytest.raises(DeviceLostError, match="closed"):
        tracker.newest("any")


def body(x: float, y: float, heading: float) -> np.ndarray:
    cosine, sine = np.cos(heading), np.sin(heading)
    rows = [[cosine, -sine, 0, x], [sine, cosine, 0, y], [0, 0, 1, 0], [0, 0, 0, 1]]
    return np.array(rows)


@pytest.mark.parametrize("topic", ["/camera/pose", "/vehicle/pose"])
def test_a_log_gives_all_of_its_poses(tmp_path, topic):
    messages = log_messages(tmp_path)
    schema, of_frames = messages.pop("/camera/pose")
    states = np.linspace(STATES[0], STATES[-1], 26)  # at 50 Hz, of frames at 10 Hz
    matrices = mount_matrix(states, MOUNT)
    if topic == "/vehicle/pose":
        matrices = np.stack([body(*state) for state in states])
    start = of_frames[0]["header"]["stamp"]["sec"]
    poses = [pose_message(start + 0.02 * k, pose) for k, pose in enumerate(matrices)]
    write_log(tmp_path / "drive.mcap", {**messages, topic: (schema, poses)})
    now = [7.0]
    words = f"replay:{tmp_path / 'drive.mcap'}"
    tracker = open_tracker(words, MOUNT, clock=lambda: now[0])
    for index, state in enumerate(states):
        now[0] = 7.01 + 0.02 * index
        pose = tracker.newest("car")
        assert pose is not None and pose.index == index
        assert pose.time_s == pytest.approx(7 + 0.02 * index, abs=1e-6)
        assert pose.body_to_world == pytest.approx(body(*state), abs=1e-9)


def test_vicon_is_opened_where_it_is_told():
    tracker = open_tracker("vicon:127.0.0.1:0", MOUNT)
    assert isinstance(tracker, ViconTracker) and tracker.address[0] == "127.0.0.1"
    tracker.close()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "must be vicon:HOST"),
        ("vicon", "must be vicon:HOST or"),
        ("vicon::51001", "must be vicon:HOST or"),
        ("vicon:0.0.0.0:port", "must be vicon:HOST or"),
        ("vicon:127.0.0.1:70000", "port 70000"),
        ("motioncapture:vicon", "must be motioncapture:KIND:HOST; kinds are vicon, "),
        ("replay:", "must be vicon:HOST"),
        ("replay:drive.mp4", "drive.mp4: not a pose file"),
        ("replay:timeless.csv", "no times; add a column time_s"),
        ("replay:poseless.mcap", "no geometry_msgs/msg/PoseStamped, .*record the po"),
        ("gps:0", "must be vicon:HOST"),
    ],
)
def test_other_words_are_refused(tmp_path, monkeypatch, text, message):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "timeless.csv").write_text("x_m,y_m,heading_rad\n0,0,0\n")
    topics = log_messages(tmp_path)
    del topics["/camera/pose"]
    write_log(tmp_path / "poseless.mcap", topics)
    with pytest.raises(InputError, match=message):
        open_tracker(text, MOUNT)
