"""Write the run folder: metrics, tables, fields, frames, plots, page."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from mi_nerfattack.attack.gradient import GradientAttack
from mi_nerfattack.backend.versions import versions
from mi_nerfattack.evaluation.metrics import metrics_document
from mi_nerfattack.experiment.attribution import attribute, write_attribution
from mi_nerfattack.fields import save_field
from mi_nerfattack.io import exr, files
from mi_nerfattack.render.camera.intrinsics import mount_matrix
from mi_nerfattack.report.pages.attack import write_report
from mi_nerfattack.report.plots import drives as plots
from mi_nerfattack.report.plots.strip import first_person_strip
from mi_nerfattack.report.table import write_steps
from mi_nerfattack.rollout.drive import Drive, departure_limit
from mi_nerfattack.rollout.loop import OnStep
from mi_nerfattack.scenario.world import Appearance, World, object_footprints
from mi_nerfattack.vehicle.state import to_state

STRIP_FRAMES = 6
EXR_FRAMES = 3


def write_results(
    output: Path,
    world: World,
    drives: list[Drive],
    attack: GradientAttack,
    looks: dict[str, Appearance],
    scenario_text: str,
    cost: dict[str, Any],
    ignored: list[str],
    on_step: OnStep | None = None,
) -> dict[str, Any]:
    """Write everything but scenario and checkpoint.

    Args:
        output: the run folder, present.
        world: what was driven in; its textures are changed.
        drives: all drives.
        attack: the finished attack.
        looks: how the objects look and where they stand, per case.
        scenario_text: the scenario file.
        cost: of the run, as `metrics.json` holds it.
        ignored: changes between interruption and resumption that were ignored.
        on_step: called after each of the 3 x horizon control periods of the
            attribution.

    Returns:
        the document that ``metrics.json`` holds.
    """
    scenario = world.scenario
    route = world.route
    limit = departure_limit(route.lane_width_m, scenario.vehicle.width_m)
    limits = {route.name: limit}
    document = metrics_document(
        scenario.model_dump(mode="json"), scenario.seed, drives, limits, cost
    )
    if attack.freedom.pose_rate is not None:
        document["object_poses"] = _poses(world, looks["gradient"])
    if ignored:
        document["ignored_changes"] = ignored
    files.write_json(output / "metrics.json", document)
    write_steps(output / "steps.csv", drives, limits)
    history = [asdict(record) for record in attack.history]
    files.write_json(output / "attack.json", history)
    files.make_folder(output / "objects")
    for grid, item, texture in zip(
        world.fields, scenario.objects, looks["gradient"].textures, strict=True
    ):
        grid.set_parameter("texture", texture)
        save_field(output / "objects" / f"{item.id}.safetensors", grid)
    images = _write_plots(output, world, drives, history, limit)
    names = [item.id for item in scenario.objects]
    found = attribute(attack, names, limit, on_step)
    images |= write_attribution(output, found, world.fields)
    images["First-person frames"] = output / "strip.png"
    first_person_strip(images["First-person frames"], *_strip(world, drives, looks))
    _write_frames(output / "frames", world, drives, looks)
    write_report(output / "report.html", document, images, scenario_text, versions())
    return document


def _poses(world: World, look: Appearance) -> dict[str, Any]:
    """Say where the attacked objects stand, by their ids."""
    world.show(look)
    poses = {}
    for item, posed, offset in zip(
        world.scenario.objects, world.surrogate.objects, look.offsets, strict=True
    ):
        poses[item.id] = {
            "shift_m": offset[:3].tolist(),
            "rotation_vector": offset[3:].tolist(),
            "position_m": posed.placed.translation.tolist(),
            "rotation": posed.placed.rotation.tolist(),
        }
    return poses


def _write_plots(
    output: Path,
    world: World,
    drives: list[Drive],
    history: list[dict[str, Any]],
    limit: float,
) -> dict[str, Path]:
    images = {
        "Overhead view": output / "overhead.png",
        "Cross-track error": output / "errors.png",
        "Convergence of the attack": output / "convergence.png",
    }
    route = world.route
    plots.overhead(
        images["Overhead view"],
        drives,
        route.points,
        route.lane_width_m,
        object_footprints(world),
        limit,
    )
    plots.errors(images["Cross-track error"], drives, limit)
    plots.convergence(images["Convergence of the attack"], history)
    return images


def _first_drives(drives: list[Drive]) -> dict[tuple[str, str], Drive]:
    """Return the nominal drive (run 0) of each environment and case but random."""
    return {
        (drive.environment, drive.case): drive
        for drive in drives
        if drive.run == 0 and drive.case != "random"
    }


def _steps(drive: Drive, count: int) -> np.ndarray:
    last = len(drive.controls) - 1
    return np.unique(np.linspace(0, last, count).round().astype(int))


def _strip(
    world: World, drives: list[Drive], looks: dict[str, Appearance]
) -> tuple[dict[str, list[np.ndarray]], list[float]]:
    rows, times = {}, []
    for (environment, case), drive in sorted(_first_drives(drives).items()):
        world.show(looks[case])
        sensor = world.surrogate if environment == "surrogate" else world.deployment
        steps = _steps(drive, STRIP_FRAMES)
        times = [float(step) * world.scenario.vehicle.dt_s for step in steps]
        frames = []
        for step in steps:
            seen = sensor.observe(to_state(drive.states[step]), int(step))
            frames.append(np.round(255 * np.array(seen.image)[0]).astype(np.uint8))
        rows[f"{environment}\n{case}"] = frames
    return rows, times


def _write_frames(
    folder: Path,
    world: World,
    drives: list[Drive],
    looks: dict[str, Appearance],
) -> None:
    files.make_folder(folder)
    for (environment, case), drive in _first_drives(drives).items():
        world.show(looks[case])
        for step in _steps(drive, EXR_FRAMES):
            state = drive.states[step]
            pose = mount_matrix(state[None], world.surrogate.mount)[0]
            layers = (
                _surrogate_layers(world, state, int(step))
                if environment == "surrogate"
                else world.deployment.layers(pose, int(step), _exr_names(world))
            )
            metadata = {
                "scenario": world.scenario.name,
                "environment": environment,
                "case": case,
                "step": str(step),
                "camera_to_world": " ".join(f"{v:.9g}" for v in pose.ravel()),
                "camera": str(world.surrogate.camera),
            }
            name = f"{environment}_{case}_{step:04d}.exr"
            # path-traced light sources may exceed the range of half precision
            half = environment == "surrogate"
            exr.write_layers(folder / name, layers, metadata, half)


def _surrogate_layers(
    world: World, state: np.ndarray, step: int
) -> dict[str, np.ndarray]:
    sensor = world.surrogate
    observation = sensor.observe(to_state(state), step)
    seen = observation.seen
    assert seen is not None
    behind = sensor.behind(observation)
    shape = (sensor.camera.height, sensor.camera.width)
    layers = seen.total.images("", shape)
    through = (1 - seen.total.opacity) * behind
    layers[""][..., :3] += through.numpy().T.reshape(*shape, 3)
    layers[""][..., 3] = 1.0
    scenery = [f"scene{k or ''}" for k in range(len(sensor.scene))]
    names = [*scenery, *_exr_names(world)]
    for name, layer in zip(names, seen.layers, strict=True):
        layers |= layer.images(name, shape)
    return layers


def _exr_names(world: World) -> list[str]:
    """Call a single object's layer ``object``, several ones by their ids."""
    names = [item.id for item in world.scenario.objects]
    return ["object"] if len(names) == 1 else names
