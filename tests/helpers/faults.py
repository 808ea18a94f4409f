"""Disks that are full, processes that are killed, and signals, where a test says."""

from __future__ import annotations

import errno
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path

import pytest

from mi_nerfattack.commands.shared.progress import StageBars


@contextmanager
def full_disk(name: str, at: int = 1) -> Iterator[None]:
    """Let the disk be full from the first byte of a file on.

    Args:
        name: of the file begins so.
        at: which file of such a name it is, from 1.
    """
    found: set[int] = set()
    left, is_full = at, False
    opened, written = os.open, os.write

    def open_(path, *rest, **more) -> int:
        descriptor = opened(path, *rest, **more)
        found.discard(descriptor)
        if Path(os.fsdecode(path)).name.startswith(f".{name}"):  # while it is written
            found.add(descriptor)
        return descriptor

    def write(descriptor: int, data) -> int:
        nonlocal left, is_full
        left -= descriptor in found
        found.discard(descriptor)
        is_full = is_full or left == 0
        if is_full:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return written(descriptor, data)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "open", open_)
        patch.setattr(os, "write", write)
        yield
    assert is_full


def kill(
    words: Sequence[object], cwd: Path, name: str, at: int = 1, setup: str = ""
) -> None:
    """Run a command in a process that is killed when a file is to get its name.

    What was written of it lies beside it then, under a hidden name.

    Args:
        words: of the command.
        cwd: it works there.
        name: the file's begins so.
        at: which file of such a name it is, from 1.
        setup: what else the process does, before.
    """
    code = f"""
import os, signal, sys
sys.path[:] = {sys.path!r}
from pathlib import Path
replace, left = os.replace, {at}
def stop(source, target):
    global left
    left -= Path(target).name.startswith({name!r})
    if left == 0:
        os.kill(os.getpid(), signal.SIGKILL)
    replace(source, target)
os.replace = stop
{setup}
from mi_nerfattack.cli import main
main({[str(word) for word in words]!r})
"""
    command = [sys.executable, "-c", code]
    done = subprocess.run(command, cwd=cwd, capture_output=True, text=True)
    assert done.returncode == -signal.SIGKILL, done.stderr


def signalled(stage: str, number: int, at: int = 1) -> AbstractContextManager[None]:
    """Send a signal to this process when a stage of a command has got on."""
    return disturbed(stage, lambda: signal.raise_signal(number), at)


def short_of_memory(stage: str, at: int = 1) -> AbstractContextManager[None]:
    """Let there be too little memory when a stage of a command has got on."""

    def fail() -> None:
        raise MemoryError("249 TiB")

    return disturbed(stage, fail, at)


@contextmanager
def disturbed(stage: str, disturb: Callable[[], None], at: int) -> Iterator[None]:
    """Do something when a stage of a command has got on.

    Args:
        stage: its bar's name.
        disturb: what.
        at: how often the bar has been drawn.
    """
    show, left = StageBars.show, at

    def send(self, name, *state, **more) -> None:
        nonlocal left
        show(self, name, *state, **more)
        left -= name == stage
        if left == 0:
            disturb()

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(StageBars, "show", send)
        yield
    assert left <= 0
