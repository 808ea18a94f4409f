"""Waiting for what another thread or process does."""

from __future__ import annotations

import time
from collections.abc import Callable


def wait_for(found: Callable[[], object]) -> None:
    """Wait until something holds; fails after a time that nothing here takes."""
    end = time.monotonic() + 60
    while not found():
        assert time.monotonic() < end
        time.sleep(0.002)
