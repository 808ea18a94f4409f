"""The whole of drive at its real boundaries: serial line, UDP, joystick, video."""

from __future__ import annotations

import math
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import pytest
from helpers.joystick import Pad
from helpers.loopback import free_port
from helpers.vesc_stand_in import StandIn
from helpers.vicon_sender import Sender, datagrams

from mi_nerfattack.deploy.place import bundled_place
from mi_nerfattack.io import files
from mi_nerfattack.io.video import write_video
from mi_nerfattack.vehicle.route.route import Route

CAMERA = "[camera]\nwidth = 32\nheight = 16\n"


@contextmanager
def tracked_car(port: int) -> Iterator[None]:
    """A car that goes around the square at 0.5 m/s, seen 50 times a second."""
    route = Route.from_file(bundled_place("room").routes, "square")
    sender, ended = Sender(("127.0.0.1", port)), threading.Event()

    def send() -> None:
        start, frame = time.monotonic(), 0
        while not ended.wait(0.02):
            frame += 1
            x, y, heading = route.pose_at(0.5 * (time.monotonic() - start)).tolist()
            place = (1000 * x, 1000 * y, 0.0)
            turn = (0.0, 0.0, math.remainder(heading, 2 * math.pi))
            for raw in datagrams(frame, [("racecar", place, turn)]):
                sender.send(raw)

    thread = threading.Thread(target=send)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()
        sender.close()


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGHUP])
def test_it_arms_drives_and_brakes(tmp_path, number):
    images = (np.full((16, 32, 3), i % 256, np.uint8) for i in range(6000))
    write_video(tmp_path / "seen.mp4", images, 30)
    files.write_text(tmp_path / "camera.toml", CAMERA)
    pad, port = Pad(tmp_path / "js0"), free_port()
    with StandIn(tmp_path / "car.jsonl") as vesc, tracked_car(port):
        command = [
            sys.executable,
            "-m",
            "mi_nerfattack.cli",
            "car",
            "drive",
            "--policy",
        ]
        command += ["expert", "--speed-ms", "0.5", "--port", vesc.port]
        command += ["--tracker", f"vicon:127.0.0.1:{port}", "--enable", "js0"]
        command += ["--camera", "video:seen.mp4", "--camera-file", "camera.toml"]
        command += ["--log", "drive.mcap", "--on-block"]
        pipe = subprocess.PIPE
        process = subprocess.Popen(command, stdout=pipe, text=True, cwd=tmp_path)
        assert process.stdout is not None
        ending = threading.Timer(120.0, process.kill)
        ending.start()
        told = []
        for line in process.stdout:
            told.append(line.strip())
            if "hold it as long" in line or "hold the enable button to drive" in line:
                pad.press(True)
            elif "release the enable button" in line or line.startswith("not ready"):
                pad.press(False)
            elif "the enable is held" in line:
                threading.Timer(2.0, process.send_signal, [number]).start()
        code = process.wait(60)
        ending.cancel()
        process.stdout.close()
        vesc.wait_for(speed_ms=0.0)
    pad.close()
    said = "\n".join(told)
    print(said)
    assert said.index("Lift the wheels") < said.index("Armed."), said
    # on a machine that is busy the drive may end before the signal: by a cause, too
    assert "braked, wheels centred" in said, said
    assert code == 130 or "interrupted" not in said, said
