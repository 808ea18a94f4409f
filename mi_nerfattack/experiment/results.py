"""Write the run folder: metrics, tables, fields, frames, plots, page."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mi_nerfattack.attack.gradient import GradientAttack
from mi_nerfattack.backend.versions import versions
from mi_nerfattack.deploy.views.above import scene_above, surrogate_above
from mi_nerfattack.deploy.views.paste import Paster
from mi_nerfattack.evaluation.metrics import metrics_document, validate
from mi_nerfattack.evaluation.textures import texture_figures
from mi_nerfattack.evaluation.verdict import verdict
from mi_nerfattack.experiment.attribution import attribute, write_attribution
from mi_nerfattack.experiment.checks.before_attack import mesh_scene
from mi_nerfattack.experiment.effort import Effort
from mi_nerfattack.experiment.pictures.frames import write_pictures
from mi_nerfattack.experiment.replayed import control_changes, write_control_changes
from mi_nerfattack.fields import save_field
from mi_nerfattack.io import files
from mi_nerfattack.render.camera.outside import Overhead
from mi_nerfattack.report.pages.attack import write_report
from mi_nerfattack.report.plots import drives as plots
from mi_nerfattack.report.table import write_steps
from mi_nerfattack.rollout.drive import ATTACK, OWN, Drive, Lane
from mi_nerfattack.rollout.loop import OnStep
from mi_nerfattack.scenario.deployment import SURROGATE
from mi_nerfattack.scenario.world import Appearance, World, object_footprints

_GROUND_PX = 400  # of the longer edge of pictures from above


@dataclass(frozen=True)
class Finished:
    """What a run came to.

    Attributes:
        world: what was driven in; its textures are changed by what looks at it.
        drives: all drives.
        attack: the finished attack.
        looks: how the objects look and where they stand, per case; None: nowhere.
        ignored: changes between interruption and resumption that were ignored.
        baseline: figures of the random looks.
        flags: findings of the checks before the attack.
    """

    world: World
    drives: list[Drive]
    attack: GradientAttack
    looks: Mapping[str, Appearance | None]
    ignored: list[str]
    baseline: dict[str, Any]
    flags: list[str]

    def look(self, case: str) -> Appearance:
        """Return how the objects look in a case that has any."""
        look = self.looks[case]
        assert look is not None, "objects are there"
        return look

    @property
    def replayed(self) -> list[Drive]:
        """The drives of recordings."""
        return [d for d in self.drives if self.world.is_open_loop(d.environment)]

    @property
    def driven(self) -> list[Drive]:
        """The drives in closed loops."""
        return [d for d in self.drives if not self.world.is_open_loop(d.environment)]

    @property
    def lane(self) -> Lane:
        """Of the route."""
        return Lane.of(self.world.route, self.world.scenario.vehicle.width_m)


def write_results(
    output: Path,
    done: Finished,
    scenario_text: str,
    effort: Callable[[], Effort],
    on_step: OnStep | None = None,
    pictures: bool = True,
) -> dict[str, Any]:
    """Write everything but scenario and checkpoint, ``metrics.json`` last but one.

    Args:
        output: the run folder, present.
        done: what the run came to.
        scenario_text: the scenario file.
        effort: tells what the run has cost so far.
        on_step: called after each of the 3 x horizon control periods of the
            attribution.
        pictures: write frames, plots, attribution and page, too.

    Returns:
        the document that ``metrics.json`` holds.
    """
    history = [asdict(record) for record in done.attack.history]
    _write_tables(output, done, history)
    images = _write_images(output, done, history, on_step) if pictures else {}
    document = _describe(done, effort)
    files.write_json(output / "metrics.json", document)
    if pictures:
        page = output / "report.html"
        write_report(page, document, images, scenario_text, versions())
    return document


def _write_tables(output: Path, done: Finished, history: list[dict[str, Any]]) -> None:
    """Write steps, iterations and fields."""
    world, texture_of = done.world, done.look(ATTACK).textures
    write_steps(output / "steps.csv", done.driven, {world.route.name: done.lane})
    files.write_json(output / "attack.json", history)
    files.make_folder(output / "objects")
    for grid, item, texture in zip(
        world.fields, world.scenario.objects, texture_of, strict=True
    ):
        grid.set_parameter("texture", texture)
        save_field(output / "objects" / f"{item.id}.safetensors", grid)


def _write_images(
    output: Path,
    done: Finished,
    history: list[dict[str, Any]],
    on_step: OnStep | None,
) -> dict[str, Path]:
    """Write plots and frames, and return the figures of the page by their titles."""
    world, limit = done.world, done.lane.wheel_m
    images = _write_plots(output, world, done.driven, history, limit)
    unit = world.scenario.vehicle.car().control_unit
    images["Trajectories over the ground"] = _write_triptych(output, done)
    images |= write_control_changes(output, done.replayed, unit)
    names = [item.id for item in world.scenario.objects]
    found = attribute(done.attack, names, limit, on_step)
    images |= write_attribution(output, found, world.fields)
    write_pictures(output, world, done.drives, done.looks)
    return {**images, "First-person frames": output / "strip.png"}


def _describe(done: Finished, effort: Callable[[], Effort]) -> dict[str, Any]:
    """Return the document that ``metrics.json`` holds."""
    world, scenario = done.world, done.world.scenario
    lanes = {world.route.name: done.lane}
    more: dict[str, Any] = {"baseline": done.baseline, "flags": done.flags}
    if replayed := done.replayed:
        unit = scenario.vehicle.car().control_unit
        more["replay"] = control_changes(replayed, unit, scenario.seed)
    if done.attack.freedom.pose_rate is not None:
        more["object_poses"] = _poses(world, done.look(ATTACK))
    if done.ignored:
        more["ignored_changes"] = done.ignored
    more["converged"] = done.attack.has_converged
    if scenario.scene.bricks is not None:
        more["bricks"] = _in_bricks(done)
    more |= texture_figures(world, done.drives, done.look(OWN), done.look(ATTACK))
    values, cost = scenario.model_dump(mode="json"), effort().model_dump()
    document = metrics_document(values, scenario.seed, done.driven, lanes, cost) | more
    document["verdict"] = verdict(document, SURROGATE)
    validate(document)
    return document


def _in_bricks(done: Finished) -> dict[str, Any]:
    """Say how far the attack's own drives go in bricks, and in the field itself."""
    world, attack = done.world, done.attack
    world.show(done.look(ATTACK))
    return {
        "file": str(world.scenario.scene.bricks),
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


def _write_triptych(output: Path, done: Finished) -> Path:
    """Draw unperturbed, surrogate and transferred drives over the rendered ground."""
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
    seen = np.concatenate([*points, *object_footprints(world)])
    overhead = Overhead.covering(seen, route.lane_width_m, _GROUND_PX)
    scene = mesh_scene(world)
    bare = None if scene is None else scene_above(scene, overhead, points[0], 4)
    panels = []
    for (case, label), drives in zip(pairs, groups, strict=True):
        world.show(done.look(case))
        if label == SURROGATE or bare is None:
            ground = surrogate_above(world.surrogate, overhead)
        else:
            objects = world.surrogate.objects
            ground = Paster(overhead.camera, objects).paste(bare).image
        panels.append(plots.Panel(drives, ground, object_footprints(world)))
    world.show(done.look(ATTACK))
    path, lane = output / "triptych.png", (route.lane_width_m, done.lane.wheel_m)
    plots.triptych(path, panels, overhead, route.points, *lane)
    return path
