"""What commands print and ask: text, figures as JSON, questions."""

from __future__ import annotations

import contextlib
import ctypes
import json
import os
import sys
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from mi_nerfattack.errors import InputError

if TYPE_CHECKING:
    from rich.console import Console


def console(stderr: bool = False) -> Console:
    """Return the terminal, for text and tables in which brackets mean themselves."""
    from rich.console import Console  # slow to import

    return Console(stderr=stderr, markup=False)


def say(text: str) -> None:
    """Show a line at once, through a pipe, too."""
    print(text, flush=True)


def ask(question: str) -> str:
    """Return the answer to a question, without spaces around it.

    Raises:
        InputError: nobody can answer.
    """
    try:
        return input(f"{question}: ").strip()
    except EOFError as err:
        raise InputError(f"{question}: nobody answers; run it in a terminal") from err


def confirm(question: str) -> bool:
    """Ask whether something may be done; no, unless it is said."""
    return ask(f"{question} [y/N]").lower() in ("y", "yes")


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
    saved_stdout = os.dup(1)
    try:
        os.dup2(2, 1)
        with contextlib.redirect_stdout(sys.stderr):
            yield
    finally:
        if os.name == "posix":
            ctypes.pythonapi.fflush(None)  # what C has not written yet
        os.dup2(saved_stdout, 1)
        os.close(saved_stdout)
