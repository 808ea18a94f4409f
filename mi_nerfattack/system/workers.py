"""Numbered pieces of work, done here or by several processes.

Of our own because `concurrent.futures` neither hears how far a piece is, nor ends its
processes with the one that started them (SIGKILL included), nor tells which piece the
process was at that died.
"""

from __future__ import annotations

import multiprocessing
import signal
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection, wait
from typing import Any

from mi_nerfattack.errors import InputError
from mi_nerfattack.system.cores import cores
from mi_nerfattack.system.processes import safe_path

#: Most processes.
MOST = 256
#: Called with units of work that were just done.
OnUnits = Callable[[int], None]


class AbstractWork(ABC):
    """Work in pieces that do not depend on each other; must be picklable."""

    @abstractmethod
    def open(self) -> Any:
        """Load what all pieces need, once for each process."""

    @abstractmethod
    def do(self, opened: Any, index: int, report: OnUnits) -> None:
        """Do one piece and leave its result in a file.

        Args:
            opened: what `open` returned.
            index: of the piece.
            report: to be called now and then; an exception from it must pass.
        """

    @abstractmethod
    def close(self, opened: Any) -> None:
        """Let go of what `open` returned."""


class AbstractWorkers(ABC):
    """Who does the work."""

    @abstractmethod
    def run(self, work: AbstractWork, pieces: Sequence[int], report: OnUnits) -> None:
        """Do all pieces.

        Args:
            work: see there.
            pieces: indices; each is done once, in any order.
            report: called with units of work as they are done, here; an exception
                from it ends the work.

        Raises:
            InputError: from a piece; or a worker ended before its work.
        """


@dataclass(frozen=True)
class InThisProcess(AbstractWorkers):
    """One piece after the other, without a process of its own."""

    def run(self, work: AbstractWork, pieces: Sequence[int], report: OnUnits) -> None:
        """Do all pieces, in order."""
        if not pieces:
            return
        opened = work.open()
        try:
            for index in pieces:
                work.do(opened, index, report)
        finally:
            work.close(opened)


@dataclass(frozen=True)
class Processes(AbstractWorkers):
    """Several processes with one thread each for rendering and one for torch.

    A process takes the next piece when it is done with one. They end with this
    process, however it ends; when one of them ends early, so do the others.

    Args:
        count: 1 to `MOST`.
    """

    count: int = field(default_factory=lambda: available_cores())

    def __post_init__(self) -> None:
        if not isinstance(self.count, int) or not 1 <= self.count <= MOST:
            raise InputError(f"workers: {self.count!r}; 1 to {MOST}")

    def run(self, work: AbstractWork, pieces: Sequence[int], report: OnUnits) -> None:
        """Do all pieces."""
        team: list[_Member] = []
        left = list(reversed(pieces))
        try:
            for _ in range(min(self.count, len(pieces))):
                team.append(_Member(work))
                team[-1].give(left)
            while busy := {m.connection: m for m in team if m.piece is not None}:
                for connection in wait(list(busy)):
                    member = busy[connection]  # pyright: ignore[reportArgumentType]
                    kind, value = member.hear()
                    if kind == "units":
                        report(value)
                    elif kind == "error":
                        raise InputError(value)
                    elif kind == "bug":
                        raise RuntimeError(f"piece {member.piece} failed:\n{value}")
                    else:
                        member.give(left)
        finally:
            for member in team:
                member.stop()


class _Member:
    """One process, as its employer sees it."""

    def __init__(self, work: AbstractWork) -> None:
        context = multiprocessing.get_context("spawn")  # Dr.Jit is not fork-safe
        self.connection, theirs = context.Pipe()
        self.piece: int | None = None
        self._process = context.Process(target=_serve, args=(work, theirs), daemon=True)
        with safe_path(), _blocked_interrupts():
            self._process.start()
        theirs.close()  # so that its end is noticed

    def give(self, left: list[int]) -> None:
        """Hand over the last of the pieces that are left, or none."""
        self.piece = left.pop() if left else None
        try:
            self.connection.send(self.piece)
        except OSError:
            if self.piece is not None:
                self._report_end()

    def hear(self) -> tuple[str, Any]:
        """Return the next message."""
        try:
            return self.connection.recv()
        except (EOFError, OSError):
            self._report_end()
            raise AssertionError("not reached") from None

    def stop(self) -> None:
        """End the process: at once, unless it has nothing to do."""
        if self.piece is None:
            self._process.join(10)
        if self._process.is_alive():
            self._process.kill()
            self._process.join()
        self.connection.close()

    def _report_end(self) -> None:
        self._process.join(10)
        code = self._process.exitcode
        how = (
            f"signal {-code}" if code is not None and code < 0 else f"exit code {code}"
        )
        memory = "; it may have run out of memory: use fewer workers" * (code == -9)
        raise InputError(
            f"a worker process ended by {how} in piece {self.piece}{memory}; "
            "finished pieces are kept, the same command continues"
        ) from None


def available_cores() -> int:
    """Return the number of cores that this process may use, at most `MOST`."""
    return min(cores(), MOST)


@contextmanager
def _blocked_interrupts() -> Iterator[None]:
    """Keep Ctrl-C, which a terminal sends to all, from processes that start here.

    They inherit the mask; else it would end them, with a traceback each, in the seconds
    until `_serve` runs.
    """
    if not hasattr(signal, "pthread_sigmask"):  # not on Windows
        yield
        return
    resource_tracker.ensure_running()  # its start would unblock them
    before = signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT])
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _serve(work: AbstractWork, connection: Connection) -> None:
    """Do pieces until there are no more; runs in a process of its own."""
    import traceback

    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the employer decides
    try:
        _use_one_thread()
        opened = None
        while (piece := connection.recv()) is not None:
            opened = work.open() if opened is None else opened
            work.do(opened, piece, lambda units: connection.send(("units", units)))
            connection.send(("done", piece))
        if opened is not None:
            work.close(opened)
    except (EOFError, BrokenPipeError, ConnectionResetError):
        pass  # the employer is gone
    except InputError as error:
        _tell(connection, "error", str(error))
    except Exception:
        _tell(connection, "bug", traceback.format_exc())


def _use_one_thread() -> None:
    """Set up Dr.Jit and torch so that a process keeps to one core."""
    from mi_nerfattack import variant

    variant.ensure()
    import drjit as dr
    import torch

    dr.set_thread_count(1)
    torch.set_num_threads(1)


def _tell(connection: Connection, kind: str, text: str) -> None:
    try:
        connection.send((kind, text))
    except OSError:
        pass  # nobody listens
