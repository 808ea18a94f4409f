"""From a scene to a policy: collect, train, let it drive, train again, validate."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import torch

from mi_nerfattack.errors import InputError
from mi_nerfattack.policy.adapter import TorchPolicy, one_thread
from mi_nerfattack.policy.collect import (
    CollectSettings,
    World,
    collect,
    collect_visited,
)
from mi_nerfattack.policy.dataset import FrameDataset
from mi_nerfattack.policy.evaluate import EvaluateSettings, drive_routes, policy_card
from mi_nerfattack.policy.pilotnet import PilotNet
from mi_nerfattack.policy.train import Progress, TrainSettings, fit_policy
from mi_nerfattack.vehicle.route import Route

#: Called with the name of the stage, units done and wanted, and what to show.
OnStage = Callable[[str, float, float, str], None]


@dataclass(frozen=True)
class ImitationSettings:
    """Choices of the whole way from a scene to a policy.

    Args:
        frames: wanted of each world, by name; 0 leaves a world out.
        dagger_frames: added to each used world in every DAgger round.
        dagger_rounds: number of rounds.
        dagger_epochs: epochs of the training after each round, which starts from the
            weights before.
        dagger_rate: learning rate of these.
        seed: of everything; overrides those of the settings below.
        collecting: of the frames; their number and seed are overridden.
        training: of the first training.
        validation: of the closed-loop drives at the end.
    """

    frames: dict[str, int]
    dagger_frames: int = 2048
    dagger_rounds: int = 0
    dagger_epochs: int = 4
    dagger_rate: float = 5e-4
    seed: int = 0
    collecting: CollectSettings = field(default_factory=CollectSettings)
    training: TrainSettings = field(default_factory=TrainSettings)
    validation: EvaluateSettings = field(default_factory=EvaluateSettings)


@dataclass(frozen=True, eq=False)
class Imitated:
    """A trained policy, the losses of each training, and its closed-loop card."""

    module: PilotNet
    history: list[list[dict[str, float]]]
    card: dict[str, Any]


def imitate(
    worlds: Sequence[tuple[World, str]],
    routes: Sequence[Route],
    settings: ImitationSettings,
    folder: str | Path,
    progress: OnStage = lambda stage, done, total, state: None,
) -> Imitated:
    """Train a policy to follow the lane, and measure it in the closed loop.

    Everything slow is kept in the folder: the same call continues where it stopped.

    Args:
        worlds: each with the text that identifies it.
        routes: to drive; their goals are those of the policy.
        settings: see there.
        folder: of frames and checkpoints.
        progress: called often; an exception from it stops the work.

    Raises:
        InputError: no frames wanted, a goal missing, or the folder holds frames or
            checkpoints of other settings.
    """
    folder = Path(folder)
    used = [pair for pair in worlds if settings.frames.get(pair[0].name, 0) > 0]
    goals = sorted(route.goal for route in routes)
    if not used or goals != list(range(len(routes))):
        raise InputError(
            f"imitate: worlds {[pair[0].name for pair in used]}, goals {goals}; at "
            "least one world with frames, and goals 0, 1, 2, ..."
        )
    shards: list[Path] = []
    for world, origin in used:
        wanted = replace(
            settings.collecting,
            frames=settings.frames[world.name],
            seed=settings.seed,
        )
        shards += collect(
            world,
            routes,
            wanted,
            folder / "round_0",
            origin,
            _frames_of(progress, f"frames, {world.name}"),
        )
    torch.manual_seed(settings.seed)
    module = PilotNet(len(routes))
    training = replace(settings.training, seed=settings.seed)
    history = [_train(module, shards, training, folder, 0, progress)]
    for number in range(1, settings.dagger_rounds + 1):
        shards += _visit(module, used, routes, settings, number, folder, progress)
        again = replace(
            training,
            epochs=settings.dagger_epochs,
            learning_rate=settings.dagger_rate,
            seed=settings.seed + number,
        )
        history.append(_train(module, shards, again, folder, number, progress))
    card = validate(module, [pair[0] for pair in worlds], routes, settings, progress)
    return Imitated(module, history, card)


def validate(
    module: PilotNet,
    worlds: Sequence[World],
    routes: Sequence[Route],
    settings: ImitationSettings,
    progress: OnStage = lambda stage, done, total, state: None,
) -> dict[str, Any]:
    """Drive all routes in all worlds and return the card."""
    validation = replace(settings.validation, seed=settings.seed)
    drives = drive_routes(
        TorchPolicy(module),
        worlds,
        routes,
        validation,
        lambda done, total: progress(
            "closed loop", done, total, f"step {done}/{total}"
        ),
    )
    card = policy_card(drives, routes, validation.car_width_m)
    return {"schema": 1, "settings": asdict(validation), **card}


def _visit(
    module: PilotNet,
    worlds: Sequence[tuple[World, str]],
    routes: Sequence[Route],
    settings: ImitationSettings,
    number: int,
    folder: Path,
    progress: OnStage,
) -> list[Path]:
    """Collect one DAgger round in all worlds."""
    shards: list[Path] = []
    policy = TorchPolicy(module)
    wanted = replace(
        settings.collecting, frames=settings.dagger_frames, seed=settings.seed + number
    )
    for world, origin in worlds:
        with one_thread():
            shards += collect_visited(
                world,
                routes,
                policy,
                wanted,
                folder / f"round_{number}",
                json.dumps({"world": origin, "policy": _digest(module)}),
                progress=_frames_of(progress, f"round {number}, {world.name}"),
            )
    return shards


def _train(
    module: PilotNet,
    shards: Sequence[Path],
    settings: TrainSettings,
    folder: Path,
    number: int,
    progress: OnStage,
) -> list[dict[str, float]]:
    """Train once, with a checkpoint after each epoch."""

    def step(at: Progress) -> None:
        done = (at.epoch - 1) * at.steps + at.step
        total = settings.epochs * at.steps
        state = f"epoch {at.epoch}/{settings.epochs}  loss {at.loss:.4f}"
        progress(f"training {number}", done, total, state)

    # a quarter faster on a CPU; the values do not depend on it
    module.to(memory_format=torch.channels_last)  # pyright: ignore[reportCallIssue]
    checkpoint = folder / f"checkpoint_{number}.safetensors"
    data = FrameDataset.from_folders(shards)
    return fit_policy(module, data, settings, checkpoint, progress=step)


def _frames_of(progress: OnStage, name: str) -> Callable[[int, int], None]:
    return lambda done, total: progress(name, done, total, f"{done}/{total}")


def _digest(module: PilotNet) -> str:
    """Return a checksum of all weights."""
    total = hashlib.sha256()
    for value in module.state_dict().values():
        total.update(value.contiguous().numpy().tobytes())
    return total.hexdigest()
