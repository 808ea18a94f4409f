"""Full disks, killed processes, signals, modes for root, dead ports, and waiting."""

from __future__ import annotations

import ctypes
import errno
import os
import re
import shutil
import signal
import socket
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import pytest

from mi_nerfattack.commands.shared.progress import StageBars
from mi_nerfattack.io import files


class Killed(BaseException):
    """Ends what a test runs, as SIGKILL ends a process."""


@dataclass
class Watch:
    """What a command writes and shows, and a fault that it meets there.

    Attributes:
        fault: called once, at the place; what it raises goes through the command. None
            only counts.
        place: the kind of file, or the stage, where the fault is.
        at: which drawing of the stage it is, from 1; of a file it is the first one.
        share: of the file's bytes that are written before.
        lasts: every later write meets the fault too, as on a full disk.
        files: kinds of files by how many were begun.
        stages: stages by how often their bars were drawn.
        met: whether the fault has come.
    """

    fault: Callable[[], None] | None = None
    place: str = ""
    at: int = 1
    share: float = 0.0
    lasts: bool = False
    files: dict[str, int] = field(default_factory=dict)
    stages: dict[str, int] = field(default_factory=dict)
    met: bool = False

    def meet(self) -> None:
        self.met = True
        if self.fault is not None:
            self.fault()

    @contextmanager
    def watching(self) -> Iterator[Watch]:
        """Watch this process; every file is written under a hidden name first."""
        new: dict[int, str] = {}
        opened, written, show = os.open, os.write, StageBars.show

        def open_(path, *arguments, **options) -> int:
            descriptor = opened(path, *arguments, **options)
            new.pop(descriptor, None)
            name = Path(os.fsdecode(path)).name
            if files.TEMPORARY.fullmatch(name):
                new[descriptor] = kind_of(name[1:-17])
            return descriptor

        def write(descriptor: int, data) -> int:
            kind = new.pop(descriptor, "")
            if kind:
                self.files[kind] = self.files.get(kind, 0) + 1
            if self.met and self.lasts:
                self.meet()
            if kind != self.place or not kind or self.met:
                return written(descriptor, data)
            done = written(descriptor, data[: int(self.share * len(data))])
            self.meet()
            return done

        def draw(bars, stage, *state, **options) -> None:
            show(bars, stage, *state, **options)
            self.stages[stage] = self.stages.get(stage, 0) + 1
            if stage == self.place and self.stages[stage] == self.at and not self.met:
                self.meet()

        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(os, "open", open_)
            patch.setattr(os, "write", write)
            patch.setattr(StageBars, "show", draw)
            yield self


def signalled(stage: str, number: int, at: int = 1) -> AbstractContextManager[None]:
    """Send a signal to this process when a stage of a command has got on."""
    return disturbed(stage, lambda: signal.raise_signal(number), at)


@contextmanager
def disturbed(stage: str, disturb: Callable[[], None], at: int) -> Iterator[None]:
    """Do something when the bar of a stage of a command has been drawn so often."""
    watch = Watch(disturb, stage, at)
    with watch.watching():
        yield
    assert watch.met


def kind_of(name: str) -> str:
    """Return a file's name without its numbers and digests."""
    return re.sub(r"[0-9a-f]{8,}|\d+", "#", name)


def copy_and_die(folder: Path, copy: Path) -> None:
    """Keep what a process that is killed now would leave in a folder, and end."""
    shutil.copytree(folder, copy, symlinks=True)
    raise Killed


def have_no_space() -> None:
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def have_no_memory() -> None:
    raise MemoryError("249 TiB")


_VERSION = 0x20080522  # of Linux's capget and capset
_OVERRIDING = 1 << 1 | 1 << 2  # CAP_DAC_OVERRIDE, CAP_DAC_READ_SEARCH


@contextmanager
def obeyed_modes() -> Iterator[None]:
    """Let modes hold for this thread, as they do for an ordinary user."""
    if os.geteuid() != 0:
        yield
        return
    if sys.platform != "linux":
        pytest.skip("root, whom no mode stops here")
    libc = ctypes.CDLL(None)
    header, held = (ctypes.c_uint32 * 2)(_VERSION, 0), (ctypes.c_uint32 * 6)()
    assert libc.capget(header, held) == 0
    fewer = (ctypes.c_uint32 * 6)(*held)
    fewer[0] &= ~_OVERRIDING
    assert libc.capset(header, fewer) == 0
    try:
        yield
    finally:
        assert libc.capset(header, held) == 0


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def wait_for(condition: Callable[[], object]) -> None:
    """Wait until something holds; fails after a time that nothing here takes."""
    end = time.monotonic() + 60
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.002)
