"""Starting Python processes that import what this one imports.

Python looks for modules in the working folder first when it starts with ``-m`` or
``-c``, so that a user's `queue.py` there would take the place of its own.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager

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
