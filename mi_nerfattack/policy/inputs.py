"""The inputs of a network, their order, and the form in which it gets the goal."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

import torch

from mi_nerfattack.errors import InputError
from mi_nerfattack.policy.base import Numbers
from mi_nerfattack.ranges import Count, checked

#: What the image is called where a vehicle has one camera.
IMAGE = "image"
GOAL = "goal"
#: Names of what `Numbers` has.
NUMBERS = ("speed", "route", "time")


@dataclass(frozen=True)
class Inputs:
    """The arguments of a network, in their order.

    Args:
        names: of cameras, of numbers ("speed", (n, 1); "route", (n, k, 2), forward and
            left; "time", (n, 1)), and "goal". Left out, the images and the goal.
        numbers: what the closed loop gives; the action may need more than the network.
        views: rows and columns of each camera's image in the frame, by its name; left
            out, the frame is the only image.

    Raises:
        InputError: a name that is none of these, or no image.
    """

    names: tuple[str, ...] = ()
    numbers: Numbers = Numbers()
    views: Mapping[str, tuple[slice, slice]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        cameras = tuple(self.views) or (IMAGE,)
        if taken := set(cameras) & set(NUMBERS + (GOAL,)):
            raise InputError(
                f"cameras: {', '.join(sorted(taken))} is another input of a policy; "
                "give the camera another name"
            )
        known = (*cameras, *NUMBERS, GOAL)
        missing = {*NUMBERS} - {*self.numbers.columns}
        for name in self.names:
            if name not in known or name in missing or self.names.count(name) > 1:
                raise InputError(
                    f"policy.inputs: {name!r}; each of {', '.join(known)} at most once"
                )
        if self.names and not set(self.names) & set(cameras):
            raise InputError(f"policy.inputs: no image; one of {', '.join(cameras)}")

    @property
    def images(self) -> tuple[str, ...]:
        """Names of the images that the network takes, in its order."""
        cameras = tuple(self.views) or (IMAGE,)
        return tuple(name for name in self.names or cameras if name in cameras)

    def pictures(self, frame: torch.Tensor) -> dict[str, torch.Tensor]:
        """Take a frame (n, height, width, 3) apart into the images of the network.

        Raises:
            InputError: the frame is not as large as the images side by side.
        """
        if not self.views:
            return {IMAGE: frame}
        high = max(rows.stop for rows, _ in self.views.values())
        wide = max(columns.stop for _, columns in self.views.values())
        if tuple(frame.shape[1:3]) != (high, wide):
            raise InputError(
                f"frame: {frame.shape[2]} x {frame.shape[1]} px; the images of "
                f"{', '.join(self.views)} side by side have {wide} x {high} px"
            )
        every = slice(None)
        return {name: frame[(every, *self.views[name])] for name in self.images}

    def arguments(
        self,
        images: Mapping[str, torch.Tensor],
        goals: tuple[torch.Tensor, ...],
        numbers: torch.Tensor | None,
    ) -> tuple[torch.Tensor, ...]:
        """Put the arguments of a network in order.

        Args:
            images: by name.
            goals: the goal as the network takes it, or none.
            numbers: (n, k), columns of `Numbers`.
        """
        columns = self.by_name(numbers)
        names = self.names or (*images, GOAL)
        arguments: list[torch.Tensor] = []
        for name in names:
            if name == GOAL:
                arguments += goals
            else:
                arguments.append(images[name] if name in images else columns[name])
        return tuple(arguments)

    def by_name(self, numbers: Any) -> dict[str, Any]:
        """Return columns (n, k) of torch or NumPy by name, of points as (n, k, 2).

        Raises:
            InputError: none are given, where the policy asks for some.
        """
        if not self.numbers:
            return {}
        if numbers is None or numbers.shape[-1] != self.numbers.size:
            shape = None if numbers is None else tuple(numbers.shape)
            raise InputError(
                f"policy: it asks for {', '.join(self.numbers.columns)}, "
                f"{self.numbers.size} numbers, and gets {shape}; this way of driving "
                "it does not know them"
            )
        named_columns = {
            k: numbers[:, columns] for k, columns in self.numbers.columns.items()
        }
        if "route" in named_columns:
            named_columns["route"] = named_columns["route"].reshape(len(numbers), -1, 2)
        return named_columns


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
