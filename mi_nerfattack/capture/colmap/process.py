"""pycolmap in a process of its own: ``python -m mi_nerfattack.capture.colmap.process``.

A native crash, or COLMAP's own abort, then ends this process and not its user's. The
task comes as one line of JSON on standard input; when that is closed, nobody waits any
longer and the process ends. What it is at goes to standard output as lines that start
with `MARK`, between COLMAP's log lines; what it found, to `RESULT` and `POINTS` in the
working folder.
"""

from __future__ import annotations

import json
import os
import sys
import threading
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np

from mi_nerfattack.errors import SetupError
from mi_nerfattack.extras import load_extra

MARK = "@ "
RESULT = "structure.json"
POINTS = "points.npy"
MODEL_STEMS = ("cameras", "images", "points3D")  # of a model; the last may be missing
LEAST_IMAGES = 3

_MANY = 20  # photographs of a camera that may tell its principal point
_MOST_SD = 0.005  # of the longer edge, at most: how surely they tell it
_LEAST_TRACK = 3  # images that see a point which counts
_OVERLAP = 10  # sequential: neighbours, and neighbours at distances 2^k, k < overlap
_PURPOSE = "COLMAP: to read models and estimate poses"  # for messages
_OTHERWISE = "give 'fit' a transforms.json, such as nerfstudio writes of a COLMAP model"
_BLOCK = 10  # exhaustive: photographs a side of the squares of pairs that are logged
_PADDING = bytes(1 << 20)


def main() -> int:
    """Run the task on standard input."""
    task = json.loads(sys.stdin.readline())
    threading.Thread(target=_end_with_parent, daemon=True).start()
    return run(task)


def run(task: dict[str, Any]) -> int:
    """Run a task, in this process; return its exit code."""
    try:
        pycolmap = load_extra("pycolmap", _PURPOSE, _OTHERWISE)
    except SetupError as error:
        _say(missing=str(error))
        return 2
    pycolmap.logging.logtostderr = True  # no file among the temporary ones
    work = Path(task["work"])
    if "files" not in task:
        structure = _reconstruct(pycolmap, task, work)
    else:
        try:
            structure = _read(pycolmap, task["files"], work)
        except Exception as error:  # of pycolmap, about the files
            sys.exit(f"{type(error).__name__}: {error}")
    (work / RESULT).write_text(json.dumps(structure), encoding="utf-8")
    return 0


def _read(pycolmap: Any, names: list[str], work: Path) -> dict[str, Any]:
    """Return a model's cameras and images; its points go to `POINTS`.

    The files are added one by one, so that the last one is to blame for a failure.
    COLMAP reads on beyond a file's end: zeros there let its loops end soon, and a
    model that takes another length when it is written is not the file's.
    """
    folder, again = work / "model", work / "again"
    folder.mkdir()
    again.mkdir()
    suffix = Path(names[0]).suffix
    binary = suffix == ".bin"
    size = sum((work / name).stat().st_size for name in names)
    _limit("RLIMIT_CPU", 6 + size // 1_000_000)
    _limit("RLIMIT_AS", (2 << 30) + 10 * size)
    for part in MODEL_STEMS:
        (folder / f"{part}{suffix}").write_bytes(bytes(8) if binary else b"")
    model, images = pycolmap.Reconstruction(), []
    for name in names:
        _say(stage=name, total=1)
        path = (work / name).replace(folder / name)
        length = _length(path)
        if binary:
            with path.open("ab") as file:
                file.write(_PADDING)
        (model.read_binary if binary else model.read_text)(folder)
        (model.write_binary if binary else model.write_text)(again)
        understood = _length(again / name)
        if length != understood:
            unit = "bytes" if binary else "words (names with blanks need .bin files)"
            raise ValueError(f"{length} {unit}, a model like it has {understood}")
        images = [_placed(image) for image in model.images.values()]
    points = [model.points3D[i].xyz for i in sorted(model.points3D)]
    np.save(work / POINTS, np.array(points, np.float64).reshape(-1, 3))
    return {"cameras": _cameras(model), "images": images}


def _cameras(model: Any) -> dict[int, tuple[str, int, int, list[float]]]:
    """Return the cameras of a model as `conventions.from_colmap` takes them."""
    return {
        i: (camera.model.name, camera.width, camera.height, camera.params.tolist())
        for i, camera in model.cameras.items()
    }


def _limit(name: str, most: int) -> None:
    try:
        import resource
    except ImportError:  # Windows has no limits of this kind
        return
    kind = getattr(resource, name)
    _, hard = resource.getrlimit(kind)
    if hard == resource.RLIM_INFINITY or most < hard:
        resource.setrlimit(kind, (most, hard))


def _placed(image: Any) -> tuple[str, int, list[float], list[float]]:
    """Return name, camera, quaternion (w, x, y, z) and translation, world to camera."""
    pose = image.cam_from_world()
    x, y, z, w = pose.rotation.quat.tolist()
    return image.name, image.camera_id, [w, x, y, z], pose.translation.tolist()


def _length(path: Path) -> int:
    """Return the bytes of a binary file, the words of a text file's records."""
    if path.suffix == ".bin":
        return path.stat().st_size
    with path.open(encoding="utf-8") as lines:
        return sum(len(line.split()) for line in lines if line[:1] != "#")


def _reconstruct(
    pycolmap: Any, task: dict[str, Any], work: Path
) -> dict[str, Any] | None:
    """Return what photographs show, None if nothing could be placed."""
    database, folder = work / "database.db", Path(task["folder"])
    count = sum(map(len, task["groups"]))
    pycolmap.set_random_seed(task["seed"])
    _say(stage="features", total=count)
    start = 0
    for names in task["groups"]:  # each call makes one camera
        _say(part=[start, len(names)])
        pycolmap.extract_features(
            database,
            folder,
            names,
            pycolmap.CameraMode.SINGLE,
            pycolmap.ImageReaderOptions(
                camera_model=task["lens"], mask_path=task["masks"]
            ),
            pycolmap.FeatureExtractionOptions(
                max_image_size=task["long_edge_px"], use_gpu=False
            ),
        )
        start += len(names)
    _assume_fisheye(pycolmap, database)
    _match(pycolmap, database, task["matching"], count=count)
    models = _map(pycolmap, database, folder, task=task)
    model = max(models.values(), key=lambda m: m.num_reg_images(), default=None)
    if model is None:
        return None
    model = _with_principal_points(pycolmap, model)
    with pycolmap.Database.open(database) as table:
        features = {
            image.name: table.num_keypoints_for_image(image.image_id)
            for image in table.read_all_images()
        }
    return {**_summary(model), "features": features}


def _assume_fisheye(pycolmap: Any, database: Path) -> None:
    """Begin with fisheyes of 115 degrees where EXIF data say no focal length.

    COLMAP finds a focal length from pairs of photographs, but not of fisheyes, which
    it would leave out. From here, it finds those of 70 degrees and of 180.
    """
    with pycolmap.Database.open(database) as table:
        for camera in table.read_all_cameras():
            if "FISHEYE" in camera.model.name and not camera.has_prior_focal_length:
                focal = max(camera.width, camera.height) / 2
                camera.params = [focal, focal, *camera.params[2:]]
                camera.has_prior_focal_length = True
                table.update_camera(camera)


def _end_with_parent() -> None:
    # the descriptor: the interpreter's end may not wait for sys.stdin's lock
    while os.read(0, 1):
        pass
    os._exit(1)


def _say(**what: Any) -> None:
    print(MARK + json.dumps(what), flush=True)


def _match(pycolmap: Any, database: Path, matching: str, count: int) -> None:
    if matching == "exhaustive":
        _say(stage="matches", total=count * (count - 1) // 2)
        pycolmap.match_exhaustive(database, pairing_options={"block_size": _BLOCK})
        return
    steps = {*range(1, _OVERLAP + 1), *(2**k for k in range(_OVERLAP))}
    _say(stage="matches", total=sum(max(0, count - step) for step in steps))
    pycolmap.match_sequential(database, pairing_options={"overlap": _OVERLAP})


def _map(pycolmap: Any, database: Path, folder: Path, task: dict[str, Any]) -> Any:
    placed = 2  # the first pair starts the map

    def count_image() -> None:
        nonlocal placed
        placed += 1
        _say(done=placed)

    _say(stage="poses", total=sum(map(len, task["groups"])))
    options = {"min_model_size": LEAST_IMAGES, "random_seed": task["seed"]}
    if "FISHEYE" in task["lens"]:  # a narrow one tells k3 and k4 badly
        options["max_extra_param"] = 10.0
    return pycolmap.incremental_mapping(
        database, folder, Path(task["work"]), options, next_image_callback=count_image
    )


def _with_principal_points(pycolmap: Any, model: Any) -> Any:
    """Return the model with principal points where photographs tell of them.

    COLMAP leaves them in the middle of the image, and a lens that sits beside it seems
    a turn of the camera. They are let go once all else is known, of cameras with many
    photographs; where one of them is not told to `_MOST_SD` of the longer edge, as
    when a camera looks and moves one way, all stay where they were.
    """
    images = model.reg_image_ids()
    placed = Counter(model.images[i].camera_id for i in images)
    many = [camera for camera, count in placed.items() if count >= _MANY]
    if not many:
        return model
    moved = pycolmap.Reconstruction(model)
    options = pycolmap.BundleAdjustmentOptions()
    options.refine_principal_point, options.print_summary = True, False
    config = pycolmap.BundleAdjustmentConfig()
    for i in images:
        config.add_image(i)
    for camera in placed.keys() - set(many):
        config.set_constant_cam_intrinsics(camera)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    adjuster = pycolmap.create_default_ceres_bundle_adjuster(options, config, moved)
    adjuster.solve()
    moved.update_point_3d_errors()
    covariances = pycolmap.estimate_ba_covariance(
        pycolmap.BACovarianceOptions(), moved, adjuster
    )
    error_px = moved.compute_mean_reprojection_error()
    cameras = (moved.cameras[i] for i in many)
    if covariances and all(
        _is_determined(covariances, camera, error_px) for camera in cameras
    ):
        return moved
    return model


def _is_determined(covariances: Any, camera: Any, error_px: float) -> bool:
    """Whether a covariance, of errors of 1 px, tells a camera's principal point."""
    covariance = covariances.get_other_params_cov(camera.params)
    if covariance is None:
        return False
    variances = np.diag(covariance)[list(camera.principal_point_idxs())]
    most = _MOST_SD * max(camera.width, camera.height)
    return bool(error_px * np.sqrt(variances.max()) <= most)


def _summary(model: Any) -> dict[str, Any]:
    """Return what `structure.Structure` is made of, as JSON has it."""
    images = sorted(
        (model.images[i] for i in model.reg_image_ids()), key=lambda image: image.name
    )
    poses = [image.cam_from_world().inverse().matrix().tolist() for image in images]
    point_errors = [
        [model.points3D[p.point3D_id].error for p in image.points2D if p.has_point3D()]
        for image in images
    ]
    points = [
        point.xyz.tolist()
        for point in model.points3D.values()
        if point.track.length() >= _LEAST_TRACK
    ]
    return {
        "names": [image.name for image in images],
        "camera_to_world": poses,
        "cameras": _cameras(model),
        "camera_ids": [image.camera_id for image in images],
        "points": points,
        "points_seen": [len(errors) for errors in point_errors],
        "errors_px": [sum(errors) / max(1, len(errors)) for errors in point_errors],
        "error_px": model.compute_mean_reprojection_error(),
    }


if __name__ == "__main__":
    sys.exit(main())
