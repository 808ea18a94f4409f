"""From a place to a policy: collect, train, let it drive, train again, validate."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import torch

from mi_nerfattack.errors import InputError
from mi_nerfattack.policy.collect import CollectSettings, OnFrames, collect
from mi_nerfattack.policy.dataset import FrameDataset
from mi_nerfattack.policy.evaluate import EvaluateSettings
from mi_nerfattack.policy.pilotnet import IMAGE_SHAPE, PilotNet
from mi_nerfattack.policy.sites import AbstractSite
from mi_nerfattack.policy.sources import (
    AbstractSource,
    ExpertDrives,
    Mixture,
    PolicyDrives,
    Scattered,
)
from mi_nerfattack.policy.train import Progress, TrainSettings, fit_policy
from mi_nerfattack.policy.validation import ClosedLoop, rank
from mi_nerfattack.policy.workers import AbstractWorkers
from mi_nerfattack.vehicle.route import Route

#: Called with the name of the stage, units done and wanted, and what to show.
OnStage = Callable[[str, float, float, str], None]

#: Scattered states and recoveries of the expert.
CLONING = Mixture((Scattered(), ExpertDrives()), (0.7, 0.3))
#: Added to the seed of held-out frames; more than there are rounds.
_HELD_OUT = 1 << 20


@dataclass(frozen=True)
class ImitationSettings:
    """Choices of the whole way from a place to a policy.

    Args:
        frames: of the first collection, by site.
        validation_frames: of a collection for the held-out loss, by site; none: a part
            of the others.
        dagger_rounds: number of rounds.
        dagger_frames: added in every round, by site.
        dagger_epochs: epochs of the training after each round, which starts from the
            weights before.
        dagger_rate: learning rate of these.
        expert_share: of the control periods of a round in which the expert drives.
        horizon: control periods of a drive of a round.
        seed: of everything but the closed-loop drives; overrides those of `collecting`
            and `training`.
        validate_every: epochs from one validation in the closed loop to the next.
        validate_in: names of the sites of these validations; none: all.
        cloning: source of the first collection's states.
        collecting: of the frames; their number and seed are overridden.
        training: of the first training.
        validation: of the closed-loop drives between epochs.
        final: of those at the end.
    """

    frames: Mapping[str, int]
    validation_frames: Mapping[str, int] = field(default_factory=dict)
    dagger_rounds: int = 0
    dagger_frames: Mapping[str, int] = field(default_factory=dict)
    dagger_epochs: int = 3
    dagger_rate: float = 5e-4
    expert_share: float = 0.0
    horizon: int = 16
    seed: int = 0
    validate_every: int = 4
    validate_in: tuple[str, ...] = ()
    cloning: AbstractSource = CLONING
    collecting: CollectSettings = field(default_factory=CollectSettings)
    training: TrainSettings = field(default_factory=TrainSettings)
    validation: EvaluateSettings = field(
        default_factory=lambda: EvaluateSettings(runs=1)
    )
    final: EvaluateSettings = field(default_factory=lambda: EvaluateSettings(runs=2))

    def __post_init__(self) -> None:
        for name in ("frames", "validation_frames", "dagger_frames"):
            for site, count in getattr(self, name).items():
                if not isinstance(count, int) or count < 0:
                    raise InputError(f"{name}: {count!r} of {site!r}; at least 0")


@dataclass(frozen=True, eq=False)
class Imitated:
    """A trained policy, the history of each training, and its closed-loop card.

    The policy is that of the best validation of all rounds.
    """

    module: PilotNet
    history: list[list[dict[str, Any]]]
    best_round: int
    card: dict[str, Any]


def imitate(
    sites: Sequence[AbstractSite],
    routes: Sequence[Route],
    settings: ImitationSettings,
    folder: str | Path,
    workers: AbstractWorkers,
    progress: OnStage = lambda stage, done, total, state: None,
    start: PilotNet | None = None,
    more: Sequence[Path] = (),
) -> Imitated:
    """Train a policy to follow the lane, and measure it in the closed loop.

    Everything slow is kept in the folder: the same call continues where it stopped.

    Args:
        sites: with different names; those of `settings`.
        routes: to drive; their goals are those of the policy.
        settings: see there.
        folder: of frames and checkpoints.
        workers: who collects.
        progress: called often; an exception from it stops the work.
        start: weights to begin with; None for random ones.
        more: shards of earlier collections to train on, too.

    Raises:
        InputError: no frames wanted, an unknown site, a goal missing, a camera that
            does not fit, or the folder holds what was made with other settings.
    """
    _check(sites, routes, settings, more)
    run = _Imitation(sites, routes, settings, Path(folder), workers, progress)
    shards = [*more, *run.collect("round_0", settings.frames, settings.cloning, 0)]
    held_out = run.collect(
        "held_out", settings.validation_frames, settings.cloning, _HELD_OUT
    )
    torch.manual_seed(settings.seed)
    car = sites[0].car
    module = PilotNet(len(routes), car.max_control, car.control_unit)
    if start is not None:
        _take_weights(module, start)
    with run:
        history = [run.train(module, shards, held_out, 0)]
        weights = [run.save(module, 0)]
        for number in range(1, settings.dagger_rounds + 1):
            drives = PolicyDrives(weights[-1], settings.horizon, settings.expert_share)
            wanted = settings.dagger_frames
            shards += run.collect(f"round_{number}", wanted, drives, number)
            history.append(run.train(module, shards, held_out, number))
            weights.append(run.save(module, number))
        ranks = [min(rank(row) for row in rows if row["measured"]) for rows in history]
        best = ranks.index(min(ranks))
        module = PilotNet.load(weights[best])
        card = run.card(module)
    return Imitated(module, history, best, card)


class _Imitation:
    """What the stages of one imitation share."""

    def __init__(
        self,
        sites: Sequence[AbstractSite],
        routes: Sequence[Route],
        settings: ImitationSettings,
        folder: Path,
        workers: AbstractWorkers,
        progress: OnStage,
    ) -> None:
        self.sites, self.routes, self.settings = sites, routes, settings
        self.folder, self.workers, self.progress = folder, workers, progress
        self._loop: ClosedLoop | None = None

    def __enter__(self) -> _Imitation:
        """Load what validation drives in, after the workers have gone."""
        sites = self.sites
        objects = sites[0].load_objects()
        self._loop = ClosedLoop(
            [site.open(site.typical()) for site in self._validated()],
            self.routes,
            objects,
            sites[0].load_ground(),
            self.settings.validation,
            self.settings.validate_every,
            self._steps("validation"),
        )
        return self

    def __exit__(self, *error: object) -> None:
        """Close the environments."""
        for environment in self.loop.environments:
            environment.close()

    @property
    def loop(self) -> ClosedLoop:
        """Validation in the closed loop."""
        assert self._loop is not None
        return self._loop

    def _validated(self) -> list[AbstractSite]:
        chosen = self.settings.validate_in
        return [site for site in self.sites if not chosen or site.name in chosen]

    def collect(
        self, name: str, frames: Mapping[str, int], source: AbstractSource, number: int
    ) -> list[Path]:
        """Collect frames of all sites; returns the shards."""
        shards: list[Path] = []
        for site in self.sites:
            if not frames.get(site.name):
                continue
            settings = replace(
                self.settings.collecting,
                frames=frames[site.name],
                seed=self.settings.seed + number,
            )
            arguments = (settings, self.folder / name, self.workers)
            show = self._frames(f"{name}, {site.name}")
            shards += collect(site, self.routes, source, *arguments, show)
        return shards

    def train(
        self,
        module: PilotNet,
        shards: Sequence[Path],
        held_out: Sequence[Path],
        number: int,
    ) -> list[dict[str, Any]]:
        """Train once, with a checkpoint after each epoch."""
        settings = replace(self.settings.training, seed=self.settings.seed + number)
        if number:
            settings = replace(
                settings,
                epochs=self.settings.dagger_epochs,
                learning_rate=self.settings.dagger_rate,
            )

        def step(at: Progress) -> None:
            done = (at.epoch - 1) * at.steps + at.step
            total = settings.epochs * at.steps
            state = f"epoch {at.epoch}/{settings.epochs}  loss {at.loss:.4f}"
            self.progress(f"training {number}", done, total, state)

        # a quarter faster on a CPU; the values do not depend on it
        layout: Any = {"memory_format": torch.channels_last}
        module.to(**layout)
        return fit_policy(
            module,
            FrameDataset.from_folders(shards),
            settings,
            self.folder / f"checkpoint_{number}.safetensors",
            progress=step,
            held_out=FrameDataset.from_folders(held_out) if held_out else None,
            validation=self.loop,
        )

    def save(self, module: PilotNet, number: int) -> Path:
        """Write the best weights of a round."""
        path = self.folder / f"policy_{number}.safetensors"
        module.save(path)
        return path

    def card(self, module: PilotNet) -> dict[str, Any]:
        """Drive a policy for its final figures, in the environments of validation."""
        final = replace(
            self.loop, settings=self.settings.final, progress=self._steps("card")
        )
        return final.card(module)

    def _frames(self, stage: str) -> OnFrames:
        def show(done: int, total: int, left_s: float) -> None:
            left = "" if left_s != left_s else f"  {_clock(left_s)} left"
            self.progress(stage, done, total, f"{done}/{total} frames{left}")

        return show

    def _steps(self, stage: str) -> Callable[[int, int], None]:
        return lambda done, total: self.progress(
            stage, done, total, f"step {done}/{total}"
        )


def _check(
    sites: Sequence[AbstractSite],
    routes: Sequence[Route],
    settings: ImitationSettings,
    more: Sequence[Path],
) -> None:
    """Raise `InputError` for what cannot be trained."""
    names = [site.name for site in sites]
    wanted = {**settings.frames, **settings.dagger_frames, **settings.validation_frames}
    if unknown := sorted({*wanted, *settings.validate_in} - set(names)):
        raise InputError(f"frames: of {', '.join(unknown)}; there is {names}")
    goals = sorted(route.goal for route in routes)
    frames = sum(settings.frames.values())
    if not sites or not (frames or more) or goals != list(range(len(routes))):
        raise InputError(
            f"imitate: {frames} frames of {names}, goals {goals}; at least one frame, "
            "and goals 0, 1, 2, ..."
        )
    for site in sites:
        check_camera(site)


def check_camera(site: AbstractSite) -> None:
    """Raise `InputError` unless PilotNet takes the images of a site's camera."""
    height, width = IMAGE_SHAPE
    camera = site.camera
    if (camera.width, camera.height) != (width, height):
        raise InputError(
            f"camera of {site.name!r}: {camera.width} x {camera.height} px; PilotNet "
            f"takes {width} x {height}"
        )


def _take_weights(module: PilotNet, start: PilotNet) -> None:
    """Copy weights from a policy for the same goals and controls."""
    mine, theirs = ((m.goals, m.max_control, m.unit) for m in (module, start))
    if mine != theirs:
        raise InputError(
            f"start: a policy of goals, largest control and unit {theirs}; {mine} "
            "are needed here"
        )
    module.load_state_dict(start.state_dict())


def _clock(seconds: float) -> str:
    """Return a time as minutes and seconds."""
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes}:{rest:02d}"
