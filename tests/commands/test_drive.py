"""``mi-nerfattack car drive`` in the simulated room."""

from __future__ import annotations

import json
import signal
from collections.abc import Callable
from contextlib import nullcontext

import numpy as np
import pytest
from helpers.boxes import COLOURS, made_box
from helpers.driving_stand_ins import (
    SETTINGS,
    Bench,
    StandInCamera,
    StandInEnable,
    StandInMotor,
    StandInPilot,
    StandInTracker,
)
from scipy.spatial.transform import Rotation

from mi_nerfattack.cli import main
from mi_nerfattack.commands.drive import _arm, _check, _drive
from mi_nerfattack.deploy.replay.environment import open_recording
from mi_nerfattack.errors import InputError
from mi_nerfattack.render.camera.intrinsics import CameraMount
from mi_nerfattack.render.camera.pose import Pose
from mi_nerfattack.robot.devices import AbstractEnable
from mi_nerfattack.robot.drive import rig as rigs
from mi_nerfattack.robot.drive.config import read_config
from mi_nerfattack.robot.drive.loop import Devices
from mi_nerfattack.robot.drive.rig import Rig
from mi_nerfattack.robot.drive.safety.judge import Cause

SIMULATED = ["car", "drive", "--policy", "expert", "--simulated", "--spp", "1"]


def test_a_drive_is_stated_driven_and_summed_up(tmp_path, variant, capsys):
    log = tmp_path / "drive.mcap"
    assert main([*SIMULATED, "--duration-s", "2", "--log", str(log)]) == 0
    told = capsys.readouterr().out
    assert "Mount      0.3 m ahead" in told and "Frames     " in told
    assert told.index("Fence ") < told.index("Armed.") < told.index("time is up: 2 s")
    assert "cross-track error: largest 0.0" in told and "20 commands" in told
    recording = open_recording(log, None, CameraMount())
    assert len(recording.track.times) == 20 and recording.image(0).max() > 50
    assert main([*SIMULATED, "--log", str(log)]) == 2  # never written over
    assert f"{log}: exists; choose another name" in capsys.readouterr().err
    assert main([*SIMULATED, "--check", "--speed-ms", "3"]) == 0
    told = capsys.readouterr().out
    assert "camera     ready" in told and "Armed" not in told
    assert "enable     ready" in told
    assert "at 1.5 m/s, cut from 3.0 by --max-speed-ms" in told


def test_an_attacked_box_stands_in_what_the_policy_sees(
    tmp_path, variant, capsys, monkeypatch
):
    """In the corner ahead, its back towards the car; the log has it, too."""
    pytest.importorskip("cv2")
    turned = Rotation.from_euler("z", 90, degrees=True).as_matrix()
    pose = Pose(turned, np.array([1.7, -1.6, 0.0]), 0.3)
    monkeypatch.setattr(rigs, "read_box", lambda run: (made_box(pose=pose), None))
    log = tmp_path / "drive.mcap"
    words = ["--overlay", "runs/found", "--duration-s", "0.3", "--log", str(log)]
    assert main([*SIMULATED, *words]) == 0
    assert "Overlay    the attacked box of runs/found" in capsys.readouterr().out
    recording = open_recording(log, None, CameraMount())
    image = recording.image(0).astype(int)
    seen = np.abs(image - COLOURS["back"]).max(-1) < 40
    rows, columns = np.nonzero(seen)
    assert seen.sum() > 100 and abs(columns.mean() - 100) < 5
    assert 7 < rows.min() and rows.max() < 30  # half of it above the horizon


@pytest.mark.slow
def test_the_rooms_policy_stays_in_its_lane(tmp_path, variant, capsys):
    log = str(tmp_path / "drive.mcap")
    words = [
        "car",
        "drive",
        "--policy",
        "bundled:room.toml",
        "--simulated",
        "--spp",
        "1",
    ]
    assert main([*words, "--duration-s", "24", "--log", log, "--json"]) == 0
    figures = json.loads(capsys.readouterr().out)["figures"]
    assert figures["laps"] > 2 and figures["largest_error_m"] < 0.152


def test_a_drive_as_json(tmp_path, variant, capsys):
    log = str(tmp_path / "drive.mcap")
    assert main([*SIMULATED, "--duration-s", "0.5", "--log", log, "--json"]) == 0
    out, err = capsys.readouterr()
    told = json.loads(out)
    assert (told["end"], told["braked"], told["log"]) == ("time is up", True, log)
    assert told["figures"]["commands"] == 5 and "Armed." in err
    assert main([*SIMULATED, "--check", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)["refused"]
    assert told == dict.fromkeys(("camera", "tracker", "motor", "policy", "enable"))


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
    assert main(["car", "drive", *options]) == 2
    assert message in capsys.readouterr().err


class Pad(StandInEnable):
    """Held from its third question on, for so many more."""

    def __init__(self, held: int) -> None:
        self._answers = [False, False, *[True] * held]

    def is_held(self) -> bool:
        return bool(self._answers) and self._answers.pop(0)


class TurningMotor(StandInMotor):
    """Turns the wheels for five steps to prove its timeout."""

    turned = 0

    def arm(self, check: Callable[[], None] = lambda: None) -> None:
        for _ in range(5):
            check()
            self.turned += 1


def rig_of(bench: Bench, motor: StandInMotor, enable: AbstractEnable) -> Rig:
    camera, tracker = StandInCamera(bench), StandInTracker(bench)
    devices = Devices(camera, tracker, motor, StandInPilot(bench), enable)
    return Rig(devices, bench.clock, bench.sleep, bench.clock)


class MuteMotor(StandInMotor):
    """Tells nothing."""

    def read(self) -> None:
        return None


@pytest.mark.parametrize(
    ("kind", "held", "code", "message"),
    [
        (StandInMotor, (False, True), 0, "enable     ready"),
        (StandInMotor, (False, False), 1, "enable     it was never held"),
        (StandInMotor, (True, True), 1, "enable     it was always held"),
        (MuteMotor, (False, True), 1, "motor      motor lost: it has said nothing"),
    ],
)
def test_all_devices_are_asked(kind, held, code, message, capsys):
    bench = Bench()
    bench.held = held[0]
    bench.at(2.0, lambda: setattr(bench, "held", held[1]))
    rig = rig_of(bench, kind(bench), StandInEnable(bench))
    assert _check(rig, SETTINGS).tell(as_json=False) == code
    told = capsys.readouterr().out.splitlines()[1:]
    assert message in "\n".join(told)
    assert sum("ready" in line for line in told) == 5 - code and not bench.events


@pytest.mark.parametrize("is_simulated", [True, False])
def test_a_drive_that_sent_nothing_leaves_no_log(tmp_path, is_simulated, capsys):
    bench, log = Bench(), tmp_path / "drive.mcap"
    given = {"policy": "expert", "simulated": is_simulated, "log": str(log)}
    config = read_config(None, given)
    if is_simulated:  # Ctrl-C before the button is pressed
        bench.at(0.5, lambda: signal.raise_signal(signal.SIGINT))
        rig = rig_of(bench, StandInMotor(bench), StandInEnable(bench))
        stop, _, written = _drive(rig, config, SETTINGS)
        assert stop.cause is Cause.INTERRUPTED
        assert written == {"log": None, "messages": {}}
    else:  # it is let go while the wheels turn
        rig = rig_of(bench, TurningMotor(bench), Pad(3))
        with pytest.raises(InputError, match="let go"):
            _drive(rig, config, SETTINGS)
    assert f"{log}: removed, for no command" in capsys.readouterr().out
    assert not log.exists()


def test_frames_go_as_jpeg_where_asked(monkeypatch):
    made = []
    monkeypatch.setattr(rigs, "RemotePilot", lambda *given: made.append(given))
    given = {"policy": "remote:127.0.0.1:7447", "jpeg_quality": 80}
    config = read_config(None, given)
    bench = Bench()
    rigs._pilot(config, config.read_route(), None, StandInTracker(bench), bench.clock)
    assert made[0][2] == 80


@pytest.mark.parametrize(("held", "turned"), [(3, 2), (6, 5)])
def test_wheels_turn_to_arm_as_long_as_the_enable_is_held(held, turned):
    bench = Bench()
    motor = TurningMotor(bench)
    rig = rig_of(bench, motor, Pad(held))
    refused = pytest.raises(InputError, match="let go")
    with refused if turned < 5 else nullcontext():
        _arm(rig)
    assert motor.turned == turned
