"""COLMAP models, text and binary, as posed images."""

from __future__ import annotations

import json
import os
import tempfile
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple, NoReturn

import numpy as np

from mi_nerfattack.capture.colmap.follow import Stages, run_task
from mi_nerfattack.capture.colmap.process import MODEL_STEMS, POINTS, RESULT
from mi_nerfattack.capture.posed_images import PosedImages, differing, load_images
from mi_nerfattack.errors import InputError
from mi_nerfattack.io import files
from mi_nerfattack.io.strict import require_near
from mi_nerfattack.render.camera.conventions import (
    COLMAP_MODELS,
    colmap_to_opencv,
    from_colmap,
)
from mi_nerfattack.render.camera.intrinsics import Camera

MODEL_FOLDERS = (".", "sparse/0", "sparse", "colmap/sparse/0")
"""Where in a folder a model is looked for, in this order."""

MAX_BYTES = 1 << 31


class _Image(NamedTuple):
    name: str
    camera_id: int
    quaternion: Sequence[float]
    translation: Sequence[float]


def find_model(folder: str | Path) -> Path | None:
    """Return the first of `MODEL_FOLDERS` in a folder that holds a model, or None."""
    location = _find(Path(folder))
    return None if location is None else location[0]


def read_colmap(
    path: str | Path, long_edge_px: int | None = None, skip_missing: bool = False
) -> PosedImages:
    """Read a COLMAP model and its images, in the order of their names.

    The world is the model's: its unit is not the metre and its z axis need not point
    up, unless the model was made so. COLMAP counts pixels from the image's corner, as
    we do.

    Args:
        path: folder with a model in one of `MODEL_FOLDERS`. Images are looked for in
            `images` of the folder, and in the folder and `images` of the model and of
            the two folders above it.
        long_edge_px: reduce images to this longer edge, in pixels; None keeps them.
        skip_missing: leave out images whose file is missing.

    Returns:
        the images, with `points` from points3D where that file is there.

    Raises:
        InputError: no model, a damaged file, a camera model that is not one of
            `COLMAP_MODELS`, or missing images.
        SetupError: pycolmap, which reads it, is not installed.
    """
    root = Path(path)
    at = _find(root)
    if at is None:
        raise InputError(
            f"{root}: no COLMAP model (cameras and images, .bin or .txt); looked in "
            f"{', '.join(MODEL_FOLDERS)}"
        )
    model, suffix = at
    contents, points = _read(model, suffix)
    source, where = model / f"cameras{suffix}", model / f"images{suffix}"
    cameras = _cameras(source, contents["cameras"])
    records = sorted(_Image(*image) for image in contents["images"])
    _check_images(where, records)
    image_paths = _find_images(root, model, [record.name for record in records])
    missing = tuple(record.name for record in records if record.name not in image_paths)
    if missing and not skip_missing:
        _refuse_missing(where, missing, len(records), image_paths=image_paths)
    used = [record for record in records if record.name in image_paths]
    paths = [image_paths[record.name] for record in used]
    lenses = [cameras[record.camera_id] for record in used]
    poses = colmap_to_opencv(
        [r.quaternion for r in used], [r.translation for r in used]
    )
    require_near(where, poses[:, :3, 3])
    images, reduced = load_images(paths, lenses, source, long_edge_px=long_edge_px)
    return PosedImages(
        images=images,
        camera_to_world=poses,
        camera=reduced[0],
        names=tuple(record.name for record in used),
        missing=missing,
        cameras=differing(reduced),
        points=points,
        unit="arbitrary",
    )


def _refuse_missing(
    where: Path, missing: Sequence[str], count: int, image_paths: Mapping[str, Path]
) -> NoReturn:
    raise InputError(
        f"{where}: {len(missing)} of {count} images are missing, first "
        f"{missing[0]!r} in {next(iter(image_paths.values())).parent}; restore them or "
        "leave them out (--skip-missing, or skip_missing=True)"
    )


def _find(folder: Path) -> tuple[Path, str] | None:
    """Return the folder of a model and the suffix of its files."""
    for name in MODEL_FOLDERS:
        for suffix in (".bin", ".txt"):
            needed = (folder / name / f"{part}{suffix}" for part in MODEL_STEMS[:2])
            with files.reported(folder / name):
                if all(path.is_file() for path in needed):
                    return folder / name, suffix
    return None


def _read(model: Path, suffix: str) -> tuple[dict[str, Any], np.ndarray | None]:
    """Return what pycolmap finds in a model's files, and its points if it has any.

    COLMAP checks little of what it reads, and reads without end in some damaged files:
    this is done in a process of its own, with limits.
    """
    names = [f"{part}{suffix}" for part in MODEL_STEMS]
    names = [name for name in names if (model / name).is_file()]
    with tempfile.TemporaryDirectory() as work:
        for name in names:
            if suffix == ".bin":
                raw = files.read_bytes(model / name, MAX_BYTES)
            else:
                text = files.read_text(model / name)
                raw = f"{text}\n\n".encode()  # the last image may lack its second line
            (Path(work) / name).write_bytes(raw)
        stages = Stages(lambda *_: None)
        code = run_task({"work": work, "files": names}, stages)
        if code:
            raise InputError(
                f"{model / stages.name}: {stages.ending(code)}; the file is damaged or "
                "not of COLMAP, copy it again"
            )
        contents = json.loads((Path(work) / RESULT).read_text(encoding="utf-8"))
        points = np.load(Path(work) / POINTS)
    if not np.isfinite(points).all():
        raise InputError(
            f"{model / names[-1]}: a position is not finite; copy the file again"
        )
    return contents, points if len(points) else None


def _cameras(source: Path, records: dict[str, Sequence[Any]]) -> dict[int, Camera]:
    result = {}
    for camera_id, (name, *parameters) in records.items():
        where = f"{source}: camera {camera_id}"
        if name not in COLMAP_MODELS:
            raise InputError(
                f"{where}: model {name}; only {', '.join(COLMAP_MODELS)} can "
                "be read; run 'colmap image_undistorter' and give its output, or "
                "reconstruct with OPENCV"
            )
        try:
            result[int(camera_id)] = from_colmap(name, *parameters)
        except InputError as error:
            raise InputError(f"{where}: {error}") from error
    return result


def _check_images(where: Path, records: Sequence[_Image]) -> None:
    if not records:
        raise InputError(f"{where}: the model holds no image; reconstruct it again")
    name, times = Counter(record.name for record in records).most_common(1)[0]
    if times > 1:
        raise InputError(f"{where}: image {name!r} occurs {times} times; names differ")
    for record in records:
        if not record.name.isprintable():
            raise InputError(f"{where}: image {record.name!r}: unprintable; rename it")
        try:
            colmap_to_opencv(record.quaternion, record.translation)
        except InputError as error:
            raise InputError(f"{where}: image {record.name!r}: {error}") from error


def _find_images(root: Path, model: Path, names: Sequence[str]) -> dict[str, Path]:
    """Return the files of the images that exist in the first folder that has any."""
    bases = dict.fromkeys((root, model, model.parent, model.parent.parent))
    folders = [path for base in bases for path in (base / "images", base)]
    for folder in folders:
        paths = {name: folder / name for name in names if os.path.isfile(folder / name)}
        if paths:
            return paths
    raise InputError(
        f"{model}: none of the {len(names)} images is there, first {names[0]!r}; put "
        f"them into {root / 'images'} (looked in {', '.join(map(str, folders))})"
    )
