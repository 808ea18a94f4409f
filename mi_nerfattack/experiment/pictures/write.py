"""All pictures of a run: plots, attribution, the triptych, frames and videos."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np

from mi_nerfattack.deploy.views.above import scene_above, surrogate_above
from mi_nerfattack.deploy.views.paste import Paster
from mi_nerfattack.experiment.attribution import (
    attribute,
    plot_control_changes,
    write_attribution,
)
from mi_nerfattack.experiment.cases import OnProgress, step_counter
from mi_nerfattack.experiment.checks.before_attack import mesh_scene
from mi_nerfattack.experiment.finished import Finished, Frames
from mi_nerfattack.experiment.pictures.frames import (
    frame_folder,
    nominal_drives,
    write_frames,
)
from mi_nerfattack.io import files
from mi_nerfattack.io.video import write_video
from mi_nerfattack.render.camera.outside import Overhead
from mi_nerfattack.render.posed import object_footprints
from mi_nerfattack.report.plots.curves import convergence
from mi_nerfattack.report.plots.drives import by_name, errors
from mi_nerfattack.report.plots.map import Panel, overhead, write_maps
from mi_nerfattack.report.plots.strip import tiles
from mi_nerfattack.rollout.drive import ATTACK, OWN, Drive
from mi_nerfattack.scenario.deployment import SURROGATE


def write_images(
    output: Path,
    done: Finished,
    history: list[dict[str, Any]],
    frames: Frames,
    on_progress: OnProgress,
) -> None:
    """Write plots, attribution and frames; of all frames, videos, too.

    Args:
        output: the run folder; what an earlier run left of attribution and videos is
            removed.
        done: results of the run; the objects have other textures afterwards.
        history: one record per iteration of the attack.
        frames: which frames become files.
        on_progress: called after every time step of attribution and frames.
    """
    world, limit = done.world, done.lane.wheel_m
    for path in (*output.glob("attribution*"), *(output / "videos").glob("*.mp4")):
        path.unlink()
    _write_plots(output, done, history)
    unit = world.scenario.vehicle.car().control_unit
    _write_triptych(output, done)
    plot_control_changes(output, done.replayed, unit)
    if world.policy.differentiable:
        names = [item.id for item in world.scenario.objects]
        sweeps = 3 * world.horizon
        on_step = step_counter(on_progress, "surrogate: attribution", sweeps)
        attribution = attribute(done.attack, names, limit, on_step=on_step)
        write_attribution(output, attribution, world.fields)
    write_frames(output, done, frames, on_progress=on_progress)
    if frames == "all":
        _write_videos(output, done, on_progress)


def _write_plots(output: Path, done: Finished, history: list[dict[str, Any]]) -> None:
    world, drives, limit = done.world, done.driven, done.lane.wheel_m
    footprints = object_footprints(world.surrogate.objects)
    overhead(
        output / "overhead.png",
        drives,
        world.route,
        object_footprints=footprints,
        limit=limit,
    )
    errors(output / "errors.png", by_name(drives), {world.route.name: limit})
    convergence(output / "convergence.png", history, done.curve)


_GROUND_PX = 400  # of the longer edge of pictures from above


def _write_triptych(output: Path, done: Finished) -> None:
    """Draw unperturbed, surrogate and transferred drives over the rendered ground.

    The objects look attacked afterwards. Source: appendix, figure C.3.
    """
    world, route = done.world, done.world.route
    others = [x for x in world.deployments if not world.is_open_loop(x)]
    pairs = [
        (OWN, [*others, SURROGATE][0]),
        *((ATTACK, x) for x in [SURROGATE, *others]),
    ]
    groups = [
        [d for d in done.driven if (d.case, d.environment) == pair] for pair in pairs
    ]
    points = [d.states[:, :2] for group in groups for d in group]
    footprints = object_footprints(world.surrogate.objects)
    ground_points = np.concatenate([*points, *footprints])
    above = Overhead.covering(ground_points, route.lane_width_m, _GROUND_PX)
    scene = mesh_scene(world)
    bare = None if scene is None else scene_above(scene, above, points[0], spp=4)
    panels = []
    for (case, label), drives in zip(pairs, groups, strict=True):
        world.show(done.look(case))
        objects = world.surrogate.objects
        if label == SURROGATE or bare is None:
            ground = surrogate_above(world.surrogate, above)
        else:
            ground = Paster(above.camera, objects).paste(bare).image
        name = "original" if case == OWN else case
        title = f"({chr(97 + len(panels))}) {name}, {label}"
        panels.append(Panel(title, drives, object_footprints(objects), ground=ground))
    world.show(done.look(ATTACK))
    limit, extent = done.lane.wheel_m, above.extent
    write_maps(output / "triptych.png", panels, route, limit=limit, extent=extent)


def _write_videos(output: Path, done: Finished, on_progress: OnProgress) -> None:
    """Write ``videos/ENV.mp4`` from the frames of all control periods, in real time."""
    files.make_folder(output / "videos")
    nominal = nominal_drives(done.drives, done.looks)
    groups = groupby(nominal, lambda drive: drive.environment)
    for label, group in groups:
        drives = list(group)
        pictures = _pictures(output, drives, f"{label}: video", on_progress=on_progress)
        path = output / "videos" / f"{label}.mp4"
        write_video(path, pictures, 1 / float(drives[0].time_s[0]))


def _pictures(
    output: Path, drives: list[Drive], stage: str, on_progress: OnProgress
) -> Iterator[np.ndarray]:
    """Lay the frames of all drives side by side; a drive that is over stands still."""
    count = 1 + max(len(drive.controls) for drive in drives)
    for step in range(count):
        images = {}
        for drive in drives:
            own = min(step, len(drive.controls))
            time_s, error = 0.0, ""
            if own:
                time_s = drive.time_s[own - 1]
                error = f"{drive.cross_track_m[own - 1]:+.2f} m"
            title = f"{drive.case.replace('_', ' ')}  {time_s:.1f} s  {error}"
            path = frame_folder(output, drive) / f"{own:04d}.png"
            images[title] = files.read_image(path)
        yield tiles(images)
        on_progress(stage, step + 1, count, "")
