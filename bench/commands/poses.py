"""``python -m bench poses FOLDER``: photographs placed anew, against given poses."""

from __future__ import annotations

import contextlib
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro

from mi_nerfattack.commands.shared.result import Result

_PLACED, _ROTATION_DEG, _POSITION = 0.96, 1.0, 0.01
_LOSS_DB = 0.7


@dataclass(frozen=True)
class BenchPoses:
    """Estimate the poses of a posed folder's photographs alone, and compare.

    Both are brought together by a similarity of the cameras' places. Prints photographs
    placed, and medians of rotation and position, the latter as a share of the greatest
    distance between two cameras. Exit code 1 unless 96 % are placed, within 1 degree
    and 1 %, and with --steps the field of what `capture` wrote is within 0.7 dB of that
    of the poses as they came.
    """

    folder: tyro.conf.Positional[Path]
    """Posed photographs, as `fit` reads them; `$NERFATTACK_DATA/fox`, for one."""
    output: Annotated[Path | None, tyro.conf.arg(aliases=["-o"])] = None
    """Folder for photographs, poses and fields, where the same command goes on; of
    other options, another. By default nothing is kept."""
    mixed: bool = False
    """Turn and zoom the photographs: of five in a row, one stays, two are held sideways
    and EXIF data say so, one is zoomed in by 1.5, one lies on its side."""
    long_edge: int = 1600
    """Look for features at most at this size, pixels."""
    steps: int | None = None
    """Fit small fields to poses given and found, with so many steps each."""
    fit_long_edge: int = 480
    """Of the photographs that are fitted to, pixels."""
    seed: int = 0
    """Of the random choices."""
    json: bool = False
    """Print one line of JSON in place of lines."""

    def run(self) -> Result:
        """Estimate, compare and print."""
        from bench.photographs import compare_fits, compare_poses, place
        from mi_nerfattack import variant
        from mi_nerfattack.capture.transforms import read_images

        variant.ensure()
        given = read_images(self.folder, skip_missing=True)
        with contextlib.ExitStack() as stack:
            work = self.output
            if work is None:
                work = Path(stack.enter_context(tempfile.TemporaryDirectory()))
            place(given, work, self.mixed, self.long_edge, self.seed)
            found: dict[str, Any] = dict(compare_poses(work))
            if self.steps is not None:
                found |= compare_fits(work, self.steps, self.fit_long_edge)

        def show() -> None:
            for name, value in found.items():
                print(f"{name}: {value:.5g}")

        return Result(found, show, int(not _is_good(found)))


def _is_good(found: dict[str, Any]) -> bool:
    good = found["placed"] >= _PLACED * found["photographs"]
    good = good and found["rotation_deg"] <= _ROTATION_DEG
    good = good and found["position_share"] <= _POSITION
    if "given_cube_psnr_db" not in found:
        return good
    as_they_came, ours = found["given_cube_psnr_db"], found["found_points_psnr_db"]
    return good and as_they_came - ours <= _LOSS_DB
