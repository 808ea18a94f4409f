"""Write the run folder: metrics, tables, fields, frames, plots, page."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

from mi_nerfattack.attack.gradient import GradientAttack
from mi_nerfattack.backend.versions import versions
from mi_nerfattack.evaluation.metrics import metrics_document, validate
from mi_nerfattack.evaluation.textures import texture_figures
from mi_nerfattack.evaluation.verdict import verdict
from mi_nerfattack.experiment.attribution import attribute, write_attribution
from mi_nerfattack.experiment.effort import Effort
from mi_nerfattack.experiment.pictures import write_pictures
from mi_nerfattack.experiment.replayed import control_changes, write_control_changes
from mi_nerfattack.fields import save_field
from mi_nerfattack.io import files
from mi_nerfattack.report.pages.attack import write_report
from mi_nerfattack.report.plots import drives as plots
from mi_nerfattack.report.table import write_steps
from mi_nerfattack.rollout.drive import ATTACK, OWN, Drive, Lane
from mi_nerfattack.rollout.loop import OnStep
from mi_nerfattack.scenario.deployment import SURROGATE
from mi_nerfattack.scenario.world import Appearance, World, object_footprints


def write_results(
    output: Path,
    world: World,
    drives: list[Drive],
    attack: GradientAttack,
    looks: Mapping[str, Appearance | None],
    scenario_text: str,
    effort: Callable[[], Effort],
    ignored: list[str],
    baseline: dict[str, Any],
    flags: list[str],
    on_step: OnStep | None = None,
) -> dict[str, Any]:
    """Write everything but scenario and checkpoint, ``metrics.json`` last but one.

    Args:
        output: the run folder, present.
        world: what was driven in; its textures are changed.
        drives: all drives.
        attack: the finished attack.
        looks: how the objects look and where they stand, per case; None: nowhere.
        scenario_text: the scenario file.
        effort: tells what the run has cost so far.
        ignored: changes between interruption and resumption that were ignored.
        baseline: figures of the random looks.
        flags: findings of the checks before the attack.
        on_step: called after each of the 3 x horizon control periods of the
            attribution.

    Returns:
        the document that ``metrics.json`` holds.
    """
    scenario, route = world.scenario, world.route
    lane = Lane.of(route, scenario.vehicle.width_m)
    lanes, limit = {route.name: lane}, lane.wheel_m
    replayed = [d for d in drives if world.is_open_loop(d.environment)]
    driven = [drive for drive in drives if drive not in replayed]
    attacked = looks[ATTACK]
    assert attacked is not None, "an attack has objects"
    more: dict[str, Any] = {"baseline": baseline, "flags": flags}
    unit = scenario.vehicle.car().control_unit
    if replayed:
        more["replay"] = control_changes(replayed, unit, scenario.seed)
    if attack.freedom.pose_rate is not None:
        more["object_poses"] = _poses(world, attacked)
    if ignored:
        more["ignored_changes"] = ignored
    write_steps(output / "steps.csv", driven, lanes)
    history = [asdict(record) for record in attack.history]
    files.write_json(output / "attack.json", history)
    files.make_folder(output / "objects")
    for grid, item, texture in zip(
        world.fields, scenario.objects, attacked.textures, strict=True
    ):
        grid.set_parameter("texture", texture)
        save_field(output / "objects" / f"{item.id}.safetensors", grid)
    images = _write_plots(output, world, driven, history, limit)
    images |= write_control_changes(output, replayed, unit)
    names = [item.id for item in scenario.objects]
    found = attribute(attack, names, limit, on_step)
    images |= write_attribution(output, found, world.fields)
    images["First-person frames"] = output / "strip.png"
    write_pictures(output, world, drives, looks)
    own = looks[OWN]
    assert own is not None, "objects are there by themselves"
    more |= {"converged": attack.has_converged}
    more |= texture_figures(world, drives, own, attacked)
    values, cost = scenario.model_dump(mode="json"), effort().model_dump()
    document = metrics_document(values, scenario.seed, driven, lanes, cost) | more
    document["verdict"] = verdict(document, SURROGATE)
    validate(document)
    files.write_json(output / "metrics.json", document)
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
