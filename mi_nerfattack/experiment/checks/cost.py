"""What an attack would cost, from a few control periods of it."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from mi_nerfattack.attack.black_box.random_looks import equal_count
from mi_nerfattack.backend.arrays import allocated_bytes
from mi_nerfattack.rollout.adjoint import KeptBackgrounds
from mi_nerfattack.rollout.objective import truncated
from mi_nerfattack.scenario.attack import FrameMethod
from mi_nerfattack.scenario.deployment import SURROGATE, labelled
from mi_nerfattack.scenario.scenario import Scenario
from mi_nerfattack.scenario.world import World, build_attack, driven_route
from mi_nerfattack.system.machine import peak_memory_mb

_PERIODS = 6  # of the iterations that are timed
_ALONG = (0.125, 0.375, 0.625, 0.875)  # of the drive: where frames are kept on trial
_PICTURES_MB = 10.0


@dataclass(frozen=True)
class Cost:
    """Estimate of an attack that uses all its iterations.

    Attributes:
        iterations: at most.
        random_looks: number of random textures to compare the attack with.
        horizon: control periods of a drive.
        frames: rendered, with the frames of backward passes.
        wall_s: seconds, on this machine with the load that it has.
        memory_mb: at most.
        disk_mb: of the run folder.
        period_s: seconds per control period: of an iteration's ``forward`` and
            ``backward`` pass, and of a drive in each environment by its label.
    """

    iterations: int
    random_looks: int
    horizon: int
    frames: int
    wall_s: float
    memory_mb: float
    disk_mb: float
    period_s: dict[str, float]

    def document(self) -> dict[str, Any]:
        """Return all as JSON takes it."""
        return asdict(self)


def planned_periods(scenario: Scenario) -> int:
    """Return about how many control periods an attack and its drives have.

    A backward pass counts as a drive. The estimate does not load the scene.

    Raises:
        InputError: the route cannot be read.
    """
    section, runs = scenario.attack, scenario.drive.runs
    method, vehicle = section.method, scenario.vehicle
    route = driven_route(scenario, vehicle.motion())
    horizon = scenario.drive.steps(route, vehicle.dt_s)
    count = method.iterations(horizon * section.poses)
    share = method.rendered(horizon) / horizon
    back = float(method.needs_derivatives)
    looks = scenario.baseline.textures or equal_count(count, back)
    deployed = min(looks, scenario.baseline.deployment_textures)
    drives = looks + 4 * runs
    drives += len(labelled(scenario.deployment)) * (deployed + 4 * runs)
    return round(horizon * (drives + count * share * (1 + back)))


def estimate(world: World, drive_s: Mapping[str, float]) -> Cost:
    """Time two short iterations of the attack, and add up what all would take.

    Args:
        world: what the scenario describes; its textures are as before afterwards.
        drive_s: seconds of a control period of a drive by environment.
    """
    scenario, horizon = world.scenario, world.horizon
    forward, backward, update, disk = _iteration(world)
    section = scenario.attack
    count = section.method.iterations(horizon * section.poses)
    rendered = section.method.rendered(horizon)
    equal = equal_count(count, backward / forward)
    looks = scenario.baseline.textures or equal
    iteration = horizon * (forward + backward) + update
    periods = {SURROGATE: 4 * scenario.drive.runs + looks}
    for label in world.deployments:
        deployed = min(looks, scenario.baseline.deployment_textures)
        runs = 1 if world.is_open_loop(label) else scenario.drive.runs
        periods[label] = 4 * runs + deployed
    drives = sum(n * drive_s.get(label, 0.0) for label, n in periods.items())
    passes = count + 3  # attribution is about three more
    wall = passes * iteration + horizon * ((looks + 1) * forward + drives)
    keeps_backgrounds = isinstance(section.adjoint, KeptBackgrounds)
    again = 1 if keeps_backgrounds or not backward else 2
    frames = section.poses * rendered * (again * passes + looks + 1)
    frames += sum(periods.values()) * horizon
    return Cost(
        iterations=count,
        random_looks=looks,
        horizon=horizon,
        frames=frames,
        wall_s=wall,
        memory_mb=peak_memory_mb() + backgrounds_mb(world),
        disk_mb=disk + _PICTURES_MB,
        period_s={**drive_s, "forward": forward, "backward": backward},
    )


def _iteration(world: World) -> tuple[float, float, float, float]:
    """Return seconds of a period there, back, of an update; MB of files of a run."""
    scenario = world.scenario
    periods = min(_PERIODS, world.horizon)
    drive = scenario.drive.model_copy(update={"horizon": periods, "length_m": None})
    changes: dict[str, Any] = {"drive": drive}
    if isinstance(method := scenario.attack.method, FrameMethod):
        frame = min(method.frame, periods - 1)
        method = method.model_copy(update={"frame": frame})
        changes["attack"] = scenario.attack.model_copy(update={"method": method})
    short = replace(
        world,
        objective=truncated(world.objective, periods),
        scenario=scenario.model_copy(update=changes),
    )
    original = world.appearance()
    try:
        attack = build_attack(short)
        attack.step()  # compiles
        times = [time.perf_counter()]

        def on_step(step: int) -> None:
            del step
            times.append(time.perf_counter())

        attack.step(on_step)
        end = time.perf_counter()
        tensor_bytes = sum(value.nbytes for value in attack.tensors().values())
    finally:
        world.show(original)
    forward = (times[periods] - times[0]) / periods
    there = attack.sweeps * periods
    backward = (times[there] - times[periods]) / periods
    return (
        forward,
        backward,
        end - times[-1],
        (tensor_bytes + _field_bytes(world)) / 1e6,
    )


def _field_bytes(world: World) -> int:
    total = 0
    for item, field in zip(world.scenario.objects, world.fields, strict=True):
        if item.named is None:
            total += sum(tensor.nbytes for tensor in field.tensors().values())
        else:
            total += item.named.file.stat().st_size
    return total


def backgrounds_mb(world: World) -> float:
    """Return what `kept_backgrounds` keeps for all periods but the timed ones, in MB.

    The estimate is made from four frames along the route.
    """
    section, sensor = world.scenario.attack, world.optimised
    if not isinstance(section.adjoint, KeptBackgrounds):
        return 0.0
    period = world.scenario.vehicle.dt_s
    first, last = world.scenario.drive.stretch(world.route, period)
    loop, total_bytes = world.loop(sensor), 0
    for share in _ALONG:
        pose = world.route.pose_at(first + share * (last - first))
        state = loop.initial(np.tile(pose, (section.poses, 1)))
        total_bytes += allocated_bytes(sensor.keep(sensor.observe(state, 0)))
    return total_bytes / len(_ALONG) * max(0, world.horizon - _PERIODS) / 1e6
