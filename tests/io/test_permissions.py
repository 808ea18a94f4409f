"""Files and folders that an ordinary user may not read or write."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
from helpers.modes import obeyed_modes

from mi_nerfattack.errors import InputError
from mi_nerfattack.io import files, locks
from mi_nerfattack.io.growing import GrowingFile


@pytest.mark.parametrize(
    "call",
    [
        lambda folder: files.write_text(folder / "a", "new"),
        lambda folder: files.make_folder(folder / "b" / "c"),
        lambda folder: files.check_writable(folder / "a"),
        lambda folder: files.check_folder(folder / "b" / "c"),
        lambda folder: GrowingFile(folder / "b"),
    ],
)
def test_what_may_not_be_written_is_told_and_left_alone(
    tmp_path: Path, call: Callable[[Path], object]
) -> None:
    folder = tmp_path / "kept"
    folder.mkdir()
    (folder / "a").write_text("old")
    folder.chmod(0o555)
    try:
        with obeyed_modes(), pytest.raises(InputError, match="kept.*permission denied"):
            call(folder)
    finally:
        folder.chmod(0o755)
    assert [(path.name, path.read_text()) for path in folder.iterdir()] == [
        ("a", "old")
    ]


def test_what_may_not_be_read_is_told(tmp_path: Path) -> None:
    folder, path = tmp_path / "folder", tmp_path / "file"
    folder.mkdir()
    path.write_text("secret")
    folder.chmod(0o333)
    path.chmod(0o222)
    try:
        with obeyed_modes():
            with pytest.raises(InputError, match="file: permission denied"):
                files.read_text(path)
            with pytest.raises(InputError, match="folder: permission denied"):
                with locks.exclusive(folder):
                    pass
            with pytest.raises(InputError, match="folder: permission denied"):
                locks.wait_for(folder)
    finally:
        folder.chmod(0o755)
