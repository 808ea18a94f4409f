"""``python -m bench poses FOLDER``: photographs placed anew, against given poses."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import tyro

from mi_nerfattack.commands.shared.result import Result

if TYPE_CHECKING:
    import numpy as np


@dataclass(frozen=True)
class BenchPoses:
    """Estimate the poses of a posed folder's photographs alone, and compare.

    Both are brought together by a similarity of the cameras' places. Prints photographs
    placed, and medians of rotation and position, the latter as a share of the greatest
    distance between two cameras. Exit code 1 unless 96 % are placed, within 1 degree
    and 1 %.
    """

    folder: tyro.conf.Positional[Path]
    """Posed photographs, as `fit` reads them; `$NERFATTACK_DATA/fox`, for one."""
    long_edge: int = 1600
    """Look for features at most at this size, pixels."""
    seed: int = 0
    """Of the random choices."""
    json: bool = False
    """Print one line of JSON in place of lines."""

    def run(self) -> Result:
        """Estimate, compare and print."""
        import tempfile

        import numpy as np

        from mi_nerfattack.capture.photographs.estimate import (
            PoseOptions,
            estimate_poses,
        )
        from mi_nerfattack.capture.transforms import read_images
        from mi_nerfattack.commands.shared.progress import StageBars
        from mi_nerfattack.io import files

        given = read_images(self.folder, skip_missing=True)
        names = [f"{i:04d}.png" for i in range(len(given))]
        with tempfile.TemporaryDirectory() as work, StageBars() as bars:
            source, output = Path(work) / "photographs", Path(work) / "out"
            source.mkdir()
            for name, image in zip(names, given.images, strict=True):
                files.write_image(source / name, image[..., :3])
            result = estimate_poses(
                source,
                output,
                PoseOptions(long_edge_px=self.long_edge, seed=self.seed),
                lambda stage, done, total: bars.show(
                    stage, done, total, f"{done} of {total}"
                ),
            )
        placed = [names.index(name) for name in result.placed]
        turns, shares = pose_errors(
            result.found.camera_to_world, given.camera_to_world[placed]
        )
        found = {
            "photographs": len(names),
            "placed": len(placed),
            "rotation_deg": float(np.median(turns)),
            "position_share": float(np.median(shares)),
            "reprojection_error_px": result.error_px,
        }
        good = found["rotation_deg"] <= 1 and found["position_share"] <= 0.01
        good = good and len(placed) >= 0.96 * len(names)

        def show() -> None:
            for name, value in found.items():
                print(f"{name}: {value:.5g}")

        return Result(found, show, int(not good))


def pose_errors(found: np.ndarray, given: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Compare poses (n, 4, 4) after a similarity of their places.

    Returns:
        rotations that remain, degrees, and distances by the greatest one between two
        given places, (n,) each.
    """
    import numpy as np
    from scipy.spatial.distance import pdist
    from scipy.spatial.transform import Rotation

    eyes, wanted = found[:, :3, 3], given[:, :3, 3]
    centred, target = eyes - eyes.mean(0), wanted - wanted.mean(0)
    turn = Rotation.align_vectors(target, centred)[0]
    turned = turn.apply(centred)
    scale = (turned * target).sum() / (turned**2).sum()
    apart = np.linalg.norm(scale * turned - target, axis=1) / pdist(wanted).max()
    left = turn * Rotation.from_matrix(found[:, :3, :3])
    left = left.inv() * Rotation.from_matrix(given[:, :3, :3])
    return np.degrees(left.magnitude()), apart
