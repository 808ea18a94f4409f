"""Random textures and poses: what an attack is compared with, at its own cost."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mi_nerfattack.attack.base import Freedom
from mi_nerfattack.attack.black_box.search import AbstractSearch, Proposal, propose
from mi_nerfattack.attack.texture.colours import Colours
from mi_nerfattack.errors import InputError
from mi_nerfattack.fields.grid import GridField
from mi_nerfattack.fields.random_textures import random_texture
from mi_nerfattack.rollout.function import Rollout
from mi_nerfattack.rollout.loop import OnStep


@dataclass(frozen=True, eq=False)
class RandomLooks:
    """Draws of all that an attack may change, by their numbers from 0.

    Args:
        fields: of the objects.
        freedom: what the attack may change.
        kind: of textures, see `random_texture`.
        seed: of all draws.
    """

    fields: Sequence[GridField]
    freedom: Freedom
    kind: str
    seed: int

    def textures(self, number: int) -> list[np.ndarray] | None:
        """Return a texture an object, None if the attack leaves textures alone."""
        if self.freedom.texture_rate is None:
            return None
        # A draw depends on the seed and on its number, not on the draws before it
        sequence = np.random.SeedSequence([self.seed, 1, number])
        seeds = sequence.generate_state(len(self.fields))
        return [
            random_texture(grid, self.kind, int(seed))
            for grid, seed in zip(self.fields, seeds, strict=True)
        ]

    def offsets(self, number: int) -> np.ndarray | None:
        """Return offsets (k, 6), uniform within the attack's limits, or None."""
        if self.freedom.pose_rate is None:
            return None
        rng = np.random.default_rng([self.seed, 3, number])
        limit = np.repeat([self.freedom.limit_m, self.freedom.limit_rad], 3)
        drawn = rng.uniform(-limit, limit, (len(self.fields), 6))
        return self.freedom.project(drawn)


class RandomSearch(AbstractSearch):
    """Proposes random textures, by their numbers; what they give changes nothing.

    Args:
        looks: the draws.
        colourings: of the objects. Where they limit colours, a draw moves to the
            nearest colours that are allowed, and has their penalty.

    Raises:
        InputError: they leave textures alone.
    """

    def __init__(self, looks: RandomLooks, colourings: Sequence[Colours] = ()) -> None:
        if looks.freedom.texture_rate is None:
            raise InputError("RandomSearch: textures may not change")
        self.looks = looks
        self.colourings = colourings
        self._number = 0

    def ask(self) -> Proposal:
        """See :meth:`AbstractSearch.ask`."""
        textures = self.looks.textures(self._number)
        assert textures is not None  # textures may change
        if not any(colouring.is_limited for colouring in self.colourings):
            return Proposal(textures)
        pairs = zip(self.colourings, textures, strict=True)
        colours = [colouring.near(texture) for colouring, texture in pairs]
        return propose(self.colourings, colours)

    def tell(self, objective: float) -> None:
        """See :meth:`AbstractSearch.tell`."""
        del objective
        self._number += 1


def equal_count(iterations: float, backward_multiple: float) -> int:
    """Return the number of drives that cost as much as an attack's iterations.

    Args:
        iterations: each has one drive and one backward pass through it.
        backward_multiple: cost of the backward pass, in drives.
    """
    return max(1, round(iterations * (1 + backward_multiple)))


def judge(rollout: Rollout, initial: np.ndarray, on_step: OnStep | None) -> float:
    """Return an attack's objective for what its sensor shows; costs one drive.

    Args:
        rollout: of the attack.
        initial: (m, n) that it starts from.
        on_step: called after each control period with its index.

    Raises:
        InputError: the objective is not finite.
    """
    return float(rollout.measure(initial, on_step).value)
