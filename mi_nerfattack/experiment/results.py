"""Write the run folder: metrics, tables, fields, frames, plots, page."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from mi_nerfattack.attack.texture.statistics import seen_weights, texture_statistics
from mi_nerfattack.drives.table import write_steps
from mi_nerfattack.evaluation.flags import run_flags
from mi_nerfattack.evaluation.metrics import metrics_document, validate
from mi_nerfattack.evaluation.verdict import verdict
from mi_nerfattack.experiment.attribution import control_changes, write_control_changes
from mi_nerfattack.experiment.cases import OnProgress
from mi_nerfattack.experiment.checks.before_attack import fit_findings
from mi_nerfattack.experiment.finished import Finished, Frames
from mi_nerfattack.experiment.page.run import read_run
from mi_nerfattack.experiment.pictures.write import write_images
from mi_nerfattack.experiment.run_folder import METRICS, Effort, object_path
from mi_nerfattack.fields import save_field
from mi_nerfattack.io import files
from mi_nerfattack.report.pages.elements import PageContents
from mi_nerfattack.report.pages.results import write_results_page
from mi_nerfattack.rollout.drive import ATTACK, OWN, Drive
from mi_nerfattack.scenario.deployment import SURROGATE
from mi_nerfattack.scenario.world import Appearance, World
from mi_nerfattack.vehicle.dynamics import to_state

#: Frames of the first unattacked drive that say what of a texture is seen.
FRAMES = 16


def texture_figures(
    world: World, drives: Sequence[Drive], own: Appearance, attacked: Appearance
) -> dict[str, Any]:
    """Judge the textures by what the camera of the unattacked drive sees of them.

    Args:
        world: what was driven in; its objects look attacked afterwards.
        drives: the run's; the first of the case `own` in the surrogate is looked at.
        own: how the objects look by themselves.
        attacked: how the attack leaves them.

    Returns:
        ``textures`` by object, with the ``picture_share`` that it takes on average,
        and ``saturated_share`` and ``total_variation``, means over the objects.
    """
    driven = next(d for d in drives if d.case == OWN and d.environment == SURROGATE)
    picked = np.unique(np.linspace(0, len(driven.states) - 1, FRAMES).astype(int))
    world.show(own)
    states = [to_state(driven.poses[None, step]) for step in picked]
    weights = seen_weights(world.surrogate.through(0), world.fields, states)
    world.show(attacked)
    camera = world.surrogate.intrinsics
    # A colour's sigmoid rises by a quarter there, in each channel of a pixel it fills.
    filled = 3 / 4 * camera.width * camera.height * len(states)
    textures = {
        item.id: asdict(texture_statistics(field, original, weight))
        | {"picture_share": float(np.clip(weight.sum() / filled, 0, 1))}
        for item, field, original, weight in zip(
            world.scenario.objects, world.fields, own.textures, weights, strict=True
        )
    }
    names = ("saturated_share", "total_variation")
    means = {
        name: float(np.mean([figures[name] for figures in textures.values()]))
        for name in names
    }
    return {"textures": textures, **means}


def write_results(
    output: Path,
    done: Finished,
    effort: Callable[[], Effort],
    on_progress: OnProgress,
    on_notice: Callable[[str], None],
    frames: Frames | None,
) -> dict[str, Any]:
    """Write everything but scenario and checkpoint, the figures before the pictures.

    Args:
        output: the run folder, present.
        done: results of the run.
        effort: returns the cost of the run so far.
        on_progress: called after every time step of attribution and frames.
        on_notice: called with a sentence that names the safe files if pictures fail.
        frames: of which frames, plots, attribution and page are written, too; None
            leaves all of them out.

    Returns:
        the document that ``metrics.json`` holds.
    """
    history = done.history
    path = output / METRICS
    _write_tables(output, done, history)
    document = _describe(done, effort)
    files.write_json(path, document)
    if frames is None:
        return document
    try:
        write_images(output, done, history, frames=frames, on_progress=on_progress)
        document["cost"] = effort().model_dump()
        files.write_json(path, document)
        contents = PageContents(runs=[read_run(output, output.name)])
        write_results_page(
            output / "report.html", document["scenario"]["name"], contents
        )
    except BaseException:
        on_notice(
            f"{path}: holds all figures; pictures are missing: make room if the disk "
            "is full, and the same command writes them (fewer, or none, with "
            "--pictures)"
        )
        raise
    return document


def _write_tables(output: Path, done: Finished, history: list[dict[str, Any]]) -> None:
    world, texture_of = done.world, done.look(ATTACK).textures
    write_steps(output / "steps.csv", done.driven, {world.route.name: done.lane})
    files.write_json(output / "attack.json", history)
    write_control_changes(output, done.replayed)
    for grid, item, texture in zip(
        world.fields, world.scenario.objects, texture_of, strict=True
    ):
        grid.set_parameter("texture", texture)
        path = object_path(output, item.id)
        files.make_folder(path.parent)
        save_field(path, grid)


def _describe(done: Finished, effort: Callable[[], Effort]) -> dict[str, Any]:
    """Return the document that ``metrics.json`` holds."""
    world, scenario = done.world, done.world.scenario
    lanes = {world.route.name: done.lane}
    sections: dict[str, Any] = {"baseline": done.baseline}
    if not scenario.objective.is_lane_distance:
        name = scenario.objective.name
        sections["objective"] = {"name": name, "missing": done.uncosted}
    if replayed := done.replayed:
        unit = scenario.vehicle.car().control_unit
        sections["replay"] = control_changes(replayed, unit, scenario.seed)
    if done.attack.freedom.pose_rate is not None:
        sections["object_poses"] = _poses(world, done.look(ATTACK))
    if done.ignored:
        sections["ignored_changes"] = done.ignored
    if (curve := done.curve) is not None:
        sections["curve"] = curve
    sections["converged"] = done.attack.has_converged
    if (gain := done.attack.least_gain) is not None and not done.ignored:
        sections["least_gain"] = gain
    bricks, one_level = scenario.scene.bricks, done.attack.one_level
    if bricks is not None or one_level:
        means = _optimised_and_exact(done)
        sections |= {"bricks": {"file": str(bricks), **means}} if bricks else {}
        sections |= {"one_level": means} if one_level else {}
    sections |= texture_figures(
        world, done.drives, done.look(OWN), attacked=done.look(ATTACK)
    )
    values, cost = scenario.model_dump(mode="json"), effort().model_dump()
    document = metrics_document(
        values, scenario.seed, done.driven, lanes=lanes, cost=cost, costs=done.costs
    )
    document |= sections
    attack, names = done.attack, [item.id for item in scenario.objects]
    without = [names[index] for index in attack.without_gradient]
    document["flags"] = [
        *done.flags,
        *fit_findings(world),
        *run_flags(document, without, attack.sweeps > 1),
    ]
    document["verdict"] = verdict(document, SURROGATE)
    validate(document)
    return document


def _optimised_and_exact(done: Finished) -> dict[str, float]:
    """Say how far the attack's own drives go as it made them, and in exact fields."""
    world, attack = done.world, done.attack
    world.show(done.look(ATTACK))
    return {
        "cross_track_mean_m": attack.best_mean_m,
        "field_cross_track_mean_m": attack.measure_through(world.surrogate),
    }


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
