"""``mi-nerfattack drive`` in the simulated room."""

from __future__ import annotations

import pytest

from mi_nerfattack.cli import main
from mi_nerfattack.deploy.replay.environment import open_recording
from mi_nerfattack.render.camera.intrinsics import CameraMount

SIMULATED = ["drive", "--policy", "expert", "--simulated", "--spp", "1"]


def test_a_drive_is_stated_driven_and_summed_up(tmp_path, variant, capsys):
    log = tmp_path / "drive.mcap"
    assert main([*SIMULATED, "--duration-s", "2", "--log", str(log)]) == 0
    told = capsys.readouterr().out
    assert told.index("Fence ") < told.index("Armed.") < told.index("time is up: 2 s")
    assert "cross-track error: largest 0.0" in told and "20 commands" in told
    recording = open_recording(log, None, CameraMount())
    assert len(recording.track.times) == 20 and recording.image(0).max() > 50
    assert main([*SIMULATED, "--log", str(log)]) == 2  # never written over
    assert f"{log}: exists; choose another name" in capsys.readouterr().err
    assert main([*SIMULATED, "--check"]) == 0
    told = capsys.readouterr().out
    assert "camera     ready" in told and "Armed" not in told


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ([], "--policy: none; give a file, expert, or remote:HOST:PORT"),
        (["--policy", "gone.safetensors"], "gone.safetensors"),
        (
            ["--policy", "remote:127.0.0.1:7447", "--simulated"],
            "--simulated: its time is not that of another computer",
        ),
        (["--policy", "expert"], "--tracker: none; give vicon:ADDRESS"),
        (
            [
                "--policy",
                "expert",
                "--camera",
                "webcam",
                "--tracker",
                "vicon:127.0.0.1",
            ],
            "camera 'webcam': must be zed:",
        ),
        (["--policy", "expert", "--speed-ms", "nan"], "drive.speed_ms"),
    ],
)
def test_what_cannot_be_driven(options, message, variant, capsys):
    assert main(["drive", *options]) == 2
    assert message in capsys.readouterr().err
