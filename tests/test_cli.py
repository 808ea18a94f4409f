from __future__ import annotations

import json
import os
import re
import shlex
import signal
import subprocess
import sys
import threading
import time
from dataclasses import dataclass

import pytest
from support.reference.derivatives import later

import mi_nerfattack
from mi_nerfattack import cli
from mi_nerfattack.backend import llvm
from mi_nerfattack.commands import COMMANDS, THEMES
from mi_nerfattack.errors import InputError
from mi_nerfattack.system import doctor

COMMAND = [sys.executable, "-m", "mi_nerfattack.cli"]
HEAVY = {"torch", "matplotlib", "trimesh", "skimage", "scipy", "cv2", "OpenEXR"}


RAISED: dict[str, BaseException] = {
    "refuse": InputError("fields/x.safetensors: truncated; copy it again"),
    "names": InputError("a: called '\x1b[2J\x9b1mä\u202e'\n\tb"),
    "interrupt": KeyboardInterrupt(),
    "recorded": RuntimeError("dr.while_loop(): an exception"),
    "rich": SystemExit(1),
    "memory": MemoryError("249 TiB"),
    "bug": ZeroDivisionError("ours"),
}
RAISED["recorded"].__cause__ = KeyboardInterrupt()
RAISED["rich"].__context__ = BrokenPipeError()


@dataclass(frozen=True)
class Try:
    """Do what the test says."""

    what: str = "succeed"
    """What to do."""
    force: bool = False
    """Do it anew."""

    def run(self) -> int:
        """Do it."""
        if self.what in RAISED:
            raise RAISED[self.what]
        if self.what == "terminate":
            os.kill(os.getpid(), signal.SIGTERM)
            time.sleep(10)
        return 0 if self.what == "succeed" else 1


@pytest.fixture
def run(monkeypatch, capsys):
    """Run the command line with the command 'try' added."""
    monkeypatch.setitem(THEMES["start"], "try", Try)

    def call(*arguments: str) -> tuple[int, str, str]:
        code = cli.main(arguments)
        captured = capsys.readouterr()
        return code, captured.out, captured.err

    return call


ERROR, INTERRUPTED = "mi-nerfattack: error: ", "mi-nerfattack: interrupted\n"


@pytest.mark.parametrize(
    ("what", "code", "err"),
    [
        ("succeed", 0, ""),
        ("fail", 1, ""),
        ("refuse", 2, f"{ERROR}fields/x.safetensors: truncated; copy it again\n"),
        # a message does not steer the terminal
        ("names", 2, f"{ERROR}a: called '" + r"\x1b[2J\x9b1mä\u202e'" + "\n\tb\n"),
        ("interrupt", 130, INTERRUPTED),
        ("recorded", 130, INTERRUPTED),  # by Dr.Jit, which tells it as its own
    ],
)
def test_how_a_command_ends(run, what, code, err):
    assert run("try", "--what", what) == (code, "", err)


@pytest.mark.parametrize("place", [0, 3])
def test_debug_shows_the_traceback(run, place):
    arguments = ["try", "--what", "refuse"]
    arguments.insert(place, "--debug")
    code, _, err = run(*arguments)
    assert code == 2
    assert "Traceback" in err and err.splitlines()[-1].startswith(ERROR)


def test_the_last_line_of_an_interruption_is_the_command_that_goes_on(run, monkeypatch):
    monkeypatch.setattr(Try, "continues", True, raising=False)
    code, _, err = run("try", "--what", "interrupt")
    *_, first, last = err.splitlines()
    assert code == 130
    assert first == "mi-nerfattack: interrupted; to go on, give it again:"
    assert last == "mi-nerfattack try --what interrupt"
    monkeypatch.setattr(Try, "anew", ("--force",), raising=False)
    _, _, err = run("try", "--what", "interrupt", "--force")
    assert err.splitlines()[-1] == last


def test_sigterm_is_an_interruption_and_the_handler_is_put_back(run):
    before = signal.getsignal(signal.SIGTERM)
    code, _, err = run("try", "--what", "terminate")
    assert (code, err) == (130, INTERRUPTED)
    assert signal.getsignal(signal.SIGTERM) is before


def test_a_mistake_of_ours_keeps_its_traceback(run):
    with pytest.raises(ZeroDivisionError):
        run("try", "--what", "bug")


def test_too_little_memory_is_a_message(run):
    code, _, err = run("try", "--what", "memory")
    assert code == 2 and "not enough memory: 249 TiB; give fewer or smaller" in err


def test_other_threads_may_call(run):
    codes: list[int] = []
    thread = threading.Thread(target=lambda: codes.append(cli.main(["try"])))
    thread.start()
    thread.join()
    assert codes == [0]


def test_completion_is_printed(run):
    code, out, _ = run("--tyro-print-completion", "bash")
    assert code == 0 and "complete" in out and "attack" in out


@pytest.mark.parametrize(
    "arguments", [[], ["nonsense"], ["doctor", "--nonsense"], ["--nonsense"]]
)
def test_wrong_usage_is_code_2(run, arguments):
    code, out, err = run(*arguments)
    assert (code, out) == (2, "") and err and "Traceback" not in err
    assert run("--version") == (0, f"mi-nerfattack {mi_nerfattack.__version__}\n", "")


def test_help_is_complete_and_loads_nothing_heavy():
    code = (
        "import contextlib, io, sys\n"
        "from mi_nerfattack.cli import main\n"
        "from mi_nerfattack.commands import COMMANDS, each\n"
        "assert main(['--help']) == 0\n"
        "for words, _ in each(COMMANDS):\n"
        "    with contextlib.redirect_stdout(io.StringIO()) as out:\n"
        "        assert main([*words, '--help']) == 0\n"
        "print(*sys.modules, file=sys.stderr)"
    )
    command = [sys.executable, "-c", code]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "usage: mi-nerfattack" in done.stdout
    assert all(f"\n  {name} " in done.stdout for name in COMMANDS)
    assert done.stdout.count("\n") <= 50
    assert not HEAVY & set(done.stderr.split())


def test_closed_pipe_is_quiet():
    pipe = subprocess.PIPE
    process = subprocess.Popen([*COMMAND, "--help"], stdout=pipe, stderr=pipe)
    assert process.stdout is not None and process.stderr is not None
    process.stdout.close()
    with process.stderr as err:
        assert err.read() == b""
    assert process.wait(60) == cli.EXIT_BROKEN_PIPE


def test_a_pipe_that_rich_finds_closed_is_a_closed_pipe(run, monkeypatch):
    monkeypatch.setattr(cli, "_drop_output", lambda: None)
    assert run("try", "--what", "rich") == (cli.EXIT_BROKEN_PIPE, "", "")


@pytest.mark.skipif(sys.platform != "linux", reason="a device of Linux")
@pytest.mark.parametrize(
    ("where", "code", "message"),
    [(">&-", 0, ""), (">/dev/full", 2, "standard output: No space left on device")],
)
def test_standard_output_that_takes_nothing(where, code, message):
    command = f"{shlex.join(COMMAND)} --version {where}"
    done = subprocess.run(["sh", "-c", command], capture_output=True, text=True)
    assert done.returncode == code and "Traceback" not in done.stderr
    assert message in done.stderr and done.stderr.count("\n") == bool(message)


def start(body: str) -> subprocess.Popen:
    """Run a command of a process of its own; returns when it has written a line."""
    code = (
        "import ctypes, os, signal, sys, time\n"
        "from dataclasses import dataclass\n"
        "from mi_nerfattack import cli, commands, variant\n"
        "from mi_nerfattack.backend import interrupts\n"
        "interrupts.GRACE_S = 0.3\n"
        "@dataclass(frozen=True)\n"
        "class Wait:\n"
        "    'Wait.'\n"
        "    def run(self):\n"
        "        print('ready', flush=True)\n"
        f"        {body}\n"
        "commands.THEMES['start']['wait'] = Wait\n"
        "sys.exit(cli.main(['wait']))"
    )
    pipe = subprocess.PIPE
    command = [sys.executable, "-c", code]
    process = subprocess.Popen(command, stdout=pipe, stderr=pipe, text=True)
    assert process.stdout is not None
    assert process.stdout.readline() == "ready\n"
    return process


def end_of(process: subprocess.Popen) -> tuple[int, str]:
    _, err = process.communicate(timeout=60)
    return process.returncode, err


def test_ctrl_c_in_a_real_process():
    process = start("time.sleep(60)")
    process.send_signal(signal.SIGINT)
    assert end_of(process) == (130, INTERRUPTED)


@pytest.mark.parametrize("presses", [1, *later(2)])
def test_ctrl_c_while_a_variant_is_imported(presses):
    """Mitsuba imports modules in the call, and tells what stops them in its own way."""
    press = "os.kill(os.getpid(), signal.SIGINT)"
    times = f"for _ in range({presses}) if name.endswith('ad.integrators')"
    look = f"lambda name, *_: [{press} {times}].clear()"
    finder = f"type('Finder', (), {{'find_spec': staticmethod({look})}})"
    process = start(f"sys.meta_path.insert(0, {finder}); variant.ensure()")
    assert end_of(process) == (130, INTERRUPTED)


@pytest.mark.skipif(sys.platform != "linux", reason="locks by the C library's name")
@pytest.mark.parametrize("number", [signal.SIGTERM, *later(signal.SIGINT)])
def test_a_library_that_never_comes_back_ends_with_the_process(number):
    lock = "lock = ctypes.create_string_buffer(64); take = ctypes.CDLL(None)"
    process = start(f"{lock}.pthread_mutex_lock; take(lock); take(lock)")
    time.sleep(0.2)  # it has the lock, and waits for it
    process.send_signal(number)
    message = "mi-nerfattack: interrupted, in the midst of a computation\n"
    assert end_of(process) == (130, message)


def test_doctor_as_json_and_as_table(run):
    code, out, _ = run("doctor", "--json")
    report = json.loads(out)
    findings = {item["name"]: item for item in report["findings"]}
    assert code == (0 if report["can_run"] else 1)
    names = {"python", "LLVM", "variants", "GPU", "cores", "memory", "disk"}
    assert names <= set(findings)
    assert "llvm_ad_rgb" in findings["variants"]["value"]
    assert findings["default variant"]["state"] == "ok"
    for item in findings.values():
        assert item["state"] == "ok" or item["remedy"], item
    again, table, _ = run("doctor")
    assert again == code and re.search(r"LLVM +\d+\.\d+", table)


def test_doctor_lists_what_developers_need_only_if_asked():
    plain, asked = ([f.name for f in doctor.examine(d)] for d in (False, True))
    assert {"mitsuba", "onnx"} <= set(plain) and {"pytest", "ruff"}.isdisjoint(plain)
    assert {*plain, "pytest", "ruff", "sphinx"} <= set(asked)
    assert len(set(asked)) == len(asked)


def test_doctor_without_llvm_tells_what_to_do():
    environment = os.environ | {llvm.VARIABLE: "/nowhere/libLLVM.so"}
    command = [*COMMAND, "doctor", "--json"]
    done = subprocess.run(command, env=environment, capture_output=True, text=True)
    assert done.returncode == 1
    findings = {item["name"]: item for item in json.loads(done.stdout)["findings"]}
    assert findings["LLVM"]["state"] == "missing"
    assert llvm.PACKAGE in findings["LLVM"]["remedy"]
    assert findings["default variant"]["state"] == "missing"


def test_doctor_reports_what_is_missing():
    needed = doctor.Requirement("no-such-distribution>=2")
    finding = doctor._package(needed, "missing", "install it")
    assert (finding.name, finding.state) == ("no-such-distribution", "missing")
    assert finding.remedy == "install it" and not doctor.can_run([finding])
    old = doctor.Requirement("mitsuba>=99")
    assert ", needed >=99" in doctor._package(old, "absent", "update").value
    assert doctor.can_run([doctor._package(old, "absent", "update")])


def test_doctor_compares_bundled_files(tmp_path):
    # SHA-256 of "abc" as printed in FIPS 180-2, appendix B.1
    known = "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"
    for text, is_equal in (("abc", True), ("abd", False)):
        (tmp_path / "a").write_text(text)
        assert doctor._matches(tmp_path, "a", {"sha256": known}) == is_equal
    assert not doctor._matches(tmp_path, "b", {"sha256": known})
