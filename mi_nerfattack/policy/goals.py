"""How a network is told the goal: as a number, as a one-hot row, or not at all."""

from __future__ import annotations

from abc import ABC, abstractmethod

import torch

from mi_nerfattack.errors import InputError


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


class IntegerGoal(AbstractGoal):
    """Pass the goals themselves, (n,) int64.

    Args:
        count: number of goals, at least 1.
    """

    def __init__(self, count: int) -> None:
        self.count = _checked(count)

    def arguments(
        self, goals: torch.Tensor, like: torch.Tensor
    ) -> tuple[torch.Tensor, ...]:
        """Check the range."""
        del like
        return (_in_range(goals, self.count),)


class OneHotGoal(AbstractGoal):
    """Pass rows (n, count) that are one at the goal and zero elsewhere.

    Args:
        count: number of goals, at least 1.
    """

    def __init__(self, count: int) -> None:
        self.count = _checked(count)

    def arguments(
        self, goals: torch.Tensor, like: torch.Tensor
    ) -> tuple[torch.Tensor, ...]:
        """Check the range and spread the goals out."""
        goals = _in_range(goals, self.count)
        return (torch.nn.functional.one_hot(goals, self.count).to(like),)


class NoGoal(AbstractGoal):
    """Pass nothing: every route is driven by the image alone."""

    def arguments(
        self, goals: torch.Tensor, like: torch.Tensor
    ) -> tuple[torch.Tensor, ...]:
        """Drop the goals."""
        del goals, like
        return ()


def _checked(count: int) -> int:
    if type(count) is not int or count < 1:
        raise InputError(f"goals: {count!r}; an integer of at least 1")
    return count


def _in_range(goals: torch.Tensor, count: int) -> torch.Tensor:
    if ((goals < 0) | (goals >= count)).any():
        raise InputError(
            f"goal: {goals.tolist()}; at least 0 and below {count}, the number of the "
            "policy's goals: give the route one of these"
        )
    return goals
