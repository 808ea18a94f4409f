"""What cannot be used, from the command line: code 2, one line, nothing written."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from helpers.foreign_folders import (
    colmap,
    instant_ngp,
    nerfstudio,
    picture,
    poses,
    write,
)

from mi_nerfattack import cli
from mi_nerfattack.io import files

pytestmark = pytest.mark.usefixtures("variant")


def change_frame(**values: object) -> Callable[[Path], None]:
    """Return a change of the second frame of a transforms.json."""

    def change(folder: Path) -> None:
        table = json.loads((folder / "transforms.json").read_text())
        table["frames"][1].update(values)
        write(folder, table)

    return change


def scaled(factors: list[float]) -> list[list[float]]:
    return (np.array(poses(2)[1]) * [*factors, 1.0]).tolist()


def with_nan() -> list[list[float]]:
    matrix = poses(2)[1]
    matrix[0][3] = float("nan")
    return matrix


def with_infinity(folder: Path) -> None:
    change_frame(transform_matrix=scaled([1, 1, 12345]))(folder)
    path = folder / "transforms.json"
    matrix = json.loads(path.read_text())["frames"][1]["transform_matrix"]
    path.write_text(path.read_text().replace(repr(matrix[0][2]), "1e999"))


def garbage(name: str) -> Callable[[Path], None]:
    def change(folder: Path) -> None:
        (folder / name).write_bytes(np.random.default_rng(1).bytes(500))

    return change


def remove(*names: str) -> Callable[[Path], None]:
    def change(folder: Path) -> None:
        for name in names:
            (folder / name).unlink()

    return change


def image_of_width(name: str, width: int) -> Callable[[Path], None]:
    def change(folder: Path) -> None:
        files.write_image(folder / name, picture(9, width=width))

    return change


MATRIX = r"transforms.json: frames\[1\].transform_matrix"
IMAGES = tuple(f"images/{i}.png" for i in range(3))
UNUSABLE = {
    "missing image": (
        instant_ngp,
        remove("images/1.jpg"),
        r"transforms.json: 1 of 3 frames have no image, first './images/1.jpg'",
    ),
    "garbage JPEG": (instant_ngp, garbage("images/1.jpg"), "1.jpg: not an image"),
    "NaN": (
        instant_ngp,
        change_frame(transform_matrix=with_nan()),
        rf"{MATRIX}\[0\]\[3\]: NaN is not a JSON number",
    ),
    "infinity": (
        instant_ngp,
        with_infinity,
        rf"{MATRIX}\[0\]\[2\]: 1e999 is not a JSON number",
    ),
    "size against intrinsics of a frame": (
        nerfstudio,
        change_frame(w=1080),
        r"frame_00001.png: 12 x 8 px, .*transforms.json are for 1080 x 8",
    ),
    "not JSON": (instant_ngp, garbage("transforms.json"), "transforms.json: .*UTF-8"),
    "depth that is missing": (
        nerfstudio,
        remove("depths/frame_00001.png"),
        "frame_00001.png: does not exist",
    ),
    "garbage cameras.bin": (
        colmap,
        garbage("sparse/0/cameras.bin"),
        "cameras.bin: .*copy it again",
    ),
    "COLMAP without images": (
        colmap,
        remove(*IMAGES),
        "sparse/0: none of the 3 images is there, first '0.png'; put them into",
    ),
    "empty folder": (
        colmap,
        remove("sparse/0/cameras.bin"),
        "no posed images; looked for transforms.json.*3 photographs",
    ),
}


@pytest.mark.parametrize("case", UNUSABLE)
def test_fit_refuses(tmp_path, capsys, case):
    make, spoil, message = UNUSABLE[case]
    folder = tmp_path / "in"
    folder.mkdir()
    make(folder)
    spoil(folder)
    before = sorted(tmp_path.rglob("*"))
    code = cli.main(["fit", str(folder), "-o", str(tmp_path / "field.safetensors")])
    out, err = capsys.readouterr()
    assert (code, out, err.count("\n")) == (2, "", 1), err
    assert re.match(f"mi-nerfattack: error: .*{message}", err), err
    assert sorted(tmp_path.rglob("*")) == before
