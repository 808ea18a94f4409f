"""A scenario looked at before its attack: findings, cost, and a picture."""

from __future__ import annotations

import math
import shlex
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from mi_nerfattack.deploy.environment import (
    AbstractEnvironment,
    CameraFrame,
    OpenEnvironment,
    drive,
    first_frame,
    policy_image,
)
from mi_nerfattack.deploy.views.above import scene_above, surrogate_above
from mi_nerfattack.deploy.views.mitsuba import MitsubaView
from mi_nerfattack.deploy.views.paste import Paster
from mi_nerfattack.errors import InputError, SetupError
from mi_nerfattack.experiment.checks.before_attack import (
    driven_arc,
    first_findings,
    fit_findings,
    further_findings,
    likeness_findings,
    mesh_scene,
    period_findings,
    place_findings,
    route_findings,
    speed_findings,
    unit_findings,
)
from mi_nerfattack.experiment.checks.cost import Cost, estimate
from mi_nerfattack.render.camera.intrinsics import from_fov, mount_matrix
from mi_nerfattack.render.camera.outside import chase_mount
from mi_nerfattack.render.posed import object_footprints
from mi_nerfattack.report.plots.place import Look, Overlay, place_picture
from mi_nerfattack.rollout.drive import OWN, Drive, departure_limit
from mi_nerfattack.scenario.deployment import SURROGATE
from mi_nerfattack.scenario.world import World

_LONGEST_PX = 560  # of the pictures from above
_CHASE_PX, _CHASE_FOV_DEG = (400, 200), 75.0
_SPP = 4


@dataclass(eq=False)
class Check:
    """What is known of a scenario before its attack.

    Attributes:
        world: what the scenario describes; it stays as it was.
        on_progress: called with a stage, units done, all units, and a remark.
        refused: why `attack` would refuse the scenario, one sentence per reason.
        doubts: settings that `attack` accepts but users seldom mean.
        cost: None where no attack could be tried.
        drives: that were made, unattacked.
        frames: the first of each environment.
    """

    world: World
    on_progress: Callable[[str, int, int, str], None] = lambda *progress: None
    refused: list[str] = field(default_factory=list)
    doubts: list[str] = field(default_factory=list)
    cost: Cost | None = None
    drives: list[Drive] = field(default_factory=list)
    frames: dict[str, CameraFrame] = field(default_factory=dict)
    _period_s: dict[str, float] = field(default_factory=dict)
    _open: OpenEnvironment = field(default_factory=OpenEnvironment)

    def run(self, drives: bool = True) -> None:
        """Find what there is to find.

        Args:
            drives: make the drives of the checks before an attack, and time some of
                its control periods; otherwise only what needs none is found.
        """
        world = self.world
        departure_limit(world.route.lane_width_m, world.scenario.vehicle.width_m)
        self.doubts += [
            *unit_findings(world),
            *speed_findings(world),
            *period_findings(world),
            *fit_findings(world),
        ]
        try:
            if drives:
                self._attempt(self._drive)
            else:
                self._take(route_findings(world))
                self._take(place_findings(world))
            for label in world.labels:
                if label not in self.frames:
                    self._attempt(lambda label=label: self._environment(label))
        finally:
            self._open.close()
        base = self.frames.get(SURROGATE)
        if base is not None and world.scenario.attack.method.needs_derivatives:
            self._attempt(lambda: self._slope(base))
        for label, frame in self.frames.items():
            if label != SURROGATE and base is not None:
                camera, layout = world.surrogate.intrinsics, world.place.rig.layout
                self.doubts += likeness_findings(
                    camera,
                    first_frame(base, layout),
                    first_frame(frame, layout),
                    label=label,
                )

    def _slope(self, frame: CameraFrame) -> None:
        """Look whether the control has a derivative by the first image."""
        policy, loop = self.world.policy, self.world.loop(self.world.surrogate)
        numbers = loop.numbers(loop.initial(self.world.initial[:1]), 0)
        image, memory = policy_image(frame.image), policy.initial_memory(1)
        control, _ = policy.step(image, loop.goal, memory, numbers=numbers)
        d_image, *_ = policy.step_vjp(
            image,
            loop.goal,
            memory,
            cotangent=0 * control + 1,
            d_memory=(),
            numbers=numbers,
        )
        if not d_image.numpy().any():
            self.doubts.append(
                "the derivative of the policy's control by the first image is exactly "
                "0; if it stays so, the attack ends after an iteration: a policy that "
                "rounds (torch.round) or is at the limit of a clamp has no slope; "
                'smooth it, or give attack.method.kind = "blocks"'
            )

    def _environment(self, label: str) -> AbstractEnvironment:
        """Open an environment, one at a time, and look once."""
        world = self.world
        environment = self._open.get(label, lambda: world.open(label))
        if label not in self.frames:
            start, seed = world.initial[0], world.scenario.seed
            self.frames[label] = environment.reset(world.route, start, seed)
        return environment

    def _drive(self) -> None:
        try:
            for check in (first_findings, further_findings):
                self._take(check(self.world, self._one))
        except (InputError, SetupError):
            self._take(place_findings(self.world))
            raise

    def price(self) -> None:
        """Estimate the cost, if the drives could be made; its memory counts ours."""
        world = self.world
        driven = {x for x in world.labels if not world.is_open_loop(x)}
        if self._period_s.keys() >= driven:
            self._attempt(self._price)

    def _price(self) -> None:
        self.on_progress("timing the attack", 0, 1, "")
        self.cost = estimate(self.world, self._period_s)
        self.on_progress("timing the attack", 1, 1, "")

    def _one(self, label: str, case: str, run: int) -> Drive:
        """Drive as the attack's first drives do."""
        world, times = self.world, [time.perf_counter()]
        horizon = world.horizon

        def on_step(step: int) -> None:
            times.append(time.perf_counter())
            self.on_progress(f"driving: {label}, run {run}", step + 1, horizon, "")

        start, seed = world.initial[run], world.scenario.seed + run
        driven = drive(
            self._environment(label),
            world.policy,
            world.route,
            pose=start,
            seed=seed,
            steps=horizon,
            on_step=on_step,
            case=case,
            run=run,
            label=label,
        )
        self._period_s[label] = float(np.median(np.diff(times)))
        self.drives.append(driven)
        return driven

    def _attempt(self, work: Callable[[], object]) -> bool:
        """Do something whose error is a reason to refuse; tell whether it is done."""
        try:
            work()
        except (InputError, SetupError) as err:
            self._take(iter([str(err)]))
            return False
        return True

    def _take(self, findings: Iterator[str]) -> None:
        for line in findings:  # what was found before an error counts
            if line not in self.refused:
                self.refused.append(line)

    def document(self) -> dict[str, Any]:
        """Return all that was found, as JSON takes it."""
        scenario = self.world.scenario
        return {
            "scenario": scenario.name,
            "refused": self.refused,
            "doubts": self.doubts,
            "cost": None if self.cost is None else self.cost.document(),
            "route": {
                "name": self.world.route.name,
                "length_m": self.world.route.length,
                "horizon": self.world.horizon,
            },
            "objects": {
                item.id: posed.placed.translation.tolist()
                for item, posed in zip(
                    scenario.objects, self.world.surrogate.objects, strict=True
                )
            },
        }

    def picture(self, path: Path) -> bool:
        """Write the picture of the scenario; tell whether it could be drawn."""
        return self._attempt(lambda: self._picture(path))

    def _picture(self, path: Path) -> None:
        world = self.world
        overlay = self._overlay()
        overhead = overlay.overhead(_LONGEST_PX)
        grounds = {"Surrogate, from above": surrogate_above(world.surrogate, overhead)}
        looks = {
            f"First image in {label}": Look(
                first_frame(frame, world.place.rig.layout).image,
                world.surrogate.intrinsics,
                frame.camera_to_world,
            )
            for label, frame in list(self.frames.items())[:2]
        }
        if (scene := mesh_scene(world)) is not None:
            objects = world.surrogate.objects
            near = world.route.pose_at(np.array(overlay.driven))[:, :2]
            name = f"{world.scenario.scene.deployment.file.name}, from above"
            bare = scene_above(scene, overhead, near, spp=_SPP)
            grounds[name] = Paster(overhead.camera, objects).paste(bare).image
            camera = from_fov(*_CHASE_PX, _CHASE_FOV_DEG)
            mount = chase_mount(overlay.car_width_m)
            view = MitsubaView(scene, camera, _SPP)
            view.show(objects)
            pose = mount_matrix(world.initial[:1], mount)[0]
            behind = view.render(pose, 0).image
            looks["Start, from behind the car"] = Look(
                behind, camera, pose, from_behind=True
            )
        lines = [f"REFUSED: {line}" for line in self.refused]
        lines += [f"LOOK AT: {line}" for line in self.doubts]
        name = world.scenario.name
        place_picture(
            path,
            overlay,
            overhead,
            grounds=grounds,
            looks=looks,
            sentences=lines,
            title=name,
        )

    def _overlay(self) -> Overlay:
        world = self.world
        scenario, arc = world.scenario, driven_arc(world)
        names = [item.id for item in scenario.objects]
        posed = world.surrogate.objects
        paths = {
            f"unattacked drive, {d.environment}": d.states[:, :2]
            for d in self.drives
            if d.run == 0 and d.case == OWN
        }
        return Overlay(
            routes=[world.route],
            driven=(float(arc[0]), float(arc[-1])),
            objects=dict(zip(names, object_footprints(posed), strict=True)),
            tops={n: _top(item) for n, item in zip(names, posed, strict=True)},
            starts=world.initial,
            car_width_m=scenario.vehicle.width_m,
            car_reference_m=scenario.vehicle.car().reference,
            camera=world.surrogate.intrinsics,
            paths=paths,
        )


def _top(posed: Any) -> np.ndarray:
    """Return the middle of the upper side of an object's box, metres."""
    field = posed.field
    middle = (field.lower + field.upper) / 2
    return posed.placed.apply(np.array([*middle[:2], field.upper[2]]))


def duration(seconds: float) -> str:
    """Say how long something takes, in two figures."""
    if seconds < 90:
        return f"{max(1, round(seconds))} s"
    minutes = seconds / 60
    if minutes < 90:
        return f"{round(minutes)} min"
    return f"{minutes / 60:.{0 if minutes >= 600 else 1}f} h"


def sentences(
    check: Check, scenario_path: str, picture: Path | None, settings: Sequence[str] = ()
) -> list[str]:
    """Say in words what was found, what it costs, and what to do next.

    Args:
        check: that was run.
        scenario_path: of its scenario, as it was given.
        picture: that was drawn, if any.
        settings: of the command line.
    """
    world, cost = check.world, check.cost
    period = world.scenario.vehicle.dt_s
    lines = [
        f"{world.scenario.name}: route {world.route.name!r} of "
        f"{world.route.length:.1f} m, {world.horizon} control periods of {period:g} s; "
        f"objects: {', '.join(item.id for item in world.scenario.objects)}; "
        f"environments: {', '.join(world.labels)}"
    ]
    if cost is not None:
        lines.append(
            f"cost: at most {cost.iterations} iterations, {cost.random_looks} random "
            f"textures, {cost.frames} frames; about {duration(cost.wall_s)} as busy as "
            f"this machine is, {math.ceil(cost.memory_mb / 100) / 10:.1f} GB of "
            f"memory, {cost.disk_mb:.0f} MB of disk"
        )
    lines += [f"refused: {line}" for line in check.refused]
    lines += [f"look at: {line}" for line in check.doubts]
    if picture is not None:
        lines.append(f"picture: {picture}")
    words = ["attack", scenario_path, "-o", f"runs/{Path(scenario_path).stem}"]
    words += [word for one in settings for word in ("--set", one)]
    command = shlex.join(("mi-nerfattack", *words))
    if check.refused:
        lines.append(
            "next: mend the scenario and check again; to attack all the same: "
            f"{command} --anyway"
        )
    else:
        lines.append(f"next: {command}")
    return lines
