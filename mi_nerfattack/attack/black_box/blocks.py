"""Random search over blocks of a texture."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mi_nerfattack.attack.black_box.search import AbstractSearch, Proposal, propose
from mi_nerfattack.attack.texture.colours import Colours
from mi_nerfattack.errors import InputError
from mi_nerfattack.fields.grid import GridField

#: Shares of the budget after which blocks have half the volume.
_HALVED_AT = np.array([1, 5, 20, 50, 100, 200, 400, 600, 800]) / 1000
#: Blocks along an edge of the first proposal.
_FIRST = 4


class BlockSearch(AbstractSearch):
    """Gives blocks of an object new colours, and keeps what is better.

    A block is a cube of the lattice around a part of the object; each channel becomes 0
    or 1, projected onto what is allowed. Its volume halves as the budget is spent. The
    first proposal is made of blocks all over.

    Args:
        colourings: of the objects.
        fields: of the objects.
        proposals: that the budget allows.
        share: of the lattice that the first block takes.
        seed: of all draws.

    Raises:
        InputError: `proposals` or `share` is out of range.

    Source: Square Attack (Andriushchenko et al., ECCV 2020), with cubes for squares.
    """

    def __init__(
        self,
        colourings: Sequence[Colours],
        fields: Sequence[GridField],
        proposals: int,
        share: float = 0.3,
        seed: int = 0,
    ) -> None:
        if proposals < 1 or not 0 < share <= 1:
            raise InputError(
                f"BlockSearch: {proposals} proposals, share {share}; at least one "
                "proposal, and a share above 0 and up to 1"
            )
        self.colourings = colourings
        self._proposals, self._share = proposals, share
        self._rng = np.random.default_rng([seed, 5])
        self._cells = [field.occupancy.cells for field in fields]
        self._occupied = [np.argwhere(cells) for cells in self._cells]
        self._best = [colouring.start for colouring in colourings]
        self._asked = self._best
        self._least = np.inf
        self._count = 0

    def ask(self) -> Proposal:
        """See :meth:`AbstractSearch.ask`."""
        # Blocks all over first; then one new block on the best colours so far
        asked = [value.copy() for value in self._best]
        if self._count == 0:
            for index, colouring in enumerate(self.colourings):
                asked[index] = self._scatter(colouring)
        else:
            self._change(asked)
        self._asked = [
            colouring.project(value)
            for colouring, value in zip(self.colourings, asked, strict=True)
        ]
        return propose(self.colourings, self._asked)

    def tell(self, objective: float) -> None:
        """See :meth:`AbstractSearch.tell`."""
        self._count += 1
        if objective < self._least:
            self._best, self._least = self._asked, objective

    def _scatter(self, colouring: Colours) -> np.ndarray:
        edge = colouring.level.resolution
        # One random colour for each block; every vertex takes its block's colour
        coarse = self._rng.integers(0, 2, (_FIRST,) * 3 + (3,)).astype(np.float32)
        at = np.arange(edge) * _FIRST // edge
        return coarse[np.ix_(at, at, at)].reshape(-1, 3)

    def _change(self, values: list[np.ndarray]) -> None:
        chosen = int(self._rng.integers(len(values)))
        edge = self.colourings[chosen].level.resolution
        # The volume of a block halves as the budget is spent
        halvings = int((self._count / self._proposals >= _HALVED_AT).sum())
        side = max(1, round(edge * float(np.cbrt(self._share / 2**halvings))))
        # The middle is a random point of an occupied cell; the lattice is by z, y, x
        occupied = self._occupied[chosen]
        cell = occupied[self._rng.integers(len(occupied))]
        middle = (cell + self._rng.uniform(size=3)) / self._cells[chosen].shape
        first = np.rint(middle * (edge - 1) - (side - 1) / 2).astype(int)[::-1]
        first = np.clip(first, 0, edge - side)
        cube = values[chosen].reshape(edge, edge, edge, 3)
        z, y, x = (slice(start, start + side) for start in first)
        cube[z, y, x] = self._rng.integers(0, 2, 3)
