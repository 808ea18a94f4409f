"""Poses of a folder of photographs, upright, as a `transforms.json`."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from mi_nerfattack.capture.colmap.reconstruct import (
    Lens,
    Matching,
    StageCallback,
    Structure,
    reconstruct,
)
from mi_nerfattack.capture.masks import SUFFIX, stage_masks
from mi_nerfattack.capture.photographs.alignment import Distance, Scale, align
from mi_nerfattack.capture.photographs.markers import Markers
from mi_nerfattack.capture.photographs.quality import Quality, assess, quality_table
from mi_nerfattack.capture.photographs.staging import (
    check_in_place,
    list_photographs,
    stage,
)
from mi_nerfattack.capture.photographs.tracked import Tracked
from mi_nerfattack.capture.transforms import begin_posed, write_poses
from mi_nerfattack.errors import InputError
from mi_nerfattack.io import files
from mi_nerfattack.ranges import Count, Positive, Seed, checked
from mi_nerfattack.render.camera.intrinsics import Camera


@dataclass(frozen=True)
@checked()
class PoseOptions:
    """How poses are estimated.

    Attributes:
        matching: compare every photograph with every other one, or with those taken
            shortly before and after, by the order of their names.
        lens: COLMAP's camera model, of all cameras.
        long_edge_px: look for features at most at this size.
        metres_per_unit: of the arbitrary unit of an earlier run.
        distance: between two photographs.
        markers: of known size in the scene.
        tracked: poses of a body on the camera, whose world is taken over. With none of
            these four, the unit stays arbitrary.
        masks: folder of ``NAME.png``, black where a photograph, upright, shows what
            moves or is no part of the scene; or one such picture for all.
        seed: of the random choices.
    """

    matching: Matching = "exhaustive"
    lens: Lens = "OPENCV"
    long_edge_px: Count = 1600
    metres_per_unit: Positive | None = None
    distance: Distance | None = None
    markers: Markers | None = None
    tracked: Tracked | None = None
    masks: Path | None = None
    seed: Seed = 0

    def __post_init__(self) -> None:
        sources = [
            name
            for name in ("metres_per_unit", "distance", "markers", "tracked")
            if getattr(self, name) is not None
        ]
        if len(sources) > 1:
            raise InputError(f"{', '.join(sources)}: each tells the scale; give one")


@dataclass(frozen=True)
class PoseEstimate:
    """What was written.

    Attributes:
        path: of the `transforms.json`.
        placed: names of the photographs with a pose.
        left_out: names of those that could not be placed.
        cameras: of the photographs with a pose.
        error_px: mean reprojection error.
        farthest: the two photographs that were taken farthest apart.
        distance: between these, in the unit of the poses.
        scale: how this unit was found.
        structure: poses and points as they were written.
        qualities: of all photographs.
    """

    path: Path
    placed: tuple[str, ...]
    left_out: tuple[str, ...]
    cameras: tuple[Camera, ...]
    error_px: float
    farthest: tuple[str, str]
    distance: float
    scale: Scale
    structure: Structure
    qualities: tuple[Quality, ...]


def estimate_poses(
    photographs: str | Path,
    output: str | Path,
    options: PoseOptions | None = None,
    progress: StageCallback = lambda stage, done, total: None,
) -> PoseEstimate:
    """Estimate the poses of photographs; write poses and copies into one folder.

    z points up, against the mean of the images' downward directions. So the photographs
    must be level on average, or markers must lie flat. The origin is the mean of the
    cameras; with flat markers it is the point on the ground below. The unit is
    arbitrary, because photographs alone have no scale, unless an option gives the
    scale; `units` in the JSON file names the unit. Photographs that their EXIF data
    turn are stored upright.

    Args:
        photographs: folder of at least 3 JPEG, PNG, WebP or HEIC images; at least 3 of
            each camera, of each of its focal lengths, and of each way that it was held.
            Their EXIF data and sizes tell these apart. A.heic becomes A.heic.jpg.
        output: folder for `transforms.json`, `images`, `masks` if there are any,
            `points.safetensors`, and `capture.json`, which says what each photograph
            gave.
        options: None for the defaults.
        progress: called with stage, done and total.

    Raises:
        InputError: too few photographs, an unreadable one, too few could be placed,
            masks do not fit (see `masks.stage_masks`), or markers are not seen or
            contradict each other. Nothing is written then.
        SetupError: pycolmap failed or crashed, or markers need OpenCV, which is not
            installed; nothing is written either.
    """
    options = options or PoseOptions()
    root = Path(photographs)
    names = list_photographs(root)
    files.check_folder(output)
    with tempfile.TemporaryDirectory() as folder:
        staged, masks, work = (Path(folder) / n for n in ("images", "masks", "work"))
        for each in (staged, masks, work):
            each.mkdir()
        groups = stage(root, names, staged, progress)
        check_in_place(root, names, staged, out=Path(output) / "images")
        names = sorted(name for group in groups.values() for name in group)
        if options.masks is not None:
            stage_masks(options.masks, staged, names, target=masks)
        structure = reconstruct(
            staged,
            list(groups.values()),
            work,
            matching=options.matching,
            lens=options.lens,
            long_edge_px=options.long_edge_px,
            seed=options.seed,
            progress=progress,
            masks=None if options.masks is None else masks,
        )
        scale_source = options.markers or options.tracked
        scale_source = scale_source or options.distance or options.metres_per_unit
        structure, scale = align(structure, staged, scale_source, progress=progress)
        return _write(
            Path(output), staged, masks, structure=structure, names=names, scale=scale
        )


def _write(
    output: Path,
    staged: Path,
    masks: Path,
    structure: Structure,
    names: Sequence[str],
    scale: Scale,
) -> PoseEstimate:
    path = begin_posed(output)
    masked = {}
    for name in structure.names:
        raw = files.read_bytes(staged / name, files.MAX_IMAGE_BYTES)
        files.write_bytes(output / "images" / name, raw)
        mask = masks / (name + SUFFIX)
        if mask.exists():
            files.make_folder(output / "masks")
            raw = files.read_bytes(mask, files.MAX_IMAGE_BYTES)
            files.write_bytes(output / "masks" / mask.name, raw)
            masked[f"images/{name}"] = f"masks/{mask.name}"
    files.write_safetensors(
        output / "points.safetensors", {"points": structure.points.astype(np.float32)}
    )
    left_out = tuple(name for name in names if name not in set(structure.names))
    units = "arbitrary" if scale.metres_per_unit is None else "metre"
    qualities = assess(staged, names, structure)
    table = quality_table(structure, qualities, asdict(scale))
    files.write_json(output / "capture.json", table)
    extra = {
        "units": units,
        "points_file": "points.safetensors",
        "reprojection_error_px": structure.error_px,
        "left_out": list(left_out),
    }
    stored = [f"images/{name}" for name in structure.names]
    poses = structure.camera_to_world
    write_poses(
        path,
        stored,
        structure.cameras,
        camera_to_world=poses,
        extra=extra,
        masks=masked,
    )
    eyes = poses[:, :3, 3]
    apart = np.linalg.norm(eyes[:, None] - eyes[None], axis=2)
    a, b = np.unravel_index(int(apart.argmax()), apart.shape)
    return PoseEstimate(
        path=path,
        placed=structure.names,
        left_out=left_out,
        cameras=structure.cameras,
        error_px=structure.error_px,
        farthest=(structure.names[a], structure.names[b]),
        distance=float(apart[a, b]),
        scale=scale,
        structure=structure,
        qualities=qualities,
    )
