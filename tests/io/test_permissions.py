"""Files and folders that an ordinary user may not read or write."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from support.faults.injected import obeyed_modes

from mi_nerfattack.capture.inputs import read_depth
from mi_nerfattack.capture.masks import stage_masks
from mi_nerfattack.capture.mesh.read import load_mesh
from mi_nerfattack.capture.photographs.staging import list_photographs
from mi_nerfattack.capture.transforms import read_images
from mi_nerfattack.deploy.replay.environment import open_recording
from mi_nerfattack.errors import InputError
from mi_nerfattack.io import files, locks
from mi_nerfattack.io.growing import GrowingFile
from mi_nerfattack.render.camera.intrinsics import CameraMount
from mi_nerfattack.render.pathtrace.load import load_scene
from mi_nerfattack.scenario.scenario import load_scenario


@contextmanager
def closed(path: Path, mode: int) -> Iterator[None]:
    """Give a path a mode, and let the process obey it; afterwards it is open again."""
    before = path.stat().st_mode
    path.chmod(mode)
    try:
        with obeyed_modes():
            yield
    finally:
        path.chmod(before)


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
def test_what_may_not_be_written_is_told_and_left_alone(tmp_path: Path, call) -> None:
    folder = files.make_folder(tmp_path / "kept")
    (folder / "a").write_text("old")
    with closed(folder, 0o555), pytest.raises(InputError, match="kept.*permission"):
        call(folder)
    assert {path.name: path.read_text() for path in folder.iterdir()} == {"a": "old"}


READERS = {
    "images": lambda path: read_images(path),
    "JSON": lambda path: read_images(path / "transforms.json"),
    "depth": lambda path: read_depth(path, None),
    "masks": lambda path: stage_masks(path, path, ["a.jpg"], path),
    "photographs": lambda path: list_photographs(path),
    "mesh": lambda path: load_mesh(path / "a.glb"),
    "scene": lambda path: load_scene(path / "a.xml"),
    "recording": lambda path: open_recording(path / "a", None, CameraMount(), 0.1),
    "scenario": lambda path: load_scenario(path / "a.toml"),
}


@pytest.mark.parametrize("name", READERS)
@pytest.mark.usefixtures("variant")
def test_a_path_through_a_closed_folder_is_told(tmp_path: Path, name: str) -> None:
    """Folders whose files cannot even be looked for; `Path.is_file` raises there."""
    folder = files.make_folder(tmp_path / "closed")
    with closed(folder, 0o000), pytest.raises(InputError, match="closed.*permission"):
        READERS[name](folder / "inner")


def test_what_may_not_be_read_is_told(tmp_path: Path) -> None:
    folder, path = files.make_folder(tmp_path / "folder"), tmp_path / "file"
    path.write_text("secret")
    with closed(path, 0o222):
        with pytest.raises(InputError, match=f"{path}: permission denied"):
            files.read_text(path)
    with closed(folder, 0o333):
        for lock in (locks.wait_for, lambda at: locks.exclusive(at).__enter__()):
            with pytest.raises(InputError, match=f"{folder}: permission denied"):
                lock(folder)
