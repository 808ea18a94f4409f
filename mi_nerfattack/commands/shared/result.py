"""What a command that prints figures returns: one way of ``--json`` for all."""

from __future__ import annotations

import contextlib
import ctypes
import json
import os
import sys
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Result:
    """Figures, for programs and for people; the command line prints one of both.

    Args:
        document: the figures as JSON holds them; finite numbers alone.
        show: prints them for people.
        code: the exit code.
    """

    document: Mapping[str, Any]
    show: Callable[[], object]
    code: int = 0

    def tell(self, as_json: bool) -> int:
        """Print, one line of strict JSON if so, and return the exit code."""
        if as_json:
            print(json.dumps(self.document, allow_nan=False))
        else:
            self.show()
        return self.code


@contextlib.contextmanager
def stdout_to_stderr() -> Iterator[None]:
    """Send to standard error what is printed meanwhile, by native libraries too.

    Mitsuba's log, for one, goes to standard output past Python.
    """
    if sys.stdout is None or sys.stderr is None:  # closed before we started
        yield
        return
    kept = os.dup(1)
    try:
        os.dup2(2, 1)
        with contextlib.redirect_stdout(sys.stderr):
            yield
    finally:
        if os.name == "posix":
            ctypes.pythonapi.fflush(None)  # what C has not written yet
        os.dup2(kept, 1)
        os.close(kept)
