"""`car drive` in the simulated room, and `car serve` as a process of its own."""

from __future__ import annotations

import io
import json
import signal
import subprocess
import sys
from collections.abc import Callable
from contextlib import nullcontext
from http.server import BaseHTTPRequestHandler

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.devices import car as stand_ins
from support.faults.injected import free_port
from support.files.policies import serving
from support.worlds.attacks import COLOURS, made_box

from mi_nerfattack.car.devices import AbstractEnable
from mi_nerfattack.car.drive.config import read_config
from mi_nerfattack.car.drive.loop import Devices
from mi_nerfattack.car.drive.rig import Rig
from mi_nerfattack.car.drive.safety.judge import Cause
from mi_nerfattack.cli import main
from mi_nerfattack.commands.drive import DriveCommand, _arm, _drive, _dry_run
from mi_nerfattack.deploy.replay.environment import open_recording
from mi_nerfattack.errors import InputError
from mi_nerfattack.policy.http.client import PolicyClient
from mi_nerfattack.props import overlaid
from mi_nerfattack.render.camera.intrinsics import CameraMount
from mi_nerfattack.render.camera.pose import Pose
from mi_nerfattack.scenes import bundled

SIMULATED = ["car", "drive", "--policy", "expert", "--simulated", "--set", "spp=1"]


def test_a_drive_is_stated_driven_and_logged(tmp_path, variant, capsys):
    log = tmp_path / "drive.mcap"
    words = [*SIMULATED, "-o", str(log), "--json"]
    assert main([*words, "--set", "duration_s=2"]) == 0
    out, err = capsys.readouterr()
    document = json.loads(out)
    assert (document["end"], document["braked"], document["log"]) == (
        "time is up",
        True,
        str(log),
    )
    figures = document["figures"]
    assert figures["commands"] == 19 and figures["largest_error_m"] < 0.1
    assert max(err.index("Mount "), err.index("Fence ")) < err.index("Armed.")
    recording = open_recording(log, None, CameraMount())
    assert len(recording.track.times) == 20 and recording.image(0).max() > 50
    before = log.read_bytes()
    assert main(words) == 2  # never written over
    assert f"{log}: exists" in capsys.readouterr().err and log.read_bytes() == before
    assert main([*SIMULATED, "--dry-run", "--json"]) == 0
    refused = json.loads(capsys.readouterr().out)["refused"]
    assert refused == dict.fromkeys(("camera", "tracker", "motor", "policy", "enable"))


def test_an_attacked_box_stands_in_what_the_policy_sees(
    tmp_path, variant, capsys, monkeypatch
):
    """In the corner ahead, its back towards the car; the log has it, too."""
    pytest.importorskip("cv2")
    turned = Rotation.from_euler("z", 90, degrees=True).as_matrix()
    pose = Pose(turned, np.array([1.7, -1.6, 0.0]), 0.3)
    monkeypatch.setattr(overlaid, "read_box", lambda run: (made_box(pose=pose), None))
    log = tmp_path / "drive.mcap"
    words = ["--set", "overlay=runs/found", "--set", "duration_s=0.3", "-o", str(log)]
    assert main([*SIMULATED, *words]) == 0
    assert "Overlay    the attacked box of runs/found" in capsys.readouterr().out
    recording = open_recording(log, None, CameraMount())
    image = recording.image(0).astype(int)
    mask = np.abs(image - COLOURS["back"]).max(-1) < 40
    rows, columns = np.nonzero(mask)
    assert mask.sum() > 100 and abs(columns.mean() - 100) < 5
    assert 7 < rows.min() and rows.max() < 30  # half of it above the horizon


@pytest.mark.slow
def test_the_rooms_policy_stays_in_its_lane(tmp_path, variant, capsys):
    words = [*SIMULATED, "--policy", "bundled:room.toml", "--set", "duration_s=24"]
    assert main([*words, "-o", str(tmp_path / "drive.mcap"), "--json"]) == 0
    figures = json.loads(capsys.readouterr().out)["figures"]
    assert figures["laps"] > 2 and figures["largest_error_m"] < 0.152


POLICY = '[policy]\nfile = "bundled:policy/pilotnet.safetensors"\n'


@pytest.mark.parametrize("section", ["", '[vehicle]\nkind = "dubins"\n'])
def test_a_policy_is_driven_in_its_own_unit(tmp_path, section):
    """The bundled one gives a heading rate, which is no steering angle."""
    path, command = tmp_path / "policy.toml", DriveCommand()
    path.write_text(POLICY + section)
    options = {"policy": str(path)}
    config, _ = command._trained(read_config(None, options))
    assert config.control_unit == "rad/s"
    with pytest.raises(InputError, match="control_unit: 'rad', and .* 'rad/s'"):
        command._trained(read_config(None, options | {"control_unit": "rad"}))
    path.write_text(POLICY + '[vehicle]\nkind = "ackermann"\n')
    with pytest.raises(InputError, match="takes rad, and .* gives rad/s"):
        command._trained(read_config(None, options))


def test_a_policy_of_another_control_period_is_refused(tmp_path):
    path = tmp_path / "policy.toml"
    path.write_text(f'{POLICY}[vehicle]\nkind = "dubins"\ndt_s = 0.05\n')
    with pytest.raises(InputError, match=r"policy\.toml: vehicle\.dt_s: 0\.05"):
        DriveCommand()._trained(read_config(None, {"policy": str(path)}))


def test_a_policy_drives_the_car_that_it_was_trained_for():
    command, room = DriveCommand(), {"policy": "bundled:room.toml"}
    config, _ = command._trained(read_config(None, room))
    assert (config.control_unit, config.wheelbase_m) == ("rad", 0.325)
    with pytest.raises(InputError, match="wheelbase_m: 0.26, and .* says 0.325"):
        command._trained(read_config(None, room | {"wheelbase_m": 0.26}))


def test_a_mount_counts_from_the_rear_axle(tmp_path):
    """The state of a bicycle is that of its centre of gravity."""
    keys = bundled("room.toml").read_text().partition("[policy]")[2]
    path, mounts = tmp_path / "policy.toml", []
    for vehicle in (
        'kind = "ackermann"\nwheelbase_m = 0.325',
        'kind = "bicycle"\nfront_axle_m = 0.125\nrear_axle_m = 0.2',
    ):
        sections = keys.partition("[vehicle]")[0]
        path.write_text(f"[policy]{sections}[vehicle]\n{vehicle}\nwidth_m = 0.296\n")
        _, trained = DriveCommand()._trained(read_config(None, {"policy": str(path)}))
        mounts.append(trained.mount)
    assert mounts[1].forward_m - mounts[0].forward_m == pytest.approx(0.2)


class Pad(stand_ins.StandInEnable):
    """Held from its third question on, for so many more."""

    def __init__(self, held: int) -> None:
        self._answers = [False, False, *[True] * held]

    def is_held(self) -> bool:
        return bool(self._answers) and self._answers.pop(0)


class TurningMotor(stand_ins.StandInMotor):
    """Turns the wheels for five steps to prove its timeout."""

    turned = 0

    def arm(self, check: Callable[[], None] = lambda: None) -> None:
        for _ in range(5):
            check()
            self.turned += 1


def rig_of(
    bench: stand_ins.Bench, motor: stand_ins.StandInMotor, enable: AbstractEnable
) -> Rig:
    camera, tracker = stand_ins.StandInCamera(bench), stand_ins.StandInTracker(bench)
    devices = Devices(camera, tracker, motor, stand_ins.StandInPilot(bench), enable)
    return Rig(devices, bench.clock, bench.sleep, bench.clock)


class MuteMotor(stand_ins.StandInMotor):
    """Tells nothing."""

    def read(self) -> None:
        return None


@pytest.mark.parametrize(
    ("kind", "held", "code", "message"),
    [
        (stand_ins.StandInMotor, (False, True), 0, "enable     ready"),
        (stand_ins.StandInMotor, (False, False), 1, "enable     it was never held"),
        (stand_ins.StandInMotor, (True, True), 1, "enable     it was always held"),
        (MuteMotor, (False, True), 1, "motor      motor lost: it has said nothing"),
    ],
)
def test_all_devices_are_asked(kind, held, code, message, capsys):
    bench = stand_ins.Bench()
    bench.held = held[0]
    bench.at(2.0, lambda: setattr(bench, "held", held[1]))
    rig = rig_of(bench, kind(bench), stand_ins.StandInEnable(bench))
    assert _dry_run(rig, stand_ins.SETTINGS).tell(as_json=False) == code
    lines = capsys.readouterr().out.splitlines()[1:]
    assert message in "\n".join(lines)
    assert sum("ready" in line for line in lines) == 5 - code and not bench.events


@pytest.mark.parametrize("is_simulated", [True, False])
def test_a_drive_that_sent_nothing_leaves_no_log(tmp_path, is_simulated, capsys):
    bench, log = stand_ins.Bench(), tmp_path / "drive.mcap"
    options = {"policy": "expert", "simulated": is_simulated, "log": str(log)}
    config = read_config(None, options)
    if is_simulated:  # Ctrl-C before the button is pressed
        bench.at(0.5, lambda: signal.raise_signal(signal.SIGINT))
        rig = rig_of(
            bench, stand_ins.StandInMotor(bench), stand_ins.StandInEnable(bench)
        )
        stop, _, written = _drive(rig, config, stand_ins.SETTINGS)
        assert stop.cause is Cause.INTERRUPTED
        assert written == {"log": None, "messages": {}}
    else:  # it is let go while the wheels turn
        rig = rig_of(bench, TurningMotor(bench), Pad(3))
        with pytest.raises(InputError, match="let go"):
            _drive(rig, config, stand_ins.SETTINGS)
    assert f"{log}: removed, for no command" in capsys.readouterr().out
    assert not log.exists()


def test_a_policy_behind_a_url_drives(tmp_path, variant, capsys):
    """Every frame is asked about once, in order, with the goal and the token."""
    token = tmp_path / "token"
    token.write_text("0123456789abcdef")
    token.chmod(0o600)
    asked = []

    class Handler(BaseHTTPRequestHandler):
        def do_POST(self):
            body = self.rfile.read(int(self.headers["Content-Length"]))
            asked.append((self.headers, np.load(io.BytesIO(body))))
            self.send_response(200)
            self.end_headers()
            self.wfile.write(b'{"control": [0.125], "time_s": 1e9}')

    log = str(tmp_path / "drive.mcap")
    with serving() as start:
        words = [*SIMULATED, "--policy", start(Handler), "-o", log, "--json"]
        for setting in ("duration_s=0.3", "control_unit=rad", f"token_file={token}"):
            words += ["--set", setting]
        assert main(words) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["end"] == "time is up" and document["figures"]["latency_99_s"] < 1
    steps = [int(headers["X-Step"]) for headers, _ in asked]
    again = steps.index(0, 1)  # the policy begins anew when the button is pressed
    assert steps == [*range(again), *range(len(steps) - again)]
    for headers, image in asked:
        assert (headers["X-Goal"], image.dtype) == ("0", np.uint8)
        assert image.shape[:2] == (1, 3) and image.std() > 10
        assert headers["Authorization"] == "Bearer 0123456789abcdef"


@pytest.mark.parametrize(("held", "turned"), [(3, 2), (6, 5)])
def test_wheels_turn_to_arm_as_long_as_the_enable_is_held(held, turned):
    bench = stand_ins.Bench()
    motor = TurningMotor(bench)
    rig = rig_of(bench, motor, Pad(held))
    refused = pytest.raises(InputError, match="let go")
    with refused if turned < 5 else nullcontext():
        _arm(rig)
    assert motor.turned == turned


STEER = """\
def steer(images, goals, step):
    return images[:, 0].mean((1, 2)) + goals + 10 * step
"""
TOKEN = "0123456789abcdef" * 2


@pytest.mark.slow
def test_a_server_of_its_own(tmp_path):
    """Red channel of (n, c, h, w) in [0, 1], goal and step come back as control."""
    code, token = tmp_path / "policy.py", tmp_path / "token"
    code.write_text(STEER)
    token.write_text(TOKEN)
    token.chmod(0o600)
    listen = f"127.0.0.1:{free_port()}"
    command = [sys.executable, "-m", "mi_nerfattack.cli", "car", "serve"]
    command += [f"{code}:steer", "--set", "policy.kind=callable"]
    command += ["--set", "policy.trust_code=true"]
    command += ["--listen", listen, "--token-file", str(token), "--size", "6", "4"]
    process = subprocess.Popen(
        [*command, "--json"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        assert process.stderr is not None
        assert f"Serving at http://{listen}, asks" in process.stderr.readline()
        client = PolicyClient(f"http://{listen}", TOKEN, timeout_s=60)
        image = np.full((1, 3, 4, 6), 51, np.uint8)
        for step in range(2):
            assert client.ask(image, [2], step) == pytest.approx(2.2 + 10 * step)
        with pytest.raises(InputError, match="status 401"):
            PolicyClient(f"http://{listen}").ask(image, [2], 0)
        process.send_signal(signal.SIGSTOP)
        stopped = PolicyClient(f"http://{listen}", TOKEN, timeout_s=0.3, retries=1)
        with pytest.raises(InputError, match="no answer in 0.3 s, after 2 attempts"):
            stopped.ask(image, [2], 0)
    finally:
        process.send_signal(signal.SIGCONT)
        process.send_signal(signal.SIGINT)
        out, _ = process.communicate(timeout=60)
    document = json.loads(out)
    assert process.returncode == 0 and document["decisions"] >= 2
    assert (
        0 < document["median_s"] <= document["within_s_95"]
        and document["strangers"] == 1
    )
