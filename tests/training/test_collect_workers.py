"""Collection by several processes, killed and continued."""

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
from helpers.roadside import PaintedSite, bent, small, straight

from mi_nerfattack.errors import InputError
from mi_nerfattack.system import workers
from mi_nerfattack.system.workers import AbstractWork, InThisProcess, Processes
from mi_nerfattack.training.collect import collect
from mi_nerfattack.training.settings import CollectSettings
from mi_nerfattack.training.sources import AbstractSource, Scattered

pytestmark = pytest.mark.usefixtures("variant")

SCRIPT = """
import mi_nerfattack
from pathlib import Path
from tests.training.test_collect_workers import Stopping, settings
from helpers.roadside import PaintedSite, bent, straight
from mi_nerfattack.training.collect import collect
from mi_nerfattack.system.workers import Processes

if __name__ == "__main__":
    folder, routes = Path({folder!r}), [straight(), bent()]
    collect(PaintedSite(), routes, Stopping(folder), settings(), folder, Processes(2))
"""


def settings() -> CollectSettings:
    return small(frames=96)


def shards(folder: Path) -> list[Path]:
    return list(folder.rglob("shard_*.safetensors"))


@dataclass(frozen=True)
class Stopping(AbstractSource):
    """Scattered states; with three shards there, a process waits before its next frame.

    It says so by a file of its own beside the folder, and goes on once there is `go`.
    """

    folder: Path

    def prepare(self):
        return Scattered().prepare()

    def frames(self, prepared, scenery):
        for labelled in Scattered().frames(prepared, scenery):
            if len(shards(self.folder)) >= 3:
                (self.folder.parent / f"waiting_{os.getpid()}").touch()
                while not (self.folder.parent / "go").exists():
                    time.sleep(0.01)
            yield labelled

    def describe(self):
        return Scattered().describe()


def contents(folder: Path) -> dict[str, bytes]:
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


def is_alive(pid: int) -> bool:
    status = Path(f"/proc/{pid}/stat")
    return status.exists() and status.read_text().rpartition(")")[2].split()[0] != "Z"


@pytest.mark.skipif(not Path("/proc/self").exists(), reason="needs /proc")
def test_killed_collection_continues_without_gaps_or_duplicates(tmp_path):
    routes = [straight(), bent()]
    whole, part = tmp_path / "whole", tmp_path / "part"
    collect(PaintedSite(), routes, Scattered(), settings(), whole, InThisProcess())
    script = tmp_path / "run.py"
    script.write_text(SCRIPT.format(folder=str(part)))
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    process = subprocess.Popen([sys.executable, str(script)], env=environment)
    deadline = time.monotonic() + 120
    while len(waiting := list(tmp_path.glob("waiting_*"))) < 2:
        assert time.monotonic() < deadline and process.poll() is None
        time.sleep(0.01)
    process.send_signal(signal.SIGKILL)
    process.wait()
    (tmp_path / "go").touch()
    pids = [int(path.name.removeprefix("waiting_")) for path in waiting]
    while any(is_alive(pid) for pid in pids):  # they notice that it has gone
        assert time.monotonic() < deadline
        time.sleep(0.05)
    assert len(shards(part)) in (3, 4)  # the other process may end its shard
    collect(PaintedSite(), routes, Scattered(), settings(), part, InThisProcess())
    assert contents(part) == contents(whole)


STARTING = """
if __name__ == "__mp_main__":  # what a process imports before it works
    import pathlib, time
    pathlib.Path("started").touch()
    time.sleep(60)

from tests.training.test_collect_workers import Piece
from mi_nerfattack.system.workers import Processes

if __name__ == "__main__":
    try:
        Processes(2).run(Piece(None), range(2), print)
    except KeyboardInterrupt:
        print("interrupted")
"""


@pytest.mark.skipif(os.name == "nt", reason="needs process groups")
def test_ctrl_c_while_workers_start_is_told_once(tmp_path):
    """A terminal sends it to all processes."""
    (tmp_path / "run.py").write_text(STARTING)
    process = subprocess.Popen(
        [sys.executable, "run.py"],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    deadline = time.monotonic() + 300
    while not (tmp_path / "started").exists() and process.poll() is None:
        assert time.monotonic() < deadline
        time.sleep(0.01)
    time.sleep(0.2)
    os.killpg(process.pid, signal.SIGINT)
    assert process.communicate(timeout=30) == ("interrupted\n", "")


@dataclass(frozen=True)
class Piece(AbstractWork):
    """Ends its process at piece 2, or raises there."""

    code: int | None

    def open(self):
        return self.code

    def do(self, opened, index, report):
        report(1)
        if index == 2 and opened is not None:
            os.kill(os.getpid(), opened)
        if index == 2:
            raise InputError("piece two: is wrong; take another")

    def close(self, opened):
        pass


def test_a_dead_worker_is_told_in_a_line_and_leaves_no_other(capfd):
    with pytest.raises(
        InputError, match=r"ended by signal 9 in piece 2; it may"
    ) as end:
        Processes(2).run(Piece(signal.SIGKILL), range(8), lambda units: None)
    assert "\n" not in str(end.value) and capfd.readouterr() == ("", "")
    assert not multiprocessing.active_children()


def test_an_error_in_a_worker_is_the_callers():
    with pytest.raises(InputError, match="piece two: is wrong"):
        Processes(1).run(Piece(None), range(8), lambda units: None)


def test_too_little_memory_of_a_worker_is_told_in_a_line():
    told = workers._failed(MemoryError("249 TiB"))  # by the worker
    error = workers.failure(2, told)
    assert isinstance(error, InputError) and "\n" not in str(error)
    assert "not enough memory: 249 TiB; use fewer workers" in str(error)


@pytest.mark.parametrize("count", [0, 1000, 1.5])
def test_number_of_workers_is_checked(count):
    with pytest.raises(InputError, match="workers"):
        Processes(count)


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
