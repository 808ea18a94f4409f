"""The certificate of robustness: a bound on departures, and the best attack."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from mi_nerfattack.backend.determinism import one_thread
from mi_nerfattack.drives.run import run_drives
from mi_nerfattack.drives.spec import DriveSpec
from mi_nerfattack.drives.store import Finished, Store
from mi_nerfattack.drives.table import drives_table, write_csv
from mi_nerfattack.errors import InputError
from mi_nerfattack.evaluation.certificate import (
    bound_within,
    chance_bound,
    chance_interval,
)
from mi_nerfattack.experiment.certify.noise import (
    ATTACKED,
    CENTRE,
    SEARCH,
    Looks,
    NoisyDrives,
    Searches,
    Smoothing,
)
from mi_nerfattack.experiment.certify.search import BallSearch, severity, steepest
from mi_nerfattack.io import files, locks
from mi_nerfattack.ranges import Count, Fraction, Positive, checked
from mi_nerfattack.report.plots.certificate import plot_robustness
from mi_nerfattack.rollout.drive import ATTACK, RANDOM, Lane
from mi_nerfattack.scenario.deployment import SURROGATE
from mi_nerfattack.scenario.scenario import Scenario
from mi_nerfattack.scenario.world import World, build_world
from mi_nerfattack.system.workers import AbstractWorkers, tally

SCHEMA = 1
DOCUMENT, TABLE, PICTURE = "certificate.json", "certificate.csv", "certificate.png"
#: Folder of the finished drives, and the table with one row per drive.
DRIVES, DRIVES_TABLE = "drives", "drives.csv"

#: Called with a stage, units done and all units.
OnStage = Callable[[str, int, int], None]


@dataclass(frozen=True)
@checked("certify")
class RobustnessSettings:
    """What a certificate is of.

    Args:
        environment: label of the scenario's.
        runs: drives under noise around the original textures.
        sd: standard deviation of the noise, sRGB values.
        radii: within which textures may change; Euclidean, of the coefficients.
        coefficients: of all objects together, at most.
        confidence: of the bound, and of the attacks' intervals.
        proposals: points that a search judges, for each radius.
        judged_by: drives of each judgement.
        attacked: drives under noise around the best of each search.

    Raises:
        InputError: a value is out of its range, or a radius comes twice.
    """

    environment: str = SURROGATE
    runs: Count = 1000
    sd: Positive = 0.5
    radii: tuple[Positive, ...] = (0.25, 0.5, 1.0)
    coefficients: Count = 24
    confidence: Fraction = 0.999
    proposals: Count = 40
    judged_by: Count = 4
    attacked: Count = 200

    def __post_init__(self) -> None:
        if not self.radii or len(set(self.radii)) < len(self.radii):
            raise InputError(f"--radii: {self.radii}; at least one, each once")


@dataclass(frozen=True, eq=False)
class _Job:
    """One certificate on its way through all stages."""

    world: World
    settings: RobustnessSettings
    smoothing: Smoothing
    looks: Looks
    store: Store
    workers: AbstractWorkers
    on_stage: OnStage

    @property
    def lane(self) -> Lane:
        return Lane.of(self.world.route, self.world.scenario.vehicle.width_m)

    def work(self, specs: Sequence[DriveSpec] = ()) -> NoisyDrives:
        count, world_looks = self.settings.coefficients, (self.world, self.looks)
        return NoisyDrives(self.store, self.world.scenario, count, specs, world_looks)

    def drive(self, stage: str, specs: Sequence[DriveSpec]) -> list[Finished]:
        def progress(done: int, total: int) -> None:
            self.on_stage(stage, done, total)

        groups = run_drives(self.work(specs), self.workers, progress)
        return [item for [item] in groups]

    def centre(self) -> tuple[list[Finished], np.ndarray]:
        """Drive around the original textures; return the direction of severity, too."""
        smoothing, zero = self.smoothing, np.zeros(self.smoothing.count)
        numbers = range(self.settings.runs)
        draws = [smoothing.draw(self.world, CENTRE, k) for k in numbers]
        specs = [
            smoothing.spec(zero, draw, RANDOM, run=k) for k, draw in enumerate(draws)
        ]
        finished = self.drive("driving under noise", specs)
        severities = [self.severity(item) for item in finished]
        noise = np.array([draw.noise for draw in draws])
        return finished, steepest(noise, np.array(severities))

    def severity(self, item: Finished) -> float:
        return severity(float(item.drive.distance_m.max()), self.lane.wheel_m)

    def departed(self, finished: Sequence[Finished]) -> int:
        limit = self.lane.wheel_m
        return sum(bool(item.drive.departed(limit).any()) for item in finished)

    def search(self, direction: np.ndarray) -> list[np.ndarray]:
        """Search in the ball of each radius; return the best coefficients."""
        settings, smoothing = self.settings, self.smoothing
        numbers = range(settings.judged_by)
        draws = [smoothing.draw(self.world, SEARCH, k) for k in numbers]
        seed, count = self.world.scenario.seed, settings.proposals
        searches = [
            BallSearch(radius, direction, count, seed=seed) for radius in settings.radii
        ]
        limit = self.lane.wheel_m
        work = Searches(self.work(), smoothing, draws, searches, limit)

        def progress(done: int, total: int) -> None:
            self.on_stage("searching attacks", done, total)

        pieces = range(len(searches))
        self.workers.run(work, pieces, tally(progress, 0, count * len(searches)))
        return [work.best(index) for index in pieces]

    def attacked(
        self, points: Sequence[np.ndarray]
    ) -> list[tuple[list[Finished], list[Finished]]]:
        """Drive around each point, and past the point itself, without noise."""
        smoothing, world = self.smoothing, self.world
        noisy, plain = self.settings.attacked, len(world.initial)
        draws = [smoothing.draw(world, ATTACKED, k) for k in range(noisy)]
        draws += [smoothing.nominal(world, k) for k in range(plain)]
        specs = [
            smoothing.spec(point, draw, ATTACK, run=k)
            for point in points
            for k, draw in enumerate(draws)
        ]
        finished = self.drive("driving past attacks", specs)
        each = [
            finished[k : k + len(draws)] for k in range(0, len(finished), len(draws))
        ]
        return [(items[:noisy], items[noisy:]) for items in each]

    def row(
        self,
        radius: float,
        bound: float,
        point: np.ndarray,
        finished: tuple[list[Finished], list[Finished]],
    ) -> dict[str, Any]:
        """Return the figures of a radius."""
        noisy, plain = finished
        departed, total = self.departed(noisy), len(noisy)
        ends = chance_interval(departed, total, self.settings.confidence)
        within = bound_within(bound, radius, self.settings.sd)
        return {
            "radius": radius,
            "bound": within,
            "attack_departed": departed,
            "attack_drives": total,
            "attack_chance": departed / total,
            "attack_interval": list(ends),
            "gap": within - departed / total,
            "plain_departed": self.departed(plain),
            "plain_drives": len(plain),
            "attack": point.tolist(),
        }


def certify_robustness(
    scenario: Scenario,
    output: Path,
    settings: RobustnessSettings,
    workers: AbstractWorkers,
    on_stage: OnStage = lambda stage, done, total: None,
) -> dict[str, Any]:
    """Bound the chance of a departure under changes of textures; search attacks.

    Args:
        scenario: of the drives.
        output: folder, which keeps finished drives.
        settings: see there.
        workers: who drives.
        on_stage: called with a stage, units done and all units.

    Returns:
        the document that ``certificate.json`` holds.

    Raises:
        InputError: a file is missing or wrong, textures may not change, there is no
            such environment, or another process works in the folder.
    """
    with certificate_folder(output, DRIVES, DRIVES_TABLE):
        evaluated = _evaluated(output)
        if settings.runs not in evaluated:
            evaluated.append(settings.runs)
        world = build_world(scenario, scenario.build_policy())
        looks = Looks(world, settings.coefficients)
        label = settings.environment
        smoothing = Smoothing.of(world, label, looks, sd=settings.sd)
        world.open(label).close()  # what cannot be made is reported before hours
        store = Store(output / DRIVES)
        job = _Job(
            world,
            settings,
            smoothing,
            looks=looks,
            store=store,
            workers=workers,
            on_stage=on_stage,
        )
        with one_thread():
            centre, direction = job.centre()
            points = job.search(direction)
            attacked = job.attacked(points)
        document = _document(job, evaluated, centre, points=points, attacked=attacked)
        _write(output, document, job, centre=centre, attacked=attacked)
    return document


def _document(
    job: _Job,
    evaluated: list[int],
    centre: Sequence[Finished],
    points: Sequence[np.ndarray],
    attacked: Sequence[tuple[list[Finished], list[Finished]]],
) -> dict[str, Any]:
    """Summarise drives."""
    settings, scenario = job.settings, job.world.scenario
    departed, confidence = job.departed(centre), settings.confidence
    bound = chance_bound(departed, len(centre), confidence)
    radii = zip(settings.radii, points, attacked, strict=True)
    return {
        "schema": SCHEMA,
        "scenario": scenario.name,
        "seed": scenario.seed,
        "settings": asdict(settings) | {"radii": list(settings.radii)},
        "looks": evaluated,
        "flags": _flags(evaluated, confidence),
        "coefficients": job.looks.count,
        "departure_limit_m": job.lane.wheel_m,
        "departed": departed,
        "chance": departed / len(centre),
        "chance_interval": [*chance_interval(departed, len(centre), confidence)],
        "chance_bound": bound,
        "drive_s": float(np.median([item.wall_s for item in centre])),
        "rows": [
            job.row(radius, bound, point, finished=finished)
            for radius, point, finished in radii
        ],
    }


def _evaluated(output: Path) -> list[int]:
    """Return the numbers of runs that certificates in the folder are of, in order.

    Raises:
        InputError: ``certificate.json`` is damaged, or of another kind or version.
    """
    path = output / DOCUMENT
    if not path.exists():
        return []
    document = files.read_json(path)
    looks = document.get("looks") if isinstance(document, dict) else None
    if not isinstance(looks, list):
        raise InputError(
            f"{path}: does not list the numbers of runs of earlier results ('looks'); "
            "choose another folder"
        )
    return looks


def _flags(evaluated: Sequence[int], confidence: float) -> list[str]:
    """Say that the number of runs followed from results."""
    if len(evaluated) < 2:
        return []
    numbers = ", ".join(f"{runs}" for runs in evaluated)
    return [
        f"this folder was evaluated with {numbers} runs; if an earlier result decided "
        f"about the last number, the confidence is less than {100 * confidence:g} %"
    ]


@contextmanager
def certificate_folder(output: Path, *names: str) -> Iterator[None]:
    """Claim the folder of a certificate, and remove what was half written.

    Args:
        output: the folder.
        names: of files and folders that only this kind of certificate has.

    Raises:
        InputError: it holds something else, or another process works in it.
    """
    own = {*names, DOCUMENT, TABLE, PICTURE}
    own |= {str(Path(PICTURE).with_suffix(suffix)) for suffix in (".pdf", ".svg")}
    with locks.claimed(output):
        others = {p.name for p in output.iterdir() if not locks.is_partial(p)} - own
        if others:
            raise InputError(
                f"{output}: holds something else than such a certificate, for example "
                f"{min(others)}; choose another folder"
            )
        locks.remove_partial(output)
        yield


def _write(
    output: Path,
    document: dict[str, Any],
    job: _Job,
    centre: Sequence[Finished],
    attacked: Sequence[tuple[list[Finished], list[Finished]]],
) -> None:
    lanes = {job.world.route.name: job.lane}
    groups = [(0.0, CENTRE, centre)]
    for radius, finished in zip(job.settings.radii, attacked, strict=True):
        groups += [
            (radius, name, items)
            for name, items in zip(_GROUP_NAMES, finished, strict=True)
        ]
    tables = [
        drives_table([item.drive for item in items], lanes, radius=radius, around=name)
        for radius, name, items in groups
    ]
    write_csv(output / DRIVES_TABLE, pd.concat(tables))
    rows = [{k: v for k, v in row.items() if k != "attack"} for row in document["rows"]]
    for row in rows:
        row["attack_low"], row["attack_high"] = row.pop("attack_interval")
    write_csv(output / TABLE, pd.DataFrame(rows))
    plot_robustness(output / PICTURE, document)
    files.write_json(output / DOCUMENT, document)


_GROUP_NAMES = ("attack", "attack without noise")
