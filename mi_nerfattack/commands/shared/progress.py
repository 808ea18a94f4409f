"""Progress of commands with several stages."""

from __future__ import annotations

import time
from collections.abc import Callable
from types import TracebackType

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeRemainingColumn

_PLAIN_EVERY_S = 15.0
_SPEED_OVER_S = 86_400.0  # a frame can take minutes


class StageBars:
    """A bar a stage on standard error in a terminal; elsewhere a line now and then.

    Args:
        started: `time.perf_counter()` from which the printed seconds count.
    """

    def __init__(self, started: float | None = None) -> None:
        self._console = Console(stderr=True)
        self._bars = Progress(
            TextColumn("{task.description}"),
            BarColumn(),
            TextColumn("{task.fields[state]}"),
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
        self._console.print(text, highlight=False, markup=False, soft_wrap=True)

    def counter(self, stage: str, unit: str = "") -> Callable[[int, int], None]:
        """Return a function of units done and all units that shows a stage."""
        return lambda done, total: self.show(
            stage, done, total, f"{unit}{done}/{total}"
        )

    def show(
        self, stage: str, done: float, total: float, state: str, kept: bool = False
    ) -> None:
        """Show how far a stage is, and how long it will take.

        Args:
            stage: its name; the first call with a name adds a bar.
            done: units of work done.
            total: units of the whole stage.
            state: what to write beside the bar.
            kept: these units were there already, and tell nothing about the others.
        """
        if stage not in self._tasks:
            self._tasks[stage] = self._bars.add_task(stage, total=total, state=state)
        number = self._tasks[stage]
        if kept:
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
