"""Starting Python processes that import what this one imports.

Python looks for modules in the working folder first when it starts with ``-m`` or
``-c``, so that a user's `queue.py` there would take the place of its own.
"""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from multiprocessing import resource_tracker

_VARIABLE = "PYTHONSAFEPATH"


def module_command(module: str) -> list[str]:
    """Return the command that runs a module, found as this process finds modules."""
    code = (
        f"import sys; sys.path[:] = {sys.path!r}; import runpy; "
        f"runpy.run_module({module!r}, run_name='__main__', alter_sys=True)"
    )
    return [sys.executable, "-c", code]


@contextmanager
def safe_path() -> Iterator[None]:
    """Let what `multiprocessing` starts meanwhile not look into the working folder.

    Python 3.10 does so all the same.
    """
    before = os.environ.get(_VARIABLE)
    os.environ[_VARIABLE] = "1"
    try:
        yield
    finally:
        if before is None:
            del os.environ[_VARIABLE]
        else:
            os.environ[_VARIABLE] = before


@contextmanager
def blocked_interrupts() -> Iterator[None]:
    """Keep Ctrl-C, which a terminal sends to all, from processes that start here.

    They inherit the mask; else it would end them, with a traceback each, in the seconds
    until they ignore it.
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
