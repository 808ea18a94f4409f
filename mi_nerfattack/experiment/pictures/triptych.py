"""Trajectories over the rendered ground (appendix, figure C.3)."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from mi_nerfattack.deploy.views.above import scene_above, surrogate_above
from mi_nerfattack.deploy.views.paste import Paster
from mi_nerfattack.experiment.checks.before_attack import mesh_scene
from mi_nerfattack.experiment.finished import Finished
from mi_nerfattack.render.camera.outside import Overhead
from mi_nerfattack.report.plots import drives as plots
from mi_nerfattack.rollout.drive import ATTACK, OWN
from mi_nerfattack.scenario.deployment import SURROGATE
from mi_nerfattack.scenario.world import object_footprints

_GROUND_PX = 400  # of the longer edge of pictures from above


def write_triptych(output: Path, done: Finished) -> None:
    """Draw unperturbed, surrogate and transferred drives over the rendered ground.

    Args:
        output: the run folder.
        done: what the run came to; the objects look attacked afterwards.
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
    seen = np.concatenate([*points, *footprints])
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
        panels.append(
            plots.Panel(drives, ground, object_footprints(world.surrogate.objects))
        )
    world.show(done.look(ATTACK))
    path, lane = output / "triptych.png", (route.lane_width_m, done.lane.wheel_m)
    plots.triptych(path, panels, overhead, route.points, *lane)
