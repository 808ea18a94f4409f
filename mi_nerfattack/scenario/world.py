"""Build what a scenario describes: fields, sensors, loops, routes, initial poses."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from mi_nerfattack.attack.base import AbstractAttack
from mi_nerfattack.attack.black_box.surrogate import Task
from mi_nerfattack.deploy.environment import AbstractEnvironment
from mi_nerfattack.deploy.place import Place
from mi_nerfattack.deploy.registry import kinematic_vehicle
from mi_nerfattack.deploy.surrogate.environment import SurrogateEnvironment
from mi_nerfattack.deploy.surrogate.scene import field_sensor, scene_sensor, showing
from mi_nerfattack.deploy.vehicle import Motion
from mi_nerfattack.errors import InputError
from mi_nerfattack.fields import GridField, load_field
from mi_nerfattack.fields.compact_splats import load_splats
from mi_nerfattack.fields.io import holds_splats
from mi_nerfattack.io.resumable import array_digest
from mi_nerfattack.policy.base import AbstractPolicy
from mi_nerfattack.render.backdrop import Layer
from mi_nerfattack.render.camera.rig import Rig
from mi_nerfattack.render.pathtrace.load import load_scene
from mi_nerfattack.render.posed import PosedField, move_all, offsets_of
from mi_nerfattack.render.splatting.background import SplatBackground
from mi_nerfattack.rollout.function import Rollout
from mi_nerfattack.rollout.loop import ClosedLoop
from mi_nerfattack.rollout.objective import AbstractObjective
from mi_nerfattack.rollout.scene_sensor import SceneSensor
from mi_nerfattack.rollout.sensor import AbstractSensor
from mi_nerfattack.scenario.deployment import SURROGATE, Deployment, deployments
from mi_nerfattack.scenario.objective import VarySection
from mi_nerfattack.scenario.scenario import SMOOTH_SPP, Scenario, SceneSection
from mi_nerfattack.vehicle.route.route import Route


@dataclass(frozen=True, eq=False)
class Appearance:
    """How all objects look, and where they stand.

    Attributes:
        textures: (n_vertices, 3) raw colours an object.
        offsets: (k, 6), shift (metres) and rotation vector (radians) of each object
            from where the scenario puts it.
    """

    textures: list[np.ndarray]
    offsets: np.ndarray

    @cached_property
    def digest(self) -> str:
        """Tell it from others."""
        return array_digest((*self.textures, self.offsets))


@dataclass(frozen=True, eq=False)
class World:
    """A scenario brought to life.

    Attributes:
        scenario: what it was built from.
        route: the lane centre.
        fields: grid fields of the objects, in the scenario's order.
        surrogate: sensor in the scene's field.
        optimised: sensor that attacks are made through; `surrogate`, or in bricks.
        place: where other environments are.
        deployments: those of the scenario, by label.
        policy: the policy under test.
        motion: of the vehicle.
        objective: what an attack makes smaller.
        initial: (runs, 3) initial states, none of which an attack starts from.
    """

    scenario: Scenario
    route: Route
    fields: list[GridField]
    surrogate: SceneSensor
    optimised: SceneSensor
    place: Place
    deployments: Mapping[str, Deployment]
    policy: AbstractPolicy
    motion: Motion
    objective: AbstractObjective
    initial: np.ndarray

    def __repr__(self) -> str:
        return (
            f"World({self.route.name!r}, objects: {len(self.fields)}, {self.horizon} "
            f"periods, {len(self.initial)} initial states, {', '.join(self.labels)})"
        )

    def loop(self, sensor: AbstractSensor) -> ClosedLoop:
        """Close the loop through a sensor."""
        motion = self.motion
        return ClosedLoop(
            sensor=sensor,
            policy=self.policy,
            goal=self.route.goal,
            dynamics=motion.dynamics,
            integrator=motion.integrator,
            dt=self.scenario.vehicle.dt_s,
            substeps=motion.substeps,
            delay=motion.delay,
            route=self.route,
        )

    @property
    def horizon(self) -> int:
        """Control periods of a drive."""
        return self.scenario.drive.steps(self.route, self.scenario.vehicle.dt_s)

    @property
    def labels(self) -> tuple[str, ...]:
        """The environments that are driven in, the surrogate first."""
        return SURROGATE, *self.deployments

    def is_open_loop(self, label: str) -> bool:
        """Whether controls have no effect in an environment."""
        return label != SURROGATE and self.deployments[label].is_open_loop

    def builds_in(self, label: str) -> bool:
        """Whether an environment must be opened again for other textures of objects."""
        return label != SURROGATE and self.deployments[label].builds_in

    def open(self, label: str, empty: bool = False) -> AbstractEnvironment:
        """Make an environment, with the objects as they look and stand at present.

        Args:
            label: of the environment.
            empty: leave the objects out.
        """
        objects = [] if empty else self.surrogate.objects
        if label != SURROGATE:
            return self.deployments[label].open(objects)
        sensor = self.without_objects() if empty else self.surrogate
        return SurrogateEnvironment(sensor, kinematic_vehicle(self.place))

    def without_objects(self) -> SceneSensor:
        """Return the sensor in the scene's field, with no object in view."""
        return showing(self.surrogate, [])

    def appearance(self) -> Appearance:
        """Return how the objects look, and where they stand."""
        textures = [grid.texture.numpy().copy() for grid in self.fields]
        return Appearance(textures, offsets_of(self.surrogate.objects))

    def show(self, appearance: Appearance) -> None:
        """Give the objects their textures and places."""
        self.set_textures(appearance.textures)
        move_all(self.surrogate.objects, appearance.offsets)

    @property
    def renders(self) -> int:
        """Frames that its sensors have rendered."""
        return sum(sensor.renders for sensor in self._sensors)

    @property
    def _sensors(self) -> list[SceneSensor]:
        same = self.optimised is self.surrogate
        return [self.surrogate] if same else [self.surrogate, self.optimised]

    def set_textures(self, textures: list[np.ndarray]) -> None:
        """Give each object a texture, (n_vertices, 3) raw colours."""
        for field, texture in zip(self.fields, textures, strict=True):
            field.set_parameter("texture", texture)


def build_world(scenario: Scenario, policy: AbstractPolicy) -> World:
    """Load all files of a scenario.

    Args:
        scenario: from :func:`load_scenario`.
        policy: the policy under test.

    Raises:
        InputError: a file is missing or wrong.
    """
    place, surrogate = scenario.scene, build_surrogate(scenario)
    optimised = surrogate
    if place.bricks is not None:
        bricks = _load_layer(scenario, place.bricks.file)
        optimised = showing(surrogate, surrogate.objects, bricks)
    motion = scenario.vehicle.motion()
    route = driven_route(scenario, motion)
    objective = scenario.objective.build(scenario, route, motion.dynamics)
    where = place_of(scenario, surrogate.rig, motion)
    return World(
        scenario=scenario,
        route=route,
        fields=surrogate.fields,
        surrogate=surrogate,
        optimised=optimised,
        place=where,
        deployments=deployments(scenario.deployment, where),
        policy=policy,
        motion=motion,
        objective=objective,
        initial=initial_states(scenario, route, scenario.drive.runs, stream=0),
    )


def place_of(scenario: Scenario, rig: Rig, motion: Motion) -> Place:
    """Describe where a scenario is driven, without the scene's field.

    Args:
        scenario: names the files.
        rig: cameras; a Mitsuba scene of the surrogate may bring its own.
        motion: of the vehicle.
    """
    return Place(
        scene=scenario.scene.deployment.file,
        field=None,
        routes=scenario.scene.routes.file,
        objects=(),
        camera=rig.cameras[0],
        mount=rig.mounts[0],
        period=scenario.vehicle.dt_s,
        car=scenario.vehicle.car(),
        motion=motion,
        camera_name=rig.names[0],
        others=rig.others,
    )


def driven_route(scenario: Scenario, motion: Motion) -> Route:
    """Load the lane centre, with the vehicle's speed where that is its own.

    Raises:
        InputError: the file is missing or wrong, or the drive begins beyond its end.
    """
    route = Route.from_file(scenario.scene.routes.file, scenario.scene.route)
    route = at_own_speed(route, motion)
    if scenario.drive.start_m >= route.length:
        raise InputError(
            f"drive.start_m: {scenario.drive.start_m:g} m; route {route.name!r} is "
            f"{route.length:.1f} m long, start before its end"
        )
    return route


def at_own_speed(route: Route, motion: Motion) -> Route:
    """Return a route with the vehicle's speed, where that is its own."""
    return replace(route, speed_ms=getattr(motion.dynamics, "speed", route.speed_ms))


def judged_frames(scenario: Scenario) -> int:
    """Return the frames of the drives by which an attack is judged once.

    Raises:
        InputError: as of :func:`driven_route`.
    """
    route = driven_route(scenario, scenario.vehicle.motion())
    steps = scenario.drive.steps(route, scenario.vehicle.dt_s)
    return scenario.attack.method.rendered(steps) * scenario.attack.poses


def build_surrogate(scenario: Scenario) -> SceneSensor:
    """Make the sensor that an attack is made through.

    Raises:
        InputError: a file is missing or wrong, or its scene has no derivative that
            the scenario asks for.
    """
    place, rig = scenario.scene, scenario.rig()
    names = [item.id for item in scenario.objects]
    if place.surrogate is not None:
        xml = load_scene(place.surrogate.file)
        sensor = scene_sensor(xml, rig.mounts[0], names, seed=scenario.seed)
        if scenario.attack.attached:
            try:
                sensor.check_attached()
                _require_smooth(sensor, "sample_count of its sensor")
            except InputError as err:
                raise InputError(f"{place.surrogate}: {err}") from err
        return sensor
    posed = [PosedField(item.load(), item.pose) for item in scenario.objects]
    assert place.field is not None  # checked by SceneSection
    sensor = field_sensor(
        _load_layer(scenario, place.field.file),
        posed,
        rig.cameras[0],
        mount=rig.mounts[0],
        jitter_seed=scenario.seed if scenario.attack.jitter else None,
        stop=place.stop,
        composite=place.composite,
        names=names,
        spp=place.spp,
    ).with_rig(rig)
    if scenario.attack.attached:
        _require_smooth(sensor, "scene.spp")
    return sensor


def _require_smooth(sensor: SceneSensor, key: str) -> None:
    if (spp := sensor.camera.spp) < SMOOTH_SPP:
        raise InputError(
            f"attack.attached: rays per pixel: {spp}, too few for a smooth objective; "
            f"set {key} to {SMOOTH_SPP} or more"
        )


def build_rollout(world: World) -> tuple[Rollout, Any]:
    """Make the drives that an attack is judged by, and their initial states (m, n).

    The policy needs no derivatives.
    """
    scenario, section = world.scenario, world.scenario.attack
    loop = world.loop(world.optimised)
    if section.vary != VarySection():
        loop = section.vary.applied(loop, scenario.seed)
    rollout = Rollout(
        loop=loop,
        objective=world.objective,
        horizon=world.horizon,
        reduction=scenario.objective.reduction,
        adjoint=section.adjoint,
        attached=section.attached,
    )
    return rollout, loop.initial(optimised_states(scenario, world.route))


def build_attack(world: World) -> AbstractAttack:
    """Make the attack of a scenario, before its first iteration.

    Args:
        world: what the scenario describes.

    Raises:
        InputError: its method cannot change what it may.
        TypeError: the policy has no derivatives, and its method needs them.
    """
    section = world.scenario.attack
    rollout, initial = build_rollout(world)
    freedom, seed = section.freedom.build(), world.scenario.seed
    return section.method.build(Task(rollout, world.route, initial, freedom, seed))


def load_posed(scene: SceneSection, path: Path) -> PosedField:
    """Load a field where a scene has it, with the scene's marching step.

    Raises:
        InputError: the file is missing or wrong.
    """
    field = load_field(path)
    field.refine(scene.step_m or field.step_m)
    return PosedField(field, scene.pose)


def _load_layer(scenario: Scenario, path: Path) -> Layer:
    """Load a scene: a field, or splats, which are told by the suffix."""
    if not holds_splats(path):
        posed = load_posed(scenario.scene, path)
        if scenario.attack.attached:
            posed.field.see_all()
        return posed
    if scenario.scene.step_m is not None:
        raise InputError(f"scene.step_m: {path} holds splats, which take no steps")
    return SplatBackground(load_splats(path), scenario.scene.pose)


def optimised_states(scenario: Scenario, route: Route) -> np.ndarray:
    """Return the states (m, 3) that an attack starts from, the nominal one first."""
    states = initial_states(scenario, route, scenario.attack.poses, stream=2)
    states[0] = route.pose_at(scenario.drive.start_m)
    return states


def initial_states(
    scenario: Scenario, route: Route, count: int, stream: int
) -> np.ndarray:
    """Draw initial states normally around the nominal pose.

    Args:
        scenario: gives seed, and standard deviations or covariance.
        route: the nominal pose is its own, `drive.start_m` from its first point.
        count: number of states.
        stream: different streams give independent states.

    Returns:
        (count, 3), metres and radians.

    Source: appendix A.4.
    """
    rng = np.random.default_rng([scenario.seed, stream])
    section, shifts = scenario.drive, np.zeros((3, count))
    if section.covariance is None:
        shifts[1] = rng.normal(0, section.lateral_sd_m, count)
        shifts[2] = rng.normal(0, np.radians(section.heading_sd_deg), count)
    else:  # which may be singular
        values, vectors = np.linalg.eigh(section.covariance)
        factor = vectors * np.sqrt(values.clip(min=0))
        shifts[:] = factor @ rng.standard_normal((3, count))
    shifts[0] += section.start_m
    return route.pose_at(*shifts)
