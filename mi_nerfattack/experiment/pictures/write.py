"""All pictures of a run."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from mi_nerfattack.experiment.attribution import attribute, write_attribution
from mi_nerfattack.experiment.finished import Finished, Frames
from mi_nerfattack.experiment.pictures.frames import write_frames
from mi_nerfattack.experiment.pictures.triptych import write_triptych
from mi_nerfattack.experiment.pictures.videos import write_videos
from mi_nerfattack.experiment.replayed import plot_control_changes
from mi_nerfattack.experiment.stages import OnProgress, step_counter
from mi_nerfattack.report.plots import drives as plots
from mi_nerfattack.report.plots.convergence import convergence
from mi_nerfattack.scenario.world import object_footprints


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
        done: what the run came to; the objects look different afterwards.
        history: a record an iteration of the attack.
        frames: which frames become files.
        on_progress: told about every time step of attribution and frames.
    """
    world, limit = done.world, done.lane.wheel_m
    for path in (*output.glob("attribution*"), *(output / "videos").glob("*.mp4")):
        path.unlink()
    _write_plots(output, done, history)
    unit = world.scenario.vehicle.car().control_unit
    write_triptych(output, done)
    plot_control_changes(output, done.replayed, unit)
    if world.policy.differentiable:
        names = [item.id for item in world.scenario.objects]
        sweeps = 3 * world.horizon
        on_step = step_counter(on_progress, "surrogate: attribution", sweeps)
        found = attribute(done.attack, names, limit, on_step)
        write_attribution(output, found, world.fields)
    write_frames(output, done, frames, on_progress)
    if frames == "all":
        write_videos(output, done, on_progress)


def _write_plots(output: Path, done: Finished, history: list[dict[str, Any]]) -> None:
    world, drives, limit = done.world, done.driven, done.lane.wheel_m
    route = world.route
    plots.overhead(
        output / "overhead.png",
        drives,
        route.points,
        route.lane_width_m,
        object_footprints(world.surrogate.objects),
        limit,
    )
    plots.errors(output / "errors.png", drives, limit)
    convergence(output / "convergence.png", history, done.curve)
