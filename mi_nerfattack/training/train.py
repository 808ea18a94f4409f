"""Imitation of an expert by supervised learning."""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch

from mi_nerfattack.backend.versions import versions
from mi_nerfattack.deploy.sites import AbstractSite
from mi_nerfattack.errors import InputError
from mi_nerfattack.io.resumable import Record, Unit, array_digest, flatten
from mi_nerfattack.policy.pilotnet import IMAGE_SHAPE, PilotNet
from mi_nerfattack.ranges import Count, Fraction, checked
from mi_nerfattack.training.augment import Augmentation
from mi_nerfattack.training.dataset import FrameDataset
from mi_nerfattack.training.validation import (
    AbstractValidation,
    Epoch,
    LossAlone,
    Measured,
    rank,
)

FORMAT = "mi_nerfattack training checkpoint 1"
_REMEDY = "restore what differs, or remove the file to train again"


class TrainRecord(Record):
    """The epochs that are done."""

    history: list[Epoch]


@dataclass(frozen=True)
@checked("TrainSettings")
class TrainSettings:
    """Choices of a training run; the same settings and data give the same policy.

    Args:
        epochs: passes over the training rows.
        batch: images a step.
        learning_rate: largest rate; warms up linearly over a twentieth of the steps,
            then falls along a cosine to a hundredth.
        weight_decay: of AdamW.
        held_out: fraction of rows kept for validation, unless there are others.
        seed: of the split, the order and the augmentation.
        augmentation: changes of the training images.
    """

    epochs: Count = 10
    batch: Count = 128
    learning_rate: Fraction = 1e-3
    weight_decay: float = 1e-4
    held_out: Fraction = 0.1
    seed: int = 0
    augmentation: Augmentation = field(default_factory=Augmentation)


@dataclass(frozen=True)
class Progress:
    """What is known after a step: epoch and step from 1, loss of the step."""

    epoch: int
    step: int
    steps: int
    loss: float


def fit_policy(
    module: PilotNet,
    data: FrameDataset,
    settings: TrainSettings,
    checkpoint: str | Path | None = None,
    device: str = "cpu",
    progress: Callable[[Progress], None] | None = None,
    held_out: FrameDataset | None = None,
    validation: AbstractValidation | None = None,
) -> list[Epoch]:
    """Train a policy and leave the weights of its best epoch in it.

    The best epoch has the fewest departed drives in the closed loop. Of several such
    epochs, the least mean error decides, to a millimetre, and then the least held-out
    loss. Without a validation in the closed loop, the loss alone decides.

    The loss is the mean squared difference of control divided by the largest
    control. With a checkpoint, each epoch ends by writing it atomically, and a run
    with the same settings, data and first weights continues after the last whole epoch.

    Args:
        module: changed in place; ends on the CPU in evaluation mode.
        data: frames, goals, expert controls (rad/s).
        settings: of the training.
        checkpoint: safetensors file of the whole state, or None.
        device: torch device of the computation.
        progress: called after each step; an exception from it ends the training.
        held_out: frames of another collection for the loss, instead of a part of
            `data`.
        validation: in the closed loop; None for none.

    Returns:
        A row for each epoch: `train_loss`, `held_out_loss`, `held_out_error` (the mean
        absolute error in rad/s), and what the validation measured.

    Raises:
        InputError: goals or controls out of the policy's range; a checkpoint of
            other settings, data or first weights; a loss that is not finite.
    """
    check_labels(module, data)
    if held_out is None:
        train_rows, held_rows = data.split(settings.held_out, settings.seed)
        held = Part(data, held_rows)
    else:
        check_labels(module, held_out)
        train_rows, held = np.arange(len(data)), Part.of_all(held_out)
    module.to(device).requires_grad_(True)
    split = Part(data, train_rows), held
    run = _Run(module, split, settings, device, validation or LossAlone(), checkpoint)
    run.restore()
    for epoch in range(len(run.history), settings.epochs):
        train_loss = run.epoch(epoch, progress)
        held_loss, held_error = run.validate()
        run.record(train_loss, held_loss, held_error)
        run.save()
    module.load_state_dict(run.best)
    module.to("cpu").eval()
    return run.history


@dataclass(frozen=True, eq=False)
class Part:
    """Rows (k,) of a dataset."""

    data: FrameDataset
    rows: np.ndarray

    @classmethod
    def of_all(cls, data: FrameDataset) -> Part:
        """Take all rows of a dataset."""
        return cls(data, np.arange(len(data)))

    def describe(self) -> list[Any]:
        """Return the number of rows and the checksum of the data."""
        return [len(self.rows), self.data.digest]


class _Run:
    """State of a training run: weights, best weights, optimiser, history."""

    def __init__(
        self,
        module: PilotNet,
        split: tuple[Part, Part],
        settings: TrainSettings,
        device: str,
        validation: AbstractValidation,
        checkpoint: str | Path | None,
    ) -> None:
        self.module, self.settings, self.validation = module, settings, validation
        self.part, self.held = split
        self.device = torch.device(device)
        self.steps = -(-len(self.part.rows) // settings.batch)
        self.optimiser = torch.optim.AdamW(
            module.parameters(),
            lr=settings.learning_rate,
            weight_decay=settings.weight_decay,
        )
        self.best = copy.deepcopy(module.state_dict())
        self.history: list[Epoch] = []
        self.checkpoint: Unit[TrainRecord] | None = None
        if checkpoint is not None:
            path = Path(checkpoint)
            self.checkpoint = Unit(path, self._identity(), TrainRecord, remedy=_REMEDY)

    def epoch(self, epoch: int, progress: Callable[[Progress], None] | None) -> float:
        """Pass over the rows once, in an order that depends on seed and epoch."""
        entropy = [self.settings.seed, epoch]
        order = np.random.default_rng(entropy).permutation(self.part.rows)
        generator = torch.Generator(self.device)
        generator.manual_seed(int(np.random.SeedSequence(entropy).generate_state(1)[0]))
        self.module.train()
        losses = []
        for step in range(self.steps):
            chosen = order[step * self.settings.batch :][: self.settings.batch]
            self._set_rate(epoch * self.steps + step)
            frames, goal, control = self._batch(self.part.data, chosen)
            image = self.settings.augmentation.apply(frames, generator)
            loss = self._error(image, goal, control).square().mean()
            self.optimiser.zero_grad()
            loss.backward()
            self.optimiser.step()
            losses.append(loss.item())
            if not np.isfinite(losses[-1]):
                raise InputError(
                    f"epoch {epoch + 1}, step {step + 1}: the loss is {losses[-1]}; "
                    f"lower learning_rate = {self.settings.learning_rate}"
                )
            if progress is not None:
                progress(Progress(epoch + 1, step + 1, self.steps, loss=losses[-1]))
        return float(np.mean(losses))

    @torch.no_grad()
    def validate(self) -> tuple[float, float]:
        """Compute the held-out loss and the mean absolute error in rad/s."""
        self.module.eval()
        rows, errors = self.held.rows, []
        for start in range(0, len(rows), 256):
            chosen = rows[start : start + 256]
            frames, goal, control = self._batch(self.held.data, chosen)
            image = frames.permute(0, 3, 1, 2).float().div_(255)
            errors.append(self._error(image, goal, control))
        error = torch.cat(errors)
        mean = error.abs().mean() * self.module.max_control
        return error.square().mean().item(), mean.item()

    def record(self, train_loss: float, held_loss: float, held_error: float) -> None:
        """Append an epoch to the history and keep its weights if they are best.

        Only epochs that are measured can be best.
        """
        number, every = len(self.history) + 1, self.validation.every
        due = number % every == 0 or number == self.settings.epochs
        measured: Measured = self.validation.measure(self.module) if due else {}
        row: Epoch = {
            "train_loss": train_loss,
            "held_out_loss": held_loss,
            "held_out_error": held_error,
            "measured": due,
            **measured,
        }
        previous = [rank(older) for older in self.history if older["measured"]]
        if due and (not previous or rank(row) < min(previous)):
            self.best = copy.deepcopy(self.module.state_dict())
        self.history.append(row)

    def save(self) -> None:
        """Write the state after a whole epoch."""
        if self.checkpoint is None:
            return
        tensors = {f"last.{k}": v for k, v in self.module.state_dict().items()}
        tensors |= {f"best.{k}": v for k, v in self.best.items()}
        for index, state in self.optimiser.state_dict()["state"].items():
            tensors |= {f"adam.{index}.{k}": v for k, v in state.items()}
        arrays = {name: value.cpu().numpy() for name, value in tensors.items()}
        self.checkpoint.write(arrays, TrainRecord(history=self.history))

    def restore(self) -> None:
        """Read what `save` wrote, where there is something."""
        checkpoint = None if self.checkpoint is None else self.checkpoint.read()
        if checkpoint is None:
            return
        groups: dict[str, dict[str, torch.Tensor]] = {}
        for name, value in checkpoint.tensors.items():
            group, _, suffix = name.partition(".")
            groups.setdefault(group, {})[suffix] = torch.from_numpy(value)
        self.module.load_state_dict(groups["last"])
        self.best = groups["best"]
        state = self.optimiser.state_dict()
        for name, value in groups["adam"].items():
            index, _, key = name.partition(".")
            state["state"].setdefault(int(index), {})[key] = value
        self.optimiser.load_state_dict(state)
        self.history = checkpoint.record.history

    def _identity(self) -> dict[str, str]:
        """Describe all on which a continued run must agree."""
        identity = {
            "version": versions(),
            "settings": asdict(self.settings),
            "validation": self.validation.describe(),
            "rows": self.part.describe(),
            "held_out": self.held.describe(),
            "start": _digest_weights(self.module),
            "goals": self.module.goals,
            "max_control": self.module.max_control,
        }
        tables = [flatten(name, value) for name, value in identity.items()]
        return {
            "format": FORMAT,
            **{k: v for table in tables for k, v in table.items()},
        }

    def _batch(self, data: FrameDataset, rows: np.ndarray) -> tuple[torch.Tensor, ...]:
        """Read frames (uint8), goals and controls in [-1, 1] onto the device."""
        frames = torch.from_numpy(data.read_frames(rows)).to(self.device)
        goal = torch.from_numpy(data.goals[rows]).to(self.device)
        control = torch.from_numpy(data.controls[rows]).to(self.device)
        return frames, goal, control / self.module.max_control

    def _error(
        self, image: torch.Tensor, goal: torch.Tensor, control: torch.Tensor
    ) -> torch.Tensor:
        """Compute the difference from the expert, (n,), in units of max_control."""
        return self.module(image, goal) / self.module.max_control - control

    def _set_rate(self, step: int) -> None:
        """Set the learning rate of a step counted from the run's beginning."""
        total = self.steps * self.settings.epochs
        warm = min(1.0, (step + 1) / max(1, total // 20))
        fall = 0.505 + 0.495 * np.cos(np.pi * step / total)
        for group in self.optimiser.param_groups:
            group["lr"] = self.settings.learning_rate * warm * fall


def _digest_weights(module: PilotNet) -> str:
    return array_digest(value.cpu().numpy() for value in module.state_dict().values())


def check_labels(module: PilotNet, data: FrameDataset) -> None:
    """Raise `InputError` for goals or controls that the policy cannot express."""
    low, high = int(data.goals.min()), int(data.goals.max())
    if low < 0 or high >= module.goals:
        raise InputError(f"goals: {low} to {high}; at least 0 and below {module.goals}")
    if data.controls.ndim > 1:
        raise InputError(
            f"controls: {data.controls.shape[1]} of each frame; PilotNet gives one: "
            "train a network of your own on these frames"
        )
    largest: Any = np.abs(data.controls).max()
    # rounded alike: NumPy 1 compares in double precision
    if largest > np.float32(module.max_control):
        raise InputError(
            f"controls: up to {largest:.3g} rad/s; at most {module.max_control}"
        )


def check_site(site: AbstractSite) -> None:
    """Raise `InputError` unless PilotNet takes a site's images, and drives its car."""
    if controls := site.car.more_controls:
        names = ", ".join(control.name for control in controls)
        raise InputError(
            f"car of {site.name!r}: takes {names} besides its steering; PilotNet gives "
            "the steering alone: collect frames alone ('mi-nerfattack train "
            "--frames-only') and train your own network"
        )
    height, width = IMAGE_SHAPE
    if site.rig.size != (width, height):
        wide, high = site.rig.size
        raise InputError(
            f"camera of {site.name!r}: {wide} x {high} px; PilotNet "
            f"takes {width} x {height}: change the camera, or collect frames alone "
            "('mi-nerfattack train --frames-only') and train your own network"
        )
