"""pycolmap in a process of its own: ``python -m mi_nerfattack.capture.colmap.process``.

A native crash, or COLMAP's own abort, then ends this process and not its user's. The
task comes as one line of JSON on standard input; when that is closed, nobody waits any
longer and the process ends. What it is at goes to standard output as lines that start
with `MARK`, between COLMAP's log lines; what it found, to `RESULT` in the working
folder.
"""

from __future__ import annotations

import json
import os
import sys
import threading
from pathlib import Path
from typing import Any

MARK = "@ "
RESULT = "structure.json"
LEAST_IMAGES = 3

_LEAST_TRACK = 3  # images that see a point which counts
_OVERLAP = 10  # sequential: neighbours, and neighbours at distances 2^k, k < overlap
_BLOCK = 10  # exhaustive: photographs a side of the squares of pairs that are logged


def main() -> int:
    """Run the task on standard input."""
    task = json.loads(sys.stdin.readline())
    threading.Thread(target=_end_with_parent, daemon=True).start()
    try:
        import pycolmap
    except ImportError as error:
        _say(missing=str(error))
        return 2
    database, folder = Path(task["work"]) / "database.db", Path(task["folder"])
    names = task["names"]
    pycolmap.logging.logtostderr = True  # no file among the temporary ones
    pycolmap.set_random_seed(task["seed"])
    _say(stage="features", total=len(names))
    pycolmap.extract_features(
        database,
        folder,
        names,
        pycolmap.CameraMode.SINGLE,
        {"camera_model": task["lens"]},
        {"max_image_size": task["long_edge_px"], "use_gpu": False},
    )
    _match(pycolmap, database, task["matching"], len(names))
    models = _map(pycolmap, database, folder, task)
    found = max(models.values(), key=lambda m: m.num_reg_images(), default=None)
    result = None if found is None else _summary(found)
    (Path(task["work"]) / RESULT).write_text(json.dumps(result), encoding="utf-8")
    return 0


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

    _say(stage="poses", total=len(task["names"]))
    options = {"min_model_size": LEAST_IMAGES, "random_seed": task["seed"]}
    return pycolmap.incremental_mapping(
        database, folder, Path(task["work"]), options, next_image_callback=count_image
    )


def _summary(model: Any) -> dict[str, Any]:
    """Return what `structure.Structure` is made of, as JSON has it."""
    images = sorted(
        (model.images[i] for i in model.reg_image_ids()), key=lambda image: image.name
    )
    camera = model.cameras[images[0].camera_id]
    poses = [image.cam_from_world().inverse().matrix().tolist() for image in images]
    points = [
        point.xyz.tolist()
        for point in model.points3D.values()
        if point.track.length() >= _LEAST_TRACK
    ]
    return {
        "names": [image.name for image in images],
        "camera_to_world": poses,
        "model": camera.model.name,
        "size": [camera.width, camera.height],
        "parameters": camera.params.tolist(),
        "points": points,
        "error_px": model.compute_mean_reprojection_error(),
    }


if __name__ == "__main__":
    sys.exit(main())
