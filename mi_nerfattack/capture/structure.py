"""Structure from motion by pycolmap: features, matches, poses, one camera."""

from __future__ import annotations

import signal
import sqlite3
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from mi_nerfattack.errors import InputError
from mi_nerfattack.render.camera import Camera
from mi_nerfattack.render.conventions import from_colmap

Matching = Literal["exhaustive", "sequential"]
Lens = Literal["SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV"]
StageCallback = Callable[[str, int, int], None]

_OVERLAP = 10  # sequential: neighbours, and neighbours at distances 2^k, k < overlap
_LEAST_TRACK = 3  # images that see a point which counts
_LEAST_IMAGES = 3
_POLL_S = 0.5
_ERRORS_ONLY = 2


@dataclass(frozen=True, eq=False)
class Structure:
    """What structure from motion found, in a world of arbitrary frame and unit.

    Attributes:
        names: n images that were placed, sorted.
        camera_to_world: (n, 4, 4), OpenCV axes.
        camera: of all images.
        points: (m, 3), seen in at least three images each.
        error_px: mean reprojection error.
    """

    names: tuple[str, ...]
    camera_to_world: np.ndarray
    camera: Camera
    points: np.ndarray
    error_px: float


def reconstruct(
    folder: Path,
    names: Sequence[str],
    work: Path,
    matching: Matching,
    lens: Lens,
    long_edge_px: int,
    seed: int,
    progress: StageCallback,
) -> Structure:
    """Estimate poses and the one camera of photographs, on the CPU.

    Args:
        folder: of the photographs, all of one size.
        names: of the photographs, in the order they were taken if matching is
            sequential.
        work: an empty folder for intermediate files.
        matching: every photograph with every other one, or with its neighbours.
        lens: COLMAP's camera model.
        long_edge_px: features are looked for at most at this size.
        seed: of the random choices. Threads leave differences from run to run.
        progress: called with stage, done and total.

    Raises:
        InputError: pycolmap is not installed, fewer than 3 photographs could be
            placed, or the lens is impossible.
    """
    pycolmap = _pycolmap()
    database = work / "database.db"
    steps = _Steps(database, pycolmap.CancellationToken(), progress)
    with _quiet(pycolmap.logging):
        pycolmap.set_random_seed(seed)
        steps.run(
            "features",
            len(names),
            "SELECT count(*) FROM descriptors",
            pycolmap.extract_features,
            database,
            folder,
            list(names),
            pycolmap.CameraMode.SINGLE,
            {"camera_model": lens},
            {"max_image_size": long_edge_px, "use_gpu": False},
        )
        match, options, pairs = _matcher(pycolmap, matching, len(names))
        query = "SELECT count(*) FROM two_view_geometries"
        steps.run("matches", pairs, query, match, database, **options)
        models = _map(pycolmap, steps, folder, work, len(names), seed)
    return _best(models, len(names))


def _pycolmap() -> Any:
    before = signal.getsignal(signal.SIGTERM)
    try:
        import pycolmap
    except ImportError as error:
        raise InputError(
            f"pycolmap: {error}; poses are estimated with it: pip install pycolmap, "
            "or reconstruct with COLMAP elsewhere and give the model to 'fit'"
        ) from error
    # its import takes SIGTERM to print a stack trace; it must end us as before
    if before is not None and threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGTERM, before)
    return pycolmap


def _matcher(
    pycolmap: Any, matching: Matching, count: int
) -> tuple[Callable[..., None], dict[str, Any], int]:
    """Return the function that matches, its options, and the number of pairs."""
    if matching == "exhaustive":
        return pycolmap.match_exhaustive, {}, count * (count - 1) // 2
    steps = {*range(1, _OVERLAP + 1), *(2**k for k in range(_OVERLAP))}
    pairs = sum(max(0, count - step) for step in steps)
    options = {"pairing_options": {"overlap": _OVERLAP}}
    return pycolmap.match_sequential, options, pairs


def _map(
    pycolmap: Any, steps: _Steps, folder: Path, work: Path, count: int, seed: int
) -> Any:
    placed = [2]  # the first pair starts the map

    def count_image() -> None:
        placed[0] += 1

    return steps.run(
        "poses",
        count,
        lambda: placed[0],
        pycolmap.incremental_mapping,
        steps.database,
        folder,
        work,
        {"min_model_size": _LEAST_IMAGES, "random_seed": seed},
        next_image_callback=count_image,
    )


def _best(models: Any, count: int) -> Structure:
    model = max(models.values(), key=lambda m: m.num_reg_images(), default=None)
    placed = 0 if model is None else model.num_reg_images()
    if model is None or placed < _LEAST_IMAGES:
        raise InputError(
            f"photographs: {placed} of {count} could be placed, at least "
            f"{_LEAST_IMAGES} are needed; take them of a still scene with texture, "
            "from different places, each part of it in three photographs or more"
        )
    images = sorted(
        (model.images[i] for i in model.reg_image_ids()), key=lambda image: image.name
    )
    poses = np.tile(np.eye(4), (placed, 1, 1))
    poses[:, :3] = [image.cam_from_world().inverse().matrix() for image in images]
    found = model.cameras[images[0].camera_id]
    try:
        camera = from_colmap(
            found.model.name, found.width, found.height, list(found.params)
        )
    except InputError as error:
        raise InputError(
            f"photographs: the estimated lens is impossible ({error}); take a simpler "
            "one (--lens SIMPLE_RADIAL) or more photographs"
        ) from error
    points = [
        point.xyz
        for point in model.points3D.values()
        if point.track.length() >= _LEAST_TRACK
    ]
    return Structure(
        tuple(image.name for image in images),
        poses,
        camera,
        np.array(points, np.float64).reshape(-1, 3),
        float(model.compute_mean_reprojection_error()),
    )


class _Steps:
    """Runs pycolmap's functions in a thread, so that progress and Ctrl-C work."""

    def __init__(self, database: Path, token: Any, progress: StageCallback) -> None:
        self.database = database
        self._token, self._progress = token, progress

    def run(
        self,
        stage: str,
        total: int,
        done: str | Callable[[], int],
        function: Callable[..., Any],
        *arguments: Any,
        **options: Any,
    ) -> Any:
        """Return what a function returns; `done` is asked, or the database with it."""
        result: list[Any] = []
        failure: list[BaseException] = []

        def work() -> None:
            try:
                result.append(
                    function(*arguments, **options, cancellation_token=self._token)
                )
            except BaseException as error:  # raised again below
                failure.append(error)
            finally:
                ended.set()

        # not join(): interrupted, it may take a running thread for an ended one
        ended = threading.Event()
        thread = threading.Thread(target=work)
        thread.start()
        try:
            while not ended.wait(_POLL_S):
                count = self._ask(done) if isinstance(done, str) else done()
                self._progress(stage, min(count, total - 1), total)
        except BaseException:
            self._token.cancel()
            ended.wait()
            raise
        finally:
            thread.join()
        if failure:
            raise failure[0]
        self._progress(stage, total, total)
        return result[0]

    def _ask(self, query: str) -> int:
        """Return a count from the database, 0 while it is busy or not yet there."""
        try:
            uri = f"{self.database.as_uri()}?mode=ro"
            with closing(sqlite3.connect(uri, uri=True, timeout=0.1)) as connection:
                return connection.execute(query).fetchone()[0]
        except sqlite3.Error:
            return 0


@contextmanager
def _quiet(logging: Any) -> Iterator[None]:
    """Keep COLMAP's log off the terminal and the disk."""
    before = logging.minloglevel
    logging.minloglevel = _ERRORS_ONLY
    try:
        yield
    finally:
        logging.minloglevel = before
