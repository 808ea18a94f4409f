"""Files of work that is done: what they hold, and what they belong to."""

from __future__ import annotations

import json
from threading import Event, Thread

import numpy as np
import pytest

from mi_nerfattack.errors import InputError
from mi_nerfattack.io import files, locks
from mi_nerfattack.io.resumable import Record, Unit, differences, flatten

IDENTITY = {"format": "test 1", **flatten("job", {"seed": 1, "size": {"width": 3}})}
TENSORS = {"a": np.arange(6.0).reshape(2, 3), "b": np.zeros(0, np.uint8)}


class Note(Record):
    seconds: float
    names: list[str]


NOTE = Note(seconds=float("inf"), names=["one"])


def unit(path, **changes) -> Unit[Note]:
    return Unit(path / "unit.safetensors", {**IDENTITY, **changes}, Note, "remove it")


def test_unit_reads_back_what_was_written(tmp_path):
    assert unit(tmp_path).read() is None and unit(tmp_path).read_record() is None
    unit(tmp_path).write(TENSORS, NOTE)
    content = unit(tmp_path).read()
    assert content is not None and content.record == NOTE and not content.ignored
    for name, value in TENSORS.items():
        np.testing.assert_array_equal(content.tensors[name], value, strict=True)
    assert unit(tmp_path).read_record() == NOTE


def test_unit_of_something_else_is_refused_with_all_differences(tmp_path):
    unit(tmp_path).write(TENSORS, NOTE)
    other = unit(tmp_path, **{"job.seed": "2", "job.size.width": "4"})
    for read in (other.read, other.read_record):
        with pytest.raises(InputError, match=r"seed: 1 -> 2\n .*width: 3 -> 4\n"):
            read()
    content = other.read(force=True)
    assert content is not None and len(content.ignored) == 2
    with pytest.raises(InputError, match="'test 1', .* 'test 2'"):
        unit(tmp_path, format="test 2").read(force=True)


@pytest.mark.parametrize("change", [{"names": [1]}, {"seconds": "1"}, {"more": 1}])
def test_record_is_strict(tmp_path, change):
    unit(tmp_path).write(TENSORS, NOTE)
    path = unit(tmp_path).path
    tensors, metadata = files.read_safetensors(path)
    metadata["kept.record"] = json.dumps({"seconds": 1.0, "names": [], **change})
    files.write_safetensors(path, tensors, metadata)
    with pytest.raises(InputError, match=f"{path}: .*damaged"):
        unit(tmp_path).read()


def test_differences_are_told_key_by_key():
    def file(name, digest):
        return json.dumps({"file": name, "sha256": digest})

    stored = {"same": "1", "gone": "2", "moved": file("a", "1"), "new": file("b", "1")}
    present = {"same": "1", "moved": file("z", "1"), "new": file("b", "2"), "add": "3"}
    keys = [line.partition(":")[0] for line in differences(stored, present)]
    assert keys == ["new", "add", "gone"]


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
