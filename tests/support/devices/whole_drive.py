"""The whole of drive at its real boundaries: serial line, UDP, joystick, video."""

from __future__ import annotations

import math
import subprocess
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from pathlib import Path

import numpy as np
from support.devices.car import Pad, Sender, datagrams
from support.devices.controller import StandIn
from support.faults.injected import free_port

from mi_nerfattack.io import files
from mi_nerfattack.io.video import write_video
from mi_nerfattack.scenes import bundled
from mi_nerfattack.vehicle.route.route import Route

CAMERA = "[policy]\n[vehicle]\n[camera]\nwidth = 32\nheight = 16\n"


@contextmanager
def tracked_car(port: int) -> Iterator[None]:
    """A car that goes around the square at 0.5 m/s, seen 50 times a second."""
    route = Route.from_file(bundled("room/routes.json"), "square")
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


def drive(
    folder: Path, start: Sequence[str], words: Sequence[str], number: int | None = None
) -> tuple[int, str]:
    """Drive on the block, the button held, and return the exit code and the output.

    `start` runs `mi_nerfattack.cli`, `words` name the policy, and the signal `number`
    ends the drive two seconds after its start.
    """
    images = (np.full((16, 32, 3), i % 256, np.uint8) for i in range(6000))
    write_video(folder / "seen.mp4", images, 30)
    files.write_text(folder / "camera.toml", CAMERA)
    port, lines = free_port(), []
    with (
        closing(Pad(folder / "js0")) as pad,
        StandIn(folder / "car.jsonl") as vesc,
        tracked_car(port),
    ):
        command = [*start, "car", "drive", *words, "-o", "drive.mcap", "--on-block"]
        for setting in (
            "speed_ms=0.5",
            "calibration=racecar-j",
            f"port={vesc.port}",
            f"tracker=vicon:127.0.0.1:{port}",
            "enable=js0",
            "camera=video:seen.mp4",
            "camera_file=camera.toml",
        ):
            command += ["--set", setting]
        pipe, both = subprocess.PIPE, subprocess.STDOUT
        process = subprocess.Popen(
            command, stdout=pipe, stderr=both, text=True, cwd=folder
        )
        assert process.stdout is not None
        ending = threading.Timer(120.0, process.kill)
        ending.start()
        for line in process.stdout:
            lines.append(line.strip())
            if "hold it as long" in line or "hold the enable button to drive" in line:
                pad.press(True)
            elif "release the enable button" in line or line.startswith("not ready"):
                pad.press(False)
            elif "the enable is held" in line and number is not None:
                threading.Timer(2.0, process.send_signal, [number]).start()
        code = process.wait(60)
        ending.cancel()
        process.stdout.close()
        vesc.wait_for(speed_ms=0.0)
    said = "\n".join(lines)
    print(said)
    return code, said
