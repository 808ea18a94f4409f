"""What the policy saw: frames of drives, as a strip and as EXR files with layers.

The first drive of each environment and case, whose objects look alike in all drives, is
driven again by its recorded controls, which gives the frames that the policy saw.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np

from mi_nerfattack.deploy.environment import AbstractEnvironment, CameraFrame
from mi_nerfattack.evaluation.metrics import environment_order
from mi_nerfattack.io import exr, files
from mi_nerfattack.render.camera.intrinsics import Camera
from mi_nerfattack.render.pathtrace.metadata import describe_lens, frame_metadata
from mi_nerfattack.report.plots.strip import aligned_steps, first_person_strip
from mi_nerfattack.rollout.drive import CASES, Drive
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
        digests = _digests(world, look)
        names = [item.id for item in world.scenario.objects] if look else []
        # path-traced light sources may exceed the range of half precision
        half = drive.environment == SURROGATE
        environment = world.open(drive.environment, empty=look is None)
        try:
            row = rows[f"{drive.environment}\n{drive.case.replace('_', ' ')}"] = []
            written = _steps(drive, EXR_FRAMES)
            wanted = {*columns, *written}
            for step, frame in _again(environment, world, drive, wanted):
                row += [frame.image] * columns.count(step)
                if step in written:
                    about = drive, step, frame, environment.camera, digests
                    name = f"{drive.environment}_{drive.case}_{step:04d}.exr"
                    path = output / "frames" / name
                    _write_frame(path, frame, names, _describe(world, *about), half)
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
    path: Path,
    frame: CameraFrame,
    objects: Sequence[str],
    metadata: Mapping[str, str],
    half: bool,
) -> None:
    names = ["object"] if len(objects) == 1 else objects
    exr.write_layers(path, frame.layers(names), metadata, half)


def _digests(world: World, look: Appearance | None) -> dict[str, str]:
    """Hash the scenario's files, and the textures as files of fields hold them."""
    found = world.scenario.digests()
    if look is None:
        return found
    objects = zip(world.scenario.objects, world.fields, look.textures, strict=True)
    for item, field, texture in objects:
        raw = texture[field.held_vertices()].astype(np.float16).tobytes()
        found[f"texture.{item.id}"] = hashlib.sha256(raw).hexdigest()
    return found


def _describe(
    world: World,
    drive: Drive,
    step: int,
    frame: CameraFrame,
    camera: Camera,
    digests: Mapping[str, str],
) -> dict[str, str]:
    """Say what a frame of a drive shows; see :func:`frame_metadata`."""
    state, label = drive.states[step], drive.environment
    driven = step < len(drive.controls)
    return frame_metadata(
        describe_lens(camera),
        frame.camera_to_world,
        drive.seed,
        1 if label == SURROGATE else world.deployments[label].spp,
        digests,
        scenario=world.scenario.name,
        environment=label,
        case=drive.case,
        run=drive.run,
        step=step,
        time_s=step * world.scenario.vehicle.dt_s,
        state=state.tolist(),
        control=float(drive.controls[step]) if driven else None,
        cross_track_m=float(world.route.cross_track_numpy(state[None])[0]),
    )
