"""What the policy saw: frames of drives, as a strip and as EXR files with layers.

The first drive of each environment and case, whose objects look alike in all drives, is
driven again by its recorded controls, which gives the frames that the policy saw.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path

import numpy as np

from mi_nerfattack.deploy.environment import AbstractEnvironment, CameraFrame
from mi_nerfattack.evaluation.metrics import environment_order
from mi_nerfattack.io import exr, files
from mi_nerfattack.report.plots.strip import aligned_steps, first_person_strip
from mi_nerfattack.rollout.drive import CASES, NO_OBJECT, Drive
from mi_nerfattack.scenario.deployment import SURROGATE
from mi_nerfattack.scenario.world import Appearance, World

STRIP_FRAMES = 6
EXR_FRAMES = 3


def write_pictures(
    output: Path,
    world: World,
    drives: Iterable[Drive],
    looks: Mapping[str, Appearance | None],
) -> None:
    """Write ``strip.png`` and ``frames/``.

    Args:
        output: the run folder.
        world: what was driven in; its textures are changed.
        drives: all drives.
        looks: how the objects look and where they stand, per case; None: nowhere.
    """
    files.make_folder(output / "frames")
    rows: dict[str, list[np.ndarray]] = {}
    nominal = [d for d in drives if d.run == 0 and d.case in looks]
    nominal.sort(key=lambda d: (environment_order(d.environment), CASES.index(d.case)))
    places, passed = aligned_steps(world.route, nominal, STRIP_FRAMES)
    for drive, columns in zip(nominal, passed, strict=True):
        if look := looks[drive.case]:
            world.show(look)
        environment = world.open(drive.environment, empty=look is None)
        try:
            row = rows[f"{drive.environment}\n{drive.case.replace('_', ' ')}"] = []
            written = _steps(drive, EXR_FRAMES)
            wanted = {*columns, *written}
            for step, frame in _again(environment, world, drive, wanted):
                row += [frame.image] * columns.count(step)
                if step in written:
                    _write_frame(output / "frames", world, drive, step, frame)
        finally:
            environment.close()
    titles = [f"{place:.1f} m" for place in places]
    first_person_strip(output / "strip.png", rows, titles)


def _steps(drive: Drive, count: int) -> list[int]:
    last = len(drive.controls) - 1
    return np.unique(np.linspace(0, last, count).round().astype(int)).tolist()


def _again(
    environment: AbstractEnvironment, world: World, drive: Drive, wanted: set[int]
) -> Iterator[tuple[int, CameraFrame]]:
    """Yield some frames of a drive, each with the index of the control it led to."""
    frame = environment.reset(world.route, drive.states[0], drive.seed)
    if 0 in wanted:
        yield 0, frame
    for step, control in enumerate(drive.controls[:-1], start=1):
        if step in wanted:
            yield step, environment.step(float(control))
        else:
            environment.advance(float(control))


def _write_frame(
    folder: Path, world: World, drive: Drive, step: int, frame: CameraFrame
) -> None:
    shown = () if drive.case == NO_OBJECT else world.scenario.objects
    names = [item.id for item in shown]
    metadata = {
        "scenario": world.scenario.name,
        "environment": drive.environment,
        "case": drive.case,
        "step": str(step),
        "camera_to_world": " ".join(f"{v:.9g}" for v in frame.camera_to_world.ravel()),
        "camera": str(world.surrogate.camera),
    }
    # path-traced light sources may exceed the range of half precision
    half = drive.environment == SURROGATE
    layers = frame.layers(["object"] if len(names) == 1 else names)
    name = f"{drive.environment}_{drive.case}_{step:04d}.exr"
    exr.write_layers(folder / name, layers, metadata, half)
