"""Starting pycolmap's process and following what it says."""

from __future__ import annotations

import contextlib
import json
import re
import signal
import subprocess
from collections import deque
from collections.abc import Callable, Iterable
from typing import Any

from mi_nerfattack.capture.colmap.process import MARK
from mi_nerfattack.errors import SetupError
from mi_nerfattack.system.processes import module_command

StageCallback = Callable[[str, int, int], None]

_CHILD = "mi_nerfattack.capture.colmap.process"
_LAST_LINES = 5
# COLMAP's log: "Processed file [3/12]", "Processing image [3/12]" or, of squares of
# pairs, "Processing block [1/2, 2/2]"
_COUNT = re.compile(r"Process\w+ (file|image|block) \[(\d+)/(\d+)(?:, (\d+)/(\d+))?\]")


def run_task(task: dict[str, Any], stages: Stages) -> int:
    """Return the exit code of the process that does a task.

    It is ended when the callback of `stages` raises.

    Raises:
        SetupError: pycolmap is not installed.
    """
    process = subprocess.Popen(
        module_command(_CHILD),
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        encoding="utf-8",
        errors="replace",
        start_new_session=True,  # Ctrl-C is for us; we end it
    )
    assert process.stdin is not None and process.stdout is not None
    with process:
        try:
            with contextlib.suppress(BrokenPipeError):  # its last lines say why
                process.stdin.write(json.dumps(task) + "\n")
                process.stdin.flush()
            stages.follow(process.stdout)
            code = process.wait()
        except BaseException:
            process.kill()
            raise
    if stages.missing is not None:
        raise SetupError(stages.missing)
    return code


class Stages:
    """Reads what the process says, and reports its progress."""

    def __init__(self, progress: StageCallback) -> None:
        self.missing: str | None = None
        self._progress = progress
        self.name, self._total, self._part = "start", 0, (0, 0)
        self._last: deque[str] = deque(maxlen=_LAST_LINES)

    def follow(self, lines: Iterable[str]) -> None:
        """Read lines until there are no more."""
        for line in lines:
            if line.startswith(MARK):
                self._on_message(json.loads(line[len(MARK) :]))
            else:
                self._logged(line)

    def _on_message(self, what: dict[str, Any]) -> None:
        self.missing = what.get("missing")
        if "stage" in what:
            self.end()
            self.name, self._total = what["stage"], what["total"]
            self._part = 0, self._total
            self._show(0)
        if "part" in what:
            self._part = what["part"]
        if "done" in what:
            self._show(what["done"])

    def _logged(self, line: str) -> None:
        if line.strip():
            self._last.append(line.strip())
        count = _COUNT.search(line)
        if count is None:
            return
        kind, *numbers = count.groups()
        i, n, j, m = (1 if number is None else int(number) for number in numbers)
        # a file's line comes when it is done, the others when they begin
        done = (i - 1) * m + j - (kind != "file")
        start, count = self._part
        self._show(start + count * done // (n * m))

    def _show(self, done: int) -> None:
        self._progress(self.name, min(done, self._total - 1), self._total)

    def end(self) -> None:
        """Report that the stage is done."""
        if self._total:
            self._progress(self.name, self._total, self._total)

    def ending(self, code: int) -> str:
        """Tell how the process ended, from its exit code, and what it said last."""
        outcome = f"ended with code {code}"
        if code < 0:
            with contextlib.suppress(ValueError):
                outcome = f"was ended by {signal.Signals(-code).name}"
        last = "; ".join(self._last) or "nothing"
        return f"pycolmap {outcome} at the stage {self.name!r} (its last lines: {last})"
