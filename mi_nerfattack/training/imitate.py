"""From a place to a policy: collect, train, let it drive, train again, validate."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from mi_nerfattack.deploy.sites import AbstractSite
from mi_nerfattack.errors import InputError
from mi_nerfattack.evaluation.evaluate import EvaluateSettings, check_places
from mi_nerfattack.io import files
from mi_nerfattack.io.locks import exclusive, remove_partial
from mi_nerfattack.policy.pilotnet import IMAGE_SHAPE, MOST_GOALS, PilotNet
from mi_nerfattack.rollout.drive import departure_limits
from mi_nerfattack.system.workers import AbstractWorkers
from mi_nerfattack.training.collect import OnFrames, collect
from mi_nerfattack.training.dataset import FrameDataset, control_unit_of, divide_shards
from mi_nerfattack.training.settings import ImitationSettings
from mi_nerfattack.training.sources import AbstractSource, PolicyDrives
from mi_nerfattack.training.staging import ROADSIDE, AbstractStaging
from mi_nerfattack.training.train import Progress, check_labels, check_site, fit_policy
from mi_nerfattack.training.validation import ClosedLoop, Epoch, rank
from mi_nerfattack.vehicle.route.route import Route

#: Called with the name of the stage, units done and wanted, and what to show.
OnStage = Callable[[str, float, float, str], None]

#: Number of the collection of held-out frames; more than there are rounds.
_HELD_OUT = 1 << 20


@dataclass(frozen=True, eq=False)
class Imitated:
    """A trained policy, the history of each training, and its closed-loop card.

    The policy is that of the best validation of all rounds; the shards are all that
    were trained on or held out.
    """

    module: PilotNet
    history: list[list[Epoch]]
    best_round: int
    card: dict[str, Any]
    shards: list[Path]


def imitate(
    sites: Sequence[AbstractSite],
    routes: Sequence[Route],
    settings: ImitationSettings,
    folder: str | Path,
    workers: AbstractWorkers,
    progress: OnStage = lambda stage, done, total, state: None,
    start: PilotNet | None = None,
    earlier_shards: Sequence[Path] = (),
    staging: AbstractStaging = ROADSIDE,
) -> Imitated:
    """Train a policy to follow the lane, and measure it in the closed loop.

    Everything slow is kept in the folder: the same call continues where it stopped.

    Args:
        sites: with different names; the sites of `settings`.
        routes: to drive; the policy has goals from 0 to their largest goal, or as many
            as the first weights.
        settings: of collections, training and validation.
        folder: of frames and checkpoints.
        workers: who collects.
        progress: called often; an exception from it stops the work.
        start: weights to begin with; None for random ones.
        earlier_shards: shards of earlier collections to train on, too.
        staging: of all collections, see `collect`.

    Raises:
        InputError: before the first frame, no frames are wanted, or another process
            works in the folder. A site is unknown or cannot be opened, or objects find
            no place. A camera, a route, first weights or frames of `earlier_shards`
            do not fit. Later, the folder holds results of other settings.
    """
    _check_counts(sites, routes, settings, earlier_shards)
    _check_policy(sites, routes, settings, earlier_shards)
    _check_places(sites, routes, settings, (settings.validation, settings.final))
    torch.manual_seed(settings.seed)
    car = sites[0].car
    goals = 1 + max(route.goal for route in routes)
    if start is not None:
        goals = max(goals, start.goals)
    module = PilotNet(goals, car.max_control, car.control_unit)
    if start is not None:
        _take_weights(module, start)
    if earlier_shards:
        _check_frames(module, earlier_shards)
    with exclusive(files.make_folder(folder)):
        remove_partial(folder)  # of killed writers
        run = _Imitation(
            sites,
            routes,
            settings,
            folder=Path(folder),
            workers=workers,
            progress=progress,
            staging=staging,
        )
        return run.run(module, earlier_shards)


def collect_frames(
    sites: Sequence[AbstractSite],
    routes: Sequence[Route],
    settings: ImitationSettings,
    folder: str | Path,
    workers: AbstractWorkers,
    progress: OnStage = lambda stage, done, total, state: None,
    staging: AbstractStaging = ROADSIDE,
) -> list[Path]:
    """Collect the frames of the first training; return all shards, train nothing.

    Images may have any size. If they have PilotNet's, `imitate` with the same arguments
    trains on these frames. Arguments and errors are those of `imitate`.
    """
    _check_counts(sites, routes, settings, ())
    _check_places(sites, routes, settings, ())
    with exclusive(files.make_folder(folder)):
        remove_partial(folder)  # of killed writers
        run = _Imitation(
            sites,
            routes,
            settings,
            folder=Path(folder),
            workers=workers,
            progress=progress,
            staging=staging,
        )
        first, held_out = run.collect_first()
        return [*first, *held_out]


@dataclass(eq=False)
class _Imitation:
    """What the stages of one imitation share."""

    sites: Sequence[AbstractSite]
    routes: Sequence[Route]
    settings: ImitationSettings
    folder: Path
    workers: AbstractWorkers
    progress: OnStage
    staging: AbstractStaging
    training: list[Path] = field(default_factory=list)
    held_out: list[Path] = field(default_factory=list)
    _loop: ClosedLoop | None = None

    def run(self, module: PilotNet, earlier_shards: Sequence[Path]) -> Imitated:
        """Do all stages, beginning with the weights of `module`."""
        settings = self.settings
        first, held_out = self.collect_first()
        self.take([*earlier_shards, *first])
        self.held_out += held_out
        with self:
            history = [self.train(module, 0)]
            weights = [self.save(module, 0)]
            for number in range(1, settings.dagger_rounds + 1):
                drives = PolicyDrives(
                    weights[-1], settings.horizon, settings.expert_share
                )
                frames = settings.dagger_frames
                self.take(self.collect(f"round_{number}", frames, drives, number))
                history.append(self.train(module, number))
                weights.append(self.save(module, number))
            ranks = [
                min(rank(row) for row in rows if row["measured"]) for rows in history
            ]
            best = ranks.index(min(ranks))
            module = PilotNet.load(weights[best])
            card = self.card(module)
        return Imitated(module, history, best, card, [*self.training, *self.held_out])

    def __enter__(self) -> _Imitation:
        """Load what validation drives in, after the workers have gone."""
        site, settings = self.sites[0], self.settings
        object_count = max(settings.validation.most, settings.final.most)
        self._loop = ClosedLoop(
            environments=[site.open(site.typical()) for site in self._validated()],
            routes=self.routes,
            objects=site.load_objects(object_count),
            surroundings=site.load_surroundings() if object_count else None,
            settings=self.settings.validation,
            every=self.settings.validate_every,
            progress=self._shown("validation"),
        )
        return self

    def __exit__(self, *error: object) -> None:
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

    def collect_first(self) -> tuple[list[Path], list[Path]]:
        """Collect the frames of the first training, and the held-out ones, if any."""
        settings, source = self.settings, self.settings.cloning
        first = self.collect("round_0", settings.frames, source, number=0)
        frames = settings.validation_frames
        return first, self.collect("held_out", frames, source, _HELD_OUT)

    def collect(
        self, name: str, frames: Mapping[str, int], source: AbstractSource, number: int
    ) -> list[Path]:
        """Collect frames of all sites; returns the shards."""
        shards: list[Path] = []
        settings = replace(self.settings.collecting, seed=self._seed(number))
        for site in self.sites:
            if not frames.get(site.name):
                continue
            shards += collect(
                site,
                self.routes,
                source,
                settings=replace(settings, frames=frames[site.name]),
                folder=self.folder / name,
                workers=self.workers,
                progress=self._shown(f"{name}, {site.name}", "{}/{} frames"),
                staging=self.staging,
            )
        return shards

    def take(self, shards: Sequence[Path]) -> None:
        """Add shards to those of training, some to the held-out ones.

        They stay there: a round starts from weights that have seen the former.
        """
        training = shards
        if self.settings.holds_out_shards:
            least = 0 if self.held_out else 1
            fraction = self.settings.training.held_out
            training, held_out = divide_shards(shards, fraction, least)
            self.held_out += held_out
        self.training += training

    def train(self, module: PilotNet, number: int) -> list[Epoch]:
        """Train once, with a checkpoint after each epoch."""
        settings = replace(self.settings.training, seed=self._seed(number))
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
            FrameDataset.from_shards(self.training),
            settings,
            self.folder / f"checkpoint_{number}.safetensors",
            progress=step,
            held_out=FrameDataset.from_shards(self.held_out),
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
            self.loop, settings=self.settings.final, progress=self._shown("card")
        )
        return final.card(module)

    def _seed(self, number: int) -> int:
        """Return the seed of a round: those of other seeds' rounds are others."""
        entropy = [self.settings.seed, number]
        return int(np.random.SeedSequence(entropy).generate_state(1)[0])

    def _shown(self, stage: str, words: str = "step {}/{}") -> OnFrames:
        return lambda done, total: self.progress(
            stage, done, total, words.format(done, total)
        )


def _check_counts(
    sites: Sequence[AbstractSite],
    routes: Sequence[Route],
    settings: ImitationSettings,
    earlier_shards: Sequence[Path],
) -> None:
    names = [site.name for site in sites]
    if unknown := sorted(set(settings.sites) - set(names)):
        raise InputError(f"frames: of {', '.join(unknown)}; there is {names}")
    frames = sum(settings.frames.values())
    if not sites or not routes or not (frames or earlier_shards):
        raise InputError(
            f"imitate: {frames} frames of {names}, {len(routes)} routes; at least one "
            "frame and one route"
        )


def _check_policy(
    sites: Sequence[AbstractSite],
    routes: Sequence[Route],
    settings: ImitationSettings,
    earlier_shards: Sequence[Path],
) -> None:
    """Raise `InputError` for what PilotNet cannot be trained on."""
    frames = sum(settings.frames.values())
    for route in routes:
        if route.goal >= MOST_GOALS:
            raise InputError(
                f"route {route.name!r}: goal {route.goal}; PilotNet has at most "
                f"{MOST_GOALS} goals, from 0: number the manoeuvres closely"
            )
    for site in sites:
        check_site(site)
    size = settings.collecting.shard
    count = len(earlier_shards) + sum(-(-n // size) for n in settings.frames.values())
    if settings.holds_out_shards and count < 2:
        raise InputError(
            f"frames: {frames}, one shard of up to {size}; at least two, of which one "
            "is held out, or give validation_frames"
        )


def _check_places(
    sites: Sequence[AbstractSite],
    routes: Sequence[Route],
    settings: ImitationSettings,
    measured: Sequence[EvaluateSettings],
) -> None:
    """Raise `InputError` for objects without a place, or a site that does not open."""
    for drives in measured:
        departure_limits(routes, drives.car_width_m)
    collecting = settings.collecting
    object_count = collecting.objects if collecting.object_share else 0
    most = max([object_count, *(drives.most for drives in measured)])
    objects = sites[0].load_objects(most) if most else []
    if objects:
        surroundings = sites[0].load_surroundings()
        for drives in measured:
            check_places(sites[0].period, routes, objects, surroundings, drives)
        # near the ends of a route there may be no place; somewhere there must
        rng, rule = np.random.default_rng(settings.seed), collecting.roadside
        for route in routes if object_count else ():
            rule.draw(objects[:1], surroundings, route, (0.0, route.length), rng)
    # what cannot be made is told now, not after the hours of those before it
    for site in sites:
        site.open(site.typical()).close()


def _check_frames(module: PilotNet, shards: Sequence[Path]) -> None:
    for shard in shards:
        data = FrameDataset.from_shards([shard])
        height, width = data.frames[0].shape[1:3]
        if (height, width) != IMAGE_SHAPE:
            raise InputError(
                f"{shard}: frames of {width} x {height} px; PilotNet takes "
                f"{IMAGE_SHAPE[1]} x {IMAGE_SHAPE[0]}"
            )
        unit = control_unit_of(shard)
        if unit not in (None, module.unit):
            need = f"the policy's are in {module.unit}: leave these frames out"
            raise InputError(f"{shard}: controls in {unit}; {need}")
        try:
            check_labels(module, data)
        except InputError as error:
            raise InputError(f"{shard}: {error}") from error


def _take_weights(module: PilotNet, start: PilotNet) -> None:
    mine, theirs = ((m.goals, m.max_control, m.unit) for m in (module, start))
    if mine != theirs:
        raise InputError(
            f"start: a policy of goals, largest control and unit {theirs}; {mine} "
            "are needed here"
        )
    module.load_state_dict(start.state_dict())
