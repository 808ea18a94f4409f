"""Driving frames with the expert's controls, rendered and written to shards."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from mi_nerfattack.backend.versions import versions
from mi_nerfattack.deploy.environment import AbstractEnvironment, OpenEnvironment
from mi_nerfattack.deploy.sites import AbstractSite, expert_of, probe_expert
from mi_nerfattack.io import files
from mi_nerfattack.io.resumable import Record, Unit, flatten, json_digest
from mi_nerfattack.system.workers import (
    AbstractWork,
    AbstractWorkers,
    OnUnits,
    tally,
)
from mi_nerfattack.training.dataset import FORMAT, SHARDS, FrameStates, shard_columns
from mi_nerfattack.training.settings import CollectSettings
from mi_nerfattack.training.sources import AbstractSource, Labelled, Scenery
from mi_nerfattack.training.staging import ROADSIDE, AbstractStage, AbstractStaging
from mi_nerfattack.vehicle.expert import AbstractExpert, future_positions
from mi_nerfattack.vehicle.route.route import Route

#: Called with frames done and frames wanted.
OnFrames = Callable[[int, int], None]

_REMEDY = "choose another folder for the frames, or remove this one"


class ShardRecord(Record):
    """Conditions of a shard's frames; how many by goal, groups by number of objects."""

    conditions: dict[str, Any]
    goals: dict[str, int]
    objects: dict[str, int]


def collect(
    site: AbstractSite,
    routes: Sequence[Route],
    source: AbstractSource,
    settings: CollectSettings,
    folder: str | Path,
    workers: AbstractWorkers,
    progress: OnFrames = lambda done, total: None,
    staging: AbstractStaging = ROADSIDE,
) -> list[Path]:
    """Render what vehicles near the routes see, and label it by the expert.

    Complete shards are kept, and each shard has another seed. So the frames depend
    neither on the number of workers nor on interruptions, for example by a power cut.

    Args:
        site: makes the environments, and gives objects and their surroundings.
        routes: that `staging` may choose.
        source: of the states.
        settings: of the collection.
        folder: gets `<site.name>/shard_0000.safetensors` and so on.
        workers: who renders.
        progress: called now and then; an exception from it stops the work.
        staging: what is at the roadside of each stretch; random objects by default.

    Returns:
        The shards, in order.

    Raises:
        InputError: the folder holds frames of other settings, files, routes, states or
            objects; a file cannot be written; a worker ended.
    """
    root = files.make_folder(Path(folder) / site.name)
    experts = {route.name: probe_expert(site, route) for route in routes}
    identity = {
        "format": FORMAT,
        **flatten("version", versions()),
        **flatten("settings", asdict(settings)),
        **flatten("site", site.describe()),
        **flatten("source", source.describe()),
        **staging.identity(),
        "routes": _digest(routes),
        **flatten("route_names", [route.name for route in routes]),
        **flatten("expert", experts),
    }
    work = _Shards(site, tuple(routes), source, staging, settings, root, identity)
    present = sorted(root.glob(SHARDS))
    for path in present:
        work.unit(path).read_record()  # refuses frames of something else
    paths = [work.path(index) for index in range(settings.shards)]
    missing = [index for index, path in enumerate(paths) if path not in present]
    done = settings.frames - sum(map(settings.size, missing))
    progress(done, settings.frames)

    workers.run(work, missing, tally(progress, done, settings.frames))
    return paths


@dataclass(frozen=True, eq=False)
class _Shards(AbstractWork):
    """The shards of a collection, as work for one or more processes."""

    site: AbstractSite
    routes: tuple[Route, ...]
    source: AbstractSource
    staging: AbstractStaging
    settings: CollectSettings
    root: Path
    identity: Mapping[str, str]

    @cached_property
    def experts(self) -> list[AbstractExpert]:
        """Experts of the routes, in their order."""
        return [expert_of(self.site, route) for route in self.routes]

    def path(self, index: int) -> Path:
        """Return the file of a shard."""
        return self.root / f"shard_{index:04d}.safetensors"

    def unit(self, path: Path) -> Unit[ShardRecord]:
        """Return what a file must be."""
        return Unit(path, self.identity, ShardRecord, remedy=_REMEDY)

    def open(self) -> _Opened:
        """Load what staging and source need."""
        stage = self.staging.open(self.site, self.routes, self.settings)
        return _Opened(stage, self.source.prepare())

    def do(self, opened: _Opened, index: int, report: OnUnits) -> None:
        """Render, label and write one shard."""
        rng = np.random.default_rng(
            [self.settings.seed, index, *self.site.name.encode()]
        )
        conditions = self.site.draw(rng)
        environment = opened.environment.get(
            conditions, lambda: self.site.open(conditions)
        )
        opened.stage.begin(rng)
        opened.shown.clear()
        rows, numbers = [], []
        for number, row in self._rows(opened, environment, rng):
            numbers.append(number)
            rows.append(row)
            report(1)
            if len(rows) == self.settings.size(index):
                break
        goals = np.array([self.routes[number].goal for number in numbers])
        images = np.stack([row.image for row in rows])
        controls = np.array([row.control for row in rows])
        self.unit(self.path(index)).write(
            shard_columns(images, goals, controls, states=self._states(numbers, rows)),
            ShardRecord(
                conditions=asdict(conditions),
                goals=_counts(goals),
                objects=_counts(opened.shown),
            ),
        )

    def _states(self, numbers: Sequence[int], rows: Sequence[Labelled]) -> FrameStates:
        """Describe where frames were taken, and where the experts go from there.

        Args:
            numbers: (n,), indices of routes.
            rows: n frames, in the order in which they were taken.
        """
        site, count = self.site, len(rows)
        poses, step = np.stack([row.pose for row in rows]), [row.step for row in rows]
        speed, arc, error = (np.empty(count, np.float32) for _ in range(3))
        waypoints = np.empty((count, len(self.settings.waypoints_s), 2), np.float32)
        for number in set(numbers):
            mine, route = np.equal(numbers, number), self.routes[number]
            arc[mine], error[mine], _ = route.project_numpy(poses[mine])
            speed[mine] = route.speed_ms
            waypoints[mine] = future_positions(
                self.experts[number],
                poses[mine],
                self.settings.waypoints_s,
                speed=route.speed_ms,
                period=site.period,
                wheelbase=site.car.wheelbase,
            )
        later = np.flatnonzero(step)
        speed[later] = _arc_lengths(poses[later - 1], poses[later]) / site.period
        return FrameStates(
            poses=poses,
            speeds=speed,
            arc_lengths=arc,
            cross_tracks=error,
            waypoints=waypoints,
            drives=np.cumsum(np.equal(step, 0)) - 1,
            steps=np.array(step),
            routes=np.array(numbers),
        )

    def close(self, opened: _Opened) -> None:
        """Close the environment."""
        opened.environment.close()

    def _rows(
        self,
        opened: _Opened,
        environment: AbstractEnvironment,
        rng: np.random.Generator,
    ) -> Iterator[tuple[int, Labelled]]:
        """Yield indices of routes and labelled frames without end."""
        names = [route.name for route in self.routes]
        for route, arc, poses in _draw_states(opened.stage, self.settings, rng):
            objects = opened.stage.objects(route, arc, rng)
            opened.shown.append(len(objects))
            environment.show(objects)
            number = names.index(route.name)
            scenery = Scenery(environment, route, self.experts[number], poses, rng)
            for labelled in self.source.frames(opened.prepared, scenery):
                yield number, labelled


@dataclass(eq=False)
class _Opened:
    """What a worker keeps from shard to shard: one environment, and a stage.

    Args:
        stage: see `collect`.
        prepared: what the source needs.

    Attributes:
        shown: number of objects of each group of the shard.
        environment: under the conditions of the shard.
    """

    stage: AbstractStage
    prepared: Any
    shown: list[int] = field(default_factory=list)
    environment: OpenEnvironment = field(default_factory=OpenEnvironment)


def _counts(values: Any) -> dict[str, int]:
    names, counts = np.unique(values, return_counts=True)
    return {str(n): int(count) for n, count in zip(names, counts, strict=True)}


def _draw_states(
    stage: AbstractStage, settings: CollectSettings, rng: np.random.Generator
) -> Iterator[tuple[Route, float, np.ndarray]]:
    """Draw groups without end: route, arc length of the centre, states (k, 3)."""
    while True:
        route, (begin, end) = stage.draw_stretch(rng)
        centre = float(rng.uniform(begin, end))
        spread = rng.uniform(-settings.spread_m, settings.spread_m, settings.group)
        arc = np.clip(centre + spread, begin, end)
        yield route, centre, settings.scatter.states(route, arc, rng)


def _arc_lengths(before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """Return the lengths (n,) of the arcs between poses (n, 3), metres."""
    x, y, turn = (after - before).T
    turn = (turn + np.pi) % (2 * np.pi) - np.pi
    return np.hypot(x, y) / np.sinc(turn / (2 * np.pi))


def _digest(routes: Sequence[Route]) -> str:
    """Return a checksum of names, goals, lanes' widths, speeds, points and shapes."""
    rows = [
        [r.name, r.goal, r.lane_width_m, r.speed_ms, r.closed, r.points.tolist()]
        for r in routes
    ]
    return json_digest(rows)
