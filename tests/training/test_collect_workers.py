"""Work by several processes: killed, dead and interrupted ones."""

from __future__ import annotations

import multiprocessing
import os
import signal
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import pytest
from support.faults.refusals import refusals

from mi_nerfattack.errors import InputError
from mi_nerfattack.system import workers
from mi_nerfattack.system.workers import AbstractWork, Processes

SCRIPT = """
import pathlib, time
if __name__ == "__mp_main__" and {starting}:  # what a process imports before it works
    pathlib.Path("started").touch()
    time.sleep(60)

from tests.training.test_collect_workers import Piece
from mi_nerfattack.system.workers import Processes

if __name__ == "__main__":
    try:
        Processes(2).run(Piece(None, waits=True), range(2), print)
    except KeyboardInterrupt:
        print("interrupted")
"""
PIPES = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}


@dataclass(frozen=True)
class Piece(AbstractWork):
    """Ends its process at piece 2, or raises there; or waits, and says so by a file."""

    code: int | None
    waits: bool = False

    def open(self):
        return self.code

    def do(self, opened, index, report):
        report(1)
        if self.waits:
            Path(f"started_{os.getpid()}").touch()
            while not Path("go").exists():
                time.sleep(0.01)
        if index == 2 and opened is not None:
            os.kill(os.getpid(), opened)
        if index == 2:
            raise InputError("piece two: is wrong; take another")

    def close(self, opened):
        pass


def started(folder: Path, starting: bool, count: int) -> subprocess.Popen:
    """Run the script until so many of its processes have begun."""
    (folder / "run.py").write_text(SCRIPT.format(starting=starting))
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    command = [sys.executable, "run.py"]
    process = subprocess.Popen(
        command, cwd=folder, env=environment, start_new_session=True, **PIPES
    )
    deadline = time.monotonic() + 300
    while len(list(folder.glob("started*"))) < count and process.poll() is None:
        assert time.monotonic() < deadline
        time.sleep(0.01)
    return process


def is_alive(pid: int) -> bool:
    status = Path(f"/proc/{pid}/stat")
    return status.exists() and status.read_text().rpartition(")")[2].split()[0] != "Z"


@pytest.mark.skipif(not Path("/proc/self").exists(), reason="needs /proc")
def test_workers_of_a_killed_process_end(tmp_path):
    process = started(tmp_path, starting=False, count=2)
    process.kill()
    (tmp_path / "go").touch()
    process.communicate(timeout=30)
    pids = [int(path.name.partition("_")[2]) for path in tmp_path.glob("started_*")]
    deadline = time.monotonic() + 30
    assert len(pids) == 2
    while any(is_alive(pid) for pid in pids):  # they notice that it has gone
        assert time.monotonic() < deadline
        time.sleep(0.05)


@pytest.mark.skipif(os.name == "nt", reason="needs process groups")
def test_ctrl_c_while_workers_start_is_told_once(tmp_path):
    """A terminal sends it to all processes."""
    process = started(tmp_path, starting=True, count=1)
    time.sleep(0.2)
    os.killpg(process.pid, signal.SIGINT)
    assert process.communicate(timeout=30) == ("interrupted\n", "")


@pytest.mark.parametrize(
    ("code", "count", "message"),
    [(signal.SIGKILL, 2, "signal 9 in piece 2"), (None, 1, "piece two: is wrong")],
)
def test_a_dead_worker_is_told_in_a_line_and_leaves_no_other(
    code, count, message, capfd
):
    with pytest.raises(InputError, match=message) as end:
        Processes(count).run(Piece(code), range(8), lambda units: None)
    assert "\n" not in str(end.value) and capfd.readouterr() == ("", "")
    assert not multiprocessing.active_children()


def test_too_little_memory_of_a_worker_is_told_in_a_line():
    report = workers._failed(MemoryError("249 TiB"))  # by the worker
    error = workers.failure(2, report)
    assert isinstance(error, InputError) and "\n" not in str(error)
    assert "249 TiB" in str(error) and "workers" in error.remedy


test_number_of_workers_is_checked = refusals(
    *((lambda count=count: Processes(count), "workers") for count in (0, 1000, 1.5))
)


def test_a_large_machine_has_as_many_workers_as_are_allowed(monkeypatch):
    monkeypatch.setattr(workers, "cores", lambda: 384)
    assert Processes().count == 256


def test_work_goes_on_without_a_piece_that_fails():
    """With a new process in the place of the one that died with it."""
    ended = {}
    Processes(1, pieces_each=2).run(
        Piece(signal.SIGKILL), range(4), lambda units: None, ended.__setitem__
    )
    assert list(ended) == [0, 1, 2, 3]
    assert "signal 9 in piece 2" in str(ended.pop(2))
    assert set(ended.values()) == {None} and not multiprocessing.active_children()
