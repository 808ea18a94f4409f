"""How a network is told the goal: as a number, as a one-hot row, or not at all."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Literal

import torch

from mi_nerfattack.errors import InputError
from mi_nerfattack.ranges import Count, checked


class AbstractGoal(ABC):
    """Turn goals into the network's arguments after the image."""

    @abstractmethod
    def arguments(
        self, goals: torch.Tensor, like: torch.Tensor
    ) -> tuple[torch.Tensor, ...]:
        """Encode goals.

        Args:
            goals: (n,) int64.
            like: gives precision and device of floating arguments.

        Raises:
            InputError: a goal that the network does not have.
        """


@dataclass(frozen=True)
@checked("goals")
class IntegerGoal(AbstractGoal):
    """Pass the goals themselves, (n,) int64.

    Args:
        count: number of goals.
    """

    count: Count
    kind: Literal["integer"] = "integer"

    def arguments(
        self, goals: torch.Tensor, like: torch.Tensor
    ) -> tuple[torch.Tensor, ...]:
        """Check the range."""
        del like
        return (_in_range(goals, self.count),)


@dataclass(frozen=True)
@checked("goals")
class OneHotGoal(AbstractGoal):
    """Pass rows (n, count) that are one at the goal and zero elsewhere.

    Args:
        count: number of goals.
    """

    count: Count
    kind: Literal["one_hot"] = "one_hot"

    def arguments(
        self, goals: torch.Tensor, like: torch.Tensor
    ) -> tuple[torch.Tensor, ...]:
        """Check the range and spread the goals out."""
        goals = _in_range(goals, self.count)
        return (torch.nn.functional.one_hot(goals, self.count).to(like),)


@dataclass(frozen=True)
@checked()
class NoGoal(AbstractGoal):
    """Pass nothing: every route is driven by the image alone."""

    kind: Literal["none"] = "none"

    def arguments(
        self, goals: torch.Tensor, like: torch.Tensor
    ) -> tuple[torch.Tensor, ...]:
        """Drop the goals."""
        del goals, like
        return ()


def declared_goal(module: torch.nn.Module) -> AbstractGoal:
    """Return how a module takes the goal that nobody describes: the one default.

    A module whose attribute `goals` is an integer takes one of that many goals as an
    integer, as `PilotNet` does. A module without this attribute takes the image alone.

    Raises:
        InputError: `goals` is no integer of at least 1.
    """
    count = getattr(module, "goals", None)
    if count is None:
        return NoGoal()
    if not isinstance(count, int):
        raise InputError(
            f"{type(module).__name__}.goals: a {type(count).__name__}; an integer of "
            "at least 1, or say how the goal is passed: goal=NoGoal(), in a scenario "
            'policy.goal.kind = "none"'
        )
    return IntegerGoal(count)


def _in_range(goals: torch.Tensor, count: int) -> torch.Tensor:
    if ((goals < 0) | (goals >= count)).any():
        raise InputError(
            f"goal: {goals.tolist()}; at least 0 and below {count}, the number of the "
            "policy's goals: give the route one of these"
        )
    return goals
