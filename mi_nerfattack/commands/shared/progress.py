"""Progress of commands with several stages."""

from __future__ import annotations

import time
from types import TracebackType

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeRemainingColumn

_PLAIN_EVERY_S = 15.0


class StageBars:
    """A bar a stage on standard error in a terminal; elsewhere a line now and then."""

    def __init__(self) -> None:
        self._console = Console(stderr=True)
        self._bars = Progress(
            TextColumn("{task.description}"),
            BarColumn(),
            TextColumn("{task.fields[state]}"),
            TimeRemainingColumn(),
            console=self._console,
        )
        self._tasks: dict[str, TaskID] = {}
        self._start, self._printed = time.monotonic(), 0.0

    def __enter__(self) -> StageBars:
        if self._console.is_terminal:
            self._bars.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if self._console.is_terminal:
            self._bars.stop()

    def say(self, text: str) -> None:
        """Write a line above the bars."""
        self._console.print(text, highlight=False, markup=False, soft_wrap=True)

    def show(self, stage: str, done: float, total: float, state: str) -> None:
        """Show how far a stage is.

        Args:
            stage: its name; the first call with a name adds a bar.
            done: units of work done.
            total: units of the whole stage.
            state: what to write beside the bar.
        """
        if self._console.is_terminal:
            if stage not in self._tasks:
                self._tasks[stage] = self._bars.add_task(stage, total=total, state="")
            self._bars.update(self._tasks[stage], completed=done, state=state)
            return
        now = time.monotonic()
        if done >= total or now - self._printed >= _PLAIN_EVERY_S:
            self._printed = now
            text = f"{now - self._start:6.0f} s  {stage}: {state}"
            self._console.print(text, highlight=False, soft_wrap=True)
