"""Structure from motion by pycolmap: features, matches, poses, cameras."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np

from mi_nerfattack.capture.colmap.follow import StageCallback, Stages, run_task
from mi_nerfattack.capture.colmap.process import LEAST_IMAGES, RESULT
from mi_nerfattack.errors import InputError, SetupError
from mi_nerfattack.render.camera.conventions import from_colmap
from mi_nerfattack.render.camera.intrinsics import Camera

Matching = Literal["exhaustive", "sequential"]
Lens = Literal[
    "SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "OPENCV_FISHEYE"
]


@dataclass(frozen=True, eq=False)
class Structure:
    """What structure from motion found, in a world of arbitrary frame and unit.

    Attributes:
        names: n images that were placed, sorted.
        camera_to_world: (n, 4, 4), OpenCV axes.
        cameras: n, of the images; equal where these were taken by the same.
        points: (m, 3), seen in at least three images each.
        error_px: mean reprojection error.
        points_seen: n numbers of points that the images show.
        errors_px: n mean reprojection errors of these.
        features: number found in each image by name, in those without a pose, too.
    """

    names: tuple[str, ...]
    camera_to_world: np.ndarray
    cameras: tuple[Camera, ...]
    points: np.ndarray
    error_px: float
    points_seen: tuple[int, ...] = ()
    errors_px: tuple[float, ...] = ()
    features: Mapping[str, int] = field(default_factory=dict)


def reconstruct(
    folder: Path,
    groups: Sequence[Sequence[str]],
    work: Path,
    matching: Matching,
    lens: Lens,
    long_edge_px: int,
    seed: int,
    progress: StageCallback,
    masks: Path | None = None,
) -> Structure:
    """Estimate poses and cameras of photographs, on the CPU.

    pycolmap runs in a process of its own, which is ended when `progress` raises.

    Args:
        folder: of the photographs.
        groups: names of the photographs, a group for each camera, all of one size. If
            matching is sequential, the sorted names are the order they were taken in.
        work: an empty folder for intermediate files.
        matching: every photograph with every other one, or with its neighbours.
        lens: COLMAP's camera model.
        long_edge_px: features are looked for at most at this size.
        seed: of the random choices. Threads leave differences from run to run.
        progress: called with stage, done and total.
        masks: folder of ``NAME.png``, black where no features are taken.

    Raises:
        InputError: fewer than 3 photographs could be placed, or the lens is impossible.
        SetupError: pycolmap is not installed, failed or crashed.
    """
    task = {
        "folder": str(folder),
        "groups": [list(group) for group in groups],
        "work": str(work),
        "matching": matching,
        "lens": lens,
        "long_edge_px": long_edge_px,
        "seed": seed,
        "masks": "" if masks is None else str(masks),
    }
    stages = Stages(progress)
    code = run_task(task, stages)
    if code:
        raise SetupError(
            f"{stages.ending(code)}; see that memory and the disk of temporary files "
            "are not full, look for features at a smaller size (--long-edge), or "
            "reconstruct with COLMAP elsewhere and give the model to 'fit'"
        )
    stages.end()
    structure = json.loads((work / RESULT).read_text(encoding="utf-8"))
    return _structure(structure, sum(map(len, groups)))


def _structure(structure: dict[str, Any] | None, count: int) -> Structure:
    placed = 0 if structure is None else len(structure["names"])
    if structure is None or placed < LEAST_IMAGES:
        raise InputError(
            f"photographs: {placed} of {count} could be placed, at least "
            f"{LEAST_IMAGES} are needed; take them of a still scene with texture, "
            "from different places, each part of it in three photographs or more"
        )
    poses = np.tile(np.eye(4), (placed, 1, 1))
    poses[:, :3] = structure["camera_to_world"]
    try:
        known = {
            i: from_colmap(*structure["cameras"][str(i)])
            for i in set(structure["camera_ids"])
        }
    except InputError as error:
        raise InputError(
            f"photographs: the estimated lens is impossible ({error}); take a simpler "
            "one (--lens SIMPLE_RADIAL) or more photographs"
        ) from error
    return Structure(
        names=tuple(structure["names"]),
        camera_to_world=poses,
        cameras=tuple(known[i] for i in structure["camera_ids"]),
        points=np.array(structure["points"], np.float64).reshape(-1, 3),
        error_px=structure["error_px"],
        points_seen=tuple(structure["points_seen"]),
        errors_px=tuple(structure["errors_px"]),
        features=structure["features"],
    )
