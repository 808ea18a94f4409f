"""The process that places photographs: how it ends, and what it tells."""

from __future__ import annotations

import json
import os
import subprocess
import sys

import numpy as np
import pytest

from mi_nerfattack.capture.colmap.follow import Stages
from mi_nerfattack.capture.colmap.process import MARK
from mi_nerfattack.capture.photographs.estimate import estimate_poses
from mi_nerfattack.errors import SetupError
from mi_nerfattack.io import files

pytestmark = pytest.mark.usefixtures("variant")


class TestProcess:
    """pycolmap's process, with modules of its name that fail on purpose."""

    @pytest.fixture
    def poses(self, tmp_path, monkeypatch):
        """Estimate poses with a pycolmap whose extract_features is the given code."""
        folder = tmp_path / "p"
        folder.mkdir()
        for i in range(3):
            image = np.full((60, 80, 3), 40 * i, np.uint8)
            files.write_image(folder / f"{i}.jpg", image)

        def call(code: str, progress=lambda *_: None) -> None:
            lines = [
                "import os, pathlib, signal, sys, time",
                "class CameraMode: SINGLE = 0",
                "class logging: logtostderr = False",
                "def set_random_seed(seed): pass",
                "def ImageReaderOptions(**_): pass",
                "def FeatureExtractionOptions(**_): pass",
                "def extract_features(database, *_):",
                *(f"    {line}" for line in code.splitlines()),
            ]
            (tmp_path / "pycolmap.py").write_text("\n".join(lines) + "\n")
            monkeypatch.syspath_prepend(str(tmp_path))
            estimate_poses(folder, tmp_path / "out", progress=progress)

        return call

    @pytest.mark.skipif(sys.platform == "win32", reason="no such signals")
    @pytest.mark.parametrize("name", ["SIGBUS", "SIGKILL"])
    def test_crash_is_a_message(self, poses, tmp_path, name):
        code = f"print('E full', flush=True)\nos.kill(os.getpid(), signal.{name})"
        message = f"ended by {name} at the stage 'features' .*E full.*--long-edge"
        with pytest.raises(SetupError, match=message):
            poses(code)
        assert not (tmp_path / "out").exists()

    def test_exception_is_a_message(self, poses):
        with pytest.raises(SetupError, match="code 1 .*ZeroDivisionError: why"):
            poses("raise ZeroDivisionError('why')")

    def test_interrupt_ends_the_process(self, poses, tmp_path):
        pid, woken = tmp_path / "pid", tmp_path / "woken"
        code = (
            f"pathlib.Path({str(pid)!r}).write_text(str(os.getpid()))\n"
            "print('I Processed file [2/3]', flush=True)\n"
            "time.sleep(100)\n"
            f"pathlib.Path({str(woken)!r}).touch()"
        )
        seen = []

        def interrupt(*call) -> None:
            seen.append(call)
            if call == ("features", 2, 3):
                raise KeyboardInterrupt

        with pytest.raises(KeyboardInterrupt):
            poses(code, interrupt)
        with pytest.raises(ProcessLookupError):
            os.kill(int(pid.read_text()), 0)
        assert ("features", 0, 3) in seen and not woken.exists()

    def test_process_ends_with_its_parent(self, tmp_path):
        (tmp_path / "pycolmap.py").write_text("import time\ntime.sleep(100)\n")
        command = [sys.executable, "-m", "mi_nerfattack.capture.colmap.process"]
        task = json.dumps({"work": "", "folder": "", "groups": []})
        environment = {**os.environ, "PYTHONPATH": str(tmp_path)}
        result = subprocess.run(command, input=task + "\n", text=True, env=environment)
        assert result.returncode == 1

    @pytest.mark.parametrize(
        ("line", "done"),
        [
            ("Processed file [3/4]", 45),
            ("Processing image [3/4]", 30),
            ("Processing block [1/3, 3/3]", 13),
            ("Processing block [3/3, 1/3]", 40),
        ],
    )
    def test_progress_of_a_log_line(self, line, done):
        calls = []
        stages = Stages(lambda *call: calls.append(call))
        told = MARK + json.dumps({"stage": "s", "total": 60})
        stages.follow([told, f"I2026 7 pairing.cc:2] {line}\n"])
        assert calls == [("s", 0, 60), ("s", done, 60)]
