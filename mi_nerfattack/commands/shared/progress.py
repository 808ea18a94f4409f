"""Progress: bars of commands with several stages, and a ready bar for Python calls."""

from __future__ import annotations

import html
import shutil
import sys
import time
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from types import TracebackType
from typing import TYPE_CHECKING, Any, overload

from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeRemainingColumn

from mi_nerfattack.commands.shared.terminal import console

if TYPE_CHECKING:
    from mi_nerfattack.fit.options import FitProgress

_PLAIN_EVERY_S = 15.0
_EVERY_S = 0.2  # a ready bar is drawn
_CELLS = 24  # of it, in a terminal
_SPEED_OVER_S = 86_400.0  # a frame can take minutes


class StageBars:
    """A bar a stage on standard error in a terminal; elsewhere a line now and then.

    Args:
        started: `time.perf_counter()` from which the printed seconds count.
    """

    def __init__(self, started: float | None = None) -> None:
        self._console = console(stderr=True)
        self._bars = Progress(
            TextColumn("{task.description}", markup=False),
            BarColumn(),
            TextColumn("{task.fields[state]}", markup=False),
            TimeRemainingColumn(),
            console=self._console,
            speed_estimate_period=_SPEED_OVER_S,
            disable=not self._console.is_terminal,
        )
        self._tasks: dict[str, TaskID] = {}
        self._start = time.perf_counter() if started is None else started
        self._printed = float("-inf")

    def __enter__(self) -> StageBars:
        self._bars.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._bars.stop()

    def say(self, text: str) -> None:
        """Write a line above the bars."""
        self._console.print(text, highlight=False, soft_wrap=True)

    def counter(self, stage: str, unit: str = "") -> Callable[[int, int], None]:
        """Return a function of units done and all units that shows a stage."""
        return lambda done, total: self.show(
            stage, done, total, f"{unit}{done}/{total}"
        )

    def show(
        self, stage: str, done: float, total: float, state: str, resumed: bool = False
    ) -> None:
        """Show how far a stage is, and how long it will take.

        Args:
            stage: name of the stage; the first call with a name adds a bar.
            done: units of work done.
            total: units of the whole stage.
            state: text next to the bar.
            resumed: whether these units were done before, so that their time says
                nothing about the other units.
        """
        if stage not in self._tasks:
            self._tasks[stage] = self._bars.add_task(stage, total=total, state=state)
        number = self._tasks[stage]
        if resumed:
            self._bars.reset(number)
        self._bars.update(number, completed=done, state=state)
        now, task = time.perf_counter(), self._bars.tasks[number]
        is_due = task.finished or now - self._printed >= _PLAIN_EVERY_S
        if is_due and not self._console.is_terminal:
            self._printed = now
            text = f"{now - self._start:6.0f} s  {stage}: {state}"
            if task.time_remaining:
                text += f"  {TimeRemainingColumn().render(task)} left"
            self._console.print(text, highlight=False, soft_wrap=True)


@dataclass(frozen=True)
class _State:
    """How far a stage is.

    Attributes:
        stage: its name.
        done: units of work.
        total: units of the whole stage, where that is known.
        remark: what else was reported.
        first: units that were done when the stage was first reported.
        elapsed_s: since then.
    """

    stage: str
    done: float
    total: float | None
    remark: str
    first: float
    elapsed_s: float

    @property
    def share(self) -> float:
        return min(1.0, self.done / self.total) if self.total else 0.0

    def text(self) -> str:
        """Return count, time and remark, without the stage."""
        count = ""
        if not isinstance(self.done, float):
            count = str(self.done) + ("" if self.total is None else f"/{self.total}")
        clock = _clock(self.elapsed_s)
        if self.total is not None and self.first < self.done < self.total:
            period_s = self.elapsed_s / (self.done - self.first)
            clock = f"{_clock(period_s * (self.total - self.done))} left"
        return "  ".join(filter(None, (count, clock, self.remark)))


class _Display(ABC):
    """Where a bar is drawn."""

    @abstractmethod
    def show(self, state: _State, over: bool) -> None:
        """Draw the bar over its former state; `over`: the next one goes below it."""


class _Terminal(_Display):
    """One line of standard error, written again and again."""

    def __init__(self) -> None:
        self._width = 0

    def show(self, state: _State, over: bool) -> None:
        full = round(_CELLS * state.share)
        bar = "#" * full + "." * (_CELLS - full)
        line = f"{state.stage} [{bar}] {state.text()}"
        line = line[: shutil.get_terminal_size().columns - 1]  # or it would wrap
        end = "\n" if over else ""
        print(f"\r{line:{self._width}}", end=end, file=sys.stderr, flush=True)
        self._width = 0 if over else len(line)


class _Notebook(_Display):
    """An HTML element of the cell's output."""

    def __init__(self) -> None:
        self._display = import_module("IPython.display")  # the notebook brings it
        self._handle: Any = None

    def show(self, state: _State, over: bool) -> None:
        stage, text = html.escape(state.stage), html.escape(state.text())
        bar = f'<progress max="1" value="{state.share:.4f}"></progress>'
        element = self._display.HTML(f"<div>{stage} {bar} {text}</div>")
        if self._handle is None:
            self._handle = self._display.display(element, display_id=True)
        else:
            self._handle.update(element)
        if over:
            self._handle = None


class _Log(_Display):
    """A line now and then, where standard error is a file."""

    def __init__(self) -> None:
        self._started = time.perf_counter()
        self._lines = StageBars(self._started)

    def show(self, state: _State, over: bool) -> None:
        total = state.total or float("inf")
        self._lines.show(state.stage, state.done, total, state.text())
        if over:
            self._lines = StageBars(self._started)


class ProgressBar:
    """A function that shows how far a long call is; give it as `progress` or `on_step`.

    Unlike `StageBars` it has no thread and hides no cursor, so nothing must be stopped
    where the call fails.

    One object serves one call after the other. It understands what these functions
    report:

    - ``on_step(step)``: each call is one unit, whatever `step` is;
    - ``progress(done, total)``;
    - ``progress(stage, done, total, remark)``, one bar after the other;
    - the `FitProgress` of `fit.fit_grid` and of its relatives.

    Args:
        total: units of all, for `on_step`, which does not report it.
        stage: name of the bar, where the function reports none.
    """

    def __init__(self, total: int | None, stage: str) -> None:
        self._total, self._stage = total, stage
        out = console(stderr=True)
        kinds = {out.is_jupyter: _Notebook, out.is_terminal: _Terminal}
        self._display: _Display = kinds.get(True, _Log)()
        self._current: str | None = None
        self._steps = 0
        self._first = self._start = self._shown = 0.0

    @overload
    def __call__(self, step: int, /) -> None: ...
    @overload
    def __call__(self, fit: FitProgress, /) -> None: ...
    @overload
    def __call__(self, done: int, total: int, /) -> None: ...
    @overload
    def __call__(self, stage: str, done: int, total: int, remark: str, /) -> None: ...
    def __call__(self, *report: Any) -> None:
        """Show what was reported, at most five times a second, and the end."""
        match report:
            case (int(),):
                self._show(self._stage, self._steps + 1, self._total, "")
            case (fit,):
                psnr = f"loss {fit.loss:.4f}  PSNR {fit.psnr_db:.2f} dB"
                self._show("fitting", fit.fraction, 1.0, f"step {fit.step}  {psnr}")
            case (done, total):
                self._show(self._stage, done, total, "")
            case (stage, done, total, remark):
                self._show(stage, done, total, remark)
            case _:
                raise TypeError(f"progress: {len(report)} arguments; see ProgressBar")

    def _show(self, stage: str, done: float, total: float | None, remark: str) -> None:
        now = time.perf_counter()
        if stage != self._current:
            self._current, self._first = stage, done
            self._start, self._shown = now, float("-inf")
        self._steps = int(done)
        over = total is not None and done >= total
        if over or now - self._shown >= _EVERY_S:
            self._shown = now
            state = _State(
                stage,
                done,
                total,
                remark=remark,
                first=self._first,
                elapsed_s=now - self._start,
            )
            self._display.show(state, over)
        if over:
            self._current, self._steps = None, 0


def progress(total: int | None = None, stage: str = "steps") -> ProgressBar:
    """Make a progress bar for a terminal, a notebook or a log file.

    Args:
        total: calls until the end, for `on_step`: the horizon of a drive. Functions
            that report a total need none.
        stage: name of the bar, where the function reports none.

    Returns:
        what the argument `progress` or `on_step` of another function takes.
    """
    return ProgressBar(total, stage)


def _clock(seconds: float) -> str:
    minutes, remainder_s = divmod(round(seconds), 60)
    return f"{minutes}:{remainder_s:02d}"
