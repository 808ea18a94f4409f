"""Numbered pieces of work, done here or by several processes.

We do not use `concurrent.futures` because it lacks three things:

- It does not report how far a piece is.
- It does not end its processes with the process that started them (SIGKILL included).
- When a process dies, it does not say which piece this process was at.
"""

from __future__ import annotations

import multiprocessing
import signal
import sys
import traceback
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from multiprocessing.connection import Connection, wait
from typing import Any

from mi_nerfattack.errors import (
    InputError,
    NerfAttackError,
    RefusedError,
    is_interrupt,
)
from mi_nerfattack.system.machine import cores
from mi_nerfattack.system.processes import blocked_interrupts, safe_path

#: Most processes.
MOST = 256
#: Called with units of work that were just done.
OnUnits = Callable[[int], None]
#: Called with a piece that has ended, and why it failed; None where it is done.
OnEnd = Callable[[int, Exception | None], None]


#: What became of a piece, as one process tells another: "done"; "error" or "refused"
#: and a message; or "bug" and a traceback.
Outcome = tuple[str, str]


def tally(progress: Callable[[int, int], None], done: int, total: int) -> OnUnits:
    """Return what adds units of work to those that are done, and reports the sum.

    Args:
        progress: called with units done and wanted.
        done: units, before.
        total: units wanted.
    """

    def count(units: int) -> None:
        nonlocal done
        done += units
        progress(done, total)

    return count


def raise_failure(piece: int, error: Exception | None) -> None:
    """End all work with the first piece that fails."""
    del piece
    if error is not None:
        raise error


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


def do_alone(work: AbstractWork, index: int) -> Outcome:
    """Do one piece in a process that does nothing else, and return the outcome."""
    _use_one_thread()
    try:
        opened = work.open()
        try:
            work.do(opened, index, lambda units: None)
        finally:
            work.close(opened)
    except Exception as error:
        return _failed(error)
    return "done", ""


def failure(piece: int, outcome: Outcome) -> Exception | None:
    """Return the error of a piece from another process; None if the piece is done."""
    kind, text = outcome
    if kind in ("error", "refused"):
        return (InputError if kind == "error" else RefusedError)(text)
    return RuntimeError(f"piece {piece} failed:\n{text}") if kind == "bug" else None


class AbstractWorkers(ABC):
    """Who does the work."""

    def run(
        self,
        work: AbstractWork,
        pieces: Sequence[int],
        report: OnUnits,
        on_end: OnEnd = raise_failure,
    ) -> None:
        """Do all pieces.

        Args:
            work: see there.
            pieces: indices; each is done once, in any order.
            report: called in this process with units of work as they are done, where
                workers report them; an exception from it ends the work.
            on_end: called in this process with each piece that has ended; an exception
                from it ends the work. By default it raises the error of a piece. The
                error is an InputError from the piece, or of a worker that ended while
                it did the piece; or it is a RuntimeError.
        """
        if pieces:
            self._do(work, pieces, report, on_end)

    @abstractmethod
    def _do(
        self, work: AbstractWork, pieces: Sequence[int], report: OnUnits, on_end: OnEnd
    ) -> None:
        """See :meth:`run`; there are pieces."""


@dataclass(frozen=True)
class InThisProcess(AbstractWorkers):
    """One piece after the other, without a process of its own."""

    def _do(
        self, work: AbstractWork, pieces: Sequence[int], report: OnUnits, on_end: OnEnd
    ) -> None:
        opened = work.open()
        try:
            for index in pieces:
                try:
                    work.do(opened, index, report)
                except Exception as error:
                    if is_interrupt(error):
                        raise
                    on_end(index, error)
                else:
                    on_end(index, None)
        finally:
            work.close(opened)


@dataclass(frozen=True)
class Processes(AbstractWorkers):
    """Several processes with one thread each for rendering and one for torch.

    A process takes the next piece when it has finished one. A new process replaces a
    process that died or failed. All of them end with this process, however it ends.

    Args:
        count: 1 to `MOST`.
        pieces_each: that a process does before a new one takes its place; None: any
            number.
    """

    count: int = field(default_factory=lambda: available_cores())
    pieces_each: int | None = None

    def __post_init__(self) -> None:
        if not isinstance(self.count, int) or not 1 <= self.count <= MOST:
            raise InputError(f"workers: {self.count!r}; 1 to {MOST}")

    def _do(
        self, work: AbstractWork, pieces: Sequence[int], report: OnUnits, on_end: OnEnd
    ) -> None:
        team: list[_Member] = []
        left = list(reversed(pieces))
        try:
            while left or team:
                while left and len(team) < self.count:
                    team.append(_Member(work))
                    team[-1].give(left.pop())
                busy = {member.connection: member for member in team}
                for connection in wait(list(busy)):
                    member = busy[connection]  # pyright: ignore[reportArgumentType]
                    kind, value = member.hear()
                    if kind == "units":
                        report(value)
                        continue
                    piece = member.piece
                    if kind == "done" and left and member.done != self.pieces_each:
                        member.give(left.pop())
                    else:
                        team.remove(member)
                        member.stop(kind == "done")
                    on_end(piece, None if kind == "done" else value)
        finally:
            for member in team:
                member.stop()


class _Member:
    """One process, as its employer sees it."""

    def __init__(self, work: AbstractWork) -> None:
        context = multiprocessing.get_context("spawn")  # Dr.Jit is not fork-safe
        self.connection, theirs = context.Pipe()
        self.piece, self.done = 0, 0
        arguments = work, theirs, _variant()
        self._process = context.Process(target=_serve, args=arguments, daemon=True)
        with safe_path(), blocked_interrupts():
            self._process.start()
        theirs.close()  # so that its end is noticed

    def give(self, piece: int | None) -> None:
        """Hand over a piece, or that there are none left."""
        self.piece = self.piece if piece is None else piece
        with suppress(OSError):  # it has ended, which is heard
            self.connection.send(piece)

    def hear(self) -> tuple[str, Any]:
        """Return the next message: units, done, or failed with the error."""
        try:
            kind, value = self.connection.recv()
        except (EOFError, OSError):
            return "failed", self._end()
        self.done += kind == "done"
        error = failure(self.piece, (kind, value))
        return (kind, value) if error is None else ("failed", error)

    def stop(self, idle: bool = False) -> None:
        """End the process: at once, unless it has nothing to do."""
        if idle:
            self.give(None)
            self._process.join(10)
        if self._process.is_alive():
            self._process.kill()
            self._process.join()
        self.connection.close()

    def _end(self) -> InputError:
        self._process.join(10)
        code = self._process.exitcode
        ending = (
            f"signal {-code}" if code is not None and code < 0 else f"exit code {code}"
        )
        memory = "; it may have run out of memory: use fewer workers" * (code == -9)
        return InputError(
            f"a worker process ended by {ending} in piece {self.piece}{memory}; "
            "finished pieces are kept, the same command continues"
        )


def chosen_workers(count: int | None, alone: bool) -> AbstractWorkers:
    """Return who does the work of a command.

    Args:
        count: number of processes, as ``--workers`` says; 1 works in this process.
            None for one process per core.
        alone: whether None means 1.
    """
    default = 1 if alone else available_cores()
    count = default if count is None else count
    return InThisProcess() if count == 1 else Processes(count)


def available_cores() -> int:
    """Return the number of cores that this process may use, at most `MOST`."""
    return min(cores(), MOST)


def _variant() -> str | None:
    """Return Mitsuba's active variant, without importing Mitsuba."""
    mitsuba = sys.modules.get("mitsuba")
    return None if mitsuba is None else mitsuba.variant()


def _serve(work: AbstractWork, connection: Connection, variant: str | None) -> None:
    """Do pieces until there are no more; runs in a process of its own.

    Args:
        work: whose pieces.
        connection: to the process that hands them over.
        variant: of Mitsuba, there.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the employer decides
    try:
        if variant is not None:
            import mitsuba

            mitsuba.set_variant(variant)
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
    except Exception as error:
        with suppress(OSError):  # nobody listens
            connection.send(_failed(error))


def _use_one_thread() -> None:
    """Set up Dr.Jit and torch so that a process keeps to one core."""
    from mi_nerfattack import variant

    variant.ensure()
    import drjit as dr
    import torch

    dr.set_thread_count(1)
    torch.set_num_threads(1)


def _failed(error: Exception) -> Outcome:
    if isinstance(error, NerfAttackError):
        return "refused" if isinstance(error, RefusedError) else "error", str(error)
    if isinstance(error, MemoryError):
        why = f": {error}" * bool(str(error))
        return "error", (
            f"a worker process had not enough memory{why}; use fewer workers, finished "
            "pieces are kept"
        )
    return "bug", "".join(traceback.format_exception(error))
