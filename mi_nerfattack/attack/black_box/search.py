"""Attacks that only drive: what they propose, what it gave, and at what cost."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import astuple, dataclass, fields, replace

import numpy as np

from mi_nerfattack.attack.base import best_so_far
from mi_nerfattack.attack.texture.colours import Colours
from mi_nerfattack.errors import InputError
from mi_nerfattack.rollout.loop import OnStep

#: (n_vertices, 3) raw colours an object.
Textures = list[np.ndarray]


@dataclass(frozen=True, eq=False)
class Proposal:
    """What is to be judged.

    Attributes:
        textures: (n_vertices, 3) raw colours an object.
        penalty: of their colours, which is added to the objective.
    """

    textures: Textures
    penalty: float = 0.0


def propose(colourings: Sequence[Colours], colours: Sequence[np.ndarray]) -> Proposal:
    """Return what colours (n, 3) of each object make, whatever they cost."""
    pairs = list(zip(colourings, colours, strict=True))
    penalty = sum(colouring.penalty(value) for colouring, value in pairs)
    return Proposal([colouring.texture(value) for colouring, value in pairs], penalty)


class AbstractSearch(ABC):
    """Proposes textures, one after the other, and takes the objective of each.

    Proposals depend only on the seed and on the objectives so far. So a new search that
    takes the same objectives continues exactly as the first search would.
    """

    @abstractmethod
    def ask(self) -> Proposal:
        """Return what is to be judged next."""

    @abstractmethod
    def tell(self, objective: float) -> None:
        """Take the objective of what was asked last, penalty and all."""


@dataclass(frozen=True)
class Judged:
    """What textures gave.

    Attributes:
        objective: what is minimised.
        cross_track_mean_m: mean ``|e|`` over steps and drives, metres.
        cross_track_max_m: largest ``|e|``, metres.
        frames: that were rendered for it.
    """

    objective: float
    cross_track_mean_m: float
    cross_track_max_m: float
    frames: int


#: Drives with textures; told after each control period.
Judge = Callable[[Textures, OnStep | None], Judged]


class BlackBoxAttack:
    """Minimise an objective by proposals alone, within a number of rendered frames.

    Needs no derivative, of renderer, policy or vehicle, and works in any environment.

    Args:
        search: makes the proposals; new.
        judge: drives with them.
        frames: budget; the judgement that reaches it is the last.

    Attributes:
        history: a judgement each.
        best: textures of the one with the least objective; None before the first.
    """

    def __init__(self, search: AbstractSearch, judge: Judge, frames: int) -> None:
        if frames < 1:
            raise InputError(f"frames: {frames}; at least 1")
        self.search, self.judge, self.budget = search, judge, frames
        self.history: list[Judged] = []
        self.best: Textures | None = None

    @property
    def frames(self) -> int:
        """Frames rendered so far."""
        return sum(judged.frames for judged in self.history)

    @property
    def is_over(self) -> bool:
        """Whether the budget is spent."""
        return self.frames >= self.budget

    def step(self, on_step: OnStep | None = None) -> Judged:
        """Judge one proposal.

        Raises:
            InputError: the objective is not finite.
        """
        # Propose, drive, and add what the search charges for the proposal itself.
        asked = self.search.ask()
        judged = self.judge(asked.textures, on_step)
        judged = replace(judged, objective=judged.objective + asked.penalty)
        if not np.isfinite(judged.objective):
            raise InputError(f"objective: {judged.objective}; check the judge for NaN")
        self._take(asked, judged)
        return judged

    def _take(self, asked: Proposal, judged: Judged) -> None:
        least = min((past.objective for past in self.history), default=np.inf)
        if judged.objective < least:
            self.best = asked.textures
        self.search.tell(judged.objective)
        self.history.append(judged)

    def curve(self) -> np.ndarray:
        """Return the best objective so far and its cost, one row per judgement.

        Returns:
            (n, 3): see ``best_so_far``.
        """
        frames = np.cumsum([judged.frames for judged in self.history])
        objectives = [judged.objective for judged in self.history]
        means = [judged.cross_track_mean_m for judged in self.history]
        return best_so_far(frames.tolist(), objectives, means)

    def tensors(self) -> dict[str, np.ndarray]:
        """Return what :meth:`load_tensors` needs: the history."""
        rows = np.array([astuple(judged) for judged in self.history], np.float64)
        return {"history": rows.reshape(-1, len(fields(Judged)))}

    def load_tensors(self, tensors: dict[str, np.ndarray]) -> None:
        """Replay the history of another search of this kind and seed in a new search.

        Raises:
            InputError: the tensor does not have the shape of a history.
            KeyError: there is no history.
        """
        rows = tensors["history"]
        if rows.ndim != 2 or rows.shape[1] != len(fields(Judged)):
            raise InputError(f"history: shape {rows.shape}; (n, {len(fields(Judged))})")
        # A new search of the same seed makes the same proposals, if it learns the same
        # objectives in the same order. So nobody drives again.
        for objective, mean, largest, frames in rows.tolist():
            judged = Judged(objective, mean, largest, int(frames))
            self._take(self.search.ask(), judged)
