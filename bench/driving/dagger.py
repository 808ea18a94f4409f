"""DAgger against plain behaviour cloning, on as many frames and gradient steps."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from mi_nerfattack.deploy.place import bundled_place
from mi_nerfattack.deploy.sites import PlaceSite, Weather
from mi_nerfattack.errors import InputError
from mi_nerfattack.evaluation.evaluate import EvaluateSettings, evaluate_run
from mi_nerfattack.io import files
from mi_nerfattack.io.resumable import Record, Unit, flatten
from mi_nerfattack.policy.pilotnet import PilotNet
from mi_nerfattack.policy.torch_policy import TorchPolicy
from mi_nerfattack.report.plots.charts import BLUE, ORANGE, chart
from mi_nerfattack.rollout.drive import NO_OBJECT, departure_limit
from mi_nerfattack.system.workers import AbstractWork, AbstractWorkers, OnUnits
from mi_nerfattack.training.collect import collect
from mi_nerfattack.training.dataset import FrameDataset
from mi_nerfattack.training.settings import CLONING, CollectSettings
from mi_nerfattack.training.sources import PolicyDrives
from mi_nerfattack.training.train import Progress, TrainSettings, fit_policy
from mi_nerfattack.training.validation import LossAlone
from mi_nerfattack.vehicle.route.route import load_routes

#: Called with a stage's name, units done and wanted.
OnStage = Callable[[str, int, int], None]

ARMS = ("cloning", "DAgger")
_FORMAT = "mi_nerfattack compared drive 2"
_REMEDY = "choose another folder, or remove this one"
_LAST = LossAlone(every=1 << 30)  # the weights of the last epoch count


@dataclass(frozen=True)
class Settings:
    """Sizes of the comparison.

    Cloning trains once on all its frames. DAgger trains on its first frames, which are
    the first of cloning's, and again after each round; its epochs are such that both
    do equally many gradient steps.

    Args:
        seeds: of frames, weights and order; the drives have seeds of their own.
        first: frames before the first round.
        added: frames of each round.
        epochs: of DAgger's trainings, one more than rounds.
        cloning_epochs: of cloning's.
        batch: images a step; divides all numbers of frames.
        runs: drives of each route, from random starts.
        horizon: most steps of a drive.
        environment: in which frames are taken and policies drive.
        spp: samples per pixel.
        collecting: of the frames.
    """

    seeds: tuple[int, ...] = (0, 1, 2)
    first: int = 768
    added: int = 384
    epochs: tuple[int, ...] = (12, 8, 10)
    cloning_epochs: int = 22
    batch: int = 64
    runs: int = 3
    horizon: int = 1000
    environment: str = "mitsuba"
    spp: int = 4
    collecting: CollectSettings = field(default_factory=CollectSettings)

    def __post_init__(self) -> None:
        sizes = [self.first + k * self.added for k in range(len(self.epochs))]
        if any(size % self.batch for size in sizes):
            raise InputError(f"frames: {sizes}; multiples of the batch, {self.batch}")
        steps = sum(n * e for n, e in zip(sizes, self.epochs, strict=True))
        if steps != sizes[-1] * self.cloning_epochs:
            raise InputError(
                f"epochs: {self.epochs} on {sizes} frames, {self.cloning_epochs} on "
                f"{sizes[-1]}; both must be equally many steps"
            )

    @classmethod
    def quick(cls) -> Settings:
        """Return the smallest sizes: to see that it works, not for figures."""
        return cls((0, 1), 64, 32, (3, 1), 3, 32, 1, 5, spp=1)

    @property
    def frames(self) -> int:
        """Frames of either side."""
        return self.first + (len(self.epochs) - 1) * self.added

    @property
    def steps(self) -> int:
        """Gradient steps of either side."""
        return self.frames // self.batch * self.cloning_epochs


def run(
    settings: Settings, folder: Path, workers: AbstractWorkers, show: OnStage
) -> dict[str, Any]:
    """Collect, train and drive, for all seeds; the same call continues.

    Args:
        settings: see there.
        folder: of frames, checkpoints and results.
        workers: who collects and drives.
        show: called often; an exception from it stops the work.

    Returns:
        Settings, and of each arm the errors of every drive and of every seed.
    """
    folder = files.make_folder(folder)
    weather = Weather(spp=settings.spp)
    site = PlaceSite(settings.environment, bundled_place(), weather)
    bench = _Bench(settings, site, folder, workers, show)
    errors: dict[str, list[list[float]]] = {arm: [] for arm in ARMS}
    departed: dict[str, int] = dict.fromkeys(ARMS, 0)
    for seed in settings.seeds:
        policies = bench.cloning(seed), bench.dagger(seed)
        for arm, policy in zip(ARMS, policies, strict=True):
            drives = bench.drive(arm, seed, policy)
            errors[arm].append([drive.mean_m for drive in drives])
            departed[arm] += sum(drive.departed for drive in drives)
    return to_document(settings, errors, departed)


def to_document(
    settings: Settings,
    errors: dict[str, list[list[float]]],
    departed: dict[str, int],
) -> dict[str, Any]:
    """Return the result as JSON.

    Args:
        settings: see there.
        errors: by arm, seed and drive, metres.
        departed: drives that left the lane, by arm.
    """
    arms = {}
    for arm, drives in errors.items():
        means = np.mean(drives, axis=1)
        spread = means.std(ddof=1) / np.sqrt(len(means)) if len(means) > 1 else 0.0
        arms[arm] = {
            "mean_m": float(means.mean()),
            "standard_error_m": float(spread),
            "seeds_m": means.tolist(),
            "drives_m": drives,
            "drives_departed": departed[arm],
        }
    about = {"frames": settings.frames, "gradient_steps": settings.steps}
    return {**about, "settings": asdict(settings), "arms": arms}


class _Bench:
    """What the stages share."""

    def __init__(
        self,
        settings: Settings,
        site: PlaceSite,
        folder: Path,
        workers: AbstractWorkers,
        show: OnStage,
    ) -> None:
        self.settings, self.site, self.folder = settings, site, folder
        self.workers, self.show = workers, show
        self.routes = load_routes(site.place.routes)

    def cloning(self, seed: int) -> Path:
        """Train on the expert's frames alone."""
        shards = self._expert_frames(seed)
        path = self.folder / f"cloning_{seed}.safetensors"
        module = self._module(seed)
        self._fit(module, shards, seed, self.settings.cloning_epochs, path, 1e-3)
        return path

    def dagger(self, seed: int) -> Path:
        """Train on the first of them, then on what the policy met."""
        settings = self.settings
        count = settings.first // self.settings.collecting.shard
        if settings.first % settings.collecting.shard:
            raise InputError(
                f"first: {settings.first}; a multiple of "
                f"{settings.collecting.shard}, the frames of a shard"
            )
        shards = self._expert_frames(seed)[:count]
        module, path = self._module(seed), Path()
        for number, epochs in enumerate(settings.epochs):
            if number:
                drives = PolicyDrives(path)
                shards += self._frames(
                    f"dagger_{seed}_{number}",
                    settings.added,
                    drives,
                    100 * number + seed,
                )
            path = self.folder / f"dagger_{seed}_{number}.safetensors"
            rate = 5e-4 if number else 1e-3
            self._fit(module, shards, seed, epochs, path, rate)
        return path

    def drive(self, arm: str, seed: int, policy: Path) -> list[_Driven]:
        """Let a policy drive all routes."""
        folder = files.make_folder(self.folder / f"drives_{arm}_{seed}")
        work = _Drives(self.settings, self.site, policy, folder)
        pieces = range(len(self.routes) * self.settings.runs)
        left = [index for index in pieces if work.unit(index).read_record() is None]
        done = len(pieces) - len(left)

        def count(units: int) -> None:
            nonlocal done
            done += units
            self.show(f"{arm} {seed} drives", done, len(pieces))

        self.workers.run(work, left, count)
        found = [work.unit(index).read_record() for index in pieces]
        return [drive for drive in found if drive is not None]

    def _expert_frames(self, seed: int) -> list[Path]:
        return self._frames(f"expert_{seed}", self.settings.frames, CLONING, seed)

    def _frames(self, name: str, count: int, source: Any, seed: int) -> list[Path]:
        return collect(
            self.site,
            self.routes,
            source,
            replace(self.settings.collecting, frames=count, seed=seed),
            self.folder / name,
            self.workers,
            lambda done, total: self.show(f"{name} frames", done, total),
        )

    def _module(self, seed: int) -> PilotNet:
        torch.manual_seed(seed)
        return PilotNet(len(self.routes))

    def _fit(
        self,
        module: PilotNet,
        shards: Sequence[Path],
        seed: int,
        epochs: int,
        path: Path,
        rate: float,
    ) -> None:
        """Train on all frames, and write the weights after the last step."""
        name = path.stem

        def step(at: Progress) -> None:
            done = (at.epoch - 1) * at.steps + at.step
            self.show(f"{name} training", done, epochs * at.steps)

        layout: Any = {"memory_format": torch.channels_last}
        module.to(**layout)  # faster on a CPU
        data = FrameDataset.from_shards(shards)
        fit_policy(
            module,
            data,
            TrainSettings(epochs, self.settings.batch, rate, seed=seed),
            self.folder / f"{name}.checkpoint.safetensors",
            progress=step,
            held_out=FrameDataset.from_shards(shards[:1]),  # has no influence
            validation=_LAST,
        )
        module.save(path)


class _Driven(Record):
    """Route, mean distance from the lane's centre, and whether it was left."""

    route: str
    mean_m: float
    departed: bool


@dataclass(frozen=True, eq=False)
class _Drives(AbstractWork):
    """Drives of one policy; a piece is a drive, and so is a unit."""

    settings: Settings
    site: PlaceSite
    policy: Path
    folder: Path

    def unit(self, index: int) -> Unit[_Driven]:
        """Return the file of a drive's result."""
        identity = {"format": _FORMAT, **flatten("settings", asdict(self.settings))}
        path = self.folder / f"{index:03d}.safetensors"
        return Unit(path, identity, _Driven, _REMEDY)

    def open(self) -> Any:
        """Load environment, policy and routes."""
        environment = self.site.open(self.site.typical())
        routes = load_routes(self.site.place.routes)
        return environment, TorchPolicy(PilotNet.load(self.policy)), routes

    def do(self, opened: Any, index: int, report: OnUnits) -> None:
        """Drive once."""
        environment, policy, routes = opened
        number, drive_number = divmod(index, self.settings.runs)
        route = routes[number]
        rules = EvaluateSettings(objects=(), horizon=self.settings.horizon)
        arguments = (
            environment,
            policy,
            route,
            NO_OBJECT,
            drive_number,
            (),
            None,
        )
        driven = evaluate_run(*arguments, rules)
        limit = departure_limit(route.lane_width_m, rules.car_width_m)
        result = _Driven(
            route=route.name,
            mean_m=float(driven.distance_m.mean()),
            departed=bool(driven.departed(limit).any()),
        )
        self.unit(index).write({}, result)
        report(1)

    def close(self, opened: Any) -> None:
        """Close the environment."""
        opened[0].close()


def write_figure(path: Path, document: dict[str, Any]) -> None:
    """Draw the errors of both arms: small dots are drives, large ones seeds."""
    with chart(path, 4.2) as figure:
        axes = figure.subplots()
        for place, (arm, colour) in enumerate(zip(ARMS, (BLUE, ORANGE), strict=True)):
            found = document["arms"][arm]
            mean, error = 100 * found["mean_m"], 100 * found["standard_error_m"]
            ends = np.linspace(place - 0.18, place + 0.18, len(found["seeds_m"]) + 1)
            across = (ends[:-1] + ends[1:]) / 2
            drives = 100 * np.array(found["drives_m"])  # (seeds, drives)
            axes.plot(across, drives, ".", color=colour, alpha=0.4)
            axes.plot(across, drives.mean(1), "o", color=colour, markersize=8)
            axes.hlines(mean, place - 0.22, place + 0.22, color="black")
            text = (
                f"mean {mean:.1f} cm\nstandard error {error:.1f} cm\n"
                f"{found['drives_departed']} of {drives.size} drives\n"
                "left the lane"
            )
            axes.annotate(text, (place + 0.25, mean), fontsize=8, va="center")
        axes.set_xticks(range(len(ARMS)), ARMS)
        axes.set_xlim(-0.6, len(ARMS) - 0.2)
        axes.set_yscale("log")
        axes.set_ylabel("distance from the lane centre, cm")
        axes.set_title(
            f"{document['frames']} frames and {document['gradient_steps']} gradient "
            f"steps each; {len(document['settings']['seeds'])} seeds"
        )
