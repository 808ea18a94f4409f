"""Validation of a policy in training: what decides which of its epochs is best."""

from __future__ import annotations

import copy
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np
import pydantic
from typing_extensions import TypedDict

from mi_nerfattack.deploy.environment import AbstractEnvironment
from mi_nerfattack.deploy.roadside.surroundings import Surroundings
from mi_nerfattack.evaluation.evaluate import EvaluateSettings, evaluate
from mi_nerfattack.evaluation.metrics import cells
from mi_nerfattack.fields.grid import GridField
from mi_nerfattack.policy.pilotnet import PilotNet
from mi_nerfattack.policy.torch_policy import TorchPolicy
from mi_nerfattack.vehicle.route.route import Route

#: Keys of a row of a training's history.
ERROR, DEPARTED = "closed_loop_error_m", "closed_loop_drives_departed"


class Measured(TypedDict, total=False):
    """What a validation in the closed loop measures; nothing without one."""

    closed_loop_error_m: float
    closed_loop_drives_departed: int
    routes: dict[str, float]


class Epoch(Measured):
    """A row of a training's history."""

    __pydantic_config__ = pydantic.ConfigDict(extra="forbid", strict=True)  # pyright: ignore

    train_loss: float
    held_out_loss: float
    held_out_error: float
    measured: bool


class AbstractValidation(ABC):
    """Measurement of a policy besides its loss.

    Attributes:
        every: epochs from one measurement to the next; the last is always measured.
    """

    every: int

    @abstractmethod
    def measure(self, module: PilotNet) -> Measured:
        """Return what is known, for the history.

        Args:
            module: in evaluation mode; left unchanged.
        """

    @abstractmethod
    def describe(self) -> dict[str, Any]:
        """Return all that decides about the measurement, as JSON."""


@dataclass(frozen=True)
class LossAlone(AbstractValidation):
    """Measures nothing: the loss on held-out frames decides."""

    every: int = 1

    def measure(self, module: PilotNet) -> Measured:
        """Measure nothing."""
        del module
        return {}

    def describe(self) -> dict[str, Any]:
        """Return nothing."""
        return {}


@dataclass(frozen=True, eq=False)
class ClosedLoop(AbstractValidation):
    """Lets the policy drive every route in some environments, from random starts.

    The seed of the settings decides starts, places and textures, the same each time.

    Args:
        environments: with different names.
        routes: to drive.
        objects: fields of the roadside objects; may be empty.
        surroundings: of the objects; None without objects.
        settings: number of drives, starts, cases.
        every: epochs from one measurement to the next.
        progress: called with steps done and wanted.
    """

    environments: Sequence[AbstractEnvironment]
    routes: Sequence[Route]
    objects: Sequence[GridField]
    surroundings: Surroundings | None
    settings: EvaluateSettings = field(default_factory=EvaluateSettings)
    every: int = 4
    progress: Callable[[int, int], None] = lambda done, total: None

    def measure(self, module: PilotNet) -> Measured:
        """Drive; return mean error, drives departed, and the error of each route."""
        card = self.card(module)
        errors = route_errors(card)
        return {
            "closed_loop_error_m": float(np.mean(list(errors.values()))),
            "closed_loop_drives_departed": count_departed(card),
            "routes": errors,
        }

    def card(self, module: PilotNet) -> dict[str, Any]:
        """Drive, and return all figures; see `evaluation.evaluate.evaluate`."""
        # the parameters of a policy that drives are frozen
        policy = TorchPolicy(copy.deepcopy(module))
        return evaluate(
            policy,
            self.environments,
            self.routes,
            objects=self.objects,
            surroundings=self.surroundings,
            settings=self.settings,
            progress=self.progress,
        )

    def describe(self) -> dict[str, Any]:
        """Return names and settings."""
        return {
            "environments": [item.name for item in self.environments],
            "routes": [route.name for route in self.routes],
            "settings": asdict(self.settings),
            "every": self.every,
        }


_CARD = "environment", "route", "case"


def rank(row: Mapping[str, Any]) -> tuple[float, float, float]:
    """Return what is smaller for better epochs: drives departed, error in mm, loss."""
    error = round(row.get(ERROR, 0.0), 3)
    return row.get(DEPARTED, 0), error, row["held_out_loss"]


def route_errors(card: Mapping[str, Any]) -> dict[str, float]:
    """Return mean cross-track errors, metres, by "ENVIRONMENT ROUTE CASE"."""
    return {
        " ".join(case[name] for name in _CARD): case["cross_track_mean_m"]
        for case in cells(card, *_CARD)
    }


def count_departed(card: Mapping[str, Any]) -> int:
    """Return the number of drives of a card that left their lane."""
    return sum(case["drives_departed"] for case in cells(card, *_CARD))
