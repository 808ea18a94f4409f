"""Driving frames with the expert's controls, rendered and written to shards."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from mi_nerfattack.deploy.environment import AbstractEnvironment
from mi_nerfattack.deploy.roadside.rule import Roadside
from mi_nerfattack.deploy.scatter import Scatter
from mi_nerfattack.deploy.sites import AbstractSite, expert_of, probe_expert
from mi_nerfattack.errors import InputError
from mi_nerfattack.fields.random_textures import random_texture
from mi_nerfattack.io import files
from mi_nerfattack.io.resumable import Record, Unit, flatten
from mi_nerfattack.ranges import Count, Share, checked
from mi_nerfattack.render.posed import PosedField
from mi_nerfattack.system.workers import AbstractWork, AbstractWorkers, OnUnits
from mi_nerfattack.training.dataset import shard_columns
from mi_nerfattack.training.sources import AbstractSource, Labelled, Scenery
from mi_nerfattack.vehicle.route.route import Route

#: Called with frames done and frames wanted.
OnFrames = Callable[[int, int], None]

FORMAT = "mi_nerfattack frames 1"
_SHARDS = "shard_*.safetensors"
_REMEDY = "choose another folder for the frames, or remove this one"


class ShardRecord(Record):
    """Conditions of a shard's frames; how many by goal, groups by number of objects."""

    conditions: dict[str, Any]
    goals: dict[str, int]
    objects: dict[str, int]


@dataclass(frozen=True)
@checked("CollectSettings")
class CollectSettings:
    """Choices of a collection; the same settings and site give the same frames.

    Args:
        frames: wanted.
        seed: of everything random.
        shard: frames that are written together, under the same conditions.
        group: states that are drawn around one point, with the same objects.
        objects: most of them at a time; each number from 1 is equally likely.
        object_share: share of the groups with objects.
        original_share: share of the textures that are an object's own; each object has
            one texture a shard.
        spread_m: states of a group lie within this arc length of their centre.
        ahead_m: arc length from a group's centre to where the drive ends from which
            its objects are in view; it begins `spread_m` before the centre.
        margin_m: arc length before and after an open route, from where frames come
            too.
        scatter: deviations of the states from the route.
        roadside: the rule by which the objects stand.
    """

    frames: Count = 9000
    seed: int = 0
    shard: Count = 64
    group: Count = 8
    objects: Count = 6
    object_share: Share = 0.75
    original_share: Share = 0.1
    spread_m: float = 3.0
    ahead_m: float = 8.0
    margin_m: float = 2.0
    scatter: Scatter = field(default_factory=Scatter)
    roadside: Roadside = field(default_factory=Roadside)

    @property
    def shards(self) -> int:
        """Number of shards."""
        return -(-self.frames // self.shard)

    def size(self, index: int) -> int:
        """Return the number of frames of a shard; the last one may have fewer."""
        return min(self.shard, self.frames - index * self.shard)


def collect(
    site: AbstractSite,
    routes: Sequence[Route],
    source: AbstractSource,
    settings: CollectSettings,
    folder: str | Path,
    workers: AbstractWorkers,
    progress: OnFrames = lambda done, total: None,
) -> list[Path]:
    """Render what vehicles near the routes see, and label it by the expert.

    Shards that are complete are kept; each has random numbers of its own. So the
    frames depend neither on the number of workers nor on interruptions, however hard.

    Args:
        site: makes the environments, and gives objects and their surroundings.
        routes: they take turns by chance, longer ones more often.
        source: of the states.
        settings: see there.
        folder: gets `<site.name>/shard_0000.safetensors` and so on.
        workers: who renders.
        progress: called now and then; an exception from it stops the work.

    Returns:
        The shards, in order.

    Raises:
        InputError: the folder holds frames of other settings, files, routes or states;
            a file cannot be written; a worker ended.
    """
    root = files.make_folder(Path(folder) / site.name)
    experts = {route.name: probe_expert(site, route) for route in routes}
    identity = {
        "format": FORMAT,
        **flatten("settings", asdict(settings)),
        **flatten("site", site.describe()),
        **flatten("source", source.describe()),
        "routes": _digest(routes),
        **flatten("expert", experts),
    }
    work = _Shards(site, tuple(routes), source, settings, root, identity)
    present = sorted(root.glob(_SHARDS))
    for path in present:
        work.unit(path).read_record()  # refuses frames of something else
    paths = [work.path(index) for index in range(settings.shards)]
    missing = [index for index, path in enumerate(paths) if path not in present]
    done = settings.frames - sum(map(settings.size, missing))
    progress(done, settings.frames)

    def count(frames: int) -> None:
        nonlocal done
        done += frames
        progress(done, settings.frames)

    workers.run(work, missing, count)
    return paths


@dataclass(frozen=True, eq=False)
class _Shards(AbstractWork):
    """The shards of a collection, as work for one or more processes."""

    site: AbstractSite
    routes: tuple[Route, ...]
    source: AbstractSource
    settings: CollectSettings
    root: Path
    identity: Mapping[str, str]

    def path(self, index: int) -> Path:
        """Return the file of a shard."""
        return self.root / f"shard_{index:04d}.safetensors"

    def unit(self, path: Path) -> Unit[ShardRecord]:
        """Return what a file must be."""
        return Unit(path, self.identity, ShardRecord, _REMEDY)

    def open(self) -> _Opened:
        """Load objects, surroundings and what the source needs."""
        return _Opened(self.site, self.settings, self.source.prepare())

    def do(self, opened: _Opened, index: int, report: OnUnits) -> None:
        """Render, label and write one shard."""
        rng = np.random.default_rng(
            [self.settings.seed, index, *self.site.name.encode()]
        )
        conditions = self.site.draw(rng)
        environment = opened.environment(conditions)
        opened.paint(rng)
        wanted, rows = self.settings.size(index), []
        images: list[np.ndarray] = []
        for goal, (image, control) in self._rows(opened, environment, rng):
            rows.append((goal, control))
            images.append(image)
            report(1)
            if len(rows) == wanted:
                break
        goals, controls = (np.array(column) for column in zip(*rows, strict=True))
        self.unit(self.path(index)).write(
            shard_columns(np.stack(images), goals, controls),
            ShardRecord(
                conditions=asdict(conditions),
                goals=_counts(goals),
                objects=_counts(opened.shown),
            ),
        )

    def close(self, opened: _Opened) -> None:
        """Close the environment."""
        opened.close()

    def _rows(
        self,
        opened: _Opened,
        environment: AbstractEnvironment,
        rng: np.random.Generator,
    ) -> Iterator[tuple[int, Labelled]]:
        """Yield goals and labelled frames without end."""
        experts = {route.name: expert_of(self.site, route) for route in self.routes}
        for route, arc, poses in _draw_states(self.routes, self.settings, rng):
            opened.dress(environment, route, arc, rng)
            scenery = Scenery(environment, route, experts[route.name], poses, rng)
            for labelled in self.source.frames(opened.prepared, scenery):
                yield route.goal, labelled


class _Opened:
    """What a worker keeps from shard to shard: one environment, objects, surroundings.

    Args:
        site: see `collect`.
        settings: see `collect`.
        prepared: what the source needs.

    Attributes:
        shown: number of objects of each group of the shard.
    """

    def __init__(
        self, site: AbstractSite, settings: CollectSettings, prepared: Any
    ) -> None:
        self.site, self.settings, self.prepared = site, settings, prepared
        wanted = settings.object_share > 0
        self.objects = site.load_objects(settings.objects) if wanted else []
        self.own = [item.texture.numpy().copy() for item in self.objects]
        self.surroundings = site.load_surroundings() if self.objects else None
        self.shown: list[int] = []
        self._open: tuple[Any, AbstractEnvironment] | None = None

    def environment(self, conditions: Any) -> AbstractEnvironment:
        """Return the environment under conditions; it is loaded where they differ."""
        if self._open is None or self._open[0] != conditions:
            self.close()
            self._open = conditions, self.site.open(conditions)
        return self._open[1]

    def close(self) -> None:
        """Close the environment."""
        if self._open is not None:
            self._open[1].close()
        self._open = None

    def paint(self, rng: np.random.Generator) -> None:
        """Begin a shard: give each object a random texture, or its own."""
        self.shown = []
        for item, own in zip(self.objects, self.own, strict=True):
            keep = rng.uniform() < self.settings.original_share
            texture = random_texture(item, "mixed", int(rng.integers(2**31)))
            item.set_parameter("texture", own if keep else texture)

    def dress(
        self,
        environment: AbstractEnvironment,
        route: Route,
        arc: float,
        rng: np.random.Generator,
    ) -> None:
        """Put objects beside the road, as many as find a place, or none.

        Args:
            environment: shows them.
            route: beside which they stand.
            arc: arc length of the group's centre, metres.
            rng: source of all draws.
        """
        settings, posed = self.settings, []
        if self.surroundings is not None and rng.uniform() < settings.object_share:
            count = int(rng.integers(1, settings.objects + 1))
            chosen = sorted(rng.permutation(len(self.objects))[:count].tolist())
            fields = [self.objects[index] for index in chosen]
            stretch = _stretch(route, arc, settings)
            poses = settings.roadside.find(
                fields, self.surroundings, route, stretch, rng, chosen
            )
            pairs = zip(fields, poses, strict=True)
            posed = [PosedField(item, pose) for item, pose in pairs if pose is not None]
        self.shown.append(len(posed))
        environment.show(posed)


def _stretch(
    route: Route, arc: float, settings: CollectSettings
) -> tuple[float, float]:
    """Return the drive from which a group's objects are in view; no longer a route's.

    At the ends of an open route it is as long, and ends where the frames do.
    """
    begin, end = arc - settings.spread_m, arc + settings.ahead_m
    if route.closed:
        return begin, end
    least, most = -settings.margin_m, route.length + settings.margin_m
    shift = max(least - begin, 0.0) + min(most - end, 0.0)
    return max(begin + shift, least), min(end + shift, most)


def _counts(values: Any) -> dict[str, int]:
    """Count equal integers."""
    names, counts = np.unique(values, return_counts=True)
    return {str(n): int(count) for n, count in zip(names, counts, strict=True)}


def _draw_states(
    routes: Sequence[Route], settings: CollectSettings, rng: np.random.Generator
) -> Iterator[tuple[Route, float, np.ndarray]]:
    """Draw groups without end: route, arc length of the centre, states (k, 3)."""
    lengths = np.array([route.length for route in routes])
    while True:
        route = routes[rng.choice(len(routes), p=lengths / lengths.sum())]
        margin = 0.0 if route.closed else settings.margin_m
        centre = float(rng.uniform(-margin, route.length + margin))
        spread = rng.uniform(-settings.spread_m, settings.spread_m, settings.group)
        arc = np.clip(centre + spread, -margin, route.length + margin)
        yield route, centre, settings.scatter.states(route, arc, rng)


def find_shards(folder: str | Path) -> list[Path]:
    """Return the shards anywhere below a folder, in order of their names.

    Raises:
        InputError: there are none.
    """
    found = sorted(Path(folder).rglob(_SHARDS))
    if not found:
        raise InputError(
            f"{folder}: no frames in it; give a folder of 'mi-nerfattack train'"
        )
    return found


def _digest(routes: Sequence[Route]) -> str:
    """Return a checksum of names, goals, lanes' widths, speeds, points and shapes."""
    about = [
        [r.name, r.goal, r.lane_width_m, r.speed_ms, r.closed, r.points.tolist()]
        for r in routes
    ]
    return hashlib.sha256(json.dumps(about).encode()).hexdigest()
