"""``mi-nerfattack poses``: camera poses of a plain folder of photographs."""

from __future__ import annotations

import shlex
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro


@dataclass(frozen=True)
class Poses:
    """Estimate the camera poses of photographs by structure from motion, on the CPU.

    The photographs show one still scene, from different places, by one camera or
    several, each with three or more at a focal length and held one way. z points up if
    they were held level on average. Their scale is unknown: measure the distance that
    the command prints at its end, and run it again with --metres-per-unit.
    """

    photographs: tyro.conf.Positional[Path]
    """Folder of JPEG, PNG or WebP images; those below it are not read."""
    output: Annotated[Path, tyro.conf.arg(aliases=["-o"])]
    """Folder for transforms.json, upright copies of the images and sparse points."""
    matching: Literal["exhaustive", "sequential"] = "exhaustive"
    """Compare all photographs; or, for a video's frames, each with its neighbours."""
    lens: Literal["SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV"] = (
        "OPENCV"
    )
    """Camera model of COLMAP."""
    long_edge: int = 1600
    """Look for features at most at this size, pixels; the images keep theirs."""
    metres_per_unit: float | None = None
    """Multiply all lengths by this."""
    seed: int = 0
    """Of the random choices."""

    def run(self) -> int:
        """Estimate and write."""
        from mi_nerfattack.capture.photographs.estimate import (
            PoseOptions,
            estimate_poses,
        )
        from mi_nerfattack.commands.shared.progress import StageBars

        options = PoseOptions(
            self.matching, self.lens, self.long_edge, self.metres_per_unit, self.seed
        )
        with StageBars() as bars:
            result = estimate_poses(
                self.photographs,
                self.output,
                options,
                lambda stage, done, total: bars.show(
                    stage, done, total, f"{done} of {total}"
                ),
            )
        total = len(result.placed) + len(result.left_out)
        print(
            f"Placed {len(result.placed)} of {total} photographs, mean reprojection "
            f"error {result.error_px:.2f} px; wrote {result.path}"
        )
        if result.left_out:
            print(f"Not placed: {', '.join(result.left_out)}")
        unit = "m" if self.metres_per_unit is not None else "units"
        apart = f"{result.distance:.4g} {unit}"
        print(f"{' and '.join(result.farthest)} were taken {apart} apart.")
        if self.metres_per_unit is None:
            print(
                "The unit is arbitrary: measure this distance in metres and give its "
                f"quotient by {result.distance:.4g} as --metres-per-unit."
            )
        print("Fit a field to them with")
        folder = shlex.quote(str(result.path.parent))
        print(f"  mi-nerfattack fit {folder} -o FIELD.safetensors")
        return 0
