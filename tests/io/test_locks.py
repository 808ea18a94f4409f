"""Folders that one process at a time works in."""

from __future__ import annotations

from threading import Event, Thread

import pytest

from mi_nerfattack.errors import InputError
from mi_nerfattack.io import locks


def test_a_second_worker_is_refused_or_waits(tmp_path):
    happened, waiting = [], Event()

    def wait():
        waiting.set()
        locks.wait_for(tmp_path)
        happened.append("waited")

    thread = Thread(target=wait)
    with locks.exclusive(tmp_path):
        with pytest.raises(InputError, match="another process works in it"):
            with locks.exclusive(tmp_path):
                pass
        thread.start()
        waiting.wait()
        happened.append("released")
    thread.join()
    assert happened == ["released", "waited"]
    locks.wait_for(tmp_path)
    locks.wait_for(tmp_path / "missing")
