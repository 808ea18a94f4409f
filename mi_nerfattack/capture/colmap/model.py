"""COLMAP models, text and binary, as posed images.

The files are read here rather than by pycolmap: it has no wheel for every platform,
and a message should name the file, the place in it and the field.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mi_nerfattack.capture.colmap import binary as colmap_binary
from mi_nerfattack.capture.colmap import text as colmap_text
from mi_nerfattack.capture.colmap.records import CameraRecord, ImageRecord
from mi_nerfattack.capture.posed_images import PosedImages, differing, load_images
from mi_nerfattack.errors import InputError
from mi_nerfattack.render.camera.conventions import (
    COLMAP_MODELS,
    colmap_to_opencv,
    from_colmap,
)
from mi_nerfattack.render.camera.intrinsics import Camera

MODEL_PLACES = (".", "sparse/0", "sparse", "colmap/sparse/0")
"""Where in a folder a model is looked for, in this order."""


@dataclass(frozen=True)
class _Format:
    suffix: str
    cameras: Callable[[Path], list[CameraRecord]]
    images: Callable[[Path], list[ImageRecord]]
    points: Callable[[Path], np.ndarray]


_FORMATS = (
    _Format(
        ".bin",
        colmap_binary.read_cameras,
        colmap_binary.read_images,
        colmap_binary.read_points,
    ),
    _Format(
        ".txt",
        colmap_text.read_cameras,
        colmap_text.read_images,
        colmap_text.read_points,
    ),
)


def find_model(folder: str | Path) -> Path | None:
    """Return the first of `MODEL_PLACES` in a folder that holds a model, or None."""
    for place in MODEL_PLACES:
        if _format_of(Path(folder) / place) is not None:
            return Path(folder) / place
    return None


def read_colmap(
    path: str | Path, long_edge_px: int | None = None, skip_missing: bool = False
) -> PosedImages:
    """Read a COLMAP model and its images, in the order of their names.

    The world is the model's: its unit is not the metre and its z axis need not point
    up, unless the model was made so. COLMAP counts pixels from the image's corner, as
    we do.

    Args:
        path: folder with a model in one of `MODEL_PLACES`. Images are looked for in
            `images` of the folder, and in the folder and `images` of the model and of
            the two folders above it.
        long_edge_px: reduce images to this longer edge, in pixels; None keeps them.
        skip_missing: leave out images whose file is missing.

    Returns:
        the images, with `points` from points3D where that file is there.

    Raises:
        InputError: no model, a damaged file, a camera model that is not one of
            `COLMAP_MODELS`, missing images, or images of several sizes.
    """
    root = Path(path)
    model, kind = _model_in(root)
    source = model / f"cameras{kind.suffix}"
    cameras = _cameras(source, kind.cameras(source))
    where = model / f"images{kind.suffix}"
    records = sorted(kind.images(where), key=lambda record: record.name)
    _check_images(where, records, cameras)
    found = _find_images(root, model, [record.name for record in records])
    missing = tuple(record.name for record in records if record.name not in found)
    if missing and not skip_missing:
        raise InputError(
            f"{where}: {len(missing)} of {len(records)} images are missing, first "
            f"{missing[0]!r} in {next(iter(found.values())).parent}; restore them or "
            "leave them out (--skip-missing, or skip_missing=True)"
        )
    used = [record for record in records if record.name in found]
    images, reduced = load_images(
        [found[record.name] for record in used],
        [cameras[record.camera_id] for record in used],
        source,
        long_edge_px,
    )
    points = model / f"points3D{kind.suffix}"
    return PosedImages(
        images,
        colmap_to_opencv([r.quaternion for r in used], [r.translation for r in used]),
        reduced[0],
        tuple(record.name for record in used),
        missing,
        differing(reduced),
        kind.points(points) if points.is_file() else None,
        "arbitrary",
    )


def _model_in(root: Path) -> tuple[Path, _Format]:
    for place in MODEL_PLACES:
        kind = _format_of(root / place)
        if kind is not None:
            return root / place, kind
    raise InputError(
        f"{root}: no COLMAP model (cameras and images, .bin or .txt); looked in "
        f"{', '.join(MODEL_PLACES)}"
    )


def _format_of(folder: Path) -> _Format | None:
    for kind in _FORMATS:
        if all((folder / f"{n}{kind.suffix}").is_file() for n in ("cameras", "images")):
            return kind
    return None


def _cameras(source: Path, records: Sequence[CameraRecord]) -> dict[int, Camera]:
    result = {}
    for record in records:
        where = f"{source}: camera {record.camera_id}"
        if record.model not in COLMAP_MODELS:
            raise InputError(
                f"{where}: model {record.model}; only {', '.join(COLMAP_MODELS)} can "
                "be read; run 'colmap image_undistorter' and give its output, or "
                "reconstruct with OPENCV"
            )
        try:
            result[record.camera_id] = from_colmap(
                record.model, record.width, record.height, record.parameters
            )
        except InputError as error:
            raise InputError(f"{where}: {error}") from error
    return result


def _check_images(
    where: Path, records: Sequence[ImageRecord], cameras: dict[int, Camera]
) -> None:
    if not records:
        raise InputError(f"{where}: the model holds no image; reconstruct it again")
    name, times = Counter(record.name for record in records).most_common(1)[0]
    if times > 1:
        raise InputError(f"{where}: image {name!r} occurs {times} times; names differ")
    for record in records:
        if record.camera_id not in cameras:
            raise InputError(
                f"{where}: image {record.name!r}: camera {record.camera_id} is not in "
                "the model's cameras"
            )
        values = (*record.quaternion, *record.translation)
        if not (np.isfinite(values).all() and any(record.quaternion)):
            raise InputError(
                f"{where}: image {record.name!r}: pose {values}; the quaternion must "
                "not be zero and all numbers finite"
            )


def _find_images(root: Path, model: Path, names: Sequence[str]) -> dict[str, Path]:
    """Return the files of the images that exist in the first folder that has any."""
    bases = dict.fromkeys((root, model, model.parent, model.parent.parent))
    places = [place for base in bases for place in (base / "images", base)]
    for place in places:
        found = {name: place / name for name in names if (place / name).is_file()}
        if found:
            return found
    raise InputError(
        f"{model}: none of the {len(names)} images is there, first {names[0]!r}; put "
        f"them into {root / 'images'} (looked in {', '.join(map(str, places))})"
    )
