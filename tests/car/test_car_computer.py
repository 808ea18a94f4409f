"""The computer of a car has neither Mitsuba nor Dr.Jit nor torch."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
from http.server import BaseHTTPRequestHandler

import pytest
from support.devices.whole_drive import drive
from support.files.policies import serving

from mi_nerfattack.deploy.replay.environment import open_recording
from mi_nerfattack.render.camera.intrinsics import CameraMount

MISSING = ("mitsuba", "drjit", "torch", "mujoco", "matplotlib", "pandas")
WITHOUT = f"""
import sys
class Finder:
    def find_spec(name, *_):
        if name.split(".")[0] in {MISSING}:
            raise ModuleNotFoundError(f"No module named {{name!r}}", name=name)
sys.meta_path.insert(0, Finder)
"""
MAIN = f"{WITHOUT}\nfrom mi_nerfattack.cli import main\nsys.exit(main())"
IMPORTS = """
import pkgutil, importlib, mi_nerfattack.car as car
for one in pkgutil.walk_packages(car.__path__, "mi_nerfattack.car."):
    importlib.import_module(one.name)
    print(one.name)
for name in car.__all__:
    getattr(car, name)
"""
MODULES = """
import json, sys, mi_nerfattack.car
print(json.dumps([name for name in sys.argv[1:] if name in sys.modules]))
"""
TOKEN = "0123456789abcdef"


def run(code: str, *words: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-c", code, *words]
    return subprocess.run(command, capture_output=True, text=True, timeout=120)


def test_an_import_loads_none_of_them():
    done = run(MODULES, *MISSING)
    assert json.loads(done.stdout) == [], done.stderr


def test_every_module_is_imported_without_them():
    done = run(WITHOUT + IMPORTS)
    assert done.returncode == 0, done.stderr
    assert "mi_nerfattack.car.vesc.guided" in done.stdout.split()


@pytest.mark.parametrize(
    ("words", "code", "message"),
    [
        (["car", "calibrate", "--help"], 0, "Find the scales of a car's motor"),
        (["car", "drive", "--help"], 0, "Let a policy drive a car along a route"),
        (["doctor"], 1, "No module named 'drjit'"),
        (["car", "drive", "--policy", "expert", "--simulated"], 2, "error: mitsuba: "),
        (["car", "drive", "--policy", "bundled:room.toml"], 2, "is not installed; "),
    ],
)
def test_a_command_runs_or_says_what_it_lacks(words, code, message):
    done = run(MAIN, *words)
    output = " ".join((done.stdout + done.stderr).split())
    assert (done.returncode, message in output) == (code, True), output
    assert "Traceback" not in output


@pytest.mark.slow
def test_a_served_policy_drives_to_the_end(tmp_path):
    """With a token; a busy computer may miss a deadline, which brakes: then again."""
    asked = []

    class Handler(BaseHTTPRequestHandler):
        def do_POST(self):
            self.rfile.read(int(self.headers["Content-Length"]))
            asked.append(self.headers["Authorization"])
            self.send_response(200)
            self.end_headers()
            self.wfile.write(b'{"control": [0.125]}')

    words = "--set control_unit=rad --set duration_s=2 --set token_file=token --policy"
    code, number = 1, 0
    with serving() as start:
        url = start(Handler)
        while code and number < 3:
            folder = tmp_path / str(number := number + 1)
            folder.mkdir()
            (folder / "token").write_text(TOKEN)
            (folder / "token").chmod(0o600)
            start_words = [sys.executable, "-c", MAIN]
            code, said = drive(folder, start_words, [*words.split(), url])
    assert code == 0 and "time is up: 2 s: braked, wheels centred" in said, said
    assert len(asked) >= 19 and set(asked) == {f"Bearer {TOKEN}"}
    recording = open_recording(folder / "drive.mcap", None, CameraMount())
    assert 18 <= len(recording.track.times) <= 22


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGHUP])
def test_it_arms_drives_and_brakes(tmp_path, number):
    start = [sys.executable, "-m", "mi_nerfattack.cli"]
    code, said = drive(tmp_path, start, ["--policy", "expert"], number)
    assert said.index("Lift the wheels") < said.index("Armed."), said
    # on a machine that is busy the drive may end before the signal: by a cause, too
    assert "braked, wheels centred" in said, said
    assert code == 130 or "interrupted" not in said, said
