"""Structure from motion by pycolmap: features, matches, poses, one camera."""

from __future__ import annotations

import contextlib
import json
import re
import signal
import subprocess
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from mi_nerfattack.capture.colmap.process import LEAST_IMAGES, MARK, RESULT
from mi_nerfattack.errors import InputError, SetupError
from mi_nerfattack.render.camera.conventions import from_colmap
from mi_nerfattack.render.camera.intrinsics import Camera
from mi_nerfattack.system.processes import module_command

Matching = Literal["exhaustive", "sequential"]
Lens = Literal["SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV"]
StageCallback = Callable[[str, int, int], None]

_CHILD = "mi_nerfattack.capture.colmap.process"
_LAST_LINES = 5
# COLMAP's log: "Processed file [3/12]", "Processing image [3/12]" or, of squares of
# pairs, "Processing block [1/2, 2/2]"
_COUNT = re.compile(r"Process\w+ (file|image|block) \[(\d+)/(\d+)(?:, (\d+)/(\d+))?\]")


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

    pycolmap runs in a process of its own, which is ended when `progress` raises.

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
        SetupError: pycolmap failed or crashed.
    """
    task = {
        "folder": str(folder),
        "names": list(names),
        "work": str(work),
        "matching": matching,
        "lens": lens,
        "long_edge_px": long_edge_px,
        "seed": seed,
    }
    stages = _Stages(progress)
    code = _run(task, stages)
    if stages.missing is not None:
        raise InputError(
            f"pycolmap: {stages.missing}; poses are estimated with it: pip install "
            "pycolmap, or reconstruct with COLMAP elsewhere and give the model to 'fit'"
        )
    if code:
        raise SetupError(stages.failure(code))
    stages.end()
    found = json.loads((work / RESULT).read_text(encoding="utf-8"))
    return _structure(found, len(names))


def _run(task: dict[str, Any], stages: _Stages) -> int:
    """Return the exit code of the process that does a task."""
    process = subprocess.Popen(
        module_command(_CHILD),
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        encoding="utf-8",
        errors="replace",
        start_new_session=True,  # Ctrl-C is for us; we end it
    )
    assert process.stdin is not None and process.stdout is not None
    with process:
        try:
            with contextlib.suppress(BrokenPipeError):  # its last lines say why
                process.stdin.write(json.dumps(task) + "\n")
                process.stdin.flush()
            stages.follow(process.stdout)
            return process.wait()
        except BaseException:
            process.kill()
            raise


class _Stages:
    """Reads what the process says, and reports its progress."""

    def __init__(self, progress: StageCallback) -> None:
        self.missing: str | None = None
        self._progress = progress
        self._stage, self._total = "start", 0
        self._last: deque[str] = deque(maxlen=_LAST_LINES)

    def follow(self, lines: Iterable[str]) -> None:
        """Read lines until there are no more."""
        for line in lines:
            if line.startswith(MARK):
                self._told(json.loads(line[len(MARK) :]))
            else:
                self._logged(line)

    def _told(self, what: dict[str, Any]) -> None:
        self.missing = what.get("missing")
        if "stage" in what:
            self.end()
            self._stage, self._total = what["stage"], what["total"]
            self._show(0)
        if "done" in what:
            self._show(what["done"])

    def _logged(self, line: str) -> None:
        if line.strip():
            self._last.append(line.strip())
        count = _COUNT.search(line)
        if count is None:
            return
        kind, *numbers = count.groups()
        i, n, j, m = (1 if number is None else int(number) for number in numbers)
        # a file's line comes when it is done, the others when they begin
        done = (i - 1) * m + j - (kind != "file")
        self._show(self._total * done // (n * m))

    def _show(self, done: int) -> None:
        self._progress(self._stage, min(done, self._total - 1), self._total)

    def end(self) -> None:
        """Report that the stage is done."""
        if self._total:
            self._progress(self._stage, self._total, self._total)

    def failure(self, code: int) -> str:
        """Tell how the process ended, from its exit code, and what to do."""
        how = f"ended with code {code}"
        if code < 0:
            with contextlib.suppress(ValueError):
                how = f"was ended by {signal.Signals(-code).name}"
        last = "; ".join(self._last) or "nothing"
        return (
            f"pycolmap: {how} at the stage {self._stage!r} (its last lines: {last}); "
            "see that memory and the disk of temporary files are not full, look for "
            "features at a smaller size (--long-edge), or reconstruct with COLMAP "
            "elsewhere and give the model to 'fit'"
        )


def _structure(found: dict[str, Any] | None, count: int) -> Structure:
    placed = 0 if found is None else len(found["names"])
    if found is None or placed < LEAST_IMAGES:
        raise InputError(
            f"photographs: {placed} of {count} could be placed, at least "
            f"{LEAST_IMAGES} are needed; take them of a still scene with texture, "
            "from different places, each part of it in three photographs or more"
        )
    poses = np.tile(np.eye(4), (placed, 1, 1))
    poses[:, :3] = found["camera_to_world"]
    try:
        camera = from_colmap(found["model"], *found["size"], found["parameters"])
    except InputError as error:
        raise InputError(
            f"photographs: the estimated lens is impossible ({error}); take a simpler "
            "one (--lens SIMPLE_RADIAL) or more photographs"
        ) from error
    return Structure(
        tuple(found["names"]),
        poses,
        camera,
        np.array(found["points"], np.float64).reshape(-1, 3),
        found["error_px"],
    )
