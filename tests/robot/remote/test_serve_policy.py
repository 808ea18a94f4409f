"""The command that serves a policy, as a process of its own."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from contextlib import closing

import numpy as np
import pytest
from helpers.loopback import free_port
from helpers.waiting import wait_for

from mi_nerfattack import cli
from mi_nerfattack.robot.devices import DeviceLostError, Frame
from mi_nerfattack.robot.remote.pilot import RemotePilot
from mi_nerfattack.robot.remote.sealed import Endpoint

pytest.importorskip("zenoh")

POLICY = """\
def steer(images, goals, step):
    return images[:, 0].mean((1, 2)) + goals + 10 * step
"""


@pytest.mark.slow
def test_a_server_of_its_own(tmp_path):
    """Red channel of (n, c, h, w) in [0, 1], goal and step come back as control."""
    code, key = tmp_path / "policy.py", tmp_path / "key"
    code.write_text(POLICY)
    key.write_text("0123456789abcdef" * 2)
    key.chmod(0o600)
    listen = f"127.0.0.1:{free_port()}"
    command = [sys.executable, "-m", "mi_nerfattack.cli", "car", "serve"]
    command += [f"{code}:steer", "--kind", "callable", "--trust-code"]
    command += ["--listen", listen, "--key", str(key), "--route-goal", "2"]
    process = subprocess.Popen(
        [*command, "--size", "6", "4", "--json"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert process.stderr is not None
    assert f"Serving at {listen}, sealed" in process.stderr.readline()
    try:
        pilot = RemotePilot(
            Endpoint.parse(listen), key.read_bytes(), lost_s=20.0, connect_s=60.0
        )
        with closing(pilot):
            image = np.full((4, 6, 3), 51, np.uint8)
            pilot.submit(Frame(image, time.monotonic(), 7))
            wait_for(pilot.newest)
            decision = pilot.newest()
            assert decision is not None and decision.frame_index == 7
            assert decision.control == pytest.approx(2.2, abs=1e-6)
            # stopped, it is missed; and neither frames nor the end wait for it
            pilot._lost_s = 0.5
            process.send_signal(signal.SIGSTOP)
            large = np.zeros((1000, 1000, 3), np.uint8)
            with pytest.raises(DeviceLostError, match="silent for"):
                for index in range(8, 6000):
                    pilot.submit(Frame(large, time.monotonic(), index))
                    time.sleep(0.01)
        pilot.close()
    finally:
        process.send_signal(signal.SIGCONT)
        process.send_signal(signal.SIGINT)
        out, _ = process.communicate(timeout=60)
    told = json.loads(out)
    assert process.returncode == 0 and told["decisions"] >= 1
    assert 0 < told["age_median_s"] <= told["age_99_s"]


def test_refused(tmp_path, capsys):
    short = tmp_path / "key"
    short.write_text("short")
    for given, message in (
        (
            ("--listen", "0.0.0.0:7447"),
            "0.0.0.0:7447: is not this computer alone; without --key",
        ),
        (("--listen", "here"), "here:7447: is not this computer alone"),
        (("--listen", "a:b"), "is no place to listen"),
        (("--key", short), "a key of 5 bytes; at least 16"),
        (("--size", 0, 4), "--size: (0, 4); width and height, 1 or more"),
        (("none.safetensors",), "none.safetensors"),
    ):
        code = cli.main(["car", "serve", *map(str, given)])
        out, err = capsys.readouterr()
        assert (code, out) == (2, "") and message in err, err
