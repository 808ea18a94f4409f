"""Driving frames with the expert's controls, rendered and written to shards."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from mi_nerfattack import files
from mi_nerfattack.attack.textures import random_texture
from mi_nerfattack.deploy.mitsuba import PathTracedSensor
from mi_nerfattack.errors import InputError
from mi_nerfattack.fields.grid import GridField
from mi_nerfattack.policy.dataset import write_shard
from mi_nerfattack.policy.placement import Ground, Roadside, Scatter
from mi_nerfattack.render.posed import PosedField
from mi_nerfattack.rollout.field_sensor import FieldSensor
from mi_nerfattack.rollout.loop import ClosedLoop, simulate, to_state
from mi_nerfattack.rollout.sensor import AbstractSensor, Observation
from mi_nerfattack.vehicle.dynamics import Dubins
from mi_nerfattack.vehicle.expert import LaneFollower
from mi_nerfattack.vehicle.integrators import RK4
from mi_nerfattack.vehicle.route import Route

#: Called with frames done and frames wanted; an exception from it stops the work
#: without loss of whole shards.
OnFrames = Callable[[int, int], None]

_DONE = "shard.json"
_LARGEST_ERROR_M = 2.0


@dataclass(frozen=True, eq=False)
class World:
    """What frames are rendered of.

    Args:
        name: of the folder that the shards go to, "surrogate" or "deployment".
        sensor: renders it; its objects are replaced.
        objects: stand beside the road with random textures; may be empty. Their own
            textures come back when the work ends.
        ground: where objects can stand.
    """

    name: str
    sensor: FieldSensor | PathTracedSensor
    objects: tuple[GridField, ...]
    ground: Ground


@dataclass(frozen=True)
class CollectSettings:
    """Choices of a collection; the same settings and world give the same frames.

    Args:
        frames: wanted, rounded up to whole groups.
        seed: of everything random.
        group: frames that share a place and an object, rendered together.
        groups_a_texture: groups that share a texture.
        groups_a_shard: groups that are written together.
        object_share: share of the groups with an object.
        original_share: share of these where it keeps its own texture.
        spread_m: states of a group lie within this arc length of their centre.
        ahead_m: arc length from a group's centre to its object, range.
        margin_m: arc length before and after the route, from where frames come too.
        scatter: deviations of the states from the route.
        roadside: sizes and places of the objects.
    """

    frames: int = 9000
    seed: int = 0
    group: int = 8
    groups_a_texture: int = 2
    groups_a_shard: int = 32
    object_share: float = 0.75
    original_share: float = 0.1
    spread_m: float = 3.0
    ahead_m: tuple[float, float] = (4.0, 20.0)
    margin_m: float = 2.0
    scatter: Scatter = field(default_factory=Scatter)
    roadside: Roadside = field(default_factory=Roadside)

    def __post_init__(self) -> None:
        for name in ("frames", "group", "groups_a_texture", "groups_a_shard"):
            value = getattr(self, name)
            if not isinstance(value, int) or value < 1:
                raise InputError(f"CollectSettings.{name}: {value!r}; at least 1")
        for name in ("object_share", "original_share"):
            if not 0 <= getattr(self, name) <= 1:
                raise InputError(
                    f"CollectSettings.{name}: {getattr(self, name)!r}; in [0, 1]"
                )

    @property
    def shards(self) -> int:
        """Number of shards."""
        return -(-self.frames // (self.group * self.groups_a_shard))


@dataclass(frozen=True, eq=False)
class _Group:
    """Frames (k, height, width, 3) uint8, goal, controls (k,) rad/s."""

    frames: np.ndarray
    goal: int
    controls: np.ndarray


def collect(
    world: World,
    routes: Sequence[Route],
    settings: CollectSettings,
    folder: str | Path,
    origin: str = "",
    progress: OnFrames = lambda done, total: None,
) -> list[Path]:
    """Render what vehicles near the routes see, and label it by the expert.

    Shards that are complete are kept; each has random numbers of its own, so an
    interrupted collection continues as if it had not stopped.

    Args:
        world: to render.
        routes: they take turns by chance.
        settings: see there.
        folder: gets `<world.name>/shard_0000` and so on, and a manifest.
        origin: any text that identifies scene, fields and sensor, for the manifest.
        progress: called after each group.

    Returns:
        The folders of the shards, in order.

    Raises:
        InputError: the folder holds frames of other settings or another origin.
    """

    def groups(stage: _Stage, rng: np.random.Generator, step: int) -> Iterator[_Group]:
        states = _draw_states(routes, settings, rng)
        for number in range(settings.groups_a_shard):
            route, arc, poses = next(states)
            stage.dress(route, arc, number, rng)
            seen = world.sensor.observe(to_state(poses), step + number)
            controls = LaneFollower(route).control(poses)
            yield _Group(to_uint8(seen.image), route.goal, controls)

    about = {"origin": origin, "routes": _digest(routes)}
    return _write(world, settings, folder, about, groups, progress)


def collect_visited(
    world: World,
    routes: Sequence[Route],
    policy: Any,
    settings: CollectSettings,
    folder: str | Path,
    origin: str = "",
    horizon: int = 16,
    progress: OnFrames = lambda done, total: None,
) -> list[Path]:
    """Let the policy drive, and label what it sees by the expert.

    A DAgger round (Ross et al. 2011) with the policy alone at the wheel. Drives
    start scattered around a place on the route and end after `horizon` steps of
    0.1 s; states farther than 2 m from the route are dropped.

    Args:
        world: to render.
        routes: they take turns by chance.
        policy: AbstractPolicy that drives.
        settings: a group is the vehicles that drive at the same time.
        folder: as for `collect`.
        origin: as for `collect`; must identify the policy too.
        horizon: steps of a drive.
        progress: called after each group.

    Returns:
        The folders of the shards, in order.
    """
    tape = _Tape(world.sensor)

    def groups(stage: _Stage, rng: np.random.Generator, step: int) -> Iterator[_Group]:
        tape.seed = step * horizon
        states = _draw_states(routes, settings, rng)
        wanted, found, number = settings.group * settings.groups_a_shard, 0, 0
        while found < wanted:
            route, arc, poses = next(states)
            stage.dress(route, arc, number, rng)
            group = _drive(tape, policy, route, poses, horizon)
            left = wanted - found
            group = _Group(group.frames[:left], group.goal, group.controls[:left])
            found, number = found + len(group.controls), number + 1
            yield group

    about = {"origin": origin, "routes": _digest(routes), "horizon": horizon}
    return _write(world, settings, folder, about, groups, progress)


def to_uint8(image: Any) -> np.ndarray:
    """Round an image tensor in [0, 1] to uint8, same shape."""
    return np.round(255 * np.clip(np.array(image), 0, 1)).astype(np.uint8)


class _Tape(AbstractSensor):
    """Sensor that keeps the images it passes on, and counts steps over all drives."""

    def __init__(self, sensor: FieldSensor | PathTracedSensor) -> None:
        self.sensor = sensor
        self.frames: list[np.ndarray] = []
        self.seed = 0

    def observe(self, state: Any, step: int) -> Observation:
        """Render and keep."""
        self.seed += 1
        seen = self.sensor.observe(state, self.seed)
        self.frames.append(to_uint8(seen.image))
        return seen


def _drive(
    tape: _Tape, policy: Any, route: Route, poses: np.ndarray, horizon: int
) -> _Group:
    """Record one batch of drives and label the states."""
    tape.frames.clear()
    dynamics = Dubins(speed=route.speed_ms)
    loop = ClosedLoop(tape, policy, route.goal, dynamics, RK4(), 0.1)
    trajectory = simulate(loop, to_state(poses), horizon)
    # (n, horizon, 3) -> horizon blocks of n, as the frames lie
    states = trajectory.states_numpy()[:, :-1].transpose(1, 0, 2).reshape(-1, 3)
    near = np.abs(route.cross_track_numpy(states)) < _LARGEST_ERROR_M
    frames = np.concatenate(tape.frames)
    return _Group(frames[near], route.goal, LaneFollower(route).control(states[near]))


def _draw_states(
    routes: Sequence[Route], settings: CollectSettings, rng: np.random.Generator
) -> Iterator[tuple[Route, float, np.ndarray]]:
    """Draw groups without end: route, arc length of the centre, states (k, 3)."""
    lengths = np.array([route.length for route in routes])
    while True:
        route = routes[rng.choice(len(routes), p=lengths / lengths.sum())]
        margin = settings.margin_m
        centre = float(rng.uniform(-margin, route.length + margin))
        spread = rng.uniform(-settings.spread_m, settings.spread_m, settings.group)
        arc = np.clip(centre + spread, -margin, route.length + margin)
        yield route, centre, settings.scatter.states(route, arc, rng)


class _Stage:
    """Changes the objects of a world from group to group.

    Args:
        world: whose sensor and objects are changed.
        settings: see there.
    """

    def __init__(self, world: World, settings: CollectSettings) -> None:
        self.world, self.settings = world, settings
        self.own = [item.texture.numpy() for item in world.objects]

    def dress(
        self, route: Route, arc: float, number: int, rng: np.random.Generator
    ) -> None:
        """Put an object beside the road, or none; change its texture now and then.

        Args:
            route: beside which it stands.
            arc: arc length of the group's centre, metres.
            number: of the group in its shard.
            rng: source of all draws.
        """
        sensor, settings = self.world.sensor, self.settings
        sensor.objects = []
        if not self.world.objects:
            return
        turn, rest = divmod(number, settings.groups_a_texture)
        index = turn % len(self.world.objects)
        chosen = self.world.objects[index]
        if rest == 0:
            keep = rng.uniform() < settings.original_share
            texture = random_texture(chosen, "mixed", int(rng.integers(2**31)))
            chosen.set_parameter("texture", self.own[index] if keep else texture)
        if rng.uniform() < settings.object_share:
            reach = (arc + settings.ahead_m[0], arc + settings.ahead_m[1])
            place = settings.roadside.place
            pose = place(chosen, route, reach, self.world.ground, rng)
            sensor.objects = [PosedField(chosen, pose)]

    def restore(self) -> None:
        """Give the objects their own textures back."""
        self.world.sensor.objects = []
        for item, texture in zip(self.world.objects, self.own, strict=True):
            item.set_parameter("texture", texture)


def _write(
    world: World,
    settings: CollectSettings,
    folder: str | Path,
    about: dict[str, Any],
    groups: Callable[[_Stage, np.random.Generator, int], Iterator[_Group]],
    progress: OnFrames,
) -> list[Path]:
    """Write the shards that are not there yet."""
    root = files.make_folder(Path(folder) / world.name)
    _claim(root, {"settings": asdict(settings), **about})
    stage = _Stage(world, settings)
    size = settings.group * settings.groups_a_shard
    done, paths = 0, []
    try:
        for index in range(settings.shards):
            shard = root / f"shard_{index:04d}"
            paths.append(shard)
            if (shard / _DONE).is_file():
                done += size
                progress(done, settings.shards * size)
                continue
            entropy = [settings.seed, index, *world.name.encode()]
            step = index * settings.groups_a_shard
            parts = []
            for part in groups(stage, np.random.default_rng(entropy), step):
                parts.append(part)
                done += len(part.controls)
                progress(done, settings.shards * size)
            _finish(shard, parts)
    finally:
        stage.restore()
    return paths


def _finish(shard: Path, parts: list[_Group]) -> None:
    """Write one shard and, last, the file that says that it is complete."""
    goals = np.concatenate([np.full(len(part.controls), part.goal) for part in parts])
    controls = np.concatenate([part.controls for part in parts])
    write_shard(shard, np.concatenate([part.frames for part in parts]), goals, controls)
    counts = {str(goal): int((goals == goal).sum()) for goal in np.unique(goals)}
    files.write_json(shard / _DONE, {"frames": len(goals), "goals": counts})


def _claim(root: Path, about: dict[str, Any]) -> None:
    """Write the manifest, or compare it with the one that is there."""
    path, about = root / "manifest.json", json.loads(json.dumps(about))
    if path.is_file():
        found = files.read_json(path)
        if found != about:
            keys = sorted(set(found) | set(about))
            wrong = [key for key in keys if found.get(key) != about.get(key)]
            raise InputError(
                f"{path}: the frames there differ in {', '.join(wrong)}; "
                "choose another folder or remove this one"
            )
    files.write_json(path, about)


def _digest(routes: Sequence[Route]) -> str:
    """Return a checksum of names, goals, points and speeds."""
    text = json.dumps([[r.name, r.goal, r.speed_ms, r.points.tolist()] for r in routes])
    return hashlib.sha256(text.encode()).hexdigest()
